"""How close do the methods come to the true constrained law?

    python tests/benchmarks/studies/oracle.py [--n 500] [--batches 5] [--seed 0]
        [--constraints corner,disc] [--runs latent] [--n-steps 64] [--json FILE]

The laws have exact scores, and the constrained laws are sampled by rejection
(tests/sampling/oracle.py). Every number is a mean over the batches with its standard error; one
batch is n plans and n true samples. All runs of a batch share noise and truth, so the gain is
paired: the energy distance of `projected recommended` less that of the run.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[3]))
from cdiff_cli.evaluation import metrics
from tests.sampling.oracle import (
    CONSTRAINTS,
    energy_distance,
    execute,
    jump_limit,
    measure,
    problem,
    recipe_runs,
    route_shares,
    three_routes,
    variant_runs,
)

REFERENCE = "projected recommended"

parser = argparse.ArgumentParser()
parser.add_argument("--n", type=int, default=500)
parser.add_argument("--batches", type=int, default=5)
parser.add_argument(
    "--seed", type=int, default=0, help="of the truth and the noise; other seeds share neither"
)
parser.add_argument("--n-steps", type=int, default=64, help="of the cosine schedule")
parser.add_argument("--constraints", default=",".join(CONSTRAINTS))
parser.add_argument(
    "--runs",
    default="",
    help="only runs whose name contains one of these (the reference always runs)",
)
parser.add_argument("--json", type=Path)


def mean(values):
    """(mean, standard error) over the batches."""
    v = np.asarray(values, dtype=float)
    return float(v.mean()), float(v.std(ddof=1) / np.sqrt(len(v))) if len(v) > 1 else float("nan")


def show(values, digits=4):
    return "{:.{d}f} ± {:.{d}f}".format(*mean(values), d=digits)


def percent(values):
    return f"{100 * float(np.mean(values)):.1f}"


def seeds_of(seed, batch, n):
    return range(1_000_000 * seed + 10_000 * batch, 1_000_000 * seed + 10_000 * batch + n)


def bench(law, name, wanted, n, batches, seed, n_steps):
    """The table of all runs under one constraint, and its rows."""
    g = CONSTRAINTS[name]
    at = problem(law, g, n_steps)
    rng = torch.Generator().manual_seed(seed)
    reference_truth, acceptance = law.truth(g, 20_000, rng)
    limit = jump_limit(reference_truth)
    runs = [
        r
        for r in (*recipe_runs(), *variant_runs(at))
        if r.name == REFERENCE or any(w in r.name for w in wanted)
    ]
    rows = {run.name: [] for run in runs}
    floor = []
    for batch in range(batches):
        truth, _ = law.truth(g, n, rng)
        floor.append(energy_distance(law.truth(g, n, rng)[0], truth))
        seeds = seeds_of(seed, batch, n)
        x_free, _ = execute(recipe_runs()[0], at, seeds)
        for run in runs:
            x, calls = execute(run, at, seeds)
            rows[run.name].append(measure(law, g, x, x_free, truth, limit) | {"calls": calls})
    shares = " ".join(percent(v) for v in route_shares(law, reference_truth))
    unsafe = percent(metrics.worst_segment(g, reference_truth) > 0)
    table = Table(
        title=f"{name}: acceptance {percent(acceptance)} %, floor {show(floor)} m, {batches} x {n} plans; "
        f"the truth: routes {shares} %, {unsafe} % unsafe on segments, torn beyond {limit:.3f} m"
    )
    heads = [
        "run",
        "energy / m",
        "gain / m",
        "within routes",
        "unsafe %",
        "segments %",
        "torn %",
        "routes %",
    ]
    for head in (*heads, "distance / m", "calls"):
        table.add_column(head, justify="left" if head == "run" else "right", no_wrap=True)
    for run, found in rows.items():
        column = {key: [row[key] for row in found] for key in found[0]}
        gain = [
            ref["energy"] - row["energy"] for ref, row in zip(rows[REFERENCE], found, strict=True)
        ]
        table.add_row(
            run,
            show(column["energy"]),
            "" if run == REFERENCE else show(gain),
            show(column["within"]),
            percent(column["unsafe"]),
            percent(column["unsafe_segments"]),
            percent(column["torn"]),
            " ".join(percent(column[key]) for key in column if key.startswith("route_")),
            f"{np.mean(column['distance']):.2f}",
            f"{np.mean(column['calls']):.0f}",
        )
    return table, {"acceptance": acceptance, "floor": floor, "limit": limit, "runs": rows}


def main():
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    law = three_routes()
    console = Console(width=180)
    rng = torch.Generator().manual_seed(arguments.seed)
    at = problem(law, CONSTRAINTS["corner"], arguments.n_steps)
    pairs = []
    for batch in range(arguments.batches):
        x, _ = execute(recipe_runs()[0], at, seeds_of(arguments.seed, batch, arguments.n))
        pairs.append(energy_distance(x, law.draw(arguments.n, rng).numpy()))
    console.print(
        f"without a constraint, {at.planner.schedule.n_steps} DDPM steps against exact samples: energy {show(pairs)} m"
    )
    results = {}
    for name in arguments.constraints.split(","):
        wanted = arguments.runs.split(",")
        table, results[name] = bench(
            law, name, wanted, arguments.n, arguments.batches, arguments.seed, arguments.n_steps
        )
        console.print(table)
    if arguments.json:
        arguments.json.write_text(
            json.dumps(
                {
                    "n": arguments.n,
                    "n_steps": arguments.n_steps,
                    "seed": arguments.seed,
                    "constraints": results,
                },
                indent=1,
            )
            + "\n"
        )


if __name__ == "__main__":
    main()
