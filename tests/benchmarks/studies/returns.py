"""What does guidance towards the highest return do, by weight?

    python tests/benchmarks/studies/returns.py [--task swimmer] [--checkpoint FILE]
        [--weights 0 1 1.5 2 4] [--episodes 10] [--seed 1000] [--limits] [--margin 0.15]

The planner is conditioned on the return. Weight 0 is its unconditioned estimate, weight 1 the
conditioned one; every other weight takes two network calls per step. --limits adds recommended alm
at both limits, with the same margin for all weights, because the shipped margins belong to the
weight of the recipe. For a task without `returns` in its recipe, add
`train.small.returns: {discount: 0.99}` and `conditions: 2`, and train.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from acting import act
from rich.console import Console
from rich.table import Table

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import as_planner, resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.paths import home


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="swimmer")
    parser.add_argument("--checkpoint", type=Path)
    parser.add_argument("--weights", type=float, nargs="+", default=[0.0, 1.0, 1.5, 2.0, 4.0])
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--limits", action="store_true", help="recommended alm at both limits too")
    parser.add_argument("--margin", type=float, default=0.15, help="of alm, in the units of h")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    common = {"task": arguments.task, "checkpoint": arguments.checkpoint, "device": "cpu"}
    problems = {"none": resolve(Request(method="diffuser", **common))}
    if arguments.limits:
        for name in (arguments.task, f"{arguments.task}-hard"):
            path = home() / "constraints" / f"{name}.yaml"
            problems[f"alm, {name}"] = resolve(
                Request(constraints=path, margin=arguments.margin, **common)
            )
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    table = Table(
        title=f"{arguments.task}: {arguments.episodes} episodes from seed {arguments.seed}"
    )
    for title in (
        "constraint",
        "weight",
        "return",
        "fell",
        "violating",
        "violation rate / %",
        "worst / g",
        "calls",
    ):
        table.add_column(title, justify="left" if title == "constraint" else "right")
    for constraint, experiment in problems.items():
        checkpoint = experiment.checkpoint
        assert checkpoint is not None
        assert checkpoint.card.returns is not None, "a checkpoint that knows no returns"
        for weight in arguments.weights:
            planner = as_planner(checkpoint, experiment.task, weight)
            planner = planner.respaced(experiment.preset.sampler.steps)
            acting = replace(controller(experiment), planner=planner)
            episodes = act(acting, experiment.task, seeds, experiment.declared)
            reward = np.array([row["reward"] for row in episodes.rows])
            returned = f"{reward.mean():.1f} ± {reward.std(ddof=1) / len(reward) ** 0.5:.1f}"
            rate = f"{episodes.mean('violation_rate'):.3f}"
            cells = (
                f"{weight:g}",
                returned,
                f"{episodes.done.fell.sum()}",
                episodes.violating(),
                rate,
                episodes.worst(),
                str(acting.calls),
            )
            table.add_row(constraint, *cells)
            Console(stderr=True).print(constraint, *cells)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
