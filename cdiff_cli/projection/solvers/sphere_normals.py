"""Tangent planes of the unit sphere for the segments of a path, by their normals.

Both ends of a segment must lie on the outer side of its plane. The normals are chosen so that the
path goes around the sphere on the side on which it passes the centre.
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

ROUNDING = {torch.float64: 1e-9, torch.float32: 1e-4}
"""Distance inside the sphere up to which a segment counts as outside, in radii."""


def ahead(y: Tensor) -> Tensor:
    """y with its last dimension first in memory; torch sums slowly over a short last one."""
    return y.movedim(-1, 0).contiguous().movedim(0, -1)


def nearest_points(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The point of each segment [..., k] nearest to 0, its distance, and the squared length."""
    d = last - first
    square = d.square().sum(-1)
    share = ((first * d).sum(-1) / square.clamp_min(1e-30)).neg_().clamp_(0.0, 1.0)
    near = torch.addcmul(first, share[..., None], d)
    return near, near.square().sum(-1).sqrt_(), square


def normals_of(y: Tensor, pinned: Tensor) -> Tensor:
    """Outward unit normals n of tangent planes, one per segment of y: [batch, horizon - 1, k].

    Both ends of a segment are then required to satisfy n.y >= 1. A pinned waypoint outside the
    sphere is on the outer side of the planes of its segments, where one plane can have both ends
    there.

    Outside the sphere, n points to the nearest point of the segment. Along a run of segments
    inside, from waypoint a to waypoint b, n turns from the direction of a through that of the run's
    nearest point to that of b, in proportion to the path length. On a line (k = 1) no path goes
    around: all normals point to the side that is nearer as a whole.

    y        [batch, horizon, k]
    pinned   [horizon]
    """
    if y.shape[-1] == 1:
        return _one_side(y, pinned)
    near, distance, square = nearest_points(y[:, :-1], y[:, 1:])
    n = near / distance.clamp_min(1e-9)[..., None]
    inside = distance < 1 - ROUNDING[y.dtype]
    if bool(inside.any()):
        n[inside] = _turning(y, near, distance, square.sqrt(), inside)
    return _tangent_to_pins(n, y, pinned)


def _one_side(y: Tensor, pinned: Tensor) -> Tensor:
    """The normal of a whole path on a line: towards its pinned waypoints, else to the nearer side.

    [batch, horizon - 1, 1]
    """
    below, above = ((1 + side * y).clamp_min(0).square().sum(1, keepdim=True) for side in (1, -1))
    held = y[:, pinned].sum(1, keepdim=True)
    up = torch.where(held == 0, above <= below, held > 0)
    return (2 * up.to(y) - 1).expand(-1, y.shape[1] - 1, -1)


def _turning(y: Tensor, near: Tensor, distance: Tensor, length: Tensor, inside: Tensor) -> Tensor:
    """The normals of the segments inside the sphere, run by run [segments inside, k].

    near, distance, length   nearest point, its distance and the length, per segment
    """
    edges = pad(inside, (1, 1))
    # the waypoints where each run begins and ends
    plan, tau = (edges[:, 1:] != edges[:, :-1]).nonzero().view(-1, 2, 2).unbind(2)
    into, out = y[plan, tau].unbind(1)
    count = tau[:, 1:] - tau[:, :1]
    step = torch.arange(int(count.amax()), device=y.device)
    within = step < count  # the runs one below the other, padded to the longest [runs, longest]
    plan, segment = plan[:, :1], (tau[:, :1] + step).clamp_max(inside.shape[1] - 1)
    deepest = torch.where(within, distance[plan, segment], torch.inf).argmin(1, keepdim=True)
    nearest = near[plan, segment.gather(1, deepest)][:, 0]
    points = torch.stack((into, nearest, out))
    share = _share_of_path(torch.where(within, length[plan, segment], 0.0))
    if y.shape[-1] == 2 and float(points.square().sum(-1).amin()) > 1e-12:
        return _turned_in_plane(points, share)[within]
    return _turned_in_space(points, share, within)


def _share_of_path(length: Tensor) -> Tensor:
    """The share of a run's path up to the middle of each segment [runs, longest]."""
    until = length.cumsum(1)
    whole = until[:, -1:]
    return torch.where(whole > 0, (until - length / 2) / whole.clamp_min(1e-12), 0.5)


