"""Trajectories whose straight segments stay outside balls and ellipsoids: convex inner approximations, and their exact projection.

A segment misses a ball exactly when a plane tangent to the ball has both its ends on the outer side. With one tangent plane a
segment chosen, the safe set becomes, waypoint by waypoint, an intersection of a few half-spaces: convex, separable, inside the
true set. The planes are chosen so that a path which crosses a ball slides round it on the side on which it passes the centre,
the normals turning evenly from where it enters to where it leaves: a push straight outwards from the centre would tear it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise
from typing import TypeGuard

import torch
from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj, each_end, times
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.state_sets import Ellipsoid, HalfSpace
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.projection.solvers.sphere_normals import (
    ROUNDING,
    ahead,
    nearest_points,
    normals_of,
    outwards,
)

Planes = tuple[Tensor, Tensor]
"""Half-spaces a.x <= b of each waypoint: a [batch, horizon, m, dim], b [batch, horizon, m]."""
NEVER = 1e30  # bound of a half-space that is not there


def planes(parts: Sequence[AtWaypoints | OnSegments], x: Traj, pins: Pins) -> Planes:
    """Half-spaces of each waypoint that together imply the parts: the affine ones themselves, for each ball the tangent planes of
    the segment before and after.
    """
    m = sum(1 if isinstance(part.level, HalfSpace) else 2 for part in parts)
    batch, horizon, dim = x.shape
    a, b = (
        x.new_zeros(dim, batch, m, horizon),
        x.new_full((batch, m, horizon), NEVER),
    )  # sums over few numbers are fast this way
    rows, bounds, at = a.permute(2, 1, 3, 0), b.transpose(0, 1), 0
    n = iter(
        _each_normals([part.level for part in parts if isinstance(part.level, Ellipsoid)], x, pins)
    )
    for part in parts:
        level = part.level
        if isinstance(level, HalfSpace):
            rows[at], bounds[at] = level.a, level.b
            at += 1
            continue
        assert isinstance(level, Ellipsoid)
        normal = next(n)
        first, last = zip(
            each_end(level.which, 2),
            each_end(level.centre, 1),
            each_end(level.axes, 1),
            strict=True,
        )
        before = _tangent(normal, *last)
        after = (
            before
            if all(v is w for v, w in zip(first, last, strict=True))
            else _tangent(normal, *first)
        )
        rows[at, :, 1:], bounds[at, :, 1:] = before  # of the segment before the waypoint
        rows[at + 1, :, :-1], bounds[at + 1, :, :-1] = after
        at += 2
    return a.permute(1, 3, 2, 0), b.transpose(1, 2)


def crossed(parts: Sequence[AtWaypoints | OnSegments], x: Traj, tolerance: float = 0.0) -> Tensor:
    """Which trajectories violate one of the parts, those that planes() takes, by more than the tolerance [batch]."""
    found = []
    for part in parts:
        level = part.level
        if isinstance(level, HalfSpace):
            found.append((level(x) > tolerance).any(1))
        else:
            assert isinstance(level, Ellipsoid)
            y = ahead(level.scaled(x))
            least = 1 - tolerance / level.m if tolerance else 1.0
            found.append((nearest_points(y[:, :-1], y[:, 1:])[1] < least).any(1))
    return (
        torch.stack(found).any(0)
        if len(found) > 1
        else found[0]
        if found
        else x.new_zeros(len(x), dtype=torch.bool)
    )


def excludes_ellipsoid(part: TrajectoryConstraint) -> TypeGuard[OnSegments]:
    """Whether the part keeps segments outside a ball or an ellipsoid, so that tangent planes stand for it."""
    return (
        isinstance(part, OnSegments) and isinstance(part.level, Ellipsoid) and part.level.side > 0
    )


@dataclass(frozen=True)
class TangentPlanes:
    """A constraint in which half-spaces of tangent planes stand for the parts that go round balls: the rows of the other parts,
    then for each ball those of the segments before each waypoint, and of those after it, in the parts' own units; -1 where there is
    no such segment.

    rest   the other parts
    a, b   [dim, batch, m, horizon], [batch, m, horizon]
    """

    rest: Constraint
    a: Tensor
    b: Tensor

    def __call__(self, x: Traj) -> Rows:
        return self.linearise(x)[0]

    def _values(self, x: Traj) -> Rows:
        return ((self.a * x.movedim(-1, 0).contiguous()[:, :, None]).sum(0) - self.b).flatten(1)

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        """As Constraint.linearise."""
        parts, m = len(self.rest.parts), self.b.shape[1]
        size = (parts + m) * self.a.square().sum(0).flatten(1)
        if not parts:
            return self._values(x), self._pull, size
        rows, rest_pull, rest_size = self.rest.linearise(x)
        n = rows.shape[1]
        every = torch.cat((rest_size * ((parts + m) / parts), size), 1)
        return (
            torch.cat((rows, self._values(x)), 1),
            lambda w: rest_pull(w[:, :n]) + self._pull(w[:, n:]),
            every,
        )

    def _pull(self, w: Rows) -> Traj:
        return (w.reshape(self.b.shape) * self.a).sum(2).movedim(0, -1)


def split_excluded(g: Constraint) -> tuple[list[OnSegments], Constraint]:
    """The parts of g that go round a ball, and the others."""
    round_ = [part for part in g.parts if excludes_ellipsoid(part)]
    return round_, Constraint(
        tuple(part for part in g.parts if not excludes_ellipsoid(part))
    ) if round_ else g


def row_blocks(g: Constraint, horizon: int, planes: bool) -> list[slice]:
    """Where the multipliers of g stand, block by block; a block's rows follow the waypoints, so that a plan moved on by some
    waypoints moves each block by as many rows.

    planes   of the rows of turned(g): those of the other parts, then of each ball the segments before each waypoint and those
             after it; False: of the rows of g itself
    """
    round_, rest = split_excluded(g) if planes else ([], g)
    counts = [len(part.labels(horizon)) for part in rest.parts] + 2 * len(round_) * [horizon]
    ends = list(accumulate(counts, initial=0))
    return [slice(begin, end) for begin, end in pairwise(ends)]


def with_tangent_planes(g: Constraint, x: Traj, pins: Pins) -> Constraint | TangentPlanes:
    """g with half-spaces of tangent planes at x in the place of each part that goes round a ball."""
    round_, rest = split_excluded(g)
    if not round_:
        return g
    a, b = planes(round_, x, pins)
    a, b = a.permute(3, 0, 2, 1), b.transpose(1, 2)
    for k, part in enumerate(round_):
        assert isinstance(part.level, Ellipsoid)
        own, m = slice(2 * k, 2 * k + 2), part.level.m.expand(x.shape[:2])[:, None]
        a[:, :, own] *= m
        b[:, own] = torch.where(b[:, own] == NEVER, 1.0, m * b[:, own])
    return TangentPlanes(rest, a, b)


def _tangent(n: Tensor, which: Tensor, centre: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """The half-spaces n.y >= 1 as a.x <= b, y the level's scaled x."""
    slope = n / axes
    return -times(slope, which), -1 - (slope * centre).sum(-1)


