"""What do the projections of one diffusion step cost, against the network call beside them?

    python tests/benchmarks/speed/projections.py [--task maze2d-umaze] [--batches 1,10,256]
        [--repeats 9] [--threads 2]

The trajectories are shipped demonstrations that cross the disc of the task. Times are medians over
the repeats, after a warm-up, of the whole batch. reaching.py measures the projection with dynamics,
which is made once per plan.
"""

import argparse
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from timing import milliseconds

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.constraints.dynamics import split
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import pull_back
from cdiff_cli.projection.project import project

CONSTRAINTS = Path(__file__).parents[3] / "constraints"


def measure(task: str, batch: int, repeats: int) -> list[str]:
    """The cells of one row of the table."""
    experiment = resolve(Request(task=task, constraints=CONSTRAINTS / f"{task}-disc.yaml", n=1))
    problem, checkpoint = experiment.problem, experiment.checkpoint
    assert checkpoint is not None
    windows = checkpoint.demonstrations.double()
    inside = problem.declared(windows) > 0
    crossing = windows[
        inside.any(1) & ~inside[:, [0, -1]].any(1)
    ]  # those that enter the disc on their way, over and over
    x = crossing[torch.arange(batch) % len(crossing)]
    z = problem.normaliser.encode(x).float()
    mask = torch.zeros(z.shape[1:], dtype=torch.bool)
    mask[[0, -1]] = True
    pins = Pins(mask, z)
    back = (problem.normaliser.centre, problem.normaliser.scale)
    waypoints, segments = (
        pull_back(g, *back).to(z) for g in (problem.declared, split(problem.enforced)[0])
    )
    with torch.inference_mode():
        network = milliseconds(lambda: problem.planner.denoiser(z, 10), repeats)
        parts = [
            milliseconds(lambda: project(waypoints, z, pins, strict=False), repeats),
            milliseconds(lambda: project(segments, z, pins, strict=False), repeats),
        ]
    cells = [text for ms in parts for text in (f"{ms:.2f}", f"{100 * ms / network:.0f}")]
    return [str(batch), f"{network:.1f}", *cells]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="maze2d-umaze")
    parser.add_argument("--batches", default="1,10,256")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    table = Table(title=f"{arguments.task}: milliseconds, % of the network call")
    for head in ("batch", "network", "waypoints", "%", "segments", "%"):
        table.add_column(head, justify="right")
    for batch in map(int, arguments.batches.split(",")):
        table.add_row(*measure(arguments.task, batch, arguments.repeats))
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
