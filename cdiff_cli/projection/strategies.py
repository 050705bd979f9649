"""The ways in which a trajectory is projected onto a constraint, one class each.

A strategy says whether it applies to a problem, and solves it. The order in which strategies are
tried is in project.py.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple, Protocol

import torch

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.dynamics import LinearDynamicsConstraint, dynamics_of
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import RateLimit, limits_of
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.projection.dykstra import dykstra
from cdiff_cli.projection.projectors import PROJECTORS, projector_of
from cdiff_cli.projection.rate import RateProjection
from cdiff_cli.projection.rate_dynamics import StepLimit, limits_steps, only_ends, project_rates
from cdiff_cli.projection.segments import (
    MAX_CHOICES,
    Obstacle,
    has_half_spaces,
    project_segments,
)
from cdiff_cli.projection.sequential_qp import free_rows, holds, sequential_qp


@dataclass
class Problem:
    """A projection to be solved, and what strategies ask about it.

    z             the trajectories, with pinned coordinates at their values
    strict        whether a result must satisfy g; if not, the best point around obstacles is enough
    tolerance     violation of g that rounding alone may cause, environment units
    dynamics      parts that are dynamics
    obstacles     parts that half-spaces describe, where one of them is on segments
    others        the parts that are not obstacles
    rates         parts that limit rates
    step_limits   the other parts, where all are limits on steps and one is a rate; else none
    """

    g: Constraint
    z: Traj
    pins: Pins
    strict: bool
    tolerance: float
    dynamics: Sequence[LinearDynamicsConstraint]
    obstacles: Sequence[Obstacle]
    others: Sequence[TrajectoryConstraint]
    rates: Sequence[RateLimit]
    step_limits: Sequence[StepLimit]

    @classmethod
    def from_constraint(cls, g: Constraint, z: Traj, pins: Pins, strict: bool) -> "Problem":
        """The problem of projecting z onto g and the pins."""
        obstacles: Sequence[Obstacle] = []
        others: Sequence[TrajectoryConstraint] = g.parts
        if any(isinstance(part, OnSegments) for part in g.parts):
            obstacles = [part for part in g.parts if has_half_spaces(part)]
        if obstacles:
            others = [part for part in g.parts if not has_half_spaces(part)]
        rates = limits_of(g)
        limits = [part for part in others if limits_steps(part)] if rates else []
        if len(limits) < len(others) or not only_ends(pins):
            limits = []
        tolerance = 1e-9 if z.dtype == torch.float64 else 2e-6
        z = pins.paint(z)
        return cls(g, z, pins, strict, tolerance, dynamics_of(g), obstacles, others, rates, limits)

    @property
    def empty(self) -> bool:
        """Whether there is nothing to project."""
        return not self.g.parts or self.z.numel() == 0

    @property
    def max_choices(self) -> int:
        """How often tangent half-spaces are chosen."""
        return MAX_CHOICES if self.strict else 1

    @property
    def several(self) -> bool:
        """Whether several parts without obstacles or dynamics must hold together."""
        plain = len(self.others) > 1 and not self.obstacles and not self.dynamics
        return plain and self.pins.whole

    @property
    def coupled(self) -> bool:
        """Whether rates must hold together with obstacles or barriers."""
        together = bool(self.obstacles) or len(self.rates) < len(self.others)
        return bool(self.step_limits) and together

    @property
    def exact(self) -> bool:
        """Whether every part besides obstacles has a projector of its own."""
        return (self.pins.whole or not self.others) and all(
            projector_of(part) is not None for part in self.others
        )

    @cached_property
    def projections(self) -> list[Callable[[Traj], Traj]]:
        """The projections onto the obstacles, onto all rates, and onto each other part."""
        pins, onto = self.pins, list[Callable[[Traj], Traj]]()
        if self.obstacles:
            onto.append(lambda y: project_segments(self.obstacles, y, pins, self.max_choices))
        if self.rates:
            onto.append(RateProjection(self.rates, pins))
        for part in self.others:
            if not isinstance(part, RateLimit):
                onto.append(partial(_project_part, part, pins))
        return onto

    def nearly_holds(self, x: Traj) -> bool:
        """Whether x satisfies g up to a hundred times the tolerance."""
        return not bool((free_rows(self.g, x, self.pins) > 100 * self.tolerance).any())


def _project_part(part: TrajectoryConstraint, pins: Pins, z: Traj) -> Traj:
    return PROJECTORS[type(part)].project(part, z, pins)


class Attempt(NamedTuple):
    """What a strategy returns.

    x          the trajectories
    accepted   whether they are the result of the projection
    start      whether they are where the next strategies start from, because they are near the set
               and pass the obstacles on the right side
    """

    x: Traj
    accepted: bool
    start: bool = False


class Strategy(Protocol):
    def applies(self, problem: Problem) -> bool:
        """Whether the strategy can solve the problem."""
        ...

    def solve(self, problem: Problem, start: Traj) -> Attempt:
        """Solve the problem, from `start` where the strategy is iterative."""
        ...


class Unchanged:
    """z itself, where several parts are satisfied or there is nothing to project."""

    def applies(self, problem: Problem) -> bool:
        return problem.empty or problem.several

    def solve(self, problem: Problem, start: Traj) -> Attempt:
        z = problem.z
        return Attempt(z, problem.empty or not bool((problem.g(z) > 0).any()))


class OneBroken:
    """The projection onto the only violated part of several, where it satisfies the others too.

    The nearest point of a larger set is the nearest point of a subset that contains it.
    """

    def applies(self, problem: Problem) -> bool:
        return problem.several

    def solve(self, problem: Problem, start: Traj) -> Attempt:
        g, z, pins = problem.g, problem.z, problem.pins
        broken = [part for part in g.parts if bool((part(z) > 0).any())]
        projector = projector_of(broken[0]) if len(broken) == 1 else None
        if projector is None:
            return Attempt(z, False)
        x = projector.project(broken[0], z, pins)
        return Attempt(x, bool((free_rows(g, x, pins) <= problem.tolerance).all()))


class CoupledLimits:
    """Limits on rates together with obstacles or barriers, by an interior-point method."""

    def applies(self, problem: Problem) -> bool:
        return problem.coupled

    def solve(self, problem: Problem, start: Traj) -> Attempt:
        obstacles, limits, pins = problem.obstacles, problem.step_limits, problem.pins
        x = project_rates(obstacles, limits, problem.z, pins, problem.max_choices)
        return Attempt(x, not problem.strict or holds(problem.g, x, pins), start=True)


class TangentHalfSpaces:
    """Segments around ellipsoids by tangent half-spaces, with others by Dykstra's algorithm.

    Where Dykstra's algorithm does not satisfy g, alternating projections find a feasible point that
    is near, if not the nearest.
    """

    def applies(self, problem: Problem) -> bool:
        return bool(problem.obstacles) and problem.exact and not problem.coupled

    def solve(self, problem: Problem, start: Traj) -> Attempt:
        g, z, pins, tolerance = problem.g, problem.z, problem.pins, problem.tolerance
        onto = problem.projections
        if len(onto) == 1:
            x = onto[0](z)
        else:
            x = dykstra(g, onto, z, pins, tolerance)
            if not problem.nearly_holds(x):
                x = dykstra(g, onto, z, pins, tolerance, corrected=False)
        return Attempt(x, not problem.strict or problem.nearly_holds(x), start=True)


class OneExactForm:
    """The projection onto one part, or onto several rate limits, by its own projector."""

    def applies(self, problem: Problem) -> bool:
        return _alone(problem) and len(problem.projections) == 1

    def solve(self, problem: Problem, start: Traj) -> Attempt:
        x = problem.projections[0](problem.z)
        # One part misses only rows behind the last free waypoint; without any it is exact.
        certain = len(problem.g.parts) == 1 and problem.pins.loose[1] == problem.z.shape[1]
        return Attempt(x, certain or problem.nearly_holds(x))


class Dykstra:
    """Several parts that have a projector each, by Dykstra's algorithm."""

    def applies(self, problem: Problem) -> bool:
        return _alone(problem) and len(problem.projections) > 1

    def solve(self, problem: Problem, start: Traj) -> Attempt:
        g, z, pins = problem.g, problem.z, problem.pins
        x = dykstra(g, problem.projections, z, pins, problem.tolerance)
        return Attempt(x, problem.nearly_holds(x))


