"""Trajectories whose straight segments stay outside balls and ellipsoids: convex inner approximations, and their exact projection.

A segment misses a ball exactly when a plane tangent to the ball has both its ends on the outer side. With one tangent plane a
segment chosen, the safe set becomes, waypoint by waypoint, an intersection of a few half-spaces: convex, separable, inside the
true set. The planes are chosen so that a path which crosses a ball slides round it on the side on which it passes the centre,
the normals turning evenly from where it enters to where it leaves: a push straight outwards from the centre would tear it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeGuard

import torch
from torch import Tensor
from torch.nn.functional import pad

from cdiff_cli.constraint import Constraint, Part, Pins, Pull, Rows, Segments, Traj, Waypoints
from cdiff_cli.levels import Affine, Ellipsoid, each_end, times

Planes = tuple[Tensor, Tensor]
"""Half-spaces a.x <= b of each waypoint: a [batch, horizon, m, dim], b [batch, horizon, m]."""

NEVER = 1e30  # bound of a half-space that is not there
_ROUNDING = {torch.float64: 1e-9, torch.float32: 1e-4}  # of the distance of a segment, well above that of a safe path


def planes(parts: Sequence[Waypoints | Segments], x: Traj, pins: Pins) -> Planes:
    """Half-spaces of each waypoint that together imply the parts: the affine ones themselves, for each ball the tangent planes of
    the segment before and after.
    """
    m = sum(1 if isinstance(part.level, Affine) else 2 for part in parts)
    batch, horizon, dim = x.shape
    a, b = x.new_zeros(dim, m, batch, horizon), x.new_full((m, batch, horizon), NEVER)  # sums over few numbers are fast this way
    rows, at = a.permute(1, 2, 3, 0), 0
    n = iter(_each_normals([part.level for part in parts if isinstance(part.level, Ellipsoid)], x, pins))
    for part in parts:
        level = part.level
        if isinstance(level, Affine):
            rows[at], b[at] = level.a, level.b
            at += 1
            continue
        assert isinstance(level, Ellipsoid)
        normal = next(n)
        first, last = zip(each_end(level.which, 2), each_end(level.centre, 1), each_end(level.axes, 1), strict=True)
        before = _tangent(normal, *last)
        after = before if all(v is w for v, w in zip(first, last, strict=True)) else _tangent(normal, *first)
        rows[at, :, 1:], b[at, :, 1:] = before  # of the segment before the waypoint
        rows[at + 1, :, :-1], b[at + 1, :, :-1] = after
        at += 2
    return a.permute(2, 3, 1, 0), b.permute(1, 2, 0)


def crossed(parts: Sequence[Waypoints | Segments], x: Traj) -> Tensor:
    """Which trajectories violate one of the parts, those that planes() takes [batch]."""
    found = torch.zeros(len(x), dtype=torch.bool, device=x.device)
    for part in parts:
        level = part.level
        if isinstance(level, Affine):
            found |= (level(x) > 0).any(1)
        else:
            assert isinstance(level, Ellipsoid)
            y = _ahead(level.scaled(x))
            found |= (_nearest(y[:, :-1], y[:, 1:])[1] < 1).any(1)
    return found


def goes_round(part: Part) -> TypeGuard[Segments]:
    """Whether the part keeps segments outside a ball or an ellipsoid, so that tangent planes stand for it."""
    return isinstance(part, Segments) and isinstance(part.level, Ellipsoid) and part.level.side > 0


@dataclass(frozen=True)
class Turned:
    """A constraint in which half-spaces of tangent planes stand for the parts that go round balls: the rows of the other parts,
    then of each waypoint those of the segments before and after it, in the parts' own units; -1 where there is no such segment.

    rest   the other parts
    a, b   [batch, horizon, m, dim], [batch, horizon, m]
    """

    rest: Constraint
    a: Tensor
    b: Tensor

    def __call__(self, x: Traj) -> Rows:
        return self.linearise(x)[0]

    def _values(self, x: Traj) -> Rows:
        return ((self.a * x[:, :, None]).sum(-1) - self.b).flatten(1)

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        """As Constraint.linearise."""
        parts, m = len(self.rest.parts), self.a.shape[2]
        size = (parts + m) * self.a.square().sum(-1).flatten(1)
        if not parts:
            return self._values(x), self._pull, size
        rows, rest_pull, rest_size = self.rest.linearise(x)
        n = rows.shape[1]
        every = torch.cat((rest_size * ((parts + m) / parts), size), 1)
        return torch.cat((rows, self._values(x)), 1), lambda w: rest_pull(w[:, :n]) + self._pull(w[:, n:]), every

    def _pull(self, w: Rows) -> Traj:
        return (w.reshape(self.b.shape)[..., None] * self.a).sum(2)


def apart(g: Constraint) -> tuple[list[Segments], Constraint]:
    """The parts of g that go round a ball, and the others."""
    round_ = [part for part in g.parts if goes_round(part)]
    return round_, Constraint(tuple(part for part in g.parts if not goes_round(part))) if round_ else g


def turned(g: Constraint, x: Traj, pins: Pins) -> Constraint | Turned:
    """g with half-spaces of tangent planes at x in the place of each part that goes round a ball."""
    round_, rest = apart(g)
    if not round_:
        return g
    a, b = planes(round_, x, pins)
    for k, part in enumerate(round_):
        assert isinstance(part.level, Ellipsoid)
        own, m = slice(2 * k, 2 * k + 2), part.level.m.expand(x.shape[:2])[..., None]
        a[:, :, own] *= m[..., None]
        b[:, :, own] = torch.where(b[:, :, own] == NEVER, 1.0, m * b[:, :, own])
    return Turned(rest, a, b)


def _tangent(n: Tensor, which: Tensor, centre: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """The half-spaces n.y >= 1 as a.x <= b, y the level's scaled x."""
    slope = n / axes
    return -times(slope, which), -1 - (slope * centre).sum(-1)


