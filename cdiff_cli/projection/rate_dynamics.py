"""The nearest trajectory that linear dynamics with bounded inputs make within limits on rates, around obstacles, the whole batch
at once.

    minimise |x - z|^2_W   s.t.  x' = A x + B u + c,  low <= u <= high,  limits on x' - x,  a.x <= b at waypoints,  pins

A limit on a rate acts on the state and inputs of its step, since the dynamics say what they change: as convex limits of each
waypoint all of them are solved together (interior_point.py). Obstacles are half-spaces of tangent planes, chosen anew at each result.
Where no trajectory is within all limits, goals give way first.
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
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.projection.segments import NEVER, planes
from cdiff_cli.projection.solvers.interior_point import YIELDING, ConicLimits, solve

StepLimit = RateLimit | DiscreteBarrier
MISSED = 1e-4  # of a limit, in shares of it, metres of a half-space: from there on they contradict each other


def project_rate_dynamics(
    dynamics: LinearDynamics,
    parts: Sequence[AtWaypoints | OnSegments],
    paces: Sequence[StepLimit],
    z: Traj,
    pins: Pins,
    *,
    used: Sequence[int],
    weight: Tensor,
    turns: int,
    tolerance: float,
    begin: Traj | None = None,
) -> tuple[Traj, Tensor]:
    """The trajectory nearest to z, |x - z|^2 weighted by coordinate, that the dynamics produce from the first state of z within all
    limits, a pinned last state reached; and its inputs [batch, horizon - 1, m].

    parts, paces  act on the coordinates `used` alone, in the units of z
    weight        of each coordinate in the distance   [n]
    turns         times at most that tangent planes are chosen, first at `begin`, or z
    tolerance     violation of a part up to which its planes are not chosen anew
    """
    if len(z) == 0 or z.shape[1] == 1:
        return z, dynamics.inputs(z)
    where, last = list(used), pins.mask[-1]
    held, g = Pins(pins.mask[:, where], z[..., where]), Constraint(tuple(parts))
    free = ~held.mask.any(1)[:, None]
    x, u = (z if begin is None else begin).clone(), dynamics.inputs(z)
    always, walls = _always(dynamics, paces, where, z.shape[1]), _none(parts, z, u)
    todo = torch.ones(len(z), dtype=torch.bool, device=z.device)
    touched, walled = (g(x[..., where]) > 0).any(1), ~todo
    for turn in range(turns + 1):
        if bool(touched.any()):
            near = [part.select(touched.nonzero()[:, 0]) for part in parts]
            a, b = planes(near, x[touched][..., where], Pins(held.mask, held.values[touched]))
            there, slope = free & (b < NEVER), torch.zeros_like(walls.L[touched])
            slope[:, :, :, 0, where] = torch.where(there[..., None], -a, 0.0)
            walls.L[touched], walls.o[touched] = slope, torch.where(there, b, 1.0)[..., None]
        walled = walled | touched
        limits = [*always, ConicLimits(walls.L[todo], walls.o[todo])] if parts else always
        x[todo], u[todo] = _within(dynamics, limits, z[todo], weight, last)
        unsafe = (g(x[..., where]) > tolerance).any(1)
        todo = touched = unsafe & ~walled | walled & (turn + 1 < turns)
        if not bool(todo.any()):
            break
    return x, u


def limits_steps(part: TrajectoryConstraint) -> TypeGuard[StepLimit]:
    """Whether what the part asks is a convex limit of each step: of the two states that it joins."""
    if isinstance(part, DiscreteBarrier):
        return (
            part.alpha2 is None and isinstance(part.acting, HalfSpace) and part.acting.a.ndim == 1
        )
    return isinstance(part, RateLimit) and part.scale.ndim == 1


def bounds_only(pins: Pins) -> bool:
    """Whether the pins are the start and perhaps the goal, as nearest_slowed takes them."""
    return pins.whole and bool(pins.held[:1].all()) and not bool(pins.held[1:-1].any())


def project_rates(
    parts: Sequence[AtWaypoints | OnSegments],
    paces: Sequence[StepLimit],
    z: Traj,
    pins: Pins,
    turns: int = 0,
) -> Traj:
    """The trajectory nearest to z within the limits and around obstacles, of no dynamics: x' = x + u, of any u, makes every one."""
    wide = pins.paint(z).double()
    one, none = (
        torch.eye(z.shape[2], dtype=wide.dtype, device=wide.device),
        wide.new_zeros(z.shape[2]),
    )
    x, _ = project_rate_dynamics(
        LinearDynamics(one, one, none, none - torch.inf, none + torch.inf),
        [part.to(wide) for part in parts],
        [pace.to(wide) for pace in paces],
        wide,
        Pins(pins.mask, wide),
        used=range(z.shape[2]),
        weight=none + 1,
        turns=turns,
        tolerance=1e-9,
    )
    return pins.paint(x.to(z))


