"""Receding-horizon control, the paper's Algorithm 1: observe, bind, sample, act, at every environment step."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.affine_rows import AffineRows
from cdiff_cli.constraints.observed import ObservedValues
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.models.denoiser import Denoiser, ObservingDenoiser
from cdiff_cli.models.networks import InverseDynamics
from cdiff_cli.models.normaliser import ResidualNormaliser
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.planning.episodes import Episodes, Log
from cdiff_cli.planning.problem import MARGIN
from cdiff_cli.planning.timing import Timed, candidate_seed, synchronise
from cdiff_cli.planning.warm_start import CarriedMultipliers, shift_plan
from cdiff_cli.projection.project import project
from cdiff_cli.sampling import load_kernel
from cdiff_cli.sampling.baselines import BestOf, Unconstrained
from cdiff_cli.sampling.sampler import Method, sample
from cdiff_cli.tasks.protocol import ControlTask

TOLERANCE = 1e-3  # of a finished plan's g, environment units: beyond it the projection has found no plan that obeys


@dataclass(frozen=True)
class Controller:
    """All that acting needs, resolved.

    seeing        the denoiser of a planner that is told what is observed, anew at each plan; None of the others
    calls_a_step  network calls that the denoiser takes for one estimate
    g             as declared: what is scored                                    environment units
    enforced      what plans obey: g, tightened by the margin                    environment units
    temperature   factor on all noise: below 1 plans stay nearer the mean
    ahead         waypoints between the states that the inverse dynamics model is asked about
    execute       environment steps a plan is followed
    warm          share of the diffusion steps done again on the last plan, moved on by what was executed, from the multipliers
                  it ended with, moved on likewise; None: all, from noise. Of constraints that are observed anew, see `watchful`
    resume        begin each plan from the multipliers that the last one ended with, as they are
    brake         state -> input that is used where the last projection leaves a plan outside of what it was to obey; None: the
                  plan's own
    action_noise  standard deviation of what is added to each input, over half its range: a disturbance, not ours to know
    """

    task: ControlTask
    denoiser: Denoiser
    schedule: Schedule
    frame: ResidualNormaliser
    inverse: InverseDynamics
    g: Constraint
    enforced: Constraint
    method: Method
    device: torch.device
    kernel: str = "ddpm"
    extra_steps: int = 0
    polish: bool = False
    temperature: float = 1.0
    ahead: int = 1
    execute: int = 1
    warm: float | None = None
    resume: bool = False
    brake: Callable[[Array], Array] | None = None
    action_noise: float = 0.0
    seeing: ObservingDenoiser | None = None
    calls_a_step: int = 1

    @property
    def horizon(self) -> int:
        return self.frame.mean.shape[0]

    @cached_property
    def condensed(self) -> AffineRows | None:
        """The rows of what is obeyed as one matrix, float64, where they are affine and nothing has to be observed."""
        return self.enforced.condense(self.horizon, len(self.task.layout))

    @property
    def watchful(self) -> bool:
        """Whether what plans obey is observed anew at each control step. A warm plan that no longer obeys is then made anew, from
        noise: gone on with, it keeps every push away from where the obstacle was, and slows down from plan to plan. No
        multipliers are handed on.
        """
        return self.enforced.waits and not isinstance(self.method, Unconstrained | BestOf)

    @property
    def redone(self) -> int:
        """Diffusion steps a plan, where plans are warm of those that go on from another."""
        return (
            self.schedule.n_steps
            if self.warm is None
            else max(1, round(self.warm * self.schedule.n_steps))
        )

    @property
    def tries(self) -> int:
        """Plans made of which one is kept."""
        return self.method.k if isinstance(self.method, BestOf) else 1

    @property
    def calls(self) -> int:
        """Network calls a control step at which plans are made, where plans are warm and go on from another."""
        return self.calls_of(self.redone)

    def calls_of(self, steps: int) -> int:
        """Network calls of plans made in that many diffusion steps."""
        return self.tries * (steps + self.extra_steps) * self.calls_a_step


def control(
    controller: Controller,
    seeds: Sequence[int],
    env_options: Mapping[str, Any] | None = None,
    steps: int | None = None,
    on_step: Callable[[int, int], None] | None = None,
    on_frame: Callable[[int, Any, Array], None] | None = None,
) -> Episodes:
    """One episode a seed, planned for together. A seed's environment and noise do not depend on its neighbours.

    on_step    called with the number of steps so far and of all
    on_frame   called before each step of the first episode with the step, its environment and the plan followed [horizon, dim]
    """
    task = controller.task
    total = task.max_steps if steps is None else steps
    envs = [task.make_env(**(env_options or {})) for _ in seeds]
    generators = [
        [torch.Generator().manual_seed(candidate_seed(seed, j)) for j in range(controller.tries)]
        for seed in seeds
    ]
    disturbances = [np.random.default_rng((seed, 1)) for seed in seeds]
    low, high = envs[0].action_space.low, envs[0].action_space.high
    log = Log(task, len(controller.g.parts), len(seeds), total)
    try:
        states = np.stack(
            [task.observe(env.reset(seed=seed)[0]) for env, seed in zip(envs, seeds, strict=True)]
        )
        log.observe(0, states, [task.observed(env) for env in envs], np.arange(len(seeds)))
        alive, plans, since = (
            np.arange(len(seeds)),
            np.empty((len(seeds), controller.horizon, states.shape[1])),
            0,
        )
        shift = 0 if controller.warm is None else controller.execute
        method, stuck, before = (
            CarriedMultipliers(controller.method, shift),
            np.zeros(len(seeds), dtype=bool),
            alive,
        )
        while log.done < total and len(alive):
            tau = log.done
            if since == 0:
                last = plans[alive] if tau and controller.warm is not None else None
                goes_on = controller.resume or (last is not None and not controller.watchful)
                method = CarriedMultipliers(
                    controller.method,
                    shift,
                    method.select(np.isin(before, alive)) if goes_on else None,
                )
                before, draws = (
                    alive,
                    _draws(controller, [each for i in alive for each in generators[i]]),
                )
                found = _plan(
                    controller, method, _Asked(states[alive], log.now(alive), last, draws)
                )
                plans[alive] = found.x
                log.plan(tau, alive, found.x, found.g, found.calls, found.total_s, found.network_s)
                stuck[alive] = found.missed
                alive = log.end(log.diverged, alive, ~np.isfinite(found.x).all(axis=(1, 2)))
                if not len(alive):
                    break
            target = plans[alive, min(since + controller.ahead, controller.horizon - 1)]
            u = controller.inverse(
                *(
                    torch.from_numpy(s).float().to(controller.device)
                    for s in (states[alive], target)
                )
            )
            if on_frame and alive[0] == 0:
                on_frame(tau, envs[0], plans[0])
            inputs = u.double().cpu().numpy()
            for row, i in enumerate(alive):
                if stuck[i]:
                    inputs[row], log.braked[i, tau] = cast(Any, controller.brake)(states[i]), 1.0
            fell, diverged = np.zeros(len(alive), dtype=bool), np.zeros(len(alive), dtype=bool)
            for row, i in enumerate(alive):
                disturbance = (
                    controller.action_noise
                    * disturbances[i].normal(size=len(low))
                    * (high - low)
                    / 2
                )
                push = np.clip(inputs[row] + disturbance, low, high).astype(np.float32)
                obs, reward, terminated, _, info = envs[i].step(push)
                states[i] = task.observe(obs)
                log.act(tau, int(i), push, float(reward), info)
                fell[row], diverged[row] = terminated, not np.isfinite(states[i]).all()
            since = (since + 1) % controller.execute
            log.foresee(
                tau + 1,
                plans[alive, since or controller.execute],
                alive,
                since or controller.execute,
            )
            log.observe(tau + 1, states[alive], [task.observed(envs[i]) for i in alive], alive)
            log.end(log.diverged, alive, diverged)
            log.end(log.fell, alive, fell & ~diverged)
            alive = alive[~(fell | diverged)]
            log.done += 1
            if on_step:
                on_step(log.done, total)
    finally:
        for env in envs:
            env.close()
    return log.episodes()


def _in_units(denoiser: Denoiser, scale: Tensor) -> Denoiser:
    """The denoiser on coordinates y = scale z, which have the units of the environment: what is near is measured there. The scales
    of z differ a hundredfold along the window, and a method on z would leave the first waypoints, which are all that is
    executed, as they are. The reverse steps are linear and without a constant, so that they are the same in y.

    scale   [horizon, dim]
    """
    return lambda y, t: scale * denoiser(y / scale, t)


@dataclass(frozen=True)
class _Found:
    """Plans of one control step: x [n, horizon, dim], the constraint they were scored by, whether they miss what they were to
    obey [n], network calls of each [n], times.
    """

    x: Array
    g: Constraint
    missed: NDArray[np.bool_]
    calls: NDArray[np.int_]
    total_s: float
    network_s: float


class _Asked(NamedTuple):
    """What plans of one control step begin from: states [n, dim], observed quantities [n], the last plans [n, horizon, dim] where
    they are carried on, noise [n tries, count, horizon, dim].
    """

    states: Array
    observed: Mapping[str, Array]
    last: Array | None
    draws: Tensor

    def select(self, which: Any, draws: Tensor) -> "_Asked":
        """The same of some of the episodes, or of each several times, with that noise."""
        seen = {name: values[which] for name, values in self.observed.items()}
        return _Asked(
            self.states[which], seen, None if self.last is None else self.last[which], draws
        )

    @property
    def seen(self) -> ObservedValues:
        return {name: torch.from_numpy(values) for name, values in self.observed.items()}

    def bind(self, g: Constraint, controller: Controller) -> Constraint:
        """g as it is now."""
        return g.bind(self.seen, controller.task.dt, controller.horizon)


def _plan(controller: Controller, method: Method, asked: _Asked) -> _Found:
    """Plans for all. Where one of several cannot be, the others are made without it; one that cannot be is to stay where it is, and
    missed.
    """
    if isinstance(controller.method, BestOf):
        return _best_of(controller, asked)
    began = time.perf_counter()
    try:
        return _plan_together(controller, method, asked)
    except InfeasibleError:
        if controller.brake is None:
            raise
    n = len(asked.states)
    if n == 1:
        stay, one = asked.states[:, None].repeat(controller.horizon, 1), np.ones(1, dtype=int)
        scored, spent = asked.bind(controller.g, controller), time.perf_counter() - began
        return _Found(stay, scored, one.astype(bool), controller.calls * one, spent, 0.0)
    return _apart(controller, asked, [np.array([i]) for i in range(n)])


def _apart(controller: Controller, asked: _Asked, groups: Sequence[NDArray[np.intp]]) -> _Found:
    """Plans made group by group, in the order of the episodes."""
    began = time.perf_counter()
    each = [
        _plan(controller, controller.method, asked.select(group, asked.draws[group]))
        for group in groups
    ]
    order = np.argsort(np.concatenate(groups))
    x, missed, calls = (
        np.concatenate(column)[order]
        for column in zip(*((f.x, f.missed, f.calls) for f in each), strict=True)
    )
    scored = asked.bind(controller.g, controller)
    return _Found(
        x,
        scored,
        missed,
        calls,
        time.perf_counter() - began,
        sum(found.network_s for found in each),
    )


def _best_of(controller: Controller, asked: _Asked) -> _Found:
    """Of `tries` unconstrained plans an episode the one with the least sum of [g]_+, g as enforced; the first among equals."""
    n, k = len(asked.states), controller.tries
    many = asked.select(np.repeat(np.arange(n), k), asked.draws)
    found = _plan_together(controller, Unconstrained(), many)
    unsafe = (
        many.bind(controller.enforced, controller)(torch.from_numpy(found.x))
        .clamp_min(0)
        .sum(1)
        .numpy()
    )
    best = np.nan_to_num(unsafe, nan=np.inf).reshape(n, k).argmin(1) + k * np.arange(n)
    scored = asked.bind(controller.g, controller)
    return _Found(
        found.x[best], scored, found.missed[best], found.calls[best], found.total_s, found.network_s
    )


def _plan_together(controller: Controller, method: Method, asked: _Asked) -> _Found:
    states, _, last, draws = asked
    device, horizon = controller.device, controller.horizon
    synchronise(device)
    began = time.perf_counter()
    with torch.inference_mode():
        here = torch.from_numpy(states)
        timed = Timed(
            controller.denoiser
            if controller.seeing is None
            else controller.seeing(asked.seen, here),
            device,
        )
        to, like = controller.frame.at(here), torch.empty(0, device=device)
        scale, unit = to.scale.to(like), torch.ones_like(here[0])
        scored = asked.bind(controller.g, controller)
        obeyed = (
            scored
            if controller.enforced is controller.g
            else asked.bind(controller.enforced, controller)
        )
        g = pull_back(obeyed, to.centre, unit).to(like)
        if controller.condensed is not None:
            g = replace(g, condensed=controller.condensed.about(to.centre, like))
        mask = torch.zeros((horizon, states.shape[1]), dtype=torch.bool, device=device)
        mask[0] = True
        begin = here[:, None] - to.centre
        schedule, first = controller.schedule, None
        noise = iter((scale * draws.to(device)).unbind(1))
        on = None if last is None else shift_plan(to, last, controller.execute)
        if on is not None and controller.watchful:
            overtaken = (
                (obeyed(torch.cat((here[:, None], (to.centre + on)[:, 1:]), 1)) > 0).any(1).numpy()
            )
            if overtaken.any() and not overtaken.all():
                return _apart(
                    controller, asked, [overtaken.nonzero()[0], (~overtaken).nonzero()[0]]
                )
            on = None if overtaken.all() else on
        if on is not None:
            schedule = schedule.until(controller.redone)
            a = schedule.alpha_bar[-1]
            first = a**0.5 * on.to(like) + (1 - a) ** 0.5 * next(noise)
        y = sample(
            _in_units(timed, scale),
            schedule,
            method,
            g,
            Pins(mask, begin.to(like)),
            lambda: next(noise),
            kernel=load_kernel(controller.kernel),
            extra_steps=controller.extra_steps,
            first=first,
        ).x
        y64 = y.double().cpu()
        inside = (
            obeyed
            if controller.condensed is None
            else replace(obeyed, condensed=controller.condensed)
        )
        outside = controller.polish and bool((inside(to.centre + y64) > -MARGIN).any())
        if outside:
            g64 = pull_back(obeyed.tighten(MARGIN), to.centre, unit)
            y64 = project(g64, y64, Pins(mask.cpu(), begin), strict=False)
        x = (to.centre + y64).numpy()
        x[:, 0] = states
        missed = np.zeros(len(x), dtype=bool)
        if outside and controller.brake is not None:
            missed = (obeyed(torch.from_numpy(x)) > TOLERANCE).any(1).numpy()
    synchronise(device)
    calls = np.full(len(x), controller.calls_of(schedule.n_steps))
    return _Found(x, scored, missed, calls, time.perf_counter() - began, timed.seconds)


def _draws(controller: Controller, generators: Sequence[torch.Generator]) -> Tensor:
    """Noise for a whole plan, one generator a plan [n, steps + 1, horizon, dim]."""
    shape = (controller.schedule.n_steps + 1, controller.horizon, len(controller.task.layout))
    return controller.temperature * torch.stack(
        [torch.randn(shape, generator=generator) for generator in generators]
    )
