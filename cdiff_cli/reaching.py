"""The nearest trajectory that linear dynamics with bounded inputs can produce, around obstacles, the whole batch at once.

    minimise |x - z|^2_W   s.t.   x' = A x + B u + c,  low <= u <= high,  a.x <= b at waypoints,  start and goal pinned

Without the inequalities the solution is one product with a matrix that the batch shares (tracking.py). Of the inequalities few are
active: an active-set method solves for their multipliers, a small system a plan, until each active one pushes and no other is
violated. All rows that are wrong change sides at once (the primal-dual active set method: Hintermueller, Ito and Kunisch, 2003);
where that makes no progress, one alone, which cannot cycle (block principal pivoting: Judice and Pires, 1994). The result is the
minimiser, to rounding. Plans that are done leave the batch.

Where active rows that all push cannot be met together, no trajectory meets all rows (Farkas): the plan turns soft. A row that it
misses then costs the square of that, over GIVE, and a minimiser there always is. Plans are known to be soft at the next call, which
gives them AGAIN changes from where they were and no more, until their rows can nearly be met.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cdiff_cli.constraint import Constraint, Pins, Segments, Traj, Waypoints
from cdiff_cli.dynamics import LinearDynamics
from cdiff_cli.levels import Affine
from cdiff_cli.segments import NEVER, planes
from cdiff_cli.tracking import Tracking, tracking

GIVE_U, GIVE_P = 5e-4, 2e-6  # of a row by its multiplier: who gives way, inputs or positions, where not all rows can be met
REFINED = 3  # solutions of a system, the later ones from where the one before gave way: rows that can be met then are, to rounding
PIVOTS, PATIENCE = 200, 12  # changes of the active set at most; those without fewer wrong rows, before they go one at a time
CONTRADICTED = 1e-3  # violation of active rows that all push from which they turn soft, and up to which soft ones turn hard again
SOFTLY, AGAIN = 30, 2  # changes of the active set of a plan at most once it is soft; where it was soft before
RUN = 8  # waypoints on either side among which one half-space enters at once, the one that is violated most
RHO, RELAXATION = 50.0, 1.6  # of ADMM, for what has a projection but no rows
TURNS = (0, 10, 20, 40)  # its rounds before which the tangent planes are chosen anew


class Warm(NamedTuple):
    """Where the last call ended: which rows were active (1 at their upper bound, -1 at their lower), the inputs, of ADMM
    copies and scaled multipliers, where it was needed, and which plans were soft.

    active [batch, steps, rows], u [batch, steps, m], copy, push [batch, horizon, k], soft [batch]
    """

    active: Tensor
    u: Tensor
    copy: Tensor
    push: Tensor
    soft: Tensor

    def of(self, which: Tensor) -> "Warm":
        """Of some trajectories of the batch alone."""
        return Warm(*(v[which] for v in self))


def nearest_reachable(
    dynamics: LinearDynamics,
    parts: Sequence[Waypoints | Segments],
    rest: Callable[[Traj, Pins], Traj] | None,
    z: Traj,
    pins: Pins,
    *,
    used: Sequence[int],
    weight: Tensor,
    rounds: int,
    turns: int = 1,
    warm: Warm | None = None,
    tolerance: float = 0.0,
) -> tuple[Traj, Warm]:
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
        warm = Warm(
            active, dynamics.inputs(z).double(), held.values, torch.zeros_like(held.values), torch.zeros_like(z[:, 0, 0]).bool()
        )
    if batch == 0 or horizon == 1:
        return z, warm
    heavy = tuple(v + RHO * (rest is not None and i in used) for i, v in enumerate(weight.tolist()))
    numbers = tuple(tuple(v.flatten().tolist()) for v in (dynamics.A, dynamics.B, dynamics.c))
    track = tracking(numbers, heavy, horizon - 1, bool(pins.mask[-1].all()), z.device)
    active, _, copy, push, soft = warm
    active, soft = active.clone(), soft.clone()
    g, at, free = Constraint(tuple(parts)), held.values, ~held.mask[1:].any(1)
    rows = Bounds(dynamics.low.double(), dynamics.high.double(), where, max(tolerance, 1e-9))
    a = x.new_zeros(batch, horizon - 1, slots, len(where))
    b = x.new_full((batch, horizon - 1, slots), NEVER)
    walled = torch.zeros(batch, dtype=torch.bool, device=z.device)
    every = torch.arange(batch, device=z.device)
    touched, some, w, w0 = (g(at) > 0).any(1), every, x.new_zeros(batch, horizon - 1, n + m), x
    for k in range(rounds if rest else turns + 1):
        if bool(touched.any()):
            which = touched.nonzero()[:, 0]
            near = Pins(held.mask, held.values[which])
            slope, bound = planes([part.take(which) for part in parts], at[which], near)
            a[which] = slope[:, 1:]
            b[which] = torch.where(free[:, None], bound[:, 1:], NEVER)
            walled = walled | touched
        if rest or k == 0:
            w0 = track.solve(_toward(x, weight.double(), copy - push, where) if rest else x, torch.zeros_like(w))
        active[..., m:] *= b < NEVER  # a warm start may know rows that are not there now
        w[some], active[some], soft[some] = settle(track, w0[some], rows, a[some], b[some], active[some], soft[some])
        at = torch.cat((held.values[:, :1], w[..., where]), 1)
        unsafe = (g(at) > rows.tolerance).any(1)
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
    return out.to(z), Warm(active, w[..., n:], copy, push, soft)


def _slots(parts: Sequence[Waypoints | Segments]) -> int:
    """Half-spaces a waypoint that planes() makes of the parts."""
    return sum(1 if isinstance(part.level, Affine) else 2 for part in parts)


def _toward(z: Tensor, weight: Tensor, pull: Tensor, used: list[int]) -> Tensor:
    """The target whose distance, weighted with RHO added on those coordinates, is that to z and to `pull` together."""
    out = z.clone()
    out[..., used] = (weight[used] * z[..., used] + RHO * pull) / (weight[used] + RHO)
    return out


class Bounds(NamedTuple):
    """Bounds of the inputs [m]; the coordinates that half-spaces act on; the violation that is let pass."""

    low: Tensor
    high: Tensor
    used: list[int]
    tolerance: float


def settle(
    track: Tracking, w0: Tensor, bounds: Bounds, a: Tensor, b: Tensor, active: Tensor, soft: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The nearest w to the unconstrained w0 [batch, steps, n + m] within the bounds and a.x <= b, from that active set.

    a [batch, steps, slots, k], b [batch, steps, slots] of the state that each step leads to; soft [batch] which plans are
    w, the active set, and which plans are soft now
    """
    w, active, soft = w0.clone(), active.clone(), soft.clone()
    y = w0.new_zeros(active.shape)
    kept = torch.zeros_like(y)  # multipliers of the right sign, of plans that go one row at a time
    fewest = torch.full((len(w0),), active[0].numel() + 1, device=w0.device)
    left, tries = torch.full_like(fewest, PATIENCE), torch.where(soft, AGAIN, PIVOTS)
    todo = active.flatten(1).any(1).nonzero()[:, 0]
    if len(todo):
        w[todo], y[todo] = _at_active(track, w0[todo], bounds, a[todo], b[todo], active[todo], soft[todo])
    todo = torch.arange(len(w0), device=w0.device)
    while True:
        was, push = active[todo], y[todo]
        over = _over(w[todo], bounds, a[todo], b[todo])
        enter = _foremost(torch.where(was == 0, over, 0.0), len(bounds.low)).sign().to(torch.int8)
        asked = torch.where(was * push > 0, was, enter)
        wrong = (asked != was).flatten(1).sum(1)
        missed = over.abs() > CONTRADICTED
        pushing = ~((was != 0) & (was * push <= 0)).flatten(1).any(1)
        proved = pushing & ~soft[todo] & (missed & (was != 0)).flatten(1).any(1)
        new = todo[proved]
        soft[new], tries[new], left[new], fewest[new] = True, SOFTLY, PATIENCE, active[0].numel() + 1
        open_ = proved | (wrong > 0) & (tries[todo] > 0)
        soft[todo[~open_]] = ((wrong > 0) | missed.flatten(1).any(1))[~open_]
        if not bool(open_.any()):
            break
        if not bool(open_.all()):
            todo, was, push, over, enter, asked, wrong = (v[open_] for v in (todo, was, push, over, enter, asked, wrong))
        slow = left[todo] < 0
        tries[todo] -= 1
        left[todo] = torch.where(slow, left[todo], torch.where(wrong < fewest[todo], PATIENCE, left[todo] - 1))
        fewest[todo] = torch.minimum(wrong, fewest[todo])
        if bool(slow.any()):
            asked[slow], kept[todo[slow]] = _one_at_a_time(was[slow], push[slow], kept[todo[slow]], over[slow], enter[slow])
        active[todo] = asked
        w[todo], y[todo] = _at_active(track, w0[todo], bounds, a[todo], b[todo], asked, soft[todo])
    return w, active, soft


