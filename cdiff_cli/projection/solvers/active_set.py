"""Least-squares trajectories with bounds on some entries, by the active set of each plan.

    minimise the tracking cost of w (lq_tracking.py)   s.t.   low <= slope . w <= high, row by row

Each row belongs to one step. Without rows the solution w0 is one product. Few rows are active:
their multipliers solve a small system per plan, until each active row has the right multiplier sign
and no other row is violated. All wrong rows change at once (the primal-dual active set method:
Hintermueller, Ito and Kunisch, 2003). Where that makes no progress, one row changes at a time,
which cannot cycle (block principal pivoting: Judice and Pires, 1994). The result is the minimiser,
up to rounding. Plans that are finished leave the batch.

Where active rows with the right multiplier signs cannot be satisfied together, no trajectory
satisfies all rows (Farkas), and the plan is declared infeasible. A row that it misses then costs
the square of the slack over SLACK_INPUT or SLACK_ROW, so that a minimiser always exists. A plan
that was infeasible in the last call gets MAX_CHANGES_AGAIN changes, until its rows can nearly be
satisfied.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from cdiff_cli.projection.solvers.lq_tracking import Tracking

SLACK_INPUT = 5e-4  # slack of an input bound per multiplier: inputs give way before positions
SLACK_ROW = 2e-6  # slack of a half-space per multiplier
REFINEMENTS = (
    3  # solutions of a system, each from the slack of the last; feasible rows reach rounding
)
MAX_CHANGES = 200  # changes of the active set
STALLED_AFTER = 12  # changes without fewer wrong rows, after which rows change one at a time
INFEASIBLE_ABOVE = (
    1e-3  # [row units] violation that declares a plan infeasible, and feasible again below
)
MAX_CHANGES_INFEASIBLE = 30  # changes of the active set of a plan that was just declared infeasible
MAX_CHANGES_AGAIN = 2  # changes of the active set of a plan that was infeasible in the last call
NEIGHBOURS = 8  # waypoints on either side among which only the most violated half-space enters


class Bounds(NamedTuple):
    """What bounds the entries of w.

    low, high   bounds of the inputs [m]
    used        coordinates of the state that half-spaces act on
    tolerance   violation that is accepted
    """

    low: Tensor
    high: Tensor
    used: Sequence[int]
    tolerance: float


class ActiveSetProblem(NamedTuple):
    """Plans whose active sets are sought.

    The rows of a step are the bounds of its inputs, then the half-spaces of the state it leads to.

    w0           unconstrained trajectories                                [n, steps, width]
    slope        slopes of the rows by the entries that places() lists     [n, terms, steps, rows]
    value0       values of the rows for w0                                 [n, steps, rows]
    low, high    bounds of the rows                                        [n, steps, rows]
    active       1 at the upper bound, -1 at the lower, else 0             [n, steps, rows]
    kept         multipliers, where rows change one at a time              [n, steps, rows]
    infeasible   plans whose rows cannot all be satisfied                  [n]
    fewest       smallest number of wrong rows so far                      [n]
    left         changes until rows change one at a time                   [n]
    tries        changes until the end                                     [n]
    """

    w0: Tensor
    slope: Tensor
    value0: Tensor
    low: Tensor
    high: Tensor
    active: Tensor
    kept: Tensor
    infeasible: Tensor
    fewest: Tensor
    left: Tensor
    tries: Tensor

    def select(self, which: Tensor) -> "ActiveSetProblem":
        return ActiveSetProblem(*(v[which] for v in self))


@lru_cache(maxsize=16)
def places(
    steps: int, width: int, m: int, slots: int, used: tuple[int, ...], device: torch.device
) -> tuple[Tensor, Tensor]:
    """The entries of w that each row acts on [terms, steps * rows], and its slack [steps * rows].

    Entries are counted over all steps. The slack is per multiplier.
    """
    place = (width - m + torch.arange(m)).repeat(len(used) if slots else 1, 1)
    if slots:
        place = torch.cat((place, torch.tensor(used)[:, None].expand(-1, slots)), 1)
    place = place[:, None] + (torch.arange(steps) * width)[:, None]
    slack = torch.tensor([SLACK_INPUT] * m + [SLACK_ROW] * slots, dtype=torch.float64)
    return place.flatten(1).to(device), slack.repeat(steps).to(device)


def solve(
    track: Tracking,
    w0: Tensor,
    bounds: Bounds,
    a: Tensor,
    b: Tensor,
    active: Tensor,
    infeasible: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """The nearest w to the unconstrained w0 [batch, steps, n + m] within the bounds and a.x <= b.

    a [batch, steps, slots, k], b [batch, steps, slots] act on the state that each step leads to

    active       the active set to start from   [batch, steps, m + slots]
    infeasible   plans that were infeasible in the last call   [batch]

    Returns w, its active set, and which plans are infeasible.
    """
    problem = _initial(w0, bounds, a, b, active, infeasible)
    out = (w0.clone(), active.clone(), infeasible.clone())
    todo = torch.arange(len(w0), device=w0.device)
    while True:
        w, push = _at_active(track, problem, bounds)
        check = _check(problem, bounds, w, push)
        problem = _declared_infeasible(problem, check.proved)
        going = check.proved | (check.wrong > 0) & (problem.tries > 0)
        if not bool(going.all()):
            done, going = (~going).nonzero()[:, 0], going.nonzero()[:, 0]
            missed = (check.wrong > 0) | check.missed.flatten(1).any(1)
            for whole, part in zip(out, (w, problem.active, missed), strict=True):
                whole[todo[done]] = part[done]
            if not len(going):
                return out
            todo, problem, push = todo[going], problem.select(going), push[going]
            check = check.select(going)
        problem = _changed(problem, check, push)


class Check(NamedTuple):
    """What a solution for an active set says about that set.

    over        violation of each row above the tolerance, signed   [n, steps, rows]
    enter       rows that should enter, with their side             [n, steps, rows]
    requested   the next active set if all wrong rows change        [n, steps, rows]
    missed      rows violated by more than INFEASIBLE_ABOVE         [n, steps, rows]
    wrong       number of wrong rows                                [n]
    proved      plans that this solution proves infeasible          [n]
    """

    over: Tensor
    enter: Tensor
    requested: Tensor
    missed: Tensor
    wrong: Tensor
    proved: Tensor

    def select(self, which: Tensor) -> "Check":
        return Check(*(v[which] for v in self))


def _check(problem: ActiveSetProblem, bounds: Bounds, w: Tensor, push: Tensor) -> Check:
    """Compare the solution w and its multipliers `push` with the active set."""
    value = _values(w, problem, bounds)
    over = value - value.clamp(problem.low, problem.high)
    over = torch.where(over.abs() > bounds.tolerance, over, 0.0)
    held, pushes = problem.active != 0, problem.active * push > 0
    enter = _foremost(torch.where(held, 0.0, over), len(bounds.low)).sign().to(torch.int8)
    requested = torch.where(pushes, problem.active, enter)
    wrong = (requested != problem.active).flatten(1).sum(1)
    missed = over.abs() > INFEASIBLE_ABOVE
    proved = (missed & held).flatten(1).any(1) & ~problem.infeasible
    if bool(proved.any()):
        proved &= (held == pushes).flatten(1).all(1)
    return Check(over, enter, requested, missed, wrong, proved)


def _declared_infeasible(problem: ActiveSetProblem, proved: Tensor) -> ActiveSetProblem:
    """The problem with slack for the plans that were proved infeasible, and their counts reset."""
    if not bool(proved.any()):
        return problem
    most = problem.active[0].numel() + 1
    return problem._replace(
        infeasible=problem.infeasible | proved,
        tries=torch.where(proved, MAX_CHANGES_INFEASIBLE, problem.tries),
        left=torch.where(proved, STALLED_AFTER, problem.left),
        fewest=torch.where(proved, most, problem.fewest),
    )


def _changed(problem: ActiveSetProblem, check: Check, push: Tensor) -> ActiveSetProblem:
    """The problem with its next active set."""
    requested = check.requested
    slow = problem.left < 0
    progress = torch.where(check.wrong < problem.fewest, STALLED_AFTER, problem.left - 1)
    left = torch.where(slow, problem.left, progress)
    if bool(slow.any()):
        requested[slow], problem.kept[slow] = _one_at_a_time(
            problem.active[slow],
            push[slow],
            problem.kept[slow],
            check.over[slow],
            check.enter[slow],
        )
    return problem._replace(
        active=requested,
        fewest=torch.minimum(check.wrong, problem.fewest),
        left=left,
        tries=problem.tries - 1,
    )


def _initial(
    w0: Tensor, bounds: Bounds, a: Tensor, b: Tensor, active: Tensor, infeasible: Tensor
) -> ActiveSetProblem:
    """The problem of all plans of a batch, as solve() takes them."""
    (batch, steps, slots, terms), m = a.shape, len(bounds.low)
    slope = w0.new_zeros(batch, terms if slots else 1, steps, m + slots)
    slope[:, 0, :, :m] = 1.0
    ends = w0.new_empty(2, batch, steps, m + slots)
    ends[0, ..., :m], ends[1, ..., :m] = bounds.low, bounds.high
    if slots:
        slope[..., m:] = a.movedim(-1, 1)
        ends[0, ..., m:], ends[1, ..., m:] = -torch.inf, b
    left = torch.full((batch,), STALLED_AFTER, device=w0.device)
    tries, none = torch.where(infeasible, MAX_CHANGES_AGAIN, MAX_CHANGES), torch.zeros_like(ends[0])
    fewest = left.new_full((batch,), active[0].numel() + 1)
    problem = ActiveSetProblem(
        w0, slope, none, ends[0], ends[1], active, none, infeasible, fewest, left, tries
    )
    return problem._replace(value0=_values(w0, problem, bounds))


def _values(w: Tensor, problem: ActiveSetProblem, bounds: Bounds) -> Tensor:
    """The values of the rows for w [n, steps, rows]."""
    m = len(bounds.low)
    u = w[..., -m:]
    if problem.slope.shape[3] == m:
        return u
    positions = problem.slope[:, 0, :, m:] * w[..., bounds.used[0], None]
    for i, k in enumerate(bounds.used[1:], start=1):
        positions = positions.addcmul_(problem.slope[:, i, :, m:], w[..., k, None])
    return torch.cat((u, positions), 2)


def _foremost(over: Tensor, m: int) -> Tensor:
    """The violations of inputs, and those of half-spaces that no neighbour in time exceeds.

    Neighbours share one cause, and one active row among them often removes it.
    """
    if over.shape[2] == m:
        return over
    positions = over[..., m:]
    most = torch.nn.functional.max_pool1d(
        positions.transpose(1, 2), 2 * NEIGHBOURS + 1, 1, NEIGHBOURS
    ).transpose(1, 2)
    return torch.cat((over[..., :m], torch.where(positions >= most, positions, 0.0)), 2)


def _one_at_a_time(
    active: Tensor, y: Tensor, kept: Tensor, over: Tensor, enter: Tensor
) -> tuple[Tensor, Tensor]:
    """The next active set of Lawson and Hanson (1974) on the dual, and its multipliers.

    Where all multipliers y have the right sign, the most violated row enters. Otherwise the kept
    multipliers move towards y until the first of them reaches 0, and its row leaves.
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


