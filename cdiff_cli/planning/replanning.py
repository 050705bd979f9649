"""One plan per episode from its present state: what a controller makes at each planning step."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.affine_rows import AffineRows
from cdiff_cli.constraints.observed import ObservedValues
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.errors import CdiffError, InfeasibleError
from cdiff_cli.models.denoiser import Denoiser
from cdiff_cli.models.normaliser import Normaliser
from cdiff_cli.models.planner import Planner
from cdiff_cli.models.preset import ControlSettings, SamplerSettings
from cdiff_cli.planning.problem import POLISH_MARGIN
from cdiff_cli.planning.timing import Timed, synchronise
from cdiff_cli.planning.warm_start import carry, shift_plan
from cdiff_cli.projection.project import project
from cdiff_cli.sampling import load_kernel
from cdiff_cli.sampling.baselines import Unconstrained
from cdiff_cli.sampling.sampler import Method, Sample, sample

INFEASIBLE_ABOVE = 1e-3
"""Value of a finished plan's g, environment units, above which it counts as infeasible."""

Streams = Sequence[Sequence[torch.Generator]]

SAMPLER, CONTROL = SamplerSettings(polish=True), ControlSettings()
"""Settings of a controller that is given none."""


@dataclass(frozen=True)
class Plan:
    """The plans of one planning step, one per episode.

    x            environment units [n, horizon, dim]
    levels       value of each declared constraint along them, unsafe above 0
                 [n, horizon, constraints]
    violation    sum of [g]_+ over waypoints and rows, as declared [n]
    infeasible   whether the projection found no plan that satisfies the constraints [n]
    calls        network calls per plan [n]
    total_s, network_s   wall time of the batch, and the network's part of it
    """

    x: Array
    levels: Array
    violation: Array
    infeasible: NDArray[np.bool_]
    calls: NDArray[np.int_]
    total_s: float
    network_s: float

    def select(self, episodes: Any) -> "Plan":
        """The plans of some episodes."""
        return replace(
            self,
            x=self.x[episodes],
            levels=self.levels[episodes],
            violation=self.violation[episodes],
            infeasible=self.infeasible[episodes],
            calls=self.calls[episodes],
        )


class _Batch(NamedTuple):
    """What plans begin from, one row per episode or candidate.

    states     present states [n, dim]
    observed   observed quantities, each [n]
    last       the previous plans where they are continued [n, horizon, dim], else None
    noise      [n candidates, draws, horizon, dim]
    """

    states: Array
    observed: Mapping[str, Array]
    last: Array | None
    noise: Tensor

    def select(self, rows: Any, noise: Tensor) -> "_Batch":
        """Some rows, or each several times, with that noise."""
        observed = {name: values[rows] for name, values in self.observed.items()}
        last = None if self.last is None else self.last[rows]
        return _Batch(self.states[rows], observed, last, noise)

    @property
    def observed_values(self) -> ObservedValues:
        return {name: torch.from_numpy(np.array(v)) for name, v in self.observed.items()}


class _Carried(NamedTuple):
    """Multipliers of the previous plans, and the waypoints executed since; None: begin anew."""

    multipliers: Any = None
    executed: int = 0


AFRESH = _Carried()


