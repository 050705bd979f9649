"""Episodes of one controller and their metrics, for the closed-loop studies."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.evaluation import metrics
from cdiff_cli.planning.episodes import Episodes
from cdiff_cli.planning.receding_horizon import Controller, rollout
from cdiff_cli.tasks.protocol import ControlTask


class Acted(NamedTuple):
    """Episodes with their metrics.

    done     the episodes
    levels   f at the executed states          [n, steps + 1, parts]
    rows     metrics, one mapping per episode
    """

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
        """Number of episodes with an unsafe state."""
        return str(sum(row["safe_executed"] == 0 for row in self.rows))

    def worst(self) -> str:
        """Largest f of an executed state."""
        return f"{max(row['executed_worst'] for row in self.rows):.3f}"


def act(
    controller: Controller,
    task: ControlTask,
    seeds: Sequence[int],
    truth: Constraint,
    env: Mapping[str, Any] | None = None,
) -> Acted:
    """Run one episode per seed, and score them by the constraint `truth`.

    Inputs are bounded by 1 in every task.
    """
    done = rollout(controller, task, seeds, env)
    levels = metrics.executed_levels(truth, done.x, done.observed, task.dt)
    bounds = -np.ones(done.u.shape[2]), np.ones(done.u.shape[2])
    return Acted(done, levels, metrics.control_metrics(done, levels, bounds))