def _at_active(track: Tracking, problem: ActiveSetProblem, bounds: Bounds) -> tuple[Tensor, Tensor]:
    """w with the active rows at their bounds, and the multipliers y of all rows.

        w = w0 - K C^T y,   (C K C^T + slack) y = C w0 - bound

    For plans that are feasible the slack is removed by refinement.
    """
    y = problem.w0.new_zeros(problem.active.shape)
    rows = _active_rows(problem, bounds)
    if rows is None:
        return problem.w0, y
    Q = track.between(rows.entry, rows.slope)
    Q.diagonal(dim1=1, dim2=2).add_(rows.slack)
    size = Q.diagonal(dim1=1, dim2=2).rsqrt()
    factor = torch.linalg.cholesky_ex(Q * size[:, :, None] * size[:, None])[0]
    multiplier = torch.zeros_like(rows.excess)
    repaid = torch.where(problem.infeasible[:, None], 0.0, rows.slack)
    for _ in range(REFINEMENTS):
        right = (size * (rows.excess + repaid * multiplier))[..., None]
        multiplier = size * torch.cholesky_solve(right, factor)[..., 0]
    pull = y.new_zeros(len(y), problem.w0[0].numel())
    for entry, slope in zip(rows.entry, rows.slope, strict=True):
        pull.scatter_add_(1, entry, -multiplier * slope)
    y.flatten()[rows.position] = multiplier.flatten().index_select(0, rows.slot)
    return problem.w0 + track.respond(pull.view(problem.w0.shape)), y


