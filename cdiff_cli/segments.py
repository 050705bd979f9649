"""Trajectories whose straight segments stay outside balls and ellipsoids: convex inner approximations, and their exact projection.

A segment misses a ball exactly when a plane tangent to the ball has both its ends on the outer side. With one tangent plane a
segment chosen, the safe set becomes, waypoint by waypoint, an intersection of a few half-spaces: convex, separable, inside the
true set. The planes are chosen so that a path which crosses a ball slides round it on the side on which it passes the centre,
the normals turning evenly from where it enters to where it leaves: a push straight outwards from the centre would tear it.
"""

from collections.abc import Sequence
from typing import TypeGuard

import torch
from torch import Tensor

from cdiff_cli.constraint import Constraint, Part, Pins, Segments, Traj, Waypoints
from cdiff_cli.levels import Affine, Ellipsoid, dot, each_end

Planes = tuple[Tensor, Tensor]
"""Half-spaces a.x <= b of each waypoint: a [batch, horizon, m, dim], b [batch, horizon, m]."""

NEVER = 1e30  # bound of a half-space that is not there


def planes(parts: Sequence[Waypoints | Segments], x: Traj, pins: Pins) -> Planes:
    """Half-spaces of each waypoint that together imply the parts: the affine ones themselves, for each ball the tangent planes of
    the segment before and after.
    """
    each: list[tuple[Tensor, Tensor]] = []
    for part in parts:
        level = part.level
        if isinstance(level, Affine):
            each.append((level.a.expand_as(x), level.b.expand(x.shape[:2])))
            continue
        assert isinstance(level, Ellipsoid)
        n = normals(level, x, pins)
        zero, never = torch.zeros_like(x[:, :1]), torch.full_like(x[:, :1, 0], NEVER)
        first, last = zip(each_end(level.centre, 1), each_end(level.axes, 1), strict=True)
        a, b = _tangent(n, level, *last)  # of the segment before
        each.append((torch.cat((zero, a), 1), torch.cat((never, b), 1)))
        a, b = _tangent(n, level, *first)  # of the segment after
        each.append((torch.cat((a, zero), 1), torch.cat((b, never), 1)))
    return torch.stack([a for a, _ in each], 2), torch.stack([b for _, b in each], 2)


def goes_round(part: Part) -> TypeGuard[Segments]:
    """Whether the part keeps segments outside a ball or an ellipsoid, so that tangent planes stand for it."""
    return isinstance(part, Segments) and isinstance(part.level, Ellipsoid) and part.level.side > 0


def turned(g: Constraint, x: Traj, pins: Pins) -> Constraint:
    """g with each part that goes round a ball replaced by two: the half-spaces of its tangent planes at x, of the segment before
    each waypoint and of the segment after. One row a waypoint, in the part's own units; -1 where there is no such segment.
    """
    if not any(goes_round(part) for part in g.parts):
        return g
    parts: list[Part] = []
    for part in g.parts:
        if not goes_round(part):
            parts.append(part)
            continue
        a, b = planes((part,), x, pins)
        assert isinstance(part.level, Ellipsoid)
        m = part.level.m.expand(x.shape[:2])
        for slot in range(a.shape[2]):
            bound = torch.where(b[..., slot] == NEVER, 1.0, m * b[..., slot])
            parts.append(Waypoints(part.name, Affine(m[..., None] * a[..., slot, :], bound)))
    return Constraint(tuple(parts))


