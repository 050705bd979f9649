"""Directions round the unit sphere: for each straight segment of a path the normal of a plane tangent to the sphere, both ends to
lie on its outer side, so chosen that the path slides round on the side on which it passes the centre.
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

ROUNDING = {
    torch.float64: 1e-9,
    torch.float32: 1e-4,
}  # of the distance of a segment, well above that of a safe path


def ahead(y: Tensor) -> Tensor:
    """The same numbers with the last dimension first in memory: torch sums over a short last dimension slowly."""
    return y.movedim(-1, 0).contiguous().movedim(0, -1)


def nearest_points(first: Tensor, last: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of each segment [..., k] the point nearest to 0, its distance from there, and the square of the segment's length."""
    d = last - first
    square = d.square().sum(-1)
    share = ((first * d).sum(-1) / square.clamp_min(1e-30)).neg_().clamp_(0.0, 1.0)
    near = torch.addcmul(first, share[..., None], d)
    return near, near.square().sum(-1).sqrt_(), square


def normals_of(y: Tensor, pinned: Tensor) -> Tensor:
    """Outward unit normals n of the tangent planes of the unit sphere, one a segment of y [batch, horizon, k], both ends of which
    are to satisfy n.y >= 1: [batch, horizon - 1, k]. Of pinned waypoints [horizon], the plane of a segment leaves one outside.

    Outside, n points to the segment's nearest point. Along a run of segments inside, from waypoint a to waypoint b, n turns
    from the direction of a by way of that of the run's nearest point to that of b, in proportion to the path walked.
    On a line there is no way round: all normals point to the side that is nearer as a whole.
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
    """The normal of the whole path on a line: towards its pinned ends, else where it takes the shorter way [batch, n, 1]."""
    below, above = ((1 + side * y).clamp_min(0).square().sum(1, keepdim=True) for side in (1, -1))
    held = y[:, pinned].sum(1, keepdim=True)
    up = torch.where(held == 0, above <= below, held > 0)
    return (2 * up.to(y) - 1).expand(-1, y.shape[1] - 1, -1)


def _turning(y: Tensor, near: Tensor, distance: Tensor, length: Tensor, inside: Tensor) -> Tensor:
    """Normals of the segments inside the sphere, along their runs, as normals_of() describes [segments inside, k]."""
    edges = pad(inside, (1, 1))
    plan, tau = (
        (edges[:, 1:] != edges[:, :-1]).nonzero().view(-1, 2, 2).unbind(2)
    )  # waypoints where each run begins and stops
    into, out = y[plan, tau].unbind(1)
    count = tau[:, 1:] - tau[:, :1]
    step = torch.arange(int(count.amax()), device=y.device)
    own = step < count  # the runs side by side, each padded to the longest [runs, longest]
    plan, segment = plan[:, :1], (tau[:, :1] + step).clamp_max(inside.shape[1] - 1)
    deepest = torch.where(own, distance[plan, segment], torch.inf).argmin(1, keepdim=True)
    nearest = near[plan, segment.gather(1, deepest)][:, 0]

    walked = torch.where(own, length[plan, segment], 0.0)
    until = walked.cumsum(1)
    whole = until[:, -1:]
    share = torch.where(
        whole > 0, (until - walked / 2) / whole.clamp_min(1e-12), 0.5
    )  # at the middle of each segment
    turns = torch.stack((into, nearest, out))
    if y.shape[-1] == 2 and float(turns.square().sum(-1).amin()) > 1e-12:
        return _turned_in_plane(turns, share)[own]

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
    angle = torch.where(second, angle - turn[0], angle)[own][:, None]
    half, run = second[own].long(), own.nonzero()[:, 0]
    return angle.cos() * begin[half, run] + angle.sin() * side[half, run]


def _turned_in_plane(points: Tensor, share: Tensor) -> Tensor:
    """Unit vectors [runs, longest, 2] that turn from the direction of one point by way of the next to that of the last,
    [3, runs, 2], evenly in share [runs, longest].
    """
    direction = torch.atan2(points[..., 1], points[..., 0])[..., None]
    turn = direction[1:] - direction[:-1]
    turn = turn - 2 * math.pi * torch.round(turn / (2 * math.pi))  # the shorter way
    size = turn.abs()
    past = share * (size[0] + size[1]) - size[0]  # the middle
    angle = direction[1] + past * torch.where(past > 0, turn[1], turn[0]).sign()
    return torch.stack((angle.cos(), angle.sin()), -1)


def _perpendicular(e: Tensor, towards: Tensor) -> Tensor:
    """The unit vector at right angles to e on the great circle towards another."""
    aside = towards - (towards * e).sum(-1, keepdim=True) * e
    return _unit(_sideways(aside, e), e)


def _angle(a: Tensor, b: Tensor) -> Tensor:
    return 2 * torch.atan2((a - b).norm(dim=-1, keepdim=True), (a + b).norm(dim=-1, keepdim=True))


def _tangent_to_pins(n: Tensor, y: Tensor, pinned: Tensor) -> Tensor:
    """Turn the normals of segments with a pinned end so far that this end lies on the outer side."""
    outside = pinned & (y.square().sum(-1) >= 1)
    inner = ((n * end).sum(-1) < 1 for end in (y[:, :-1], y[:, 1:]))
    if not bool((outside[:, :-1] & next(inner) | outside[:, 1:] & next(inner)).any()):
        return n
    at = pinned.nonzero()[:, 0]
    for segment, end in ((at[at < n.shape[1]], 0), (at[at > 0] - 1, 1)):
        n = n.index_copy(1, segment, outwards(n[:, segment], y[:, segment + end]))  # a few of many
    return n


def outwards(n: Tensor, at: Tensor, held: Tensor | None = None) -> Tensor:
    """Normals [..., k] turned so far that the points at, which lie outside, are on their outer side; held [..., 1], else all."""
    square = at.square().sum(-1, keepdim=True)
    beyond = ((n * at).sum(-1, keepdim=True) < 1) & (square >= 1)
    if held is not None:
        beyond &= held
    if not bool(beyond.any()):
        return n
    length = square.sqrt()
    e, cosine = at / length.clamp_min(1e-12), 1 / length.clamp_min(1.0)
    return torch.where(
        beyond, cosine * e + (1 - cosine**2).clamp_min(0).sqrt() * _perpendicular(e, n), n
    )


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