def normals(level: Ellipsoid, x: Traj, pins: Pins) -> Tensor:
    """Outward unit normals n of the tangent planes, one a segment, in the coordinates where the surface is the unit sphere
    [batch, horizon - 1, k]: both ends y of the segment are to satisfy n.y >= 1.

    Outside, n points to the segment's nearest point. Along a run of segments inside, from waypoint a to waypoint b, n turns
    from the direction of a by way of that of the run's nearest point to that of b, in proportion to the path walked.
    On a line there is no way round: all normals point to the side that is nearer as a whole.
    """
    return _each_normals([level], x, pins)[0]


def _each_normals(levels: Sequence[Ellipsoid], x: Traj, pins: Pins) -> Sequence[Tensor]:
    """The normals of several levels, all at once where they have as many coordinates."""
    scaled = [level.scaled(x) for level in levels]
    held = [pins.held if pins.whole else pins.mask[:, level.which.argmax(-1)].all(1) for level in levels]
    alike = len({y.shape[-1] for y in scaled}) == 1 and all(h is held[0] or torch.equal(h, held[0]) for h in held[1:])
    if not alike or len(levels) == 1:
        return [_normals(_ahead(y), pinned) for y, pinned in zip(scaled, held, strict=True)]
    return _normals(_ahead(torch.cat(scaled)), held[0]).chunk(len(levels))


def _ahead(y: Tensor) -> Tensor:
    """The same numbers with the last dimension first in memory: torch sums over a short last dimension slowly."""
    return y.movedim(-1, 0).contiguous().movedim(0, -1)


