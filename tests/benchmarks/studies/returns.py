"""What asking for the highest return does, weight by weight, where the planner is conditioned on it.

    python tests/benchmarks/studies/return_labels.py [--task swimmer] [--checkpoint FILE] [--weights 0 1 1.5 2 4] [--episodes 10] [--seed 1000]
        [--limits] [--margin 0.15]

Weight 0 is the same network asked for nothing, weight 1 its conditioned estimate; any other takes two network calls a step. With
--limits recommended alm at both limits too, all weights with the same margin: those shipped belong to the recipe's weight alone.
A task whose recipe has no `returns` is given them there (`train.small.returns: {discount: 0.99}`, `conditions: 2`) and trained.
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
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.models.denoiser import calls_a_step, guided
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
    asked = parser.parse_args()
    torch.set_num_threads(1)
    common = {"task": asked.task, "checkpoint": asked.checkpoint, "device": "cpu"}
    problems = {"none": resolve(Request(method="diffuser", **common))}
    if asked.limits:
        for name in (asked.task, f"{asked.task}-hard"):
            path = home() / "constraints" / f"{name}.yaml"
            problems[f"alm, {name}"] = resolve(
                Request(constraints=path, margin=asked.margin, **common)
            )
    seeds = range(asked.seed, asked.seed + asked.episodes)
    table = Table(title=f"{asked.task}: {asked.episodes} episodes from seed {asked.seed}")
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
    for constraint, resolved in problems.items():
        checkpoint = resolved.checkpoint
        assert checkpoint is not None
        assert checkpoint.card.returns is not None, "a checkpoint that knows no returns"
        for weight in asked.weights:
            denoiser = guided(checkpoint.net, weight, checkpoint.limit)
            acting = controller(resolved)
            calls = calls_a_step(weight)
            planner = replace(acting.planner, denoiser=denoiser, calls_per_step=calls)
            acting = replace(acting, planner=planner)
            found = act(acting, resolved.task, seeds, acting.declared)
            reward = np.array([row["reward"] for row in found.rows])
            returned = f"{reward.mean():.1f} ± {reward.std(ddof=1) / len(reward) ** 0.5:.1f}"
            rate = f"{found.mean('violation_rate'):.3f}"
            cells = (
                f"{weight:g}",
                returned,
                f"{found.done.fell.sum()}",
                found.violating(),
                rate,
                found.worst(),
                str(acting.calls),
            )
            table.add_row(constraint, *cells)
            Console(stderr=True).print(constraint, *cells)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
