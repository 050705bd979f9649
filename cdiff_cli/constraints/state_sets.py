"""Sets of states: half-spaces, quadrics, balls and ellipsoids.

Each is {x : f(x) <= 0} with the gradient of f written out, and with the point of a straight segment
at which f is largest (protocol.py).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal

import torch
from torch import Tensor

from cdiff_cli.arrays import dot, each_end, times
from cdiff_cli.constraints.protocol import SegmentPoints, StateSet, nonzero_columns, worse_end
from cdiff_cli.errors import InfeasibleError


@dataclass(frozen=True)
class HalfSpace:
    """f(x) = a.x - b, with a [dim] and b a scalar in the units of a.x."""

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

    def compose(self, matrix: Tensor) -> "HalfSpace":
        """The function x -> f(matrix x), with matrix [dim, dim]."""
        return replace(self, a=self.a @ matrix)

    def tighten(self, margin: float) -> "HalfSpace":
        return replace(self, b=self.b - margin)

    def segment_argmax(self, x: Tensor) -> Tensor:
        return worse_end(self(x), x)

    def coordinates(self) -> list[int]:
        return nonzero_columns(self.a)

    def restrict(self, columns: Sequence[int]) -> "HalfSpace":
        return replace(self, a=self.a[..., columns])

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
    """f(x) = x.P x + q.x - r, with P [dim, dim] symmetric of any signature, q [dim], r a scalar."""

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
        """An upper bound of |d2f/dx2|."""
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

    def coordinates(self) -> list[int]:
        return list(range(self.q.shape[-1]))

    def restrict(self, columns: Sequence[int]) -> "Quadric":
        return replace(self, P=self.P[..., columns, :][..., columns], q=self.q[..., columns])

    def ball(self) -> "Ellipsoid | None":
        """The same set as the outside of an axis-aligned ellipsoid; None if it is not one."""
        diagonal = self.P.diagonal()
        curved = diagonal != 0
        aligned = bool(curved.any()) and bool((diagonal.diag() == self.P).all())
        if not aligned or bool((diagonal > 0).any()):
            return None
        weight = -diagonal[curved]
        centre = self.q[..., curved] / (2 * weight)
        # f = size - sum_i weight_i (x_i - centre_i)^2
        size = (weight * centre.square()).sum(-1) - self.r
        if bool((self.q[..., ~curved] != 0).any()) or bool((size <= 0).any()):
            return None
        axes = (size[..., None] / weight).sqrt()
        which = torch.eye(len(curved), dtype=axes.dtype, device=axes.device)[curved]
        return Ellipsoid(which, centre, axes, axes.amin(-1), "outside")


@dataclass(frozen=True)
class QuadricInFrame:
    """f(x) = quadric(centre + scale * x), with a frame that differs by plan and waypoint.

    The frame is kept rather than multiplied out, because a segment is straight in the coordinates
    of the quadric, not in those of x.
    """

    quadric: Quadric
    centre: Tensor
    scale: Tensor

    trailing: ClassVar = {"centre": 1, "scale": 1}

    def decode(self, x: Tensor) -> Tensor:
        """x in the quadric's coordinates."""
        return self.centre + self.scale * x

    def __call__(self, x: Tensor) -> Tensor:
        return self.quadric(self.decode(x))

    def gradient(self, x: Tensor) -> Tensor:
        return self.scale * self.quadric.gradient(self.decode(x))

    def step_bound(self, x: Tensor) -> Tensor:
        bend = self.quadric.curvature * self.scale.square().amax(-1)
        return self.gradient(x).square().sum(-1) + bend * self(x).abs()

    def pull_back(self, centre: Tensor, scale: Tensor) -> "QuadricInFrame":
        return replace(self, centre=self.decode(centre), scale=self.scale * scale)

    def tighten(self, margin: float) -> "QuadricInFrame":
        return replace(self, quadric=self.quadric.tighten(margin))

    @property
    def convex(self) -> bool:
        return self.quadric.convex

    def segment_argmax(self, x: Tensor) -> Tensor:
        return self.quadric.segment_argmax(self.decode(x))

    def on_segment(self, x: Tensor, s: Tensor) -> SegmentPoints:
        at, (first, last) = self.quadric.on_segment(self.decode(x), s), each_end(self.scale, 1)
        back, on = at.back * first, at.on * last
        bend = self.quadric.curvature * torch.maximum(
            first.square().amax(-1), last.square().amax(-1)
        )
        return SegmentPoints(
            at.value,
            back,
            on,
            back.square().sum(-1) + on.square().sum(-1) + bend * at.value.abs(),
        )

    def coordinates(self) -> list[int]:
        return self.quadric.coordinates()

    def restrict(self, columns: Sequence[int]) -> "QuadricInFrame":
        return QuadricInFrame(
            self.quadric.restrict(columns), self.centre[..., columns], self.scale[..., columns]
        )

    def ball(self) -> "Ellipsoid | None":
        ball = self.quadric.ball()
        return None if ball is None else ball.pull_back(self.centre, self.scale)

    def multiplied_out(self) -> Quadric:
        """The same function of one state as a Quadric that differs by plan and waypoint."""
        P = self.scale[..., :, None] * self.quadric.P * self.scale[..., None, :]
        return Quadric(
            P, self.scale * self.quadric.gradient(self.centre), -self.quadric(self.centre)
        )


