"""What the closed-loop benchmarks measure of the episodes of one controller."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.evaluation import metrics
from cdiff_cli.planning.episodes import Episodes
from cdiff_cli.planning.receding_horizon import Controller, rollout
from cdiff_cli.tasks.protocol import ControlTask


class Acted(NamedTuple):
    """Episodes, the levels f of their states [n, steps + 1, parts], a row of metrics each."""

    done: Episodes
    levels: Any
    rows: list[dict[str, float]]

    def mean(self, name: str) -> float:
        return float(np.mean([row[name] for row in self.rows]))

    def returned(self) -> str:
        """Mean return and its standard error."""
        reward = np.array([row["reward"] for row in self.rows])
        return f"{reward.mean():.0f} ± {reward.std(ddof=1) / len(reward) ** 0.5:.0f}"

    def violating(self) -> str:
        return str(sum(row["safe_executed"] == 0 for row in self.rows))

    def worst(self) -> str:
        return f"{max(row['executed_worst'] for row in self.rows):.3f}"


def act(
    controller: Controller,
    task: ControlTask,
    seeds: Sequence[int],
    truth: Constraint,
    env: Mapping[str, Any] | None = None,
) -> Acted:
    """Episodes of all seeds together, scored by `truth`; inputs are bounded by 1 in every task."""
    done = rollout(controller, task, seeds, env)
    levels = metrics.executed_levels(truth, done.x, done.observed, task.dt)
    bounds = -np.ones(done.u.shape[2]), np.ones(done.u.shape[2])
    return Acted(done, levels, metrics.control_metrics(done, levels, bounds))