def _over(w: Tensor, bounds: Bounds, a: Tensor, b: Tensor) -> Tensor:
    """By how much each row is violated, negative at a lower bound; 0 where it holds [batch, steps, rows]."""
    m, eps = len(bounds.low), bounds.tolerance
    u = w[..., -m:]
    over = u - u.clamp(bounds.low, bounds.high)
    if a.shape[2]:
        over = torch.cat((over, ((a * w[..., None, bounds.used]).sum(-1) - b).clamp_min(0)), 2)
    return torch.where(over.abs() > eps, over, 0.0)


def _foremost(over: Tensor, m: int) -> Tensor:
    """The violations of inputs, and of the half-spaces those that no neighbour in time exceeds: neighbours share one cause, and one
    row in the middle of them often cures it.
    """
    if over.shape[2] == m:
        return over
    walls = over[..., m:]
    most = torch.nn.functional.max_pool1d(walls.transpose(1, 2), 2 * RUN + 1, 1, RUN).transpose(1, 2)
    return torch.cat((over[..., :m], torch.where(walls >= most, walls, 0.0)), 2)


def _one_at_a_time(active: Tensor, y: Tensor, kept: Tensor, over: Tensor, enter: Tensor) -> tuple[Tensor, Tensor]:
    """The next active set of the method of Lawson and Hanson (1974) on the dual, and the multipliers kept with it: where all push
    the row that is violated most enters; otherwise they go as far towards y as they keep their signs, and those that end leave.
    """
    wrong = (active != 0) & (active * y <= 0)
    right = ~wrong.flatten(1).any(1)[:, None, None]
    share = torch.where(wrong, kept / (kept - y), torch.inf).flatten(1).amin(1).nan_to_num(0.0, posinf=1.0)[:, None, None]
    kept = torch.where(right, y, kept + share * (y - kept))
    gone = wrong & (kept * active <= 1e-12 * kept.abs().amax((1, 2), keepdim=True))
    kept = torch.where(gone | (active == 0), 0.0, kept)
    most = over.abs() * (enter != 0)
    first = torch.nn.functional.one_hot(most.flatten(1).argmax(1), most[0].numel()).view(most.shape).bool()
    return torch.where(right, torch.where(first, enter, active), torch.where(gone, 0, active)), kept