@dataclass(frozen=True)
class Ellipsoid:
    """f(x) = sign * (m - m |(which x - centre) / axes|), with sign +1 outside and -1 inside.

    A ball has all axes equal to its radius m, and f is the signed distance to its surface. For
    unequal semi-axes m is the smallest one: |f| is then at most the distance to the surface.

    which    selects the coordinates that f acts on   [k, dim], unit rows that share no coordinate
    centre   environment units                        [k]
    axes     semi-axes, environment units             [k]
    m        scale of the values, environment units   scalar
    side     the side of the surface that is allowed
    mixed    whether a row of `which` has more than one nonzero coordinate
    """

    which: Tensor
    centre: Tensor
    axes: Tensor
    m: Tensor
    side: Literal["inside", "outside"]
    mixed: bool = False

    trailing: ClassVar = {"which": 2, "centre": 1, "axes": 1, "m": 0}

    @property
    def sign(self) -> int:
        """+1 where the outside is allowed, -1 where the inside is allowed."""
        return 1 if self.side == "outside" else -1

    def __call__(self, x: Tensor) -> Tensor:
        return self.sign * self.m * (1 - self.scaled(x).norm(dim=-1))

    def scaled(self, x: Tensor) -> Tensor:
        """Coordinates in which the surface is the unit sphere, segments straight [..., k]."""
        return (times(x, self.which.mT) - self.centre) / self.axes

    def gradient(self, x: Tensor) -> Tensor:
        return times(self._slope(self.scaled(x), self.m) / self.axes, self.which)

    def _slope(self, y: Tensor, m: Tensor) -> Tensor:
        """df/dy [..., k]."""
        return -self.sign * m[..., None] * (y / y.norm(dim=-1, keepdim=True).clamp_min(1e-12))

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

    def compose(self, matrix: Tensor) -> "Ellipsoid":
        """The function x -> f(matrix x).

        matrix   [dim, dim]; the rows of `which matrix` must share no coordinate
        """
        which = self.which @ matrix
        s = which.norm(dim=-1)
        return replace(
            self, which=which / s[:, None], centre=self.centre / s, axes=self.axes / s, mixed=True
        )

    def tighten(self, margin: float) -> "Ellipsoid":
        grown = 1 + self.sign * margin / self.m
        if self.convex and bool((grown <= 0).any()):
            size = float(self.m.min())
            raise InfeasibleError(
                f"no point lies {margin:g} inside an ellipsoid of semi-axis {size:g}; relax one of"
                " them"
            )
        return replace(self, axes=self.axes * grown[..., None], m=self.m * grown)

    @property
    def convex(self) -> bool:
        return self.side == "inside"

    def segment_argmax(self, x: Tensor) -> Tensor:
        if self.convex:
            return worse_end(self(x), x)
        y = self.scaled(x)
        d = y.diff(dim=-2)
        return (-(y[..., :-1, :] * d).sum(-1) / d.square().sum(-1).clamp_min(1e-30)).clamp(0.0, 1.0)

    def on_segment(self, x: Tensor, s: Tensor) -> SegmentPoints:
        y, m = self.scaled(x), each_end(self.m, 0)[0]
        share = s[..., None]
        first_axes, last_axes = each_end(self.axes, 1)
        first_which, last_which = each_end(self.which, 2)
        at = torch.lerp(y[..., :-1, :], y[..., 1:, :], share)
        slope = self._slope(at, m)
        back, on = (1 - share) * slope / first_axes, share * slope / last_axes
        value = self.sign * m * (1 - at.norm(dim=-1))
        return SegmentPoints(
            value,
            times(back, first_which),
            times(on, last_which),
            back.square().sum(-1) + on.square().sum(-1),
        )

    def coordinates(self) -> list[int]:
        return nonzero_columns(self.which)

    def restrict(self, columns: Sequence[int]) -> "Ellipsoid":
        return replace(self, which=self.which[..., columns])

    @cached_property
    def is_ball(self) -> bool:
        """Whether all semi-axes are equal, up to rounding."""
        return bool(torch.allclose(self.axes, self.axes[..., :1], rtol=1e-6))

    def quadric(self) -> Quadric:
        """The same set as a Quadric: sign * (1 - |(which x - centre) / axes|^2) <= 0."""
        weight = self.which.mT / self.axes[..., None, :] ** 2
        q = -2 * times(self.centre, weight.mT)
        r = self.sign * ((self.centre / self.axes).square().sum(-1) - 1)
        return Quadric(-self.sign * weight @ self.which, -self.sign * q, r)


def is_affine(level: StateSet) -> bool:
    """Whether f is affine and the same function for every plan and waypoint."""
    return isinstance(level, HalfSpace) and level.a.ndim == 1


def as_ellipsoid(level: StateSet) -> StateSet:
    """The set itself, or for a quadric that is the outside of an ellipsoid, that Ellipsoid.

    An Ellipsoid has an exact projection on segments; a Quadric has none.
    """
    ball = level.ball() if isinstance(level, Quadric | QuadricInFrame) else None
    return ball or level
