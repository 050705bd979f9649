"""Least-squares trajectories under bounds on a few of their entries: the active set of each plan of a batch, all plans at once.

    minimise the tracking cost of w (lq_tracking.py)   s.t.   low <= slope . w <= high, row by row, each row of one step

Without rows the solution w0 is one product. Of the rows few are active: their multipliers solve a small system a plan, until each
active row pushes and no other is violated. All rows that are wrong change sides at once (the primal-dual active set method:
Hintermueller, Ito and Kunisch, 2003); where that makes no progress, one alone, which cannot cycle (block principal pivoting: Judice
and Pires, 1994). The result is the minimiser, to rounding. Plans that are done leave the batch.

Where active rows that all push cannot be met together, no trajectory meets all rows (Farkas): the plan turns soft. A row that it
misses then costs the square of that, over GIVE, and a minimiser there always is. Plans are known to be soft at the next call, which
gives them AGAIN changes from where they were and no more, until their rows can nearly be met.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from cdiff_cli.projection.solvers.lq_tracking import Tracking

SLACK_INPUT, SLACK_ROW = (
    5e-4,
    2e-6,
)  # of a row by its multiplier: who gives way, inputs or positions, where not all rows can be met
REFINED = 3  # solutions of a system, the later ones from where the one before gave way: rows that can be met then are, to rounding
PIVOTS, PATIENCE = (
    200,
    12,
)  # changes of the active set at most; those without fewer wrong rows, before they go one at a time
INFEASIBLE_ABOVE = 1e-3  # violation of active rows that all push from which they turn soft, and up to which soft ones turn hard again
SOFTLY, AGAIN = (
    30,
    2,
)  # changes of the active set of a plan at most once it is soft; where it was soft before
RUN = 8  # waypoints on either side among which one half-space enters at once, the one that is violated most


class Bounds(NamedTuple):
    """Bounds of the inputs [m]; the coordinates that half-spaces act on; the violation that is let pass."""

    low: Tensor
    high: Tensor
    used: Sequence[int]
    tolerance: float


class ActiveSetProblem(NamedTuple):
    """Plans whose active set is sought. A step has so many rows: bounds of its inputs, half-spaces of the state that it leads to.

    w0      the unconstrained trajectories   [n, steps, width]
    slope   of the rows, by w's entries of places()   [n, terms, steps, rows]
    value0, low, high   of the rows: what w0 makes of them, and their bounds   [n, steps, rows]
    active  1 at the upper bound, -1 at the lower, else 0   [n, steps, rows]
    kept    multipliers of the right sign, of plans that go one row at a time   [n, steps, rows]
    soft    plans whose rows cannot all be met   [n]
    fewest, left, tries   wrong rows at best, changes until rows go one at a time, changes until the end   [n]
    """

    w0: Tensor
    slope: Tensor
    value0: Tensor
    low: Tensor
    high: Tensor
    active: Tensor
    kept: Tensor
    soft: Tensor
    fewest: Tensor
    left: Tensor
    tries: Tensor

    def select(self, which: Tensor) -> "ActiveSetProblem":
        return ActiveSetProblem(*(v[which] for v in self))


@lru_cache(maxsize=16)
def places(
    steps: int, width: int, m: int, slots: int, used: tuple[int, ...], device: torch.device
) -> tuple[Tensor, Tensor]:
    """Where in w each row acts, counted on over the steps [terms, steps * rows], and what it gives [steps * rows]."""
    place = (width - m + torch.arange(m)).repeat(len(used) if slots else 1, 1)
    if slots:
        place = torch.cat((place, torch.tensor(used)[:, None].expand(-1, slots)), 1)
    place = place[:, None] + (torch.arange(steps) * width)[:, None]
    give = torch.tensor([SLACK_INPUT] * m + [SLACK_ROW] * slots, dtype=torch.float64).repeat(steps)
    return place.flatten(1).to(device), give.to(device)


def solve(
    track: Tracking, w0: Tensor, bounds: Bounds, a: Tensor, b: Tensor, active: Tensor, soft: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The nearest w to the unconstrained w0 [batch, steps, n + m] within the bounds and a.x <= b, from that active set.

    a [batch, steps, slots, k], b [batch, steps, slots] of the state that each step leads to; soft [batch] which plans are
    w, the active set, and which plans are soft now
    """
    at = _opened(w0, bounds, a, b, active, soft)
    most = active[0].numel() + 1
    out, todo = (w0.clone(), active.clone(), soft.clone()), torch.arange(len(w0), device=w0.device)
    w, push = _at_active(track, at, bounds)
    while True:
        value = _values(w, at, bounds)
        over = value - value.clamp(at.low, at.high)
        over = torch.where(over.abs() > bounds.tolerance, over, 0.0)
        was, held, pushes = at.active, at.active != 0, at.active * push > 0
        enter = _foremost(torch.where(held, 0.0, over), len(bounds.low)).sign().to(torch.int8)
        asked = torch.where(pushes, was, enter)
        wrong, missed = (asked != was).flatten(1).sum(1), over.abs() > INFEASIBLE_ABOVE
        proved = (missed & held).flatten(1).any(1) & ~at.soft
        if bool(proved.any()):
            proved &= (held == pushes).flatten(1).all(1)
            fresh = {"tries": SOFTLY, "left": PATIENCE, "fewest": most}
            anew = {
                name: torch.where(proved, number, getattr(at, name))
                for name, number in fresh.items()
            }
            at = at._replace(soft=at.soft | proved, **anew)
        going = proved | (wrong > 0) & (at.tries > 0)
        if not bool(going.all()):
            done, going = (~going).nonzero()[:, 0], going.nonzero()[:, 0]
            still = ((wrong > 0) | missed.flatten(1).any(1))[done]
            for whole, part in zip(out, (w[done], was[done], still), strict=True):
                whole[todo[done]] = part
            if not len(going):
                return out
            todo, at = todo[going], at.select(going)
            push, over, enter, asked, wrong = (v[going] for v in (push, over, enter, asked, wrong))
        slow = at.left < 0
        left = torch.where(slow, at.left, torch.where(wrong < at.fewest, PATIENCE, at.left - 1))
        if bool(slow.any()):
            asked[slow], at.kept[slow] = _one_at_a_time(
                at.active[slow], push[slow], at.kept[slow], over[slow], enter[slow]
            )
        at = at._replace(
            active=asked, fewest=torch.minimum(wrong, at.fewest), left=left, tries=at.tries - 1
        )
        w, push = _at_active(track, at, bounds)