def _at_active(
    track: Tracking, w0: Tensor, bounds: Bounds, a: Tensor, b: Tensor, active: Tensor, soft: Tensor
) -> tuple[Tensor, Tensor]:
    """w with the active rows met, and their multipliers y: w = w0 - K C^T y, (C K C^T + give) y = C w0 - bound. Of plans that are
    not soft, give hardly counts.
    """
    batch, steps, rows = active.shape
    width, m = w0.shape[2], len(bounds.low)
    signs = active.flatten(1)
    plan, row = signs.nonzero(as_tuple=True)
    y = w0.new_zeros(batch, steps * rows)
    if not len(plan):
        return w0, y.view(active.shape)
    each = torch.bincount(plan, minlength=batch)
    slot = torch.arange(len(plan), device=w0.device) - (each.cumsum(0) - each)[plan]
    k = int(each.max())
    step, kind = row // rows, row % rows
    is_input = kind < m
    terms = len(bounds.used) if bool((~is_input).any()) else 1
    at = torch.zeros(batch, k, terms, dtype=torch.long, device=w0.device)
    coefficient = w0.new_zeros(batch, k, terms)
    wanted, give = w0.new_zeros(batch, k), w0.new_ones(batch, k)
    begin = step * width
    place = (begin + width - m + kind)[:, None].expand(-1, terms).clone()
    slope = torch.zeros_like(place, dtype=w0.dtype)
    slope[:, 0] = 1.0
    up = signs[plan, row] > 0
    column = kind.clamp_max(m - 1)
    limit = torch.where(up, bounds.high[column], bounds.low[column])
    if terms > 1 or not bool(is_input.all()):
        of_plane = (plan, step, (kind - m).clamp_min(0))
        used = torch.tensor(bounds.used, device=w0.device)
        place = torch.where(is_input[:, None], place, begin[:, None] + used)
        slope = torch.where(is_input[:, None], slope, a[of_plane])
        limit = torch.where(is_input, limit, b[of_plane])
    at[plan, slot], coefficient[plan, slot] = place, slope
    wanted[plan, slot] = (slope * w0.flatten(1)[plan[:, None], place]).sum(1) - limit
    give[plan, slot] = torch.where(is_input, GIVE_U, GIVE_P).to(w0)
    Q = track.between(at, coefficient)
    Q.diagonal(dim1=1, dim2=2).add_(give)
    size = Q.diagonal(dim1=1, dim2=2).rsqrt()
    factor = torch.linalg.cholesky_ex(Q * size[:, :, None] * size[:, None])[0]
    multiplier = torch.zeros_like(wanted)
    again = torch.where(soft[:, None], 0.0, give)
    for _ in range(REFINED):
        multiplier = size * torch.cholesky_solve((size * (wanted + again * multiplier))[..., None], factor)[..., 0]
    pull = w0.new_zeros(batch, steps * width)
    pull.scatter_add_(1, at.flatten(1), (-multiplier[..., None] * coefficient).flatten(1))
    y[plan, row] = multiplier[plan, slot]
    return w0 + track.respond(pull.view(w0.shape)), y.view(active.shape)