@dataclass(frozen=True)
class Replanner:
    """How plans are made while acting.

    planner          with an inverse dynamics model
    declared         g as declared: what is scored                    environment units
    method           how sampling satisfies the constraints
    enforced         what plans satisfy, tightened by the margins     environment units;
                     None: declared
    sampler          kernel, extra steps, temperature, final projection
    control          steps executed per plan, warm start, carried multipliers, disturbance
    fallback_action  state [dim] -> input [m], for a state from which the final projection found no
                     plan that satisfies the constraints; None: the infeasible plan is followed
    ahead            waypoints between the two states that the inverse dynamics model is given
    """

    planner: Planner
    declared: Constraint
    method: Method
    enforced: Constraint | None = None
    sampler: SamplerSettings = SAMPLER
    control: ControlSettings = CONTROL
    fallback_action: Callable[[Array], Array] | None = None
    ahead: int = 1

    def __post_init__(self) -> None:
        most = self.planner.horizon - self.ahead
        if not 1 <= self.control.execute <= most:
            raise CdiffError(
                f"--execute: expected 1 to {most} steps of a plan of {self.planner.horizon}, "
                f"found {self.control.execute}"
            )

    @property
    def satisfied(self) -> Constraint:
        """What plans satisfy."""
        return self.declared if self.enforced is None else self.enforced

    @cached_property
    def condensed(self) -> AffineRows | None:
        """The rows that plans satisfy as one matrix, float64; None where they are not affine."""
        return self.satisfied.condense(self.planner.horizon, self.planner.dim)

    @property
    def replans_when_unsafe(self) -> bool:
        """Whether a warm start that violates what is observed now gives way to a plan from noise.

        Where constraints are observed anew at each step, a plan that is continued keeps every push
        away from where the obstacle was, and slows down from plan to plan. Multipliers are then not
        carried either.
        """
        return self.satisfied.waits and self.method.polished

    @property
    def denoising_steps(self) -> int:
        """Diffusion steps per plan, for a plan that continues another where starts are warm."""
        n, share = self.planner.schedule.n_steps, self.control.warm_start
        return n if share is None else max(1, round(share * n))

    @property
    def calls(self) -> int:
        """Network calls per plan, for a plan that continues another where starts are warm."""
        return self.calls_for(self.denoising_steps)

    def calls_for(self, steps: int) -> int:
        """Network calls per plan of that many diffusion steps."""
        each = (steps + self.sampler.extra_steps) * self.planner.calls_per_step
        return self.method.candidates * each

    def inputs(self, x: Array, plan: Plan, since: int) -> Array:
        """Inputs [n, m] that follow the plans from x [n, dim], `since` steps into them."""
        inverse = self.planner.inverse_dynamics
        if inverse is None:
            raise CdiffError("the planner has no inverse dynamics; give it one")
        target = plan.x[:, min(since + self.ahead, self.planner.horizon - 1)]
        u = np.array(inverse(x, target), dtype=np.float64)
        if self.fallback_action is not None:
            for row in np.flatnonzero(plan.infeasible):
                u[row] = self.fallback_action(x[row])
        return u

    def replan(
        self,
        streams: Streams,
        previous: Plan | None,
        multipliers: Any,
        x: Array,
        observed: Mapping[str, Array],
    ) -> tuple[Plan, Any]:
        """Plans from the states x [n, dim], and the method's multipliers at their end."""
        warm = self.control.warm_start is not None
        last = previous.x if previous is not None and warm else None
        carries = self.control.carry_multipliers or (
            last is not None and not self.replans_when_unsafe
        )
        shift = self.control.execute if warm else 0
        noise = self._noise([stream for episode in streams for stream in episode])
        before = _Carried(multipliers if carries else None, shift)
        return self._plan(_Batch(x, observed, last, noise), before)

    def _noise(self, streams: Sequence[torch.Generator]) -> Tensor:
        """Noise for whole plans, one stream per plan [n, steps + 1, horizon, dim]."""
        shape = (self.planner.schedule.n_steps + 1, self.planner.horizon, self.planner.dim)
        draws = [torch.randn(shape, generator=stream) for stream in streams]
        return self.sampler.temperature * torch.stack(draws)

    def _bind(self, g: Constraint, batch: _Batch) -> Constraint:
        """g with what is observed now."""
        return g.bind(batch.observed_values, self.planner.dt or 0.0, self.planner.horizon)

    def _plan(self, batch: _Batch, before: _Carried = AFRESH) -> tuple[Plan, Any]:
        """Plans for all; where one cannot be made, the others are made without it.

        An episode whose plan cannot be made stays where it is, and counts as infeasible.
        """
        if self.method.candidates > 1:
            return self._best_of(batch), None
        began = time.perf_counter()
        try:
            return self._plan_together(self.method, batch, before)
        except InfeasibleError:
            if self.fallback_action is None:
                raise
        n = len(batch.states)
        if n == 1:
            stay = batch.states[:, None].repeat(self.planner.horizon, 1)
            spent = time.perf_counter() - began
            calls = np.full(1, self.calls)
            return self._scored(stay, batch, np.ones(1, dtype=bool), calls, spent, 0.0), None
        return self._apart(batch, [np.array([i]) for i in range(n)]), None

    def _apart(self, batch: _Batch, groups: Sequence[NDArray[np.intp]]) -> Plan:
        """Plans made group by group, in the order of the episodes."""
        began = time.perf_counter()
        plans = [self._plan(batch.select(group, batch.noise[group]))[0] for group in groups]
        order = np.argsort(np.concatenate(groups))
        x = np.concatenate([plan.x for plan in plans])[order]
        infeasible = np.concatenate([plan.infeasible for plan in plans])[order]
        calls = np.concatenate([plan.calls for plan in plans])[order]
        network = sum(plan.network_s for plan in plans)
        spent = time.perf_counter() - began
        return self._scored(x, batch, infeasible, calls, spent, network)

    def _best_of(self, batch: _Batch) -> Plan:
        """The safest of several unconstrained plans per episode: the least sum of [g]_+."""
        n, k = len(batch.states), self.method.candidates
        many = batch.select(np.repeat(np.arange(n), k), batch.noise)
        plan, _ = self._plan_together(Unconstrained(), many)
        g = self._bind(self.satisfied, many)
        unsafe = g(torch.from_numpy(plan.x)).clamp_min(0).sum(1).numpy()
        best = np.nan_to_num(unsafe, nan=np.inf).reshape(n, k).argmin(1) + k * np.arange(n)
        return plan.select(best)

    def _scored(
        self,
        x: Array,
        batch: _Batch,
        infeasible: NDArray[np.bool_],
        calls: NDArray[np.int_],
        total_s: float,
        network_s: float,
    ) -> Plan:
        """Plans with what the declared constraints say of them."""
        g, states = self._bind(self.declared, batch), torch.from_numpy(x)
        levels = g.state_values(states).numpy()
        violation = g(states).clamp_min(0).sum(1).numpy()
        return Plan(x, levels, violation, infeasible, calls, total_s, network_s)

    def _plan_together(
        self, method: Method, batch: _Batch, before: _Carried = AFRESH
    ) -> tuple[Plan, Any]:
        planner = self.planner
        synchronise(planner.device)
        began = time.perf_counter()
        with torch.inference_mode():
            present = torch.from_numpy(batch.states)
            timed = Timed(self._denoiser(batch, present), planner.device)
            window = planner.normaliser.at(present)
            enforced = self._bind(self.satisfied, batch)
            mask = torch.zeros((planner.horizon, planner.dim), dtype=torch.bool)
            mask[0] = True
            pins = Pins(mask, present[:, None] - window.centre)
            last = (
                None if batch.last is None else shift_plan(window, batch.last, self.control.execute)
            )
            if last is not None and self.replans_when_unsafe:
                path = torch.cat((present[:, None], (window.centre + last)[:, 1:]), 1)
                unsafe = (enforced(path) > 0).any(1).numpy()
                if unsafe.any() and not unsafe.all():
                    return self._apart(batch, [unsafe.nonzero()[0], (~unsafe).nonzero()[0]]), None
                last = None if unsafe.all() else last
            made, steps = self._sample(
                timed, method, enforced, window, pins, last, batch.noise, before
            )
            y64, outside = self._polished(enforced, window.centre, made.x.double().cpu(), pins)
            x = (window.centre + y64).numpy()
            x[:, 0] = batch.states
            infeasible = np.zeros(len(x), dtype=bool)
            if outside and self.fallback_action is not None:
                infeasible = (enforced(torch.from_numpy(x)) > INFEASIBLE_ABOVE).any(1).numpy()
        synchronise(planner.device)
        spent = time.perf_counter() - began
        calls = np.full(len(x), self.calls_for(steps))
        return self._scored(x, batch, infeasible, calls, spent, timed.seconds), made.state

    def _denoiser(self, batch: _Batch, present: Tensor) -> Denoiser:
        conditioned = self.planner.conditioned_denoiser
        if conditioned is None or self.method.planner != "conditional":
            return self.planner.denoiser
        return conditioned(batch.observed_values, present)

    def _sample(
        self,
        denoiser: Denoiser,
        method: Method,
        enforced: Constraint,
        window: Normaliser,
        pins: Pins,
        last: Tensor | None,
        draws: Tensor,
        before: _Carried,
    ) -> tuple[Sample, int]:
        """Plans y, x = window.centre + y, and the diffusion steps taken.

        They continue the previous plans `last` where those are given.

        Sampling works on y = scale z, in environment units: distances are measured there. The
        scales of z differ a hundredfold along the window, and a method on z would leave the first
        waypoints, which are all that is executed, as they are. The reverse steps are linear without
        a constant, so they are the same in y.
        """
        device = self.planner.device
        like = torch.empty(0, device=device)
        centre, scale = window.centre, window.scale.to(like)
        g = pull_back(enforced, centre, torch.ones_like(centre[0, 0])).to(like)
        if self.condensed is not None:
            g = replace(g, condensed=self.condensed.about(centre, like))
        noise = iter((scale * draws.to(device)).unbind(1))
        schedule, first = self.planner.schedule, None
        if last is not None:
            schedule = schedule.until(self.denoising_steps)
            a = schedule.alpha_bar[-1]
            first = a**0.5 * last.to(like) + (1 - a) ** 0.5 * next(noise)
        held = Pins(pins.mask.to(device), pins.values.to(like))
        like_plans = held.values.expand(-1, *held.mask.shape)
        state = carry(method, before.multipliers, g, like_plans, before.executed)
        made = sample(
            lambda y, t: scale * denoiser(y / scale, t),
            schedule,
            method,
            g,
            held,
            lambda: next(noise),
            kernel=load_kernel(self.sampler.kernel),
            extra_steps=self.sampler.extra_steps,
            first=first,
            state=state,
        )
        return made, schedule.n_steps

    def _polished(
        self, enforced: Constraint, centre: Tensor, y: Tensor, pins: Pins
    ) -> tuple[Tensor, bool]:
        """Finished plans projected onto the constraints, and whether any of them needed it."""
        if not (self.sampler.polish and self.method.polished):
            return y, False
        known = enforced
        if self.condensed is not None:
            known = replace(enforced, condensed=self.condensed)
        if not bool((known(centre + y) > -POLISH_MARGIN).any()):
            return y, False
        unit = torch.ones_like(centre[0, 0])
        g = pull_back(enforced.tighten(POLISH_MARGIN), centre, unit)
        return project(g, y, Pins(pins.mask.cpu(), pins.values), strict=False), True
