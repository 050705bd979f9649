"""How long does a batch of whole plans take, and how much of that is the network?

    python tests/benchmarks/speed/plans.py [--tasks maze2d-umaze] [--batches 1,10,100]
        [--repeats 7] [--threads 2]

Each maze is planned with its disc constraint, the presets `fast` (16 calls) and `recommended`, with
and without dynamics. The network calls of the same run are the floor: `ratio` is the time of a plan
over theirs. Times are medians after a warm-up.
"""

import argparse
import statistics
from dataclasses import replace
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.constraints.dynamics import LinearDynamicsConstraint
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.planning.open_loop import plan

CONSTRAINTS = Path(__file__).parents[3] / "constraints"

parser = argparse.ArgumentParser()
parser.add_argument("--batches", default="1,10,100")
parser.add_argument("--repeats", type=int, default=7)
parser.add_argument("--threads", type=int, default=2)
parser.add_argument("--presets", default="fast,recommended")
parser.add_argument("--tasks", default="maze2d-umaze,maze2d-large")
arguments = parser.parse_args()
torch.set_num_threads(arguments.threads)

table = Table(title=f"alm, {arguments.threads} threads, medians of {arguments.repeats}")
for head in (
    "task",
    "preset",
    "dynamics",
    "batch",
    "calls",
    "plan / ms",
    "network / ms",
    "ratio",
    "plans / s",
):
    table.add_column(
        head, justify="left" if head in ("task", "preset", "dynamics") else "right", no_wrap=True
    )
for task in arguments.tasks.split(","):
    for preset in arguments.presets.split(","):
        for with_dynamics in (False, True):
            for batch in map(int, arguments.batches.split(",")):
                file = CONSTRAINTS / f"{task}-disc.yaml"
                experiment = resolve(
                    Request(
                        task=task,
                        preset=preset,
                        method="alm",
                        constraints=file,
                        n=batch,
                        random=True,
                    )
                )
                problem = experiment.problem
                if not with_dynamics:
                    kept = tuple(
                        part
                        for part in problem.enforced.parts
                        if not isinstance(part, LinearDynamicsConstraint)
                    )
                    problem = replace(problem, enforced=Constraint(kept))
                measured = []
                for repeat in range(arguments.repeats + 1):
                    seeds = [seed + 1000 * repeat for seed in experiment.seeds]
                    plans = plan(problem, experiment.method, seeds, experiment.preset.sampler)
                    measured.append(
                        (
                            1e3 * plans.total_s,
                            1e3 * plans.network_s,
                            plans.total_s / plans.network_s,
                        )
                    )
                total, network, ratio = (
                    statistics.median(column) for column in zip(*measured[1:], strict=True)
                )
                table.add_row(
                    task,
                    preset,
                    "obeyed" if with_dynamics else "-",
                    str(batch),
                    str(plans.calls),
                    f"{total:.0f}",
                    f"{network:.0f}",
                    f"{ratio:.2f}",
                    f"{1e3 * batch / total:.0f}",
                )
Console(width=120).print(table)