def _turned_in_space(points: Tensor, share: Tensor, within: Tensor) -> Tensor:
    """Unit vectors that turn through the directions of three points, on great circles [inside, k].

    points   first, middle and last point of each run                     [3, runs, k]
    share    share of the whole angle, proportional to the path length    [runs, longest]
    within   entries that are segments, not padding                       [runs, longest]
    """
    into, nearest, out = points
    across = out - into
    along, e_in, e_out = _unit(
        torch.stack((across, into, out)), torch.stack((into, across, across))
    )
    aside = nearest - (nearest * along).sum(-1, keepdim=True) * along
    e_mid = _unit(nearest, _sideways(aside, across))
    begin, towards = torch.stack((e_in, e_mid)), torch.stack((e_mid, e_out))
    turn, side = _angle(begin, towards), _perpendicular(begin, towards)
    angle = share * (turn[0] + turn[1])
    second = angle > turn[0]
    angle = torch.where(second, angle - turn[0], angle)[within][:, None]
    half, run = second[within].long(), within.nonzero()[:, 0]
    return angle.cos() * begin[half, run] + angle.sin() * side[half, run]


def _turned_in_plane(points: Tensor, share: Tensor) -> Tensor:
    """Unit vectors in the plane that turn through the directions of three points.

    points   first, middle and last point of each run                     [3, runs, 2]
    share    share of the whole angle, proportional to the path length    [runs, longest]
    -> [runs, longest, 2]
    """
    direction = torch.atan2(points[..., 1], points[..., 0])[..., None]
    turn = direction[1:] - direction[:-1]
    turn = turn - 2 * math.pi * torch.round(turn / (2 * math.pi))  # the shorter way
    size = turn.abs()
    past = share * (size[0] + size[1]) - size[0]  # the middle
    angle = direction[1] + past * torch.where(past > 0, turn[1], turn[0]).sign()
    return torch.stack((angle.cos(), angle.sin()), -1)


def _perpendicular(e: Tensor, towards: Tensor) -> Tensor:
    """The unit vector perpendicular to e on the great circle from e to `towards`."""
    aside = towards - (towards * e).sum(-1, keepdim=True) * e
    return _unit(_sideways(aside, e), e)


def _angle(a: Tensor, b: Tensor) -> Tensor:
    """The angle between unit vectors [..., 1]."""
    return 2 * torch.atan2((a - b).norm(dim=-1, keepdim=True), (a + b).norm(dim=-1, keepdim=True))


def _tangent_to_pins(n: Tensor, y: Tensor, pinned: Tensor) -> Tensor:
    """The normals, turned where a pinned end would lie on the inner side of its plane."""
    outside = pinned & (y.square().sum(-1) >= 1)
    inner = ((n * end).sum(-1) < 1 for end in (y[:, :-1], y[:, 1:]))
    if not bool((outside[:, :-1] & next(inner) | outside[:, 1:] & next(inner)).any()):
        return n
    at = pinned.nonzero()[:, 0]
    for segment, end in ((at[at < n.shape[1]], 0), (at[at > 0] - 1, 1)):
        n = n.index_copy(1, segment, outwards(n[:, segment], y[:, segment + end]))
    return n


def outwards(n: Tensor, at: Tensor) -> Tensor:
    """The normals [..., k], turned until points `at` outside the sphere are on their outer side."""
    square = at.square().sum(-1, keepdim=True)
    beyond = ((n * at).sum(-1, keepdim=True) < 1) & (square >= 1)
    if not bool(beyond.any()):
        return n
    length = square.sqrt()
    e, cosine = at / length.clamp_min(1e-12), 1 / length.clamp_min(1.0)
    return torch.where(
        beyond, cosine * e + (1 - cosine**2).clamp_min(0).sqrt() * _perpendicular(e, n), n
    )


def _unit(v: Tensor, instead: Tensor) -> Tensor:
    """v / |v|, or the direction of `instead` where v is nearly zero."""
    length = v.norm(dim=-1, keepdim=True)
    if bool((length > 1e-9).all()):
        return v / length
    other = instead.norm(dim=-1, keepdim=True)
    first = torch.zeros_like(v)
    first[..., 0] = 1.0
    spare = torch.where(other > 1e-9, instead / other.clamp_min(1e-9), first)
    return torch.where(length > 1e-9, v / length.clamp_min(1e-9), spare)


def _sideways(v: Tensor, along: Tensor) -> Tensor:
    """v, or a vector perpendicular to `along` where v is nearly zero."""
    enough = v.norm(dim=-1, keepdim=True) > 1e-9
    if bool(enough.all()):
        return v
    turned = torch.zeros_like(along)
    turned[..., 0], turned[..., 1] = -along[..., 1], along[..., 0]
    flat = turned.norm(dim=-1, keepdim=True) < 1e-9  # `along` is orthogonal to both axes
    first = torch.zeros_like(along)
    first[..., 0] = 1.0
    return torch.where(enough, v, torch.where(flat, first, turned))
