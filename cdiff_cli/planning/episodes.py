"""Closed-loop episodes: what was executed, what the plans had foreseen, and the log that they grow from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.tasks.protocol import ControlTask, observable_of


@dataclass(frozen=True)
class Episodes:
    """Executed episodes; entries after an episode's end are NaN.

    x           states [n, steps + 1, dim];  u inputs [n, steps, m];  reward [n, steps]
    planned     the state that the plan followed foresaw for each state [n, steps + 1, dim]; the first is the start itself
    foreseen    value of each part's level at `planned`, on what was observed when it was planned [n, steps + 1, parts]
    observed    observed quantities by name, each [n, steps + 1]
    violation   sum over waypoints and rows of [g]_+ of each plan, as declared [n, steps], NaN where none was made
    calls       network calls of each plan [n, steps], NaN where none was made
    braked      1 where the input was the task's brake, for want of a plan that obeys the constraints [n, steps]
    info        numbers that the environment told beside the reward, by name, each [n, steps]
    fell        whether the episode was ended by the environment [n]
    diverged    whether it was ended because its plan or its state was no longer finite [n]
    latency_s   wall time of each control step at which plans were made, of all episodes at once; network_s the network's part
    """

    x: Array
    u: Array
    reward: Array
    planned: Array
    foreseen: Array
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
        self.x, self.planned = (np.full((n, steps + 1, dim), np.nan) for _ in range(2))
        self.u, self.reward = np.full((n, steps, inputs), np.nan), np.full((n, steps), np.nan)
        self.foreseen = np.full((n, steps + 1, parts), np.nan)
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
            self.planned[which, 0] = states
        for name, values in self.observed.items():
            values[which, tau] = [each[name] for each in observed]

    def plan(
        self,
        tau: int,
        which: NDArray[np.intp],
        x: Array,
        g: Constraint,
        calls: NDArray[np.int_],
        total_s: float,
        network_s: float,
    ) -> None:
        """Plans x [which, horizon, dim] made at step tau, g the constraint as it was then, environment units."""
        self.calls[which, tau] = calls
        self.violation[which, tau] = g(torch.from_numpy(x)).clamp_min(0).sum(1).numpy()
        self.latency.append(total_s)
        self.network.append(network_s)
        self.levels = g.state_values(torch.from_numpy(x)).numpy()
        self.rows = {int(i): row for row, i in enumerate(which)}

    def end(
        self, flags: NDArray[np.bool_], which: NDArray[np.intp], ended: Any
    ) -> NDArray[np.intp]:
        """Those of `which` that go on; the others are flagged."""
        flags[which[ended]] = True
        return which[~ended]

    def foresee(self, tau: int, states: Array, which: NDArray[np.intp], waypoint: int) -> None:
        self.planned[which, tau] = states
        rows = [self.rows[int(i)] for i in which]
        self.foreseen[which, tau] = self.levels[rows, waypoint]

    def act(self, tau: int, i: int, u: Array, reward: float, info: Mapping[str, Any]) -> None:
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
            planned=self.planned,
            foreseen=self.foreseen,
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
