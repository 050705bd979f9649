"""How long is a diffusion step of each method of Table 1, beside the paper's times?

    python tests/benchmarks/speed/table1_times.py [--task maze2d-umaze] [--n 10] [--steps 16]
        [--repeats 3] [--variants ros,res,tvs]

The methods take turns within each repeat, so their ratios to diffuser do not depend on drifts of
the machine's speed. Times are medians of the repeats, after one warm-up of all but ProxQP, which
solves one QP per waypoint. One step of `conditional` is one network call for twice as many plans.
`recommended` has dynamics, `recommended*` (--no-dynamics) has none. The final projection of the
plan is left out.
"""

import argparse
import itertools
import statistics
from pathlib import Path

import torch

from cdiff_cli.commands.experiment import Experiment, Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.evaluation import tables
from cdiff_cli.paths import home
from cdiff_cli.planning.open_loop import plan

METHODS = (
    "diffuser",
    "guidance",
    "conditional",
    "terminal",
    "final-projection",
    "projected",
    "primal-dual",
    "alm",
)
OURS = ("projected", "primal-dual", "alm")
Key = tuple[str, str]
"""Method, with its variant, and preset."""


def experiments(arguments: argparse.Namespace) -> dict[Key, Experiment]:
    """The experiments to time."""
    common = {
        "task": arguments.task,
        "constraints": arguments.constraints,
        "n": arguments.n,
        "steps": arguments.steps,
    }
    runs = {
        (method, "paper"): Request(method=method, preset="paper", **common) for method in METHODS
    }
    for variant, solver in itertools.product(
        arguments.variants.split(","), ("closed-form", "proxqp")
    ):
        settings = (f"variant={variant}", f"solver={solver}")
        runs[f"safediffuser {variant}, {solver}", "paper"] = Request(
            method="safediffuser", preset="paper", settings=settings, **common
        )
    for preset, method in itertools.product(("recommended", "recommended*"), OURS):
        runs[method, preset] = Request(method=method, no_dynamics=preset.endswith("*"), **common)
    return {key: resolve(options) for key, options in runs.items()}


def step_ms(one: Experiment) -> tuple[float, float]:
    """Time of a diffusion step and of its network calls [ms]."""
    sampler = one.preset.sampler.model_copy(update={"extra_steps": 0, "polish": False})
    plans = plan(one.constrained, one.method, one.seeds, sampler)
    return 1e3 * plans.total_s / plans.calls, 1e3 * plans.network_s / plans.calls


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="maze2d-umaze")
    parser.add_argument("--constraints", type=Path)
    parser.add_argument("--n", type=int, default=10)
    parser.add_argument("--steps", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--variants", default="ros", help="of SafeDiffuser, separated by commas")
    arguments = parser.parse_args()
    runs = experiments(arguments)
    times: dict[Key, list[tuple[float, float]]] = {key: [] for key in runs}
    for repeat in range(arguments.repeats + 1):
        for key, one in runs.items():
            if repeat or "proxqp" not in key[0]:
                measured = step_ms(one)
                if repeat:
                    times[key].append(measured)
    paper = {
        method: float(values["step_ms"])
        for (task, method), values in tables.read_paper(
            home() / "runs" / "reference" / "paper.csv"
        ).items()
        if task == arguments.task
    }
    base = statistics.median(total for total, _ in times["diffuser", "paper"])
    print(
        f"{arguments.task}, batch {arguments.n}, {arguments.steps} steps, median of {arguments.repeats}, "
        f"{torch.get_num_threads()} threads\n"
    )
    print(
        "| method | preset | step / ms | network | over its network | of diffuser | paper: s | paper: of Diffuser |"
    )
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for (name, preset), measured in times.items():
        total, network = (statistics.median(column) for column in zip(*measured, strict=True))
        method = name.partition(" ")[0]
        theirs = (
            (f"{paper[method] / 1e3:.4f}", f"{paper[method] / paper['diffuser']:.2f}")
            if method in paper
            else ("", "")
        )
        ratios = f"{total / network:.2f} | {total / base:.2f}"
        print(
            f"| {name} | {preset} | {total:.2f} | {network:.2f} | {ratios} | {theirs[0]} | {theirs[1]} |"
        )


if __name__ == "__main__":
    main()
