"""Closed-loop episodes: what was executed, what the plans predicted, and the log they grow from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdiff_cli.arrays import Array
from cdiff_cli.planning.replanning import Plan
from cdiff_cli.tasks.protocol import ControlTask, observable_of


@dataclass(frozen=True)
class Episodes:
    """Executed episodes; entries after an episode's end are NaN.

    x                 executed states [n, steps + 1, dim]
    u                 inputs as applied [n, steps, m]
    reward            [n, steps]
    predicted         the state that the plan followed predicted for each step [n, steps + 1, dim];
                      the first is the start itself
    predicted_levels  each constraint's value at `predicted`, with what was observed when the plan
                      was made [n, steps + 1, constraints]
    observed          observed quantities by name, each [n, steps + 1]
    violation         sum over waypoints and rows of [g]_+ per plan, as declared [n, steps]; NaN
                      where none was made
    calls             network calls per plan [n, steps]; NaN where none was made
    braked            1 where the input was the fallback action [n, steps]
    info              numbers that the environment reports besides, by name, each [n, steps]
    fell              whether the environment ended the episode [n]
    diverged          whether it ended because its plan or state was not finite [n]
    latency_s         wall time per planning step, for all episodes together
    network_s         the network's part of it
    """

    x: Array
    u: Array
    reward: Array
    predicted: Array
    predicted_levels: Array
    observed: dict[str, Array]
    violation: Array
    calls: Array
    braked: Array
    info: dict[str, Array]
    fell: NDArray[np.bool_]
    diverged: NDArray[np.bool_]
    latency_s: Array
    network_s: Array


class Log:
    """What happened so far, episode by episode."""

    def __init__(self, task: ControlTask, parts: int, n: int, steps: int) -> None:
        dim, inputs, self.done = len(task.layout), len(task.actions), 0
        self.x, self.predicted = (np.full((n, steps + 1, dim), np.nan) for _ in range(2))
        self.u, self.reward = np.full((n, steps, inputs), np.nan), np.full((n, steps), np.nan)
        self.predicted_levels = np.full((n, steps + 1, parts), np.nan)
        self.observed = {name: np.full((n, steps + 1), np.nan) for name in observable_of(task)}
        self.violation, self.calls = (np.full((n, steps), np.nan) for _ in range(2))
        self.braked = np.zeros((n, steps))
        self.fell, self.diverged = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        self.info: dict[str, Array] = {}
        self.latency: list[float] = []
        self.network: list[float] = []

    def now(self, which: NDArray[np.intp]) -> dict[str, Array]:
        return {name: values[which, self.done] for name, values in self.observed.items()}

    def observe(
        self,
        tau: int,
        states: Array,
        observed: Sequence[Mapping[str, float]],
        which: NDArray[np.intp],
    ) -> None:
        self.x[which, tau] = states
        if tau == 0:
            self.predicted[which, 0] = states
        for name, values in self.observed.items():
            values[which, tau] = [each[name] for each in observed]

    def plan(self, tau: int, which: NDArray[np.intp], plan: Plan) -> None:
        """The plans of these episodes, made at step tau."""
        self.calls[which, tau] = plan.calls
        self.violation[which, tau] = plan.violation
        self.latency.append(plan.total_s)
        self.network.append(plan.network_s)

    def end(
        self, flags: NDArray[np.bool_], which: NDArray[np.intp], ended: Any
    ) -> NDArray[np.intp]:
        """Those of `which` that go on; the others are flagged."""
        flags[which[ended]] = True
        return which[~ended]

    def predict(self, tau: int, which: NDArray[np.intp], states: Array, levels: Array) -> None:
        """What the plans predict for step tau: states [n, dim], constraint values [n, parts]."""
        self.predicted[which, tau] = states
        self.predicted_levels[which, tau] = levels

    def act(
        self, tau: int, i: int, u: NDArray[np.float32], reward: float, info: Mapping[str, Any]
    ) -> None:
        self.u[i, tau], self.reward[i, tau] = u, reward
        for name, value in info.items():
            if isinstance(value, bool | int | float | np.number | np.bool_):
                self.info.setdefault(name, np.full(self.reward.shape, np.nan))[i, tau] = float(
                    value
                )

    def episodes(self) -> Episodes:
        return Episodes(
            x=self.x,
            u=self.u,
            reward=self.reward,
            predicted=self.predicted,
            predicted_levels=self.predicted_levels,
            observed=self.observed,
            violation=self.violation,
            calls=self.calls,
            braked=self.braked,
            info=self.info,
            fell=self.fell,
            diverged=self.diverged,
            latency_s=np.array(self.latency),
            network_s=np.array(self.network),
        )