def _tangent(n: Tensor, level: Ellipsoid, centre: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """The half-spaces n.y >= 1 as a.x <= b, y the level's scaled x."""
    slope = n / axes
    return -slope @ level.which, -1 - dot(slope, centre)


def normals(level: Ellipsoid, x: Traj, pins: Pins) -> Tensor:
    """Outward unit normals n of the tangent planes, one a segment, in the coordinates where the surface is the unit sphere
    [batch, horizon - 1, k]: both ends y of the segment are to satisfy n.y >= 1.

    Outside, n points to the segment's nearest point. Along a run of segments inside, from waypoint a to waypoint b, n turns
    from the direction of a by way of that of the run's nearest point to that of b, in proportion to the path walked.
    On a line there is no way round: all normals point to the side that is nearer as a whole.
    """
    y = level.scaled(x)
    pinned = pins.mask[:, level.which.argmax(1)].all(1)
    if y.shape[-1] == 1:
        return _one_side(y, pinned)
    first, last = y[:, :-1], y[:, 1:]
    near = first + level.worst(x)[..., None] * (last - first)
    distance = near.norm(dim=-1)
    n = _unit(near, first)
    inside = distance < 1 - (1e-9 if x.dtype == torch.float64 else 1e-4)  # well above the rounding of a safe path
    if bool(inside.any()):
        n = n.clone()
        n[inside] = _turning(y, near, distance, inside)
    return _tangent_to_pins(n, y, pinned)


def nearest_in_planes(z: Traj, halfspaces: Planes, pins: Pins) -> Traj:
    """The nearest trajectory with a.x <= b at every waypoint, pinned waypoints left alone: exact with up to two active rows a
    waypoint (always enough in the plane); where more are needed, the best point that two give.
    """
    a, b = halfspaces
    value = (a * z[:, :, None]).sum(-1) - b
    wrong = (value.amax(2) > 0) & ~pins.mask.any(1)
    if not bool(wrong.any()):
        return z
    out = z.clone()
    out[wrong] = z[wrong] + _step(a[wrong].double(), value[wrong].double()).to(z)
    return out


def _step(a: Tensor, value: Tensor) -> Tensor:
    """The shortest d with value + a.d <= 0, among those that make one row or two rows equal: [n, m, dim] -> [n, dim]."""
    m, size = a.shape[1], a.square().sum(-1)
    i, j = torch.triu_indices(m, m, device=a.device)
    gram = torch.einsum("nid,njd->nij", a, a)[:, i, j]
    same = i == j
    det = torch.where(same, size[:, i], size[:, i] * size[:, j] - gram**2)
    floor = 1e-9 * (size[:, i] * size[:, j]).clamp_min(1e-30)
    usable = torch.where(same, size[:, i] > 0, det > floor)
    det = torch.where(usable, det, 1.0)
    mu_i = torch.where(same, value[:, i], size[:, j] * value[:, i] - gram * value[:, j]) / det
    mu_j = torch.where(same, 0.0, (size[:, i] * value[:, j] - gram * value[:, i]) / det)
    d = -(mu_i[..., None] * a[:, i] + mu_j[..., None] * a[:, j])  # [n, pairs, dim]
    excess = (value[:, None] + torch.einsum("npd,nid->npi", d, a)).clamp_min(0)
    missed = torch.where(usable, excess.amax(-1), torch.inf)
    cost = torch.where(missed <= 1e-9, d.square().sum(-1), 1e12 * (1 + missed))
    return d[torch.arange(len(d), device=d.device), cost.argmin(1)]


def _one_side(y: Tensor, pinned: Tensor) -> Tensor:
    """The normal of the whole path on a line: towards its pinned ends, else where it takes the shorter way [batch, n, 1]."""
    below, above = ((1 + side * y).clamp_min(0).square().sum(1, keepdim=True) for side in (1, -1))
    held = y[:, pinned].sum(1, keepdim=True)
    up = torch.where(held == 0, above <= below, held > 0)
    return (2 * up.to(y) - 1).expand(-1, y.shape[1] - 1, -1)


def _turning(y: Tensor, near: Tensor, distance: Tensor, inside: Tensor) -> Tensor:
    """Normals of the segments inside the sphere, along their runs, as normals() describes [segments inside, k]."""
    n = inside.shape[1]
    index = torch.arange(n, device=y.device).expand_as(inside)
    start = torch.where(inside, -1, index).cummax(1).values + 1  # first segment of the run
    stop = torch.where(inside, n, index).flip(1).cummin(1).values.flip(1) - 1  # its last
    run = start.clamp_max(n - 1)
    deepest = torch.full_like(distance, torch.inf).scatter_reduce(1, run, torch.where(inside, distance, torch.inf), "amin")
    is_deepest = inside & (distance <= deepest.gather(1, run))
    middle = torch.full_like(index, n).scatter_reduce(1, run, torch.where(is_deepest, index, n), "amin").gather(1, run)

    b, i = inside.nonzero(as_tuple=True)
    run, stop, middle = run[b, i], stop[b, i], middle[b, i]
    into, out, nearest = y[b, run], y[b, stop + 1], near[b, middle]
    across = out - into
    along = _unit(across, into)
    e_in, e_out = _unit(into, across), _unit(out, across)
    aside = nearest - (nearest * along).sum(-1, keepdim=True) * along
    e_mid = _unit(nearest, _sideways(aside, across))
    walked = torch.cat((torch.zeros_like(distance[:, :1]), (y[:, 1:] - y[:, :-1]).norm(dim=-1).cumsum(1)), 1)
    half = (walked[b, i] + walked[b, i + 1]) / 2  # at the middle of each segment
    begin, end = walked[b, run], walked[b, stop + 1]
    share = torch.where(end > begin, (half - begin) / (end - begin).clamp_min(1e-12), 0.5)[..., None]
    to_mid, to_out = _angle(e_in, e_mid), _angle(e_mid, e_out)
    angle = share * (to_mid + to_out)
    return torch.where(angle <= to_mid, _turn(e_in, e_mid, angle), _turn(e_mid, e_out, angle - to_mid))


def _turn(e: Tensor, towards: Tensor, angle: Tensor) -> Tensor:
    """The unit vector at that angle from e on the great circle towards another."""
    aside = towards - (towards * e).sum(-1, keepdim=True) * e
    return angle.cos() * e + angle.sin() * _unit(aside, _sideways(torch.zeros_like(e), e))


def _angle(a: Tensor, b: Tensor) -> Tensor:
    return 2 * torch.atan2((a - b).norm(dim=-1, keepdim=True), (a + b).norm(dim=-1, keepdim=True))


def _tangent_to_pins(n: Tensor, y: Tensor, pinned: Tensor) -> Tensor:
    """Turn the normals of segments with a pinned end so far that this end lies on the outer side."""
    for ends, held in ((y[:, :-1], pinned[:-1]), (y[:, 1:], pinned[1:])):
        some = held.nonzero()[:, 0]  # a few of many segments
        at, normal = ends[:, some], n[:, some]
        length = at.norm(dim=-1, keepdim=True)
        e = at / length.clamp_min(1e-12)
        beyond = ((normal * at).sum(-1, keepdim=True) < 1) & (length >= 1)
        cosine = 1 / length.clamp_min(1.0)
        aside = _unit(normal - (normal * e).sum(-1, keepdim=True) * e, _sideways(torch.zeros_like(e), e))
        turned_to = cosine * e + (1 - cosine**2).clamp_min(0).sqrt() * aside
        n = n.index_copy(1, some, torch.where(beyond, turned_to, normal))
    return n


def _unit(v: Tensor, instead: Tensor) -> Tensor:
    """v / |v|, or the direction of another vector where v is nearly zero."""
    length, other = v.norm(dim=-1, keepdim=True), instead.norm(dim=-1, keepdim=True)
    first = torch.zeros_like(v)
    first[..., 0] = 1.0
    spare = torch.where(other > 1e-9, instead / other.clamp_min(1e-9), first)
    return torch.where(length > 1e-9, v / length.clamp_min(1e-9), spare)


def _sideways(v: Tensor, along: Tensor) -> Tensor:
    """v, or where it is nearly zero some vector at right angles to `along`."""
    turned = torch.zeros_like(along)
    turned[..., 0], turned[..., 1] = -along[..., 1], along[..., 0]
    flat = turned.norm(dim=-1, keepdim=True) < 1e-9  # along has neither: any first axis will do
    first = torch.zeros_like(along)
    first[..., 0] = 1.0
    return torch.where(v.norm(dim=-1, keepdim=True) > 1e-9, v, torch.where(flat, first, turned))