def normals(level: Ellipsoid, x: Traj, pins: Pins) -> Tensor:
    """Normals of the tangent planes, one a segment, in the coordinates where the surface is the unit sphere (sphere_normals.py)
    [batch, horizon - 1, k].
    """
    return _each_normals([level], x, pins)[0]


def _each_normals(levels: Sequence[Ellipsoid], x: Traj, pins: Pins) -> Sequence[Tensor]:
    """The normals of several levels, all at once where they have as many coordinates."""
    scaled = [level.scaled(x) for level in levels]
    held = [
        pins.held if pins.whole else pins.mask[:, level.which.argmax(-1)].all(1) for level in levels
    ]
    alike = len({y.shape[-1] for y in scaled}) == 1 and all(
        h is held[0] or torch.equal(h, held[0]) for h in held[1:]
    )
    if not alike or len(levels) == 1:
        return [normals_of(ahead(y), pinned) for y, pinned in zip(scaled, held, strict=True)]
    return normals_of(ahead(torch.cat(scaled)), held[0]).chunk(len(levels))


def nearest_in_planes(z: Traj, halfspaces: Planes, pins: Pins) -> Traj:
    """The nearest trajectory with a.x <= b at every waypoint, pinned waypoints left alone: exact with up to two active rows a
    waypoint (always enough in the plane); where more are needed, the best point that two give.
    """
    return _moved(z, halfspaces, pins)[0]


def _moved(z: Traj, halfspaces: Planes, pins: Pins) -> tuple[Traj, Tensor]:
    """nearest_in_planes() and the waypoints that it moved, counted on over the batch [n]."""
    a, b = halfspaces
    value = (a * z[:, :, None]).sum(-1) - b
    wrong = (value.amax(2) > 0) & ~pins.held
    at = wrong.flatten().nonzero()[:, 0]
    if not len(at):
        return z, at
    m, dim = a.shape[2:]
    rows = a.permute(3, 2, 0, 1).reshape(dim, m, -1).index_select(2, at).double()
    step = _step(rows, value.permute(2, 0, 1).reshape(m, -1).index_select(1, at).double())
    return z.flatten(0, 1).index_add(0, at, step.T.to(z)).view(z.shape), at


