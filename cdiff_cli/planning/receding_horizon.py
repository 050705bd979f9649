"""Receding-horizon control, the paper's Algorithm 1: observe, bind, sample, act, at every step.

`Controller.act` plans and gives the next input: hold it in any loop over any environment.
`rollout` is the loop over the environments of a task.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError
from cdiff_cli.planning.episodes import Episodes, Log
from cdiff_cli.planning.replanning import Plan, Replanner
from cdiff_cli.planning.timing import candidate_seed
from cdiff_cli.planning.warm_start import select
from cdiff_cli.tasks.protocol import ControlTask, observed_in


@dataclass(frozen=True)
class ControlState:
    """What a controller carries from one step to the next, per episode.

    streams      noise, one generator per candidate plan; drawing from them advances them
    plan         what is followed at present; None before the first step
    since        environment steps since it was made
    multipliers  of the method when it was made; None: begin anew
    """

    streams: tuple[tuple[torch.Generator, ...], ...]
    plan: Plan | None = None
    since: int = 0
    multipliers: Any = None

    def select(self, episodes: NDArray[np.bool_]) -> "ControlState":
        """The state of some of the episodes."""
        kept = tuple(one for one, keep in zip(self.streams, episodes, strict=True) if keep)
        plan = None if self.plan is None else self.plan.select(episodes)
        return replace(
            self, streams=kept, plan=plan, multipliers=select(self.multipliers, episodes)
        )


@dataclass(frozen=True)
class Info:
    """What a controller did in one step.

    plan              the plans followed; `plan.x` [n, horizon, dim], environment units
    planned           whether they were made in this step
    predicted         the states that they predict for the next step [n, dim]
    predicted_levels  each constraint's value at those, unsafe above 0 [n, constraints]
    used_fallback     whether the input is the fallback action, for want of a safe plan [n]
    diverged          whether the plan is not finite [n]
    """

    plan: Plan
    planned: bool
    predicted: Array
    predicted_levels: Array
    used_fallback: NDArray[np.bool_]
    diverged: NDArray[np.bool_]


@dataclass(frozen=True)
class Controller(Replanner):
    """Plans anew while acting; see Replanner for its fields.

    >>> state = controller.init(seeds=[0])
    >>> u, state, info = controller.act(state, x, observed)
    """

    def init(self, seeds: Sequence[int]) -> ControlState:
        """The state before the first step, one episode per seed."""
        return ControlState(
            tuple(
                tuple(
                    torch.Generator().manual_seed(candidate_seed(seed, j))
                    for j in range(self.method.candidates)
                )
                for seed in seeds
            )
        )

    def act(
        self, state: ControlState, x: Array, observed: Mapping[str, Array] | None = None
    ) -> tuple[Array, ControlState, Info]:
        """The inputs for the present states, the state for the next step, and what was done.

        state      from `init` or the last `act`; each is used once, for its noise advances
        x          present states [n, dim], or [dim] for a single episode
        observed   quantities that constraints observe, by name, each [n] or a number
        Returns inputs [n, m] (finite where the plan is) in environment units.
        Raises InfeasibleError where no plan is found and there is no fallback action.
        """
        x = np.atleast_2d(np.asarray(x, dtype=np.float64))
        if x.shape != (len(state.streams), self.planner.dim):
            raise CdiffError(
                f"act: expected states of shape ({len(state.streams)}, {self.planner.dim}), "
                f"found {x.shape}"
            )
        values = {
            name: np.broadcast_to(np.asarray(value, dtype=np.float64), len(x))
            for name, value in (observed or {}).items()
        }
        planned = state.plan is None or state.since == 0
        if planned:
            plan, multipliers = self.replan(state.streams, state.plan, state.multipliers, x, values)
            state = replace(state, plan=plan, multipliers=multipliers)
        assert state.plan is not None
        u = self.inputs(x, state.plan, state.since)
        waypoint = state.since + 1
        info = Info(
            plan=state.plan,
            planned=planned,
            predicted=state.plan.x[:, waypoint],
            predicted_levels=state.plan.levels[:, waypoint],
            used_fallback=state.plan.infeasible,
            diverged=np.asarray(~np.isfinite(state.plan.x).all(axis=(1, 2))),
        )
        return u, replace(state, since=waypoint % self.control.execute), info


def rollout(
    controller: Controller,
    task: ControlTask,
    seeds: Sequence[int],
    env_options: Mapping[str, Any] | None = None,
    steps: int | None = None,
    on_step: Callable[[int, int], None] | None = None,
    on_frame: Callable[[int, Any, Array], None] | None = None,
) -> Episodes:
    """One episode per seed, planned for together: the only loop over environment steps.

    A seed's environment and noise do not depend on its neighbours.

    steps      None: the task's own number
    on_step    called with the number of steps so far and of all
    on_frame   called before each step of the first episode with the step, its environment and the
               plan followed [horizon, dim]
    """
    total = task.max_steps if steps is None else steps
    envs = [task.make_env(**(env_options or {})) for _ in seeds]
    disturb = _Disturbance(controller.control.action_noise, seeds, envs[0].action_space)
    log = Log(task, len(controller.declared.parts), len(seeds), total)
    alive, state = np.arange(len(seeds)), controller.init(seeds)
    try:
        states = np.stack(
            [task.observe(env.reset(seed=seed)[0]) for env, seed in zip(envs, seeds, strict=True)]
        )
        log.observe(0, states, [observed_in(task, env) for env in envs], alive)
        while log.done < total and len(alive):
            tau = log.done
            u, state, info = controller.act(state, states[alive], log.now(alive))
            if info.planned:
                log.plan(tau, alive, info.plan)
                u, state, info, alive = _drop_diverged(log, u, state, info, alive)
                if not len(alive):
                    break
            if on_frame and alive[0] == 0:
                on_frame(tau, envs[0], info.plan.x[0])
            log.braked[alive, tau] = info.used_fallback
            fell, diverged = np.zeros(len(alive), dtype=bool), np.zeros(len(alive), dtype=bool)
            for row, i in enumerate(alive):
                push = disturb(int(i), u[row])
                obs, reward, terminated, _, extra = envs[i].step(push)
                states[i] = task.observe(obs)
                log.act(tau, int(i), push, float(reward), extra)
                fell[row], diverged[row] = terminated, not np.isfinite(states[i]).all()
            log.predict(tau + 1, alive, info.predicted, info.predicted_levels)
            log.observe(tau + 1, states[alive], [observed_in(task, envs[i]) for i in alive], alive)
            log.end(log.diverged, alive, diverged)
            log.end(log.fell, alive, fell & ~diverged)
            state, alive = state.select(~(fell | diverged)), alive[~(fell | diverged)]
            log.done += 1
            if on_step:
                on_step(log.done, total)
    finally:
        for env in envs:
            env.close()
    return log.episodes()


def _drop_diverged(
    log: Log, u: Array, state: ControlState, info: Info, alive: NDArray[np.intp]
) -> tuple[Array, ControlState, Info, NDArray[np.intp]]:
    """The episodes whose plans are finite; the others end."""
    if not info.diverged.any():
        return u, state, info, alive
    fine = ~info.diverged
    left = replace(
        info,
        plan=info.plan.select(fine),
        predicted=info.predicted[fine],
        predicted_levels=info.predicted_levels[fine],
        used_fallback=info.used_fallback[fine],
        diverged=info.diverged[fine],
    )
    return u[fine], state.select(fine), left, log.end(log.diverged, alive, info.diverged)


class _Disturbance:
    """Inputs as the environment receives them: disturbed, and clipped to their bounds."""

    def __init__(self, size: float, seeds: Sequence[int], space: Any) -> None:
        self.size, self.low, self.high = size, space.low, space.high
        self.streams = [np.random.default_rng((seed, 1)) for seed in seeds]

    def __call__(self, episode: int, u: Array) -> NDArray[np.float32]:
        noise = self.streams[episode].normal(size=len(self.low))
        push = u + self.size * noise * (self.high - self.low) / 2
        return np.clip(push, self.low, self.high).astype(np.float32)
