"""Whole plans, followed in a simulator by a tracking controller."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError


@dataclass(frozen=True)
class Rollout:
    """Executed episodes.

    x               states [n, steps + 1, dim]
    u               inputs as applied [n, steps, m]
    reward          [n, steps]
    success         whether the end is within the task's success radius of the last waypoint [n]
    goal_distance   distance to the last waypoint at the end [n]
    """

    x: Array
    u: Array
    reward: Array
    success: NDArray[np.bool_]
    goal_distance: Array


def follow(
    task: Any,
    plans: Array,
    seeds: Sequence[int],
    hold: int = 100,
    on_step: Callable[[int], None] | None = None,
    planned: Array | None = None,
) -> Rollout:
    """Follow each plan with the task's tracking controller, then hold at the last waypoint.

    hold      steps at the last waypoint
    planned   inputs of the plans [n, horizon - 1, m]; they are fed forward, and the tracking
              controller corrects the rest
    Raises CdiffError where the simulation diverges.
    """
    env = task.make_env().unwrapped
    episodes: list[Mapping[str, Array]] = []
    for number, (x, seed) in enumerate(zip(plans, seeds, strict=True)):
        obs = task.reset_to(env, x[0], x[-1], seed)
        states, actions, rewards = [task.observe(obs)], [], []
        for tau in range(len(x) - 1 + hold):
            if planned is not None and tau < len(x) - 1:
                low, high = env.action_space.low, env.action_space.high
                u = np.clip(
                    planned[number, tau] + task.track(states[-1], x[tau]), low, high
                ).astype(np.float32)
            else:
                u = task.track(states[-1], x[min(tau + 1, len(x) - 1)])
            obs, reward, *_ = env.step(u)
            states.append(task.observe(obs))
            actions.append(u)
            rewards.append(float(reward))
            if not np.isfinite(states[-1]).all():
                raise CdiffError(
                    f"the simulation of seed {seed} diverged at step {tau}; its state is not finite"
                )
        episodes.append(
            {
                "x": np.stack(states),
                "u": np.stack(actions).astype(np.float64),
                "reward": np.array(rewards),
            }
        )
        if on_step:
            on_step(number + 1)
    env.close()
    executed = np.stack([e["x"] for e in episodes])
    columns = [task.layout.index(name) for name in task.positions]
    left = np.linalg.norm((executed[:, -1] - plans[:, -1])[:, columns], axis=1)
    return Rollout(
        x=executed,
        u=np.stack([e["u"] for e in episodes]),
        reward=np.stack([e["reward"] for e in episodes]),
        success=left <= task.success_radius,
        goal_distance=left,
    )