def nearest_around(
    parts: Sequence[AtWaypoints | OnSegments], z: Traj, pins: Pins, rounds: int
) -> Traj:
    """The nearest trajectory in the half-spaces of tangent planes, chosen at z and then anew at each result: the set so described
    holds the last result, so the distance to z can only fall. What the first choice leaves where it is the others do too.
    """
    x, at = _moved(z, planes(parts, z, pins), pins)
    if not len(at):
        return x
    horizon = z.shape[1]
    tau = at % horizon
    back, on = tau > 0, tau < horizon - 1
    beside = torch.stack((at - back.long(), at, at + on.long()))
    missing = None if pins.loose[0] > 0 and pins.loose[1] < horizon else torch.stack((~back, ~on))
    pinned = pins.mask[beside[::2] % horizon]  # of the waypoints before and after [2, n, dim]
    held = pinned if bool(pinned.any()) else None
    from_ = z.flatten(0, 1).index_select(0, at).T
    for _ in range(rounds - 1):
        rows = _planes_beside(parts, x, beside, missing, held)
        if rows is None:  # a step of two rows left some segment inside
            x = _moved(z, planes(parts, x, pins), pins)[0]
            continue
        a, b = rows
        value = (a * from_[:, None]).sum(0) - b
        wrong = value.amax(0) > 0
        step = torch.where(wrong, _step(a.double(), value.double()), 0.0)
        x = x.flatten(0, 1).index_copy(0, at, (from_ + step.to(z)).T).view(z.shape)
    return x


def _planes_beside(
    parts: Sequence[AtWaypoints | OnSegments],
    x: Traj,
    beside: Tensor,
    missing: Tensor | None,
    held: Tensor | None,
) -> tuple[Tensor, Tensor] | None:
    """planes() of some free waypoints alone, a [dim, m, n], b [m, n]; None where a segment beside them is inside a ball.

    beside    indices of the waypoints before, themselves, and after, counted on over the batch   [3, n]
    missing   whether there is no segment before, no segment after   [2, n]
    held      pinned coordinates of the waypoints before and after, None where there are none   [2, n, dim]
    """
    n, dim, slots = beside.shape[1], x.shape[2], []

    def own(value: Tensor, trailing: int) -> Tensor:
        """A number of a level at each waypoint [n, ...]."""
        if value.ndim == trailing:
            return value
        each = value.expand(*x.shape[:2], *value.shape[value.ndim - trailing :])
        return each.flatten(0, 1)[beside[1]]

    for part in parts:
        level = part.level
        if isinstance(level, HalfSpace):
            slots.append((own(level.a, 1).expand(n, dim).T[:, None], own(level.b, 0).expand(1, n)))
            continue
        assert isinstance(level, Ellipsoid)
        y = ahead(level.scaled(x).flatten(0, 1).index_select(0, beside.flatten()).view(3, n, -1))
        near, distance, _ = nearest_points(y[:2], y[1:])
        if y.shape[-1] == 1 or bool((distance < 1 - ROUNDING[x.dtype]).any()):
            return None
        normal = near / distance[..., None]
        if held is not None:
            normal = outwards(
                normal, y[::2], held[..., level.which.argmax(-1)].all(-1, keepdim=True)
            )
        a, b = _tangent(normal, level.which, own(level.centre, 1), own(level.axes, 1))
        slots.append((a.movedim(-1, 0), b if missing is None else torch.where(missing, NEVER, b)))
    return torch.cat([a for a, _ in slots], 1), torch.cat([b for _, b in slots])


@lru_cache(maxsize=16)
def _pairs(m: int, device: torch.device) -> Tensor:
    """The first and the second of every two rows, or the only row twice [2, pairs]."""
    return torch.triu_indices(m, m, 1 if m > 1 else 0, device=device)


def _step(a: Tensor, value: Tensor) -> Tensor:
    """The shortest d with value + a.d <= 0, among those that make one row or two rows equal: a [dim, m, n], value [m, n]
    -> [dim, n].

    Of two unit rows with cosine c the multipliers are mu = (v - c v_other) / (1 - c^2), where neither is negative; a row whose
    other one has no multiplier stands alone, mu = [v]_+.
    """
    size = a.square().sum(0).sqrt_().clamp_min_(1e-15)
    a, value = a / size, value / size
    if a.shape[1] == 2:
        two, v = a[:, :, None], value[:, None]
    else:
        pairs = _pairs(a.shape[1], a.device)
        two, v = a[:, pairs], value[pairs]  # [dim, 2, pairs, n], [2, pairs, n]
    cosine = (two[:, 0] * two[:, 1]).sum(0)
    det = 1 - cosine.square()
    parallel = det < 1e-9
    mu = v - cosine * v.flip(0)
    if bool(parallel.any()):
        larger = v[0] >= v[1]
        mu = torch.where(parallel, torch.stack((larger, ~larger)).to(mu) - 0.5, mu)
        det = torch.where(parallel, 1.0, det)
    mu = torch.where(mu.flip(0) > 0, (mu / det).clamp_min_(0), v.clamp_min(0))
    d = -(mu * two).sum(1)  # [dim, pairs, n]
    if d.shape[1] == 1:
        return d[:, 0]
    missed = ((d[:, :, None] * a[:, None]).sum(0) + value).amax(1)  # [pairs, n]
    cost = torch.where(missed <= 1e-9, d.square().sum(0), 1e12 * (1 + missed))
    return d.gather(1, cost.argmin(0).expand(len(d), 1, -1))[:, 0]
