"""The nearest trajectory that linear dynamics produce within limits on rates, around obstacles.

    minimise |x - z|^2_W   s.t.   x' = A x + B u + c,   low <= u <= high,   limits on x' - x,
                                  a.x <= b at waypoints,   pins

All plans of a batch are solved at once. The dynamics express x' - x by the state and inputs of a
step, so a limit on a rate is a convex limit at one waypoint, and all limits are solved together
(interior_point.py). Obstacles are replaced by tangent half-spaces, chosen anew at each solution
(segments.py). Where no trajectory satisfies all limits, goals give way first.
"""

import math
from collections.abc import Sequence
from typing import TypeGuard, cast

import torch
from torch import Tensor

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.dynamics import LinearDynamics
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import RateLimit
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import TrajectoryConstraint
from cdiff_cli.projection.segments import Obstacle, Plans, TangentChoice, around_obstacles, crossed
from cdiff_cli.projection.solvers.half_spaces import NEVER, HalfSpaces
from cdiff_cli.projection.solvers.interior_point import YIELDING, ConicLimits, solve

StepLimit = RateLimit | DiscreteBarrier
INFEASIBLE_ABOVE = (
    1e-4  # violation that counts as infeasible: share of a limit, or environment units
)


def limits_steps(part: TrajectoryConstraint) -> TypeGuard[StepLimit]:
    """Whether the part is a convex limit on each step, that is on the two states that it joins."""
    if isinstance(part, DiscreteBarrier):
        return (
            part.alpha2 is None and isinstance(part.acting, HalfSpace) and part.acting.a.ndim == 1
        )
    return isinstance(part, RateLimit) and part.scale.ndim == 1


def only_ends(pins: Pins) -> bool:
    """Whether the pins are the start and perhaps the goal, as project_rates takes them."""
    return pins.whole and bool(pins.held[:1].all()) and not bool(pins.held[1:-1].any())


def project_rate_dynamics(
    dynamics: LinearDynamics,
    parts: Sequence[Obstacle],
    limits: Sequence[StepLimit],
    z: Traj,
    pins: Pins,
    *,
    columns: Sequence[int],
    weight: Tensor,
    max_choices: int,
    tolerance: float,
    start: Traj | None = None,
) -> tuple[Traj, Tensor]:
    """The nearest trajectory to z that the dynamics produce from its first state within all limits.

    A pinned last state is reached. Also returns the inputs [batch, horizon - 1, m].

    parts, limits   act on the coordinates `columns` alone, in the units of z
    weight          weight per coordinate in |x - z|^2   [n]
    max_choices     how often tangent half-spaces are chosen, first at `start`, or z
    tolerance       violation of a part that is accepted without a new choice
    """
    if len(z) == 0 or z.shape[1] == 1:
        return z, dynamics.inputs(z)
    used, last = list(columns), pins.mask[-1]
    held = Pins(pins.mask[:, used], z[..., used])
    free = ~held.held[:, None]
    x, u = z.clone(), dynamics.inputs(z)
    fixed_limits = _step_limits(dynamics, limits, used, z.shape[1])
    width = z.shape[2] + u.shape[2]

    def solve_plans(half_spaces: HalfSpaces, plans: Tensor) -> tuple[Traj, Plans]:
        near = half_spaces.select(plans)
        conic = [*fixed_limits, _conic(near, free, used, width)] if parts else fixed_limits
        x[plans], u[plans] = _within(dynamics, conic, z[plans], weight, last)
        return x[plans][..., used], torch.zeros_like(plans, dtype=torch.bool)

    first = (z if start is None else start)[..., used]
    choice = TangentChoice.none(parts, first, held)
    unsafe = crossed(parts, first).nonzero()[:, 0]
    around_obstacles(solve_plans, choice, first, unsafe, max_choices, tolerance)
    return x, u


def project_rates(
    parts: Sequence[Obstacle],
    limits: Sequence[StepLimit],
    z: Traj,
    pins: Pins,
    max_choices: int = 0,
) -> Traj:
    """The nearest trajectory to z within the limits and around obstacles, without dynamics.

    The dynamics x' = x + u with unbounded inputs u produce every trajectory.
    """
    wide = pins.paint(z).double()
    one = torch.eye(z.shape[2], dtype=wide.dtype, device=wide.device)
    zero = wide.new_zeros(z.shape[2])
    x, _ = project_rate_dynamics(
        LinearDynamics(one, one, zero, zero - torch.inf, zero + torch.inf),
        [part.to(wide) for part in parts],
        [limit.to(wide) for limit in limits],
        wide,
        Pins(pins.mask, wide),
        columns=range(z.shape[2]),
        weight=zero + 1,
        max_choices=max_choices,
        tolerance=1e-9,
    )
    return pins.paint(x.to(z))


