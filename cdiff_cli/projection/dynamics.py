"""The nearest trajectory that linear dynamics with bounded inputs can produce, around obstacles, the whole batch at once.

    minimise |x - z|^2_W   s.t.   x' = A x + B u + c,  low <= u <= high,  a.x <= b at waypoints,  start and goal pinned

Without the inequalities the solution is one product with a matrix that the batch shares (lq_tracking.py); which of them are active is
found by active_set.py, around the tangent planes of the obstacles (segments.py) that are chosen here.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.dynamics import LinearDynamics
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.projection.segments import NEVER, crossed, planes
from cdiff_cli.projection.solvers.active_set import Bounds, solve
from cdiff_cli.projection.solvers.lq_tracking import tracking

RHO, RELAXATION = 50.0, 1.6  # of ADMM, for what has a projection but no rows
TURNS = (0, 10, 20, 40)  # its rounds before which the tangent planes are chosen anew


class ActiveSetWarmStart(NamedTuple):
    """Where the last call ended: which rows were active (1 at their upper bound, -1 at their lower), the inputs, of ADMM
    copies and scaled multipliers, where it was needed, and which plans were soft.

    active [batch, steps, rows], u [batch, steps, m], copy, push [batch, horizon, k], soft [batch]
    """

    active: Tensor
    u: Tensor
    copy: Tensor
    push: Tensor
    soft: Tensor

    def select(self, which: Tensor) -> "ActiveSetWarmStart":
        """Of some trajectories of the batch alone."""
        return ActiveSetWarmStart(*(v[which] for v in self))


def project_dynamics(
    dynamics: LinearDynamics,
    parts: Sequence[AtWaypoints | OnSegments],
    rest: Callable[[Traj, Pins], Traj] | None,
    z: Traj,
    pins: Pins,
    *,
    used: Sequence[int],
    weight: Tensor,
    rounds: int,
    turns: int = 1,
    warm: ActiveSetWarmStart | None = None,
    tolerance: float = 0.0,
) -> tuple[Traj, ActiveSetWarmStart]:
    """The trajectory nearest to z, |x - z|^2 weighted by coordinate, that the dynamics produce from the first state of z under
    bounded inputs, with the parts (affine at waypoints, balls on segments) obeyed and a pinned last state reached.

    parts, rest  act on the coordinates `used` alone; rest is the projection onto whatever else is to hold, or None
    weight       of each coordinate in the distance   [n]
    rounds       of ADMM at most, where there is `rest`; it stops where the copy is within the tolerance
    turns        times at most that a plan's tangent planes (segments.py) are chosen: first at z where that is unsafe, then at the
                 last result; a plan that needs none has none, one that stays soft is given them once
    tolerance    violation of a row that is let pass
    """
    (batch, horizon, n), m = z.shape, dynamics.B.shape[1]
    where, held = list(used), Pins(pins.mask[:, used], z[..., used].double())
    slots, x = _slots(parts), z.double()
    if warm is None or warm.active.shape != (batch, horizon - 1, m + slots):
        active = torch.zeros(batch, horizon - 1, m + slots, dtype=torch.int8, device=z.device)
        u, soft = (
            x.new_zeros(batch, horizon - 1, m),
            torch.zeros(batch, dtype=torch.bool, device=z.device),
        )
        warm = ActiveSetWarmStart(active, u, held.values, torch.zeros_like(held.values), soft)
    if batch == 0 or horizon == 1:
        return z, warm
    heavy = tuple(v + RHO * (rest is not None and i in used) for i, v in enumerate(weight.tolist()))
    numbers = tuple(tuple(v.flatten().tolist()) for v in (dynamics.A, dynamics.B, dynamics.c))
    track = tracking(numbers, heavy, horizon - 1, bool(pins.mask[-1].all()), z.device)
    active, _, copy, push, soft = warm
    active, soft = active.clone(), soft.clone()
    at, free = held.values, ~held.mask[1:].any(1)
    rows = Bounds(dynamics.low.double(), dynamics.high.double(), where, max(tolerance, 1e-9))
    a = x.new_zeros(batch, horizon - 1, slots, len(where))
    b = x.new_full((batch, horizon - 1, slots), NEVER)
    walled = torch.zeros(batch, dtype=torch.bool, device=z.device)
    every = torch.arange(batch, device=z.device)
    touched, some, w, w0 = crossed(parts, at), every, x.new_zeros(batch, horizon - 1, n + m), x
    for k in range(rounds if rest else turns + 1):
        if bool(touched.any()):
            which = touched.nonzero()[:, 0]
            near = Pins(held.mask, held.values[which])
            slope, bound = planes([part.select(which) for part in parts], at[which], near)
            a[which] = slope[:, 1:]
            b[which] = torch.where(free[:, None], bound[:, 1:], NEVER)
            walled = walled | touched
        if rest or k == 0:
            w0 = track.solve(
                _toward(x, weight.double(), copy - push, where) if rest else x, torch.zeros_like(w)
            )
        active[..., m:] *= b < NEVER  # a warm start may know rows that are not there now
        each = m + slots * bool(
            walled.any()
        )  # rows a step: half-spaces only where some plan has them
        near_a, near_b = a[some, :, : each - m], b[some, :, : each - m]
        w[some], active[some, :, :each], soft[some] = solve(
            track, w0[some], rows, near_a, near_b, active[some, :, :each], soft[some]
        )
        at = torch.cat((held.values[:, :1], w[..., where]), 1)
        unsafe = crossed(parts, at, rows.tolerance)
        if rest:
            over = RELAXATION * at + (1 - RELAXATION) * copy + push
            copy = rest(over, held)
            push = over - copy
            touched = unsafe & ~walled | walled & (k + 1 in TURNS)
            if tolerance and k % 5 == 4 and float((at - copy).abs().max()) < tolerance:
                break
            continue
        touched = unsafe & ~walled | walled & ~(soft & warm.soft) & (k + 1 < turns)
        some = touched.nonzero()[:, 0]
        if not len(some):
            break
    out = torch.cat((x[:, :1], w[..., :n]), 1)
    return out.to(z), ActiveSetWarmStart(active, w[..., n:], copy, push, soft)


def _slots(parts: Sequence[AtWaypoints | OnSegments]) -> int:
    """Half-spaces a waypoint that planes() makes of the parts."""
    return sum(1 if isinstance(part.level, HalfSpace) else 2 for part in parts)


def _toward(z: Tensor, weight: Tensor, pull: Tensor, used: list[int]) -> Tensor:
    """The target whose distance, weighted with RHO added on those coordinates, is that to z and to `pull` together."""
    out = z.clone()
    out[..., used] = (weight[used] * z[..., used] + RHO * pull) / (weight[used] + RHO)
    return out
