"""Which guidance weight of `conditional` leaves the least violation, and at what cost?

    python tests/benchmarks/studies/conditional_weight.py --task swimmer [--constraints FILE]
        [--weights 1,2,4,8] [--n 20] [--seed 1000]

The preset is `paper`, and `diffuser` is for comparison. Mazes: plans between the paper's start and
goal. Control tasks: episodes, on the ball run past a ghost. The seeds are in no table. The weight
to choose is the one with the least violation among those that cost at most a tenth of the return,
or of the plans (torn or in a wall).
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from acting import act

from cdiff_cli.commands.experiment import Experiment, Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.evaluation import metrics
from cdiff_cli.planning.open_loop import plan
from cdiff_cli.sampling.baselines import Unconstrained

WHOLE = ("weight", "violation / g", "of diffuser", "worst / g", "distance / m", "torn", "in wall")
CONTROL = (
    "weight",
    "return",
    "violation rate / %",
    "executed violation / g",
    "worst / g",
    "episodes violating",
    "fell",
)


def mean_text(values: np.ndarray) -> str:
    """Mean and standard error."""
    return f"{values.mean():.4g} ± {values.std(ddof=1) / len(values) ** 0.5:.2g}"


def planned(one: Experiment) -> list[str]:
    """Cells of whole plans."""
    plans = plan(one.constrained, one.method, one.seeds)
    free = plan(one.problem, Unconstrained(), one.seeds)
    g, checkpoint = one.declared, one.checkpoint
    assert checkpoint is not None
    rows = metrics.plan_metrics(one.task, g, plans.x, free.x, one.recipe.paper_units)
    violation, violation_free = metrics.violation(g, plans.x), metrics.violation(g, free.x)
    torn = np.mean(
        [not metrics.smooth(row["jump"], checkpoint.card.data["jump_q999"]) for row in rows]
    )
    wall, worst = np.mean([row["wall"] for row in rows]), max(row["worst_waypoint"] for row in rows)
    distance = np.array([row["distance"] for row in rows])
    return [
        mean_text(violation),
        f"{violation.sum() / violation_free.sum():.3f}",
        f"{worst:.3f}",
        mean_text(distance),
        f"{torn:.2f}",
        f"{wall:.2f}",
    ]


def acted(one: Experiment) -> list[str]:
    """Cells of episodes."""
    env = {"collide": False} if one.request.task == "ball-run" else {}
    episodes = act(controller(one), one.task, one.seeds, one.declared, env)
    rate, over = (
        np.array([row[name] for row in episodes.rows])
        for name in ("violation_rate", "executed_violation")
    )
    return [
        episodes.returned(),
        mean_text(rate),
        mean_text(over),
        episodes.worst(),
        episodes.violating(),
        f"{episodes.mean('fell'):.2f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="maze2d-umaze")
    parser.add_argument("--constraints", type=Path)
    parser.add_argument("--weights", default="1,2,4,8")
    parser.add_argument("--n", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1000)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    common = {
        "task": arguments.task,
        "constraints": arguments.constraints,
        "preset": "paper",
        "n": arguments.n,
        "seed": arguments.seed,
    }
    runs = {"diffuser": Request(method="diffuser", **common)}
    for weight in arguments.weights.split(","):
        runs[weight] = Request(method="conditional", settings=(f"weight={weight}",), **common)
    first = resolve(runs["diffuser"])
    acts, stem = first.task.control == "receding_horizon", first.constraints_path.stem
    print(
        f"{arguments.task}, {stem}, preset paper, n = {arguments.n}, seeds {arguments.seed}-{arguments.seed + arguments.n - 1}\n"
    )
    heading = CONTROL if acts else WHOLE
    print(f"| {' | '.join(heading)} |\n| {' | '.join(['---'] * len(heading))} |")
    for name, options in runs.items():
        print(
            f"| {' | '.join([name, *(acted if acts else planned)(resolve(options))])} |", flush=True
        )


if __name__ == "__main__":
    main()