def _opened(
    w0: Tensor, bounds: Bounds, a: Tensor, b: Tensor, active: Tensor, soft: Tensor
) -> ActiveSetProblem:
    """All plans of a batch, as settle() is given them."""
    (batch, steps, slots, terms), m = a.shape, len(bounds.low)
    slope = w0.new_zeros(batch, terms if slots else 1, steps, m + slots)
    slope[:, 0, :, :m] = 1.0
    ends = w0.new_empty(2, batch, steps, m + slots)
    ends[0, ..., :m], ends[1, ..., :m] = bounds.low, bounds.high
    if slots:
        slope[..., m:] = a.movedim(-1, 1)
        ends[0, ..., m:], ends[1, ..., m:] = -torch.inf, b
    left = torch.full((batch,), PATIENCE, device=w0.device)
    tries, none = torch.where(soft, AGAIN, PIVOTS), torch.zeros_like(ends[0])
    at = ActiveSetProblem(
        w0,
        slope,
        none,
        ends[0],
        ends[1],
        active,
        none,
        soft,
        left.new_full((batch,), active[0].numel() + 1),
        left,
        tries,
    )
    return at._replace(value0=_values(w0, at, bounds))


def _values(w: Tensor, at: ActiveSetProblem, bounds: Bounds) -> Tensor:
    """What w makes of each row [n, steps, rows]."""
    m = len(bounds.low)
    u = w[..., -m:]
    if at.slope.shape[3] == m:
        return u
    walls = at.slope[:, 0, :, m:] * w[..., bounds.used[0], None]
    for i, k in enumerate(bounds.used[1:], start=1):
        walls = walls.addcmul_(at.slope[:, i, :, m:], w[..., k, None])
    return torch.cat((u, walls), 2)


def _foremost(over: Tensor, m: int) -> Tensor:
    """The violations of inputs, and of the half-spaces those that no neighbour in time exceeds: neighbours share one cause, and one
    row in the middle of them often cures it.
    """
    if over.shape[2] == m:
        return over
    walls = over[..., m:]
    most = torch.nn.functional.max_pool1d(walls.transpose(1, 2), 2 * RUN + 1, 1, RUN).transpose(
        1, 2
    )
    return torch.cat((over[..., :m], torch.where(walls >= most, walls, 0.0)), 2)


