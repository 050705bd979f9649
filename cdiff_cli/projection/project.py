"""Euclidean projection onto {x : g(x) <= 0, pinned coordinates fixed}.

    P(z) = argmin |x - z|^2  s.t.  g(x) <= 0          (paper, the projection operator)

half-space, ball, ellipsoid, quadric at waypoints   closed form, or one scalar root (state.py)
segments outside ellipsoids, half-spaces            tangent half-spaces, local (segments.py)
discrete barrier over a half-space or a ball        isotonic regression or small QP (barrier.py)
limits on the rate of change                        ADMM on the differences (rate.py)
limits on rates around ellipsoids                   interior points (rate_dynamics.py)
linear dynamics with bounded inputs                 active set (dynamics.py), with rates interior
                                                    points, with other parts ADMM; local
several of these together                           Dykstra's algorithm (dykstra.py)
anything else                                       sequential QP by ProxQP (sequential_qp.py)
"""

from collections.abc import Sequence
from dataclasses import dataclass

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.dynamics import LinearDynamicsConstraint, dynamics_of, split
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.projection import infeasible
from cdiff_cli.projection.dynamics import ActiveSetWarmStart, project_dynamics
from cdiff_cli.projection.rate_dynamics import StepLimit, limits_steps, project_rate_dynamics
from cdiff_cli.projection.segments import MAX_CHOICES, Obstacle, has_half_spaces
from cdiff_cli.projection.strategies import (
    Attempt,
    CoupledLimits,
    Dykstra,
    OneBroken,
    OneExactForm,
    Problem,
    RatesInteriorPoint,
    SequentialQP,
    Strategy,
    TangentHalfSpaces,
    Unchanged,
)

ADMM_ROUNDS = 600  # rounds of ADMM where dynamics hold together with parts that have no rows


class Dynamics:
    """Linear dynamics, alone or with other parts, by an active set or by interior points."""

    def applies(self, problem: Problem) -> bool:
        return bool(problem.dynamics)

    def solve(self, problem: Problem, start: Traj) -> Attempt:
        return Attempt(project_reachable(problem.g, problem.z, problem.pins)[0], True)


STRATEGIES: Sequence[Strategy] = (
    Unchanged(),
    OneBroken(),
    Dynamics(),
    CoupledLimits(),
    TangentHalfSpaces(),
    OneExactForm(),
    Dykstra(),
    RatesInteriorPoint(),
    SequentialQP(),
)
"""In order: the first that applies and whose result is accepted. Exact ones first."""


def project(g: Constraint, z: Traj, pins: Pins, *, strict: bool = True) -> Traj:
    """The trajectory nearest to z [batch, horizon, dim] that satisfies g and the pins.

    Convex parts with a projector: the global nearest point. Non-convex intersections: a local one.

    strict   True: raise InfeasibleError, naming rows, where no feasible point was found. False, for
             sampling: return the best point that tangent half-spaces gave. With dynamics the result
             is never refused.
    """
    problem = Problem.from_constraint(g, z, pins, strict)
    start, x = problem.z, problem.z
    if strict and not problem.dynamics:
        infeasible.check_pins(g, Pins(pins.mask, problem.z), max(problem.tolerance, 1e-6))
    for strategy in STRATEGIES:
        if strategy.applies(problem):
            x, accepted, is_start = strategy.solve(problem, start)
            if accepted:
                return x
            start = x if is_start else start
    raise infeasible.explain(g, problem.z, start.double(), x, pins, problem.tolerance)


@dataclass(frozen=True)
class DynamicsProblem:
    """A projection onto dynamics and other parts, in environment units and float64.

    part        the dynamics
    obstacles   parts that half-spaces describe, on `columns`
    others      all other parts, on `columns`
    z           the trajectories
    pins        pinned coordinates at their values in environment units
    columns     the coordinates that the other parts constrain
    """

    part: LinearDynamicsConstraint
    obstacles: list[Obstacle]
    others: list[TrajectoryConstraint]
    z: Traj
    pins: Pins
    columns: list[int]

    @classmethod
    def from_constraint(cls, g: Constraint, z: Traj, pins: Pins) -> "DynamicsProblem":
        """The problem of a constraint with dynamics; raises InfeasibleError for two dynamics."""
        dynamics, rest = dynamics_of(g), split(g)[0].parts
        if len(dynamics) > 1:
            raise InfeasibleError(
                f'two sets of dynamics, "{dynamics[0].name}" and "{dynamics[1].name}": a plan can'
                " satisfy only one"
            )
        z = pins.paint(z).double()
        part, dim = dynamics[0].to(z), z.shape[-1]
        columns = sorted({column for other in rest for column in other.coordinates(dim)})
        units = [other.to(z).pull_back(-part.centre / part.scale, 1 / part.scale) for other in rest]
        restricted = [other.restrict(columns) for other in units]
        return cls(
            part,
            [other for other in restricted if has_half_spaces(other)],
            [other for other in restricted if not has_half_spaces(other)],
            part.decode(z),
            Pins(pins.mask, part.decode(pins.values.to(z))),
            columns,
        )

    @property
    def step_limits(self) -> list[StepLimit]:
        """The other parts where all are limits on steps; else none."""
        limits = [part for part in self.others if limits_steps(part)]
        return limits if len(limits) == len(self.others) else []


def project_reachable(
    g: Constraint,
    z: Traj,
    pins: Pins,
    warm: ActiveSetWarmStart | None = None,
    tolerance: float = 1e-6,
) -> tuple[Traj, ActiveSetWarmStart]:
    """The projection onto a g with dynamics, and a warm start for the next call.

    The dynamics are satisfied exactly, the other parts up to the tolerance (environment units).
    """
    problem = DynamicsProblem.from_constraint(g, z, pins)
    solve = by_interior_points if problem.step_limits else by_active_set
    x, warm = solve(problem, warm, tolerance)
    return pins.paint(problem.part.encode(x).to(z)), warm


def by_active_set(
    problem: DynamicsProblem, warm: ActiveSetWarmStart | None, tolerance: float
) -> tuple[Traj, ActiveSetWarmStart]:
    """The nearest trajectory by an active set, with ADMM where parts have no half-spaces."""
    rest = Constraint(tuple(problem.others))
    return project_dynamics(
        problem.part.dynamics,
        problem.obstacles,
        (lambda y, held: project(rest, y, held, strict=False)) if rest.parts else None,
        problem.z,
        problem.pins,
        columns=problem.columns,
        weight=problem.part.weight,
        rounds=ADMM_ROUNDS,
        max_choices=MAX_CHOICES,
        warm=warm,
        tolerance=tolerance,
    )


def by_interior_points(
    problem: DynamicsProblem, warm: ActiveSetWarmStart | None, tolerance: float
) -> tuple[Traj, ActiveSetWarmStart]:
    """The nearest trajectory by interior points, where all other parts limit steps.

    Of a warm start only the inputs are used, to choose the first half-spaces.
    """
    dynamics = problem.part.dynamics
    x, u = project_rate_dynamics(
        dynamics,
        problem.obstacles,
        problem.step_limits,
        problem.z,
        problem.pins,
        columns=problem.columns,
        weight=problem.part.weight,
        max_choices=MAX_CHOICES,
        tolerance=tolerance,
        start=None if warm is None else dynamics.rollout(problem.z[:, 0], warm.u),
    )
    none = u.new_zeros(len(u), 0)
    return x, ActiveSetWarmStart(none, u, none, none, none)
