"""Levels: scalar functions f of one state, allowed where f <= 0, with their gradients written out and the place on a straight
segment where they are largest.

The numbers of a level may differ by plan and by waypoint: each tensor is [...] as its class says, or has [horizon | 1] or
[batch | 1, horizon | 1] in front of that. Such a level applies to trajectories [batch, horizon, dim]; one with no dimensions in
front applies to states of any shape [..., dim].
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from cdiff_cli.arrays import dot, each_end, times
from cdiff_cli.errors import InfeasibleError

L = TypeVar("L")


class SegmentPoints(NamedTuple):
    """A level at one point of each segment of a trajectory [..., horizon, dim].

    value      f there                                                        [..., horizon - 1]
    back, on   its derivatives by the segment's first and last waypoint       [..., horizon - 1, dim]
    size       |back|^2 + |on|^2, plus |f| times the curvature (StateSet.step_bound)   [..., horizon - 1]
    """

    value: Tensor
    back: Tensor
    on: Tensor
    size: Tensor


class StateSet(Protocol):
    """A scalar function f of a state [..., dim], allowed where f <= 0, in environment units even after pull_back."""

    def __call__(self, x: Tensor) -> Tensor: ...
    def gradient(self, x: Tensor) -> Tensor:
        """df/dx [..., dim]."""
        ...

    def step_bound(self, x: Tensor) -> Tensor:
        """|df/dx|^2 [...], plus |f| times the largest curvature, so that f / size is a safe step where the gradient fades."""
        ...

    def pull_back(self, centre: Tensor, scale: Tensor) -> "StateSet":
        """f(centre + scale * z) as a function of z; centre and scale [dim], or with [horizon] or [batch | 1, horizon] in front."""
        ...

    def tighten(self, margin: float) -> "StateSet":
        """A level allowed exactly where f <= -margin."""
        ...

    def segment_argmax(self, x: Tensor) -> Tensor:
        """Where f is largest on the segments of trajectories [..., horizon, dim], exactly: the share s in [0, 1] of each segment
        that lies before it [..., horizon - 1]. Where the level differs from waypoint to waypoint, it moves evenly between them.
        """
        ...

    def on_segment(self, x: Tensor, s: Tensor) -> SegmentPoints:
        """The level at the share s of each segment."""
        ...

    @property
    def convex(self) -> bool:
        """Whether the allowed set is convex, so that a segment is safe when its ends are."""
        ...


@dataclass(frozen=True)
class HalfSpace:
    """f(x) = a.x - b.   a [dim], b scalar, in the units of a.x"""

    a: Tensor
    b: Tensor

    trailing: ClassVar = {"a": 1, "b": 0}
    convex = True

    def __call__(self, x: Tensor) -> Tensor:
        return dot(x, self.a) - self.b

    def gradient(self, x: Tensor) -> Tensor:
        return self.a.expand_as(x)

    def step_bound(self, x: Tensor) -> Tensor:
        return self.a.square().sum(-1).expand(x.shape[:-1])

    def pull_back(self, centre: Tensor, scale: Tensor) -> "HalfSpace":
        return HalfSpace(self.a * scale, self.b - dot(centre, self.a))

    def compose(self, led: Tensor) -> "HalfSpace":
        """f(led x)   led [dim, dim]"""
        return replace(self, a=self.a @ led)

    def tighten(self, margin: float) -> "HalfSpace":
        return replace(self, b=self.b - margin)

    def segment_argmax(self, x: Tensor) -> Tensor:
        return _last_end(self(x), x)

    def on_segment(self, x: Tensor, s: Tensor) -> SegmentPoints:
        f, (first, last) = self(x), each_end(self.a, 1)
        back, on = (1 - s)[..., None] * first, s[..., None] * last
        return SegmentPoints(
            torch.lerp(f[..., :-1], f[..., 1:], s),
            back,
            on,
            back.square().sum(-1) + on.square().sum(-1),
        )


@dataclass(frozen=True)
class Quadric:
    """f(x) = x.P x + q.x - r.   P [dim, dim] symmetric, q [dim], r scalar; any signature of P"""

    P: Tensor
    q: Tensor
    r: Tensor

    trailing: ClassVar = {"P": 2, "q": 1, "r": 0}

    def __call__(self, x: Tensor) -> Tensor:
        return dot(times(x, self.P) + self.q, x) - self.r

    def gradient(self, x: Tensor) -> Tensor:
        return 2 * times(x, self.P) + self.q

    def step_bound(self, x: Tensor) -> Tensor:
        return self.gradient(x).square().sum(-1) + self.curvature * self(x).abs()

    @property
    def curvature(self) -> Tensor:
        """A bound of |d2f/dx2|."""
        return 2 * torch.linalg.matrix_norm(self.P)

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Quadric | QuadricInFrame":
        if max(centre.ndim, scale.ndim) > 1:
            return QuadricInFrame(self, centre, scale)
        q = scale * (2 * times(centre, self.P) + self.q)
        return Quadric(scale[:, None] * self.P * scale, q, -self(centre))

    def tighten(self, margin: float) -> "Quadric":
        return replace(self, r=self.r - margin)

    @property
    def convex(self) -> bool:
        return bool((torch.linalg.eigvalsh(self.P)[..., 0] >= 0).all())

    def segment_argmax(self, x: Tensor) -> Tensor:
        x0, d = x[..., :-1, :], x.diff(dim=-2)
        curvature, slope = (times(d, self.P) * d).sum(-1), (self.gradient(x0) * d).sum(-1)
        end = (slope + curvature > 0).to(x)  # the larger of both ends
        return torch.where(curvature < 0, (-slope / (2 * curvature)).clamp(0.0, 1.0), end)

    def on_segment(self, x: Tensor, s: Tensor) -> SegmentPoints:
        share = s[..., None]
        at = x[..., :-1, :] + share * x.diff(dim=-2)
        slope = self.gradient(at)
        return SegmentPoints(
            self(at),
            (1 - share) * slope,
            share * slope,
            ((1 - s) ** 2 + s**2) * self.step_bound(at),
        )

    def ball(self) -> "Ellipsoid | None":
        """The same set as the outside of an ellipsoid along the coordinates, where it is one."""
        own = self.P.diagonal() != 0
        if not bool(own.any()) or bool(
            (self.P.diagonal() > 0).any() | (self.P.diagonal().diag() != self.P).any()
        ):
            return None
        weight = -self.P.diagonal()[own]
        centre = self.q[..., own] / (2 * weight)
        size = (weight * centre.square()).sum(
            -1
        ) - self.r  # f = size - sum_i weight_i (x_i - centre_i)^2
        if bool((self.q[..., ~own] != 0).any()) or bool((size <= 0).any()):
            return None
        axes = (size[..., None] / weight).sqrt()
        return Ellipsoid(
            torch.eye(len(own), dtype=axes.dtype, device=axes.device)[own],
            centre,
            axes,
            axes.amin(-1),
            1,
        )


@dataclass(frozen=True)
class QuadricInFrame:
    """A quadric that each plan and waypoint sees from a frame of its own: f(x) = quadric(centre + scale * x).

    The frame is kept rather than multiplied out: a segment is straight in the quadric's coordinates, not in those of x.
    """

    quadric: Quadric
    centre: Tensor
    scale: Tensor

    trailing: ClassVar = {"centre": 1, "scale": 1}

    def seen(self, x: Tensor) -> Tensor:
        """x in the quadric's coordinates."""
        return self.centre + self.scale * x

    def __call__(self, x: Tensor) -> Tensor:
        return self.quadric(self.seen(x))

    def gradient(self, x: Tensor) -> Tensor:
        return self.scale * self.quadric.gradient(self.seen(x))

    def step_bound(self, x: Tensor) -> Tensor:
        bend = self.quadric.curvature * self.scale.square().amax(-1)
        return self.gradient(x).square().sum(-1) + bend * self(x).abs()

    def pull_back(self, centre: Tensor, scale: Tensor) -> "QuadricInFrame":
        return replace(self, centre=self.seen(centre), scale=self.scale * scale)

    def tighten(self, margin: float) -> "QuadricInFrame":
        return replace(self, quadric=self.quadric.tighten(margin))

    @property
    def convex(self) -> bool:
        return self.quadric.convex

    def segment_argmax(self, x: Tensor) -> Tensor:
        return self.quadric.segment_argmax(self.seen(x))

    def on_segment(self, x: Tensor, s: Tensor) -> SegmentPoints:
        there, (first, last) = self.quadric.on_segment(self.seen(x), s), each_end(self.scale, 1)
        back, on = there.back * first, there.on * last
        bend = self.quadric.curvature * torch.maximum(
            first.square().amax(-1), last.square().amax(-1)
        )
        return SegmentPoints(
            there.value,
            back,
            on,
            back.square().sum(-1) + on.square().sum(-1) + bend * there.value.abs(),
        )

    def ball(self) -> "Ellipsoid | None":
        ball = self.quadric.ball()
        return None if ball is None else ball.pull_back(self.centre, self.scale)

    def multiplied_out(self) -> Quadric:
        """The same function of a single state as a quadric that differs by plan and waypoint."""
        P = self.scale[..., :, None] * self.quadric.P * self.scale[..., None, :]
        return Quadric(
            P, self.scale * self.quadric.gradient(self.centre), -self.quadric(self.centre)
        )


