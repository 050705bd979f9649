"""Time a diffusion step of SafeDiffuser by either solver, beside diffuser and alm, in one run.

    python tests/benchmarks/safediffuser.py [--task maze2d-umaze] [--constraints FILE] [--n 10] [--steps 16] [--repeats 3]

The methods take turns within each repeat, so their ratios hold when the machine's speed drifts. Medians over the repeats, after one
warm-up; preset `paper`. Respaced schedules change how many steps there are, not what one costs.
"""

import argparse
import statistics
from pathlib import Path

from cdiff_cli.planning import plan
from cdiff_cli.request import Options, resolve

parser = argparse.ArgumentParser()
parser.add_argument("--task", default="maze2d-umaze")
parser.add_argument("--constraints", type=Path)
parser.add_argument("--n", type=int, default=10)
parser.add_argument("--steps", type=int, default=16)
parser.add_argument("--repeats", type=int, default=3)
arguments = parser.parse_args()

RUNS = {
    "diffuser": ("diffuser", ()),
    "alm": ("alm", ()),
    "projected": ("projected", ()),
    **{
        f"safediffuser {variant}, {solver}": ("safediffuser", (f"variant={variant}", f"solver={solver}"))
        for solver in ("closed-form", "proxqp")
        for variant in ("ros", "res", "tvs")
    },
}
resolved = {
    name: resolve(
        Options(
            task=arguments.task,
            constraints=arguments.constraints,
            method=method,
            preset="paper",
            n=arguments.n,
            steps=arguments.steps,
            settings=settings,
        )
    )
    for name, (method, settings) in RUNS.items()
}
times: dict[str, list[tuple[float, float]]] = {name: [] for name in RUNS}
for repeat in range(arguments.repeats + 1):
    for name, one in resolved.items():
        if repeat == 0 and "proxqp" in name:
            continue
        plans = plan(one.problem, one.method, one.seeds, kernel=one.kernel)
        if repeat:
            times[name].append((1e3 * plans.total_s / plans.calls, 1e3 * plans.network_s / plans.calls))

base = statistics.median(total for total, _ in times["diffuser"])
print(f"{arguments.task}, batch {arguments.n}, {arguments.steps} steps, median of {arguments.repeats}")
print(f"{'method':32} {'step / ms':>10} {'network / ms':>13} {'constraint / ms':>16} {'of diffuser':>12}")
for name, measured in times.items():
    total, network = (statistics.median(column) for column in zip(*measured, strict=True))
    print(f"{name:32} {total:10.2f} {network:13.2f} {total - network:16.2f} {total / base:12.2f}")