def _one_at_a_time(
    active: Tensor, y: Tensor, kept: Tensor, over: Tensor, enter: Tensor
) -> tuple[Tensor, Tensor]:
    """The next active set of the method of Lawson and Hanson (1974) on the dual, and the multipliers kept with it: where all push
    the row that is violated most enters; otherwise they go as far towards y as they keep their signs, and those that end leave.
    """
    wrong = (active != 0) & (active * y <= 0)
    right = ~wrong.flatten(1).any(1)[:, None, None]
    share = (
        torch.where(wrong, kept / (kept - y), torch.inf)
        .flatten(1)
        .amin(1)
        .nan_to_num(0.0, posinf=1.0)[:, None, None]
    )
    kept = torch.where(right, y, kept + share * (y - kept))
    gone = wrong & (kept * active <= 1e-12 * kept.abs().amax((1, 2), keepdim=True))
    kept = torch.where(gone | (active == 0), 0.0, kept)
    most = over.abs() * (enter != 0)
    first = (
        torch.nn.functional.one_hot(most.flatten(1).argmax(1), most[0].numel())
        .view(most.shape)
        .bool()
    )
    return torch.where(right, torch.where(first, enter, active), torch.where(gone, 0, active)), kept


def _at_active(track: Tracking, at: ActiveSetProblem, bounds: Bounds) -> tuple[Tensor, Tensor]:
    """w with the active rows met, and the multipliers y of all rows: w = w0 - K C^T y, (C K C^T + give) y = C w0 - bound. Of plans
    that are not soft, give hardly counts.
    """
    (batch, terms, steps, each), width = at.slope.shape, at.w0.shape[2]
    rows, y = steps * each, at.w0.new_zeros(at.active.shape)
    found = at.active.flatten().nonzero()[
        :, 0
    ]  # active rows of all plans, counted on over the batch
    if not len(found):
        return at.w0, y
    place, give = places(
        steps, width, len(bounds.low), each - len(bounds.low), tuple(bounds.used), y.device
    )
    plan = found // rows
    row, count = found - plan * rows, torch.bincount(plan, minlength=batch)
    k = int(count.amax())
    slot = (
        plan * k
        + torch.arange(len(found), device=y.device)
        - (count.cumsum(0) - count).index_select(0, plan)
    )  # with padding
    up = at.active.flatten().index_select(0, found) > 0
    high, low = (end.flatten().index_select(0, found) for end in (at.high, at.low))
    own = found + (terms - 1) * rows * plan  # of the row's first slope
    slopes = [at.slope.flatten().index_select(0, own + i * rows) for i in range(terms)]
    numbers = torch.stack(
        (
            at.value0.flatten().index_select(0, found) - torch.where(up, high, low),
            give.index_select(0, row),
            *slopes,
        )
    )
    padded = y.new_zeros(2 + terms, batch * k)
    padded[1] = 1.0
    wanted, give, *_ = padded.index_copy_(1, slot, numbers).view(-1, batch, k)
    slope = padded[2:].view(terms, batch, k)
    entry = torch.zeros(terms, batch * k, dtype=torch.long, device=y.device)
    entry = entry.index_copy_(1, slot, place.index_select(1, row)).view(terms, batch, k)
    Q = track.between(entry, slope)
    Q.diagonal(dim1=1, dim2=2).add_(give)
    size = Q.diagonal(dim1=1, dim2=2).rsqrt()
    factor = torch.linalg.cholesky_ex(Q * size[:, :, None] * size[:, None])[0]
    multiplier = torch.zeros_like(wanted)
    again = torch.where(at.soft[:, None], 0.0, give)
    for _ in range(REFINED):
        multiplier = (
            size
            * torch.cholesky_solve((size * (wanted + again * multiplier))[..., None], factor)[
                ..., 0
            ]
        )
    pull = y.new_zeros(batch, steps * width)
    for i in range(terms):
        pull.scatter_add_(1, entry[i], -multiplier * slope[i])
    y.flatten()[found] = multiplier.flatten().index_select(0, slot)
    return at.w0 + track.respond(pull.view(at.w0.shape)), y