@dataclass(frozen=True)
class Ellipsoid:
    """f(x) = side * (m - m |(x - centre) / axes|): side +1 keeps outside, -1 keeps inside.

    A ball has all axes equal to its radius m, and f is the signed distance in metres. For unequal semi-axes m is the
    smallest one: |f| never exceeds the distance outside, nor the depth inside.

    which   selects what it acts on                 [k, dim], unit rows that share no coordinate
    centre, axes                                    [k]
    m       value scale, environment units          scalar
    mixed   whether a row of `which` holds more than one coordinate
    """

    which: Tensor
    centre: Tensor
    axes: Tensor
    m: Tensor
    side: int
    mixed: bool = False

    trailing: ClassVar = {"which": 2, "centre": 1, "axes": 1, "m": 0}

    def __call__(self, x: Tensor) -> Tensor:
        return self.side * self.m * (1 - self.scaled(x).norm(dim=-1))

    def scaled(self, x: Tensor) -> Tensor:
        """Coordinates in which the surface is the unit sphere [..., k], and a segment straight."""
        return (times(x, self.which.mT) - self.centre) / self.axes

    def gradient(self, x: Tensor) -> Tensor:
        return times(self._slope(self.scaled(x), self.m) / self.axes, self.which)

    def _slope(self, y: Tensor, m: Tensor) -> Tensor:
        """df/dy [..., k]."""
        return -self.side * m[..., None] * (y / y.norm(dim=-1, keepdim=True).clamp_min(1e-12))

    def step_bound(self, x: Tensor) -> Tensor:
        return self.gradient(x).square().sum(-1)

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Ellipsoid":
        if self.mixed:
            which = self.which * scale[..., None, :]
            s, inner = which.norm(dim=-1), times(centre, self.which.mT)
            return replace(
                self,
                which=which / s[..., None],
                centre=(self.centre - inner) / s,
                axes=self.axes / s,
            )
        s = scale @ self.which.T
        return replace(self, centre=(self.centre - centre @ self.which.T) / s, axes=self.axes / s)

    def compose(self, led: Tensor) -> "Ellipsoid":
        """f(led x)   led [dim, dim], which leaves the rows of `which` without a coordinate in common"""
        which = self.which @ led
        s = which.norm(dim=-1)
        return replace(
            self, which=which / s[:, None], centre=self.centre / s, axes=self.axes / s, mixed=True
        )

    def tighten(self, margin: float) -> "Ellipsoid":
        grown = 1 + self.side * margin / self.m
        if self.side < 0 and bool((grown <= 0).any()):
            size = float(self.m.min())
            raise InfeasibleError(
                f"no point lies {margin:g} inside an ellipsoid of semi-axis {size:g}; relax one of them"
            )
        return replace(self, axes=self.axes * grown[..., None], m=self.m * grown)

    @property
    def convex(self) -> bool:
        return self.side < 0

    def segment_argmax(self, x: Tensor) -> Tensor:
        if self.side < 0:
            return _last_end(self(x), x)
        y = self.scaled(x)
        d = y.diff(dim=-2)
        return (-(y[..., :-1, :] * d).sum(-1) / d.square().sum(-1).clamp_min(1e-30)).clamp(0.0, 1.0)

    def on_segment(self, x: Tensor, s: Tensor) -> SegmentPoints:
        y, m = self.scaled(x), each_end(self.m, 0)[0]
        share, (first, last), (to, there) = (
            s[..., None],
            each_end(self.axes, 1),
            each_end(self.which, 2),
        )
        at = torch.lerp(y[..., :-1, :], y[..., 1:, :], share)
        slope = self._slope(at, m)
        back, on = (1 - share) * slope / first, share * slope / last
        value = self.side * m * (1 - at.norm(dim=-1))
        return SegmentPoints(
            value, times(back, to), times(on, there), back.square().sum(-1) + on.square().sum(-1)
        )

    @cached_property
    def is_ball(self) -> bool:
        return bool(torch.allclose(self.axes, self.axes[..., :1], rtol=1e-6))

    def quadric(self) -> Quadric:
        """The same set as a Quadric: side * (1 - |(x - centre) / axes|^2) <= 0."""
        weight = self.which.mT / self.axes[..., None, :] ** 2
        q = -2 * times(self.centre, weight.mT)
        r = self.side * ((self.centre / self.axes).square().sum(-1) - 1)
        return Quadric(-self.side * weight @ self.which, -self.side * q, r)