def _within(
    dynamics: LinearDynamics, limits: Sequence[ConicLimits], z: Tensor, weight: Tensor, end: Tensor
) -> tuple[Tensor, Tensor]:
    """The nearest trajectories within the limits, and their inputs; where there are none, goals and then limits give way."""
    n, u = z.shape[2], 0.5 * dynamics.inputs(z)
    begin = torch.cat((dynamics.rollout(z[:, 0], u), torch.nn.functional.pad(u, (0, 0, 0, 1))), 2)
    q = solve(dynamics.A, dynamics.B, limits, z, weight, begin, end)
    missed = torch.where(end, q[:, -1, :n] - z[:, -1], 0.0).abs().amax(1)
    missed = torch.stack((missed, *(each.missed(q) for each in limits))).amax(0)
    soft = ~(missed < MISSED)
    if bool(soft.any()):
        some = [each.select(soft) if len(z) > 1 else each for each in limits]
        q[soft] = solve(dynamics.A, dynamics.B, some, z[soft], weight, begin[soft], end, YIELDING)
    return q[..., :n], q[:, :-1, n:]


def _none(parts: Sequence[AtWaypoints | OnSegments], x: Tensor, u: Tensor) -> ConicLimits:
    """As many half-spaces a waypoint as planes() makes of the parts, none of them there yet."""
    count = sum(1 if isinstance(part.level, HalfSpace) else 2 for part in parts)
    shape = (*x.shape[:2], count, 1)
    return ConicLimits(x.new_zeros(*shape, x.shape[2] + u.shape[2]), x.new_ones(shape))


def _always(
    dynamics: LinearDynamics, paces: Sequence[StepLimit], used: list[int], horizon: int
) -> list[ConicLimits]:
    """Inputs within their bounds, in shares of half their range, with chains and the rates of single coordinates; lengths of rates.
    Rates in shares of their larger limit.
    """
    n, m = dynamics.B.shape
    one, half = (
        torch.eye(n + m, dtype=dynamics.A.dtype, device=dynamics.A.device),
        (dynamics.high - dynamics.low) / 2,
    )
    after = torch.cat((dynamics.A, dynamics.B), 1)[used]
    rows = [
        (-one[n:] / half[:, None], dynamics.high / half),
        (one[n:] / half[:, None], -dynamics.low / half),
    ]
    lengths = []
    for pace in paces:
        if isinstance(pace, DiscreteBarrier):
            level, kept = cast(HalfSpace, pace.acting), 1 - pace.alpha
            rows.append(
                (
                    (level.a @ (kept * one[used] - after))[None],
                    (pace.alpha * level.b - level.a @ dynamics.c[used])[None],
                )
            )
            continue
        size = max((abs(v) for v in (pace.low, pace.high) if math.isfinite(v)), default=0.0) or 1.0
        S = pace.which * pace.scale / (pace.dt * size)
        L, o = S @ (after - one[used]), S @ dynamics.c[used]
        if pace.norm:
            lengths.append(
                (
                    torch.cat((torch.zeros_like(L[:1]), L))[None],
                    torch.cat((o.new_tensor([pace.high / size]), o))[None],
                )
            )
        else:
            rows += [(-L, pace.high / size - o), (L, o - pace.low / size)]
    L, o = (torch.cat(v) for v in zip(*rows, strict=True))
    there = o.isfinite()
    single = [(L[there][:, None], o[there][:, None])] if bool(there.any()) else []
    return [ConicLimits(*each).of_steps(horizon) for each in (*single, *lengths)]
