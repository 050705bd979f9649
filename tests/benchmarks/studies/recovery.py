"""How does a walker return below a limit that its state is already beyond?

    python tests/benchmarks/studies/recovery.py [--task hopper] [--n 20] [--seed 100]
        [--methods alm] [--standing]

In mid-stride the limited rate is set to a value beyond its limit. This happens in each episode at
the first state from step 300 (304, 308, ...) on whose rate is within 0.5 rad/s of the limit on that
side; with --standing it happens at the start. The columns count, over 300 further steps: the steps
with h < 0 until the first return, their largest number in an episode, the largest f = -h after five
steps (an exact barrier of alpha 0.85 leaves 0.15^5 of it), the unsafe steps of all episodes after
the first return, and the falls.
"""

import argparse
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.evaluation import metrics
from cdiff_cli.evaluation.metrics import SAFE
from cdiff_cli.planning.receding_horizon import rollout

BEYOND = (0.5, 1.0, 2.0, 3.0, 5.0)
STEPS, STRIDE = 300, 120  # after the push; the most steps of a stride
NEAR = 0.5
EXPERT = "the gait itself"
LIMITED = {"hopper": "thigh_velocity", "swimmer": "rotor2_velocity"}


class Pushed(gymnasium.Wrapper[Any, Any, Any, Any]):
    """The environment, with one velocity set to a value once.

    That happens at the first state from step `since` on whose velocity is near the value.

    at   number of that state, from 0; None before
    """

    def __init__(self, env: Any, column: int, value: float, since: int, near: float) -> None:
        super().__init__(env)
        self.column, self.value, self.since, self.near = column, value, since, near
        self.done, self.at = 0, None

    def reset(self, **options: Any) -> Any:
        obs, info = self.env.reset(**options)
        return self.pushed(obs), info

    def step(self, action: Any) -> Any:
        obs, *rest = self.env.step(action)
        self.done += 1
        return self.pushed(obs), *rest

    def pushed(self, obs: Any) -> Any:
        inner: Any = self.env.unwrapped
        velocities = inner.data.qvel.copy()
        if (
            self.at is not None
            or self.done < self.since
            or np.sign(self.value) * velocities[self.column] < self.near
        ):
            return obs
        self.at, velocities[self.column] = self.done, self.value
        inner.set_state(inner.data.qpos.copy(), velocities)
        return inner._get_obs()


class Pushing:
    """The task with pushed environments, each from another step on."""

    def __init__(self, task: Any, value: float, since: Sequence[int], near: float) -> None:
        self.task, self.value, self.since, self.near = task, value, since, near
        self.made: list[Pushed] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.task, name)

    def make_env(self, **options: Any) -> Any:
        column = self.task.layout.index(LIMITED[self.task.name]) - len(
            self.task.layout
        )  # a state ends with all velocities
        self.made.append(
            Pushed(
                self.task.make_env(**options),
                column,
                self.value,
                self.since[len(self.made)],
                self.near,
            )
        )
        return self.made[-1]


def walked(pushing: Any, seeds: Sequence[int], steps: int) -> Any:
    """States of the demonstrated gait [n, steps + 1, dim], NaN after a fall."""
    x = np.full((len(seeds), steps + 1, len(pushing.layout)), np.nan)
    for row, seed in zip(x, seeds, strict=True):
        states: list[Any] = []
        pushing.walk(pushing.make_env(), pushing.experts()[0], seed, states=states)
        row[: len(states)] = states[: steps + 1]
    return x


def recovered(
    task: str, method: str, value: float, seeds: Sequence[int], since: Sequence[int], near: float
) -> list[str]:
    """Cells of one row."""
    planned = "diffuser" if method == EXPERT else method
    experiment = resolve(Request(task=task, method=planned, n=1, device="cpu"))
    pushing: Any = Pushing(experiment.task, value, since, near)
    steps = max(since) + STRIDE + STEPS
    x = (
        walked(pushing, seeds, steps)
        if method == EXPERT
        else rollout(controller(experiment), pushing, seeds, steps=steps).x
    )
    f = metrics.executed_levels(experiment.declared, x, {}, experiment.task.dt).max(-1)
    after = np.stack(
        [
            row[env.at :][: STEPS + 1]
            for row, env in zip(f, pushing.made, strict=True)
            if env.at is not None
        ]
    )
    unsafe = after > SAFE  # NaN after a fall
    back = np.array(
        [row.argmin() for row in unsafe]
    )  # the first state that is not unsafe, or the fall
    later = sum(row[k:].sum() for row, k in zip(unsafe, back, strict=True))
    fell = np.isnan(after).any(1).sum()
    left = after[:, 5][np.isfinite(after[:, 5])]
    depth = f"{left.max():+.2f}" if len(left) else "all fell"
    return [
        f"{value:+.1f}",
        method,
        f"{len(after)}",
        f"{back.mean():.1f}",
        f"{back.max()}",
        depth,
        f"{later}",
        f"{fell}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="hopper", choices=LIMITED)
    parser.add_argument("--n", type=int, default=20)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--methods", nargs="+", default=(EXPERT, "diffuser", "projected", "alm"))
    parser.add_argument("--standing", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    seeds = range(arguments.seed, arguments.seed + arguments.n)
    since = [0 if arguments.standing else 300 + 4 * i for i in range(arguments.n)]
    kind = resolve(Request(task=arguments.task, n=1, device="cpu")).kinds[0]
    limit = kind.barrier.b  # type: ignore[union-attr]
    near = -np.inf if arguments.standing else limit - NEAR
    print(
        f"{arguments.task}, limit {limit:g} rad/s, {arguments.n} episodes from seed {arguments.seed}\n"
    )
    heading = (
        "pushed to",
        "method",
        "n",
        "steps beyond",
        "most",
        "f after 5 steps",
        "later unsafe steps",
        "fell",
    )
    print(f"| {' | '.join(heading)} |\n| {' | '.join(['---'] * len(heading))} |")
    for sign in (1, -1):
        for beyond in BEYOND:
            for method in arguments.methods:
                cells = recovered(
                    arguments.task, method, sign * (limit + beyond), seeds, since, near
                )
                print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