class ActiveRows(NamedTuple):
    """The active rows of each plan, padded to the largest number k of any plan.

    position   the rows, counted over the batch          [count]
    slot       their places in the padded arrays         [count]
    excess     value for w0 minus bound; 0 where padded  [batch, k]
    slack      slack per multiplier; 1 where padded      [batch, k]
    entry      entries of w that a row acts on           [terms, batch, k]
    slope      slopes by these entries                   [terms, batch, k]
    """

    position: Tensor
    slot: Tensor
    excess: Tensor
    slack: Tensor
    entry: Tensor
    slope: Tensor


def _active_rows(problem: ActiveSetProblem, bounds: Bounds) -> ActiveRows | None:
    """The active rows; None where no plan has one."""
    index = problem.active.flatten().nonzero()[:, 0]
    if not len(index):
        return None
    batch, terms, steps, per_step = problem.slope.shape
    rows, m = steps * per_step, len(bounds.low)
    width, used = problem.w0.shape[2], tuple(bounds.used)
    place, slack = places(steps, width, m, per_step - m, used, index.device)
    plan = index // rows
    row, (slot, k) = index - plan * rows, _slots(plan, batch)
    first_slope = index + (terms - 1) * rows * plan
    slopes = [problem.slope.flatten().index_select(0, first_slope + i * rows) for i in range(terms)]
    numbers = torch.stack((_excess(problem, index), slack.index_select(0, row), *slopes))
    padded = problem.w0.new_zeros(2 + terms, batch * k)
    padded[1] = 1.0
    excess, slack, *_ = padded.index_copy_(1, slot, numbers).view(-1, batch, k)
    slope = padded[2:].view(terms, batch, k)
    entry = torch.zeros(terms, batch * k, dtype=torch.long, device=index.device)
    entry = entry.index_copy_(1, slot, place.index_select(1, row)).view(terms, batch, k)
    return ActiveRows(index, slot, excess, slack, entry, slope)


def _slots(plan: Tensor, batch: int) -> tuple[Tensor, int]:
    """The places of rows in arrays [batch, k] flattened, and k, the largest number of any plan.

    plan   the plan of each row, in ascending order
    """
    count = torch.bincount(plan, minlength=batch)
    k = int(count.amax())
    before = (count.cumsum(0) - count).index_select(0, plan)
    return plan * k + torch.arange(len(plan), device=plan.device) - before, k


def _excess(problem: ActiveSetProblem, index: Tensor) -> Tensor:
    """Value for w0 minus the bound at which each of these rows is active."""
    value, active, high, low = (
        v.flatten().index_select(0, index)
        for v in (problem.value0, problem.active, problem.high, problem.low)
    )
    return value - torch.where(active > 0, high, low)