def is_affine(level: StateSet) -> bool:
    """Whether f is affine, and the same function for every plan and waypoint."""
    return isinstance(level, HalfSpace) and level.a.ndim == 1


def segment_max(level: StateSet, x: Tensor) -> Tensor:
    """The largest f on the segments of trajectories [..., horizon, dim], exactly [..., horizon - 1]."""
    f = level(x)
    at_ends = torch.maximum(f[..., :-1], f[..., 1:])  # so that rounding never hides an unsafe end
    return torch.maximum(at_ends, level.on_segment(x, level.segment_argmax(x)).value)


def converted(level: L, like: Tensor) -> L:
    """The level with its numbers in the dtype and on the device of `like`."""
    return _mapped(level, lambda _, value: value.to(like))


def selected(level: L, which: Tensor) -> L:
    """The level of some plans of the batch alone."""

    def some(trailing: int, value: Tensor) -> Tensor:
        return value[which] if value.ndim == trailing + 2 and len(value) > 1 else value

    return _mapped(level, some)


def _mapped(level: L, change: Any) -> L:
    """The level with each tensor changed; change(number of its own dimensions, tensor)."""
    trailing = getattr(level, "trailing", {})
    new: dict[str, Any] = {}
    for f in fields(level):  # type: ignore[arg-type]
        value = getattr(level, f.name)
        if isinstance(value, Tensor):
            new[f.name] = change(trailing.get(f.name, value.ndim), value)
        elif isinstance(value, Quadric):
            new[f.name] = _mapped(value, change)
    return replace(level, **new)  # type: ignore[type-var]


def _last_end(f: Tensor, like: Tensor) -> Tensor:
    """1 where a segment's last waypoint has the larger f, else 0."""
    return (f[..., 1:] > f[..., :-1]).to(like)