def _nearest(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of each segment [..., k] the point nearest to 0, its distance from there, and the square of the segment's length."""
    d = last - first
    square = d.square().sum(-1)
    share = ((first * d).sum(-1) / square.clamp_min(1e-30)).neg_().clamp_(0.0, 1.0)
    near = torch.addcmul(first, share[..., None], d)
    return near, near.square().sum(-1).sqrt_(), square


def _normals(y: Tensor, pinned: Tensor) -> Tensor:
    """normals() of y [batch, horizon, k], pinned [horizon]."""
    if y.shape[-1] == 1:
        return _one_side(y, pinned)
    near, distance, square = _nearest(y[:, :-1], y[:, 1:])
    n = near / distance.clamp_min(1e-9)[..., None]
    inside = distance < 1 - _ROUNDING[y.dtype]
    if bool(inside.any()):
        n[inside] = _turning(y, near, distance, square.sqrt(), inside)
    return _tangent_to_pins(n, y, pinned)


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


def nearest_around(parts: Sequence[Waypoints | Segments], z: Traj, pins: Pins, rounds: int) -> Traj:
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
    parts: Sequence[Waypoints | Segments], x: Traj, beside: Tensor, missing: Tensor | None, held: Tensor | None
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
        if isinstance(level, Affine):
            slots.append((own(level.a, 1).expand(n, dim).T[:, None], own(level.b, 0).expand(1, n)))
            continue
        assert isinstance(level, Ellipsoid)
        y = _ahead(level.scaled(x).flatten(0, 1).index_select(0, beside.flatten()).view(3, n, -1))
        near, distance, _ = _nearest(y[:2], y[1:])
        if y.shape[-1] == 1 or bool((distance < 1 - _ROUNDING[x.dtype]).any()):
            return None
        normal = near / distance[..., None]
        if held is not None:
            normal = _outwards(normal, y[::2], held[..., level.which.argmax(-1)].all(-1, keepdim=True))
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


def _one_side(y: Tensor, pinned: Tensor) -> Tensor:
    """The normal of the whole path on a line: towards its pinned ends, else where it takes the shorter way [batch, n, 1]."""
    below, above = ((1 + side * y).clamp_min(0).square().sum(1, keepdim=True) for side in (1, -1))
    held = y[:, pinned].sum(1, keepdim=True)
    up = torch.where(held == 0, above <= below, held > 0)
    return (2 * up.to(y) - 1).expand(-1, y.shape[1] - 1, -1)


def _turning(y: Tensor, near: Tensor, distance: Tensor, length: Tensor, inside: Tensor) -> Tensor:
    """Normals of the segments inside the sphere, along their runs, as normals() describes [segments inside, k]."""
    edges = pad(inside, (1, 1))
    ends = (edges[:, 1:] != edges[:, :-1]).flatten().nonzero().view(-1, 2)  # waypoints where each run begins and stops
    plan, tau = ends // y.shape[1], ends % y.shape[1]
    at = y[plan, tau]  # [runs, 2, k]
    into, out = at[:, 0], at[:, 1]
    count, step = (ends[:, 1:] - ends[:, :1]), torch.arange(int((ends[:, 1] - ends[:, 0]).max()), device=y.device)
    own = step < count  # the runs side by side, each padded to the longest [runs, longest]
    plan, segment = plan[:, :1], (tau[:, :1] + step).clamp_max(inside.shape[1] - 1)
    deepest = torch.where(own, distance[plan, segment], torch.inf).argmin(1, keepdim=True)
    nearest = near[plan, segment.gather(1, deepest)][:, 0]

    across = out - into
    along, e_in, e_out = _unit(torch.stack((across, into, out)), torch.stack((into, across, across)))
    aside = nearest - (nearest * along).sum(-1, keepdim=True) * along
    e_mid = _unit(nearest, _sideways(aside, across))
    walked = torch.where(own, length[plan, segment], 0.0)
    until = walked.cumsum(1)
    whole = until[:, -1:]
    share = torch.where(whole > 0, (until - walked / 2) / whole.clamp_min(1e-12), 0.5)  # at the middle of each segment
    begin, towards = torch.stack((e_in, e_mid)), torch.stack((e_mid, e_out))
    turn, side = _angle(begin, towards), _perpendicular(begin, towards)
    angle = share * (turn[0] + turn[1])
    second = angle > turn[0]
    angle = torch.where(second, angle - turn[0], angle)[own][:, None]
    half, run = second[own].long(), own.nonzero()[:, 0]
    return angle.cos() * begin[half, run] + angle.sin() * side[half, run]


def _perpendicular(e: Tensor, towards: Tensor) -> Tensor:
    """The unit vector at right angles to e on the great circle towards another."""
    aside = towards - (towards * e).sum(-1, keepdim=True) * e
    return _unit(_sideways(aside, e), e)


def _angle(a: Tensor, b: Tensor) -> Tensor:
    return 2 * torch.atan2((a - b).norm(dim=-1, keepdim=True), (a + b).norm(dim=-1, keepdim=True))


def _tangent_to_pins(n: Tensor, y: Tensor, pinned: Tensor) -> Tensor:
    """Turn the normals of segments with a pinned end so far that this end lies on the outer side."""
    at = pinned.nonzero()[:, 0]
    for segment, end in ((at[at < n.shape[1]], 0), (at[at > 0] - 1, 1)):
        normal = n[:, segment]  # a few of many
        outwards = _outwards(normal, y[:, segment + end])
        if outwards is not normal:
            n = n.index_copy(1, segment, outwards)
    return n


def _outwards(n: Tensor, at: Tensor, held: Tensor | None = None) -> Tensor:
    """Normals [..., k] turned so far that the points at, which lie outside, are on their outer side; held [..., 1], else all."""
    length = at.norm(dim=-1, keepdim=True)
    beyond = ((n * at).sum(-1, keepdim=True) < 1) & (length >= 1)
    if held is not None:
        beyond &= held
    if not bool(beyond.any()):
        return n
    e, cosine = at / length.clamp_min(1e-12), 1 / length.clamp_min(1.0)
    return torch.where(beyond, cosine * e + (1 - cosine**2).clamp_min(0).sqrt() * _perpendicular(e, n), n)


def _unit(v: Tensor, instead: Tensor) -> Tensor:
    """v / |v|, or the direction of another vector where v is nearly zero."""
    length = v.norm(dim=-1, keepdim=True)
    if bool((length > 1e-9).all()):
        return v / length
    other = instead.norm(dim=-1, keepdim=True)
    first = torch.zeros_like(v)
    first[..., 0] = 1.0
    spare = torch.where(other > 1e-9, instead / other.clamp_min(1e-9), first)
    return torch.where(length > 1e-9, v / length.clamp_min(1e-9), spare)


def _sideways(v: Tensor, along: Tensor) -> Tensor:
    """v, or where it is nearly zero some vector at right angles to `along`."""
    enough = v.norm(dim=-1, keepdim=True) > 1e-9
    if bool(enough.all()):
        return v
    turned = torch.zeros_like(along)
    turned[..., 0], turned[..., 1] = -along[..., 1], along[..., 0]
    flat = turned.norm(dim=-1, keepdim=True) < 1e-9  # along has neither: any first axis will do
    first = torch.zeros_like(along)
    first[..., 0] = 1.0
    return torch.where(enough, v, torch.where(flat, first, turned))