def _within(
    dynamics: LinearDynamics, limits: Sequence[ConicLimits], z: Tensor, weight: Tensor, end: Tensor
) -> tuple[Tensor, Tensor]:
    """The nearest trajectories within the limits, and their inputs.

    Where there are none, goals give way, then limits.
    """
    n, u = z.shape[2], 0.5 * dynamics.inputs(z)
    start = torch.cat((dynamics.rollout(z[:, 0], u), torch.nn.functional.pad(u, (0, 0, 0, 1))), 2)
    q = solve(dynamics.A, dynamics.B, limits, z, weight, start, end)
    missed = torch.where(end, q[:, -1, :n] - z[:, -1], 0.0).abs().amax(1)
    missed = torch.stack((missed, *(each.missed(q) for each in limits))).amax(0)
    infeasible = ~(missed < INFEASIBLE_ABOVE)
    if bool(infeasible.any()):
        some = [each.select(infeasible) if len(z) > 1 else each for each in limits]
        q[infeasible] = solve(
            dynamics.A,
            dynamics.B,
            some,
            z[infeasible],
            weight,
            start[infeasible],
            end,
            YIELDING,
        )
    return q[..., :n], q[:, :-1, n:]


def _conic(half_spaces: HalfSpaces, free: Tensor, columns: list[int], width: int) -> ConicLimits:
    """The half-spaces b - a.x >= 0 as limits on states and inputs.

    free      waypoints that are not pinned; other half-spaces are left out   [horizon, 1]
    columns   coordinates of the state that the half-spaces act on
    width     number of states and inputs n + m
    """
    a, b = half_spaces
    active = free & (b < NEVER)
    L = a.new_zeros(*b.shape, 1, width)
    L[..., 0, columns] = torch.where(active[..., None], -a, 0.0)
    return ConicLimits(L, torch.where(active, b, 1.0)[..., None])


Row = tuple[Tensor, Tensor]
"""Rows L q + o >= 0 of a step's state and inputs q: L [r, n + m], o [r]."""


def _step_limits(
    dynamics: LinearDynamics, limits: Sequence[StepLimit], columns: list[int], horizon: int
) -> list[ConicLimits]:
    """The bounds of the inputs, barriers and rates of single coordinates; then lengths of rates.

    Inputs are in units of half their range, rates in units of their larger limit.
    """
    n, m = dynamics.B.shape
    one = torch.eye(n + m, dtype=dynamics.A.dtype, device=dynamics.A.device)
    half = (dynamics.high - dynamics.low) / 2
    rows: list[Row] = [
        (-one[n:] / half[:, None], dynamics.high / half),
        (one[n:] / half[:, None], -dynamics.low / half),
    ]
    lengths = []
    for limit in limits:
        if isinstance(limit, DiscreteBarrier):
            rows.append(_barrier_row(dynamics, limit, one[columns], columns))
        elif limit.norm:
            lengths.append(_rate_length(dynamics, limit, one[columns], columns))
        else:
            rows += _rate_rows(dynamics, limit, one[columns], columns)
    L, o = (torch.cat(v) for v in zip(*rows, strict=True))
    finite = o.isfinite()
    single = [(L[finite][:, None], o[finite][:, None])] if bool(finite.any()) else []
    return [ConicLimits(*each).of_steps(horizon) for each in (*single, *lengths)]


def _next_state(dynamics: LinearDynamics, columns: list[int]) -> Tensor:
    """The matrix from state and inputs to the next state's `columns`, without c [k, n + m]."""
    return torch.cat((dynamics.A, dynamics.B), 1)[columns]


def _barrier_row(
    dynamics: LinearDynamics, barrier: DiscreteBarrier, state: Tensor, columns: list[int]
) -> Row:
    """h' - (1 - alpha) h >= 0 of a half-space."""
    level, kept = cast(HalfSpace, barrier.acting), 1 - barrier.alpha
    L = (level.a @ (kept * state - _next_state(dynamics, columns)))[None]
    return L, (barrier.alpha * level.b - level.a @ dynamics.c[columns])[None]


def _rate(
    dynamics: LinearDynamics, limit: RateLimit, state: Tensor, columns: list[int]
) -> tuple[float, Tensor, Tensor]:
    """The larger of the limits, or 1, and the rate L q + o in its units."""
    sizes = (abs(v) for v in (limit.low, limit.high) if math.isfinite(v))
    size = max(sizes, default=0.0) or 1.0
    S = limit.which * limit.scale / (limit.dt * size)
    return size, S @ (_next_state(dynamics, columns) - state), S @ dynamics.c[columns]


def _rate_rows(
    dynamics: LinearDynamics, limit: RateLimit, state: Tensor, columns: list[int]
) -> list[Row]:
    """low <= rate <= high of one coordinate."""
    size, L, o = _rate(dynamics, limit, state, columns)
    return [(-L, limit.high / size - o), (L, o - limit.low / size)]


def _rate_length(
    dynamics: LinearDynamics, limit: RateLimit, state: Tensor, columns: list[int]
) -> tuple[Tensor, Tensor]:
    """The second-order cone |rate| <= high: L [1, k + 1, n + m], o [1, k + 1]."""
    size, L, o = _rate(dynamics, limit, state, columns)
    high = o.new_tensor([limit.high / size])
    return torch.cat((torch.zeros_like(L[:1]), L))[None], torch.cat((high, o))[None]