class RatesInteriorPoint:
    """Rate limits whose pins leave little freedom, where ADMM takes more than its rounds."""

    def applies(self, problem: Problem) -> bool:
        return bool(problem.step_limits) and not problem.coupled

    def solve(self, problem: Problem, start: Traj) -> Attempt:
        x = project_rates((), problem.step_limits, problem.z, problem.pins)
        return Attempt(x, holds(problem.g, x, problem.pins))


class SequentialQP:
    """Any smooth constraint, by sequential quadratic programming, plan by plan until one fails."""

    def applies(self, problem: Problem) -> bool:
        return not problem.dynamics

    def solve(self, problem: Problem, start: Traj) -> Attempt:
        out = problem.z.to(torch.float64, copy=True)
        for b in range(len(out)):
            plan = slice(b, b + 1)
            target, x = problem.z[plan].double(), start[plan].double()
            held = Pins(problem.pins.mask, x)
            one = problem.g.select(torch.tensor([b], device=x.device)).to(x)
            out[plan] = sequential_qp(one, target, x, held, problem.tolerance)
            if not holds(one, out[plan], held):
                return Attempt(out, False)
        return Attempt(out.to(problem.z), True)


def _alone(problem: Problem) -> bool:
    """Whether parts with projectors, no obstacles and no dynamics make up the problem."""
    return problem.exact and not problem.obstacles and not problem.coupled and not problem.dynamics
