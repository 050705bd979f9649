"""Levels: scalar functions f of one state, allowed where f <= 0, with their gradients written out and the place on a straight
segment where they are largest.
"""

from dataclasses import dataclass, fields, replace
from typing import Protocol

import torch
from torch import Tensor

from cdiff_cli.errors import InfeasibleError


class Level(Protocol):
    """A scalar function f of a state [..., dim], allowed where f <= 0, in environment units even after pull_back."""

    def __call__(self, x: Tensor) -> Tensor: ...
    def gradient(self, x: Tensor) -> Tensor:
        """df/dx [..., dim]."""
        ...

    def size(self, x: Tensor) -> Tensor:
        """|df/dx|^2 [...], plus |f| times the largest curvature, so that f / size is a safe step where the gradient fades."""
        ...

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Level":
        """f(centre + scale * z) as a function of z."""
        ...

    def shift(self, margin: float) -> "Level":
        """A level allowed exactly where f <= -margin."""
        ...

    def worst(self, x0: Tensor, x1: Tensor) -> Tensor:
        """Where f is largest on the straight segments from x0 to x1, exactly: s of x0 + s (x1 - x0) in [0, 1]."""
        ...

    @property
    def convex(self) -> bool:
        """Whether the allowed set is convex, so that a segment is safe when its ends are."""
        ...


@dataclass(frozen=True)
class Affine:
    """f(x) = a.x - b.   a [dim], b scalar, in the units of a.x"""

    a: Tensor
    b: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        return x @ self.a - self.b

    def gradient(self, x: Tensor) -> Tensor:
        return self.a.expand_as(x)

    def size(self, x: Tensor) -> Tensor:
        return (self.a @ self.a).expand(x.shape[:-1])

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Affine":
        return Affine(self.a * scale, self.b - self.a @ centre)

    def shift(self, margin: float) -> "Affine":
        return replace(self, b=self.b - margin)

    convex = True

    def worst(self, x0: Tensor, x1: Tensor) -> Tensor:
        return (self(x1) > self(x0)).to(x0)


@dataclass(frozen=True)
class Quadric:
    """f(x) = x.P x + q.x - r.   P [dim, dim] symmetric, q [dim], r scalar; any signature of P"""

    P: Tensor
    q: Tensor
    r: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        return ((x @ self.P) * x).sum(-1) + x @ self.q - self.r

    def gradient(self, x: Tensor) -> Tensor:
        return 2 * x @ self.P + self.q

    def size(self, x: Tensor) -> Tensor:
        return self.gradient(x).square().sum(-1) + 2 * torch.linalg.matrix_norm(self.P) * self(x).abs()

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Quadric":
        P = scale[:, None] * self.P * scale
        return Quadric(P, scale * (2 * self.P @ centre + self.q), -self(centre))

    def shift(self, margin: float) -> "Quadric":
        return replace(self, r=self.r - margin)

    @property
    def convex(self) -> bool:
        return bool(torch.linalg.eigvalsh(self.P)[0] >= 0)

    def worst(self, x0: Tensor, x1: Tensor) -> Tensor:
        d = x1 - x0
        curvature, slope = ((d @ self.P) * d).sum(-1), (self.gradient(x0) * d).sum(-1)
        end = (slope + curvature > 0).to(x0)  # the larger of both ends
        return torch.where(curvature < 0, (-slope / (2 * curvature)).clamp(0.0, 1.0), end)

    def ball(self) -> "Ellipsoid | None":
        """The same set as the outside of an ellipsoid along the coordinates, where it is one."""
        own = self.P.diagonal() != 0
        if not bool(own.any()) or bool((self.P.diagonal() > 0).any() | (self.P.diagonal().diag() != self.P).any()):
            return None
        weight = -self.P.diagonal()[own]
        centre = self.q[own] / (2 * weight)
        size = (weight * centre.square()).sum() - self.r  # f = size - sum_i weight_i (x_i - centre_i)^2
        if bool((self.q[~own] != 0).any()) or bool(size <= 0):
            return None
        axes = (size / weight).sqrt()
        return Ellipsoid(torch.eye(len(own)).to(axes)[own], centre, axes, axes.min(), 1)


@dataclass(frozen=True)
class Ellipsoid:
    """f(x) = side * (m - m |(x - centre) / axes|): side +1 keeps outside, -1 keeps inside.

    A ball has all axes equal to its radius m, and f is the signed distance in metres. For unequal semi-axes m is the
    smallest one: |f| never exceeds the distance outside, nor the depth inside.

    which   selects the coordinates it acts on      [k, dim], rows of the identity
    centre, axes                                    [k]
    m       value scale, environment units          scalar
    """

    which: Tensor
    centre: Tensor
    axes: Tensor
    m: Tensor
    side: int

    def __call__(self, x: Tensor) -> Tensor:
        return self.side * self.m * (1 - self.scaled(x).norm(dim=-1))

    def scaled(self, x: Tensor) -> Tensor:
        """Coordinates in which the surface is the unit sphere [..., k]."""
        return (x @ self.which.T - self.centre) / self.axes

    def gradient(self, x: Tensor) -> Tensor:
        y = self.scaled(x)
        unit = y / y.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        return (-self.side * self.m * unit / self.axes) @ self.which

    def size(self, x: Tensor) -> Tensor:
        return self.gradient(x).square().sum(-1)

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Ellipsoid":
        s = self.which @ scale
        return replace(self, centre=(self.centre - self.which @ centre) / s, axes=self.axes / s)

    def shift(self, margin: float) -> "Ellipsoid":
        grown = 1 + self.side * margin / float(self.m)
        if grown <= 0 and self.side < 0:
            raise InfeasibleError(f"no point lies {margin:g} inside an ellipsoid of semi-axis {float(self.m):g}; relax one of them")
        return replace(self, axes=self.axes * grown, m=self.m * grown)

    @property
    def convex(self) -> bool:
        return self.side < 0

    def worst(self, x0: Tensor, x1: Tensor) -> Tensor:
        if self.side < 0:
            return (self(x1) > self(x0)).to(x0)
        y, d = self.scaled(x0), (x1 - x0) @ self.which.T / self.axes
        return (-(y * d).sum(-1) / (d * d).sum(-1).clamp_min(1e-30)).clamp(0.0, 1.0)

    @property
    def is_ball(self) -> bool:
        return bool(torch.allclose(self.axes, self.axes[0], rtol=1e-6))

    def quadric(self) -> Quadric:
        """The same set as a Quadric: side * (1 - |(x - centre) / axes|^2) <= 0."""
        weight = self.which.T / self.axes**2
        P = weight @ self.which
        q = -2 * weight @ self.centre
        return Quadric(-self.side * P, -self.side * q, self.side * ((self.centre / self.axes).square().sum() - 1))


def segment_max(level: Level, x0: Tensor, x1: Tensor) -> Tensor:
    """The largest f on the straight segments from x0 to x1, exactly."""
    s = level.worst(x0, x1)[..., None]
    at_ends = torch.maximum(level(x0), level(x1))  # so that rounding never hides an unsafe end
    return torch.maximum(at_ends, level(x0 + s * (x1 - x0)))


def moved(level: Level, like: Tensor) -> Level:
    """The level with its numbers in the dtype and on the device of `like`."""
    tensors = {f.name: value for f in fields(level) if isinstance(value := getattr(level, f.name), Tensor)}  # type: ignore[arg-type]
    return replace(level, **{name: value.to(like) for name, value in tensors.items()})  # type: ignore[type-var]
