"""Constraints g(x) <= 0 on trajectories, row by row, and the pins that hold coordinates fixed.

A constraint is a tuple of parts. A part applies a level (a scalar function f of one state, allowed where f <= 0) to the
trajectory: at every waypoint, or as a discrete control barrier function along it. Knowing level and part, projection.py picks
an exact form; gradients are written out, so that a method pays for a few vector operations and no autograd graph.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Protocol, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cdiff_cli.errors import InfeasibleError

Traj = Float[Tensor, "batch horizon dim"]
Rows = Float[Tensor, "batch n"]
Pull = Callable[[Rows], Traj]


@dataclass(frozen=True)
class Pins:
    """Coordinates whose values are given: the start, the goal.

    mask     True where fixed             [horizon, dim]
    values   what they are fixed to       [batch, horizon, dim]
    """

    mask: Bool[Tensor, "horizon dim"]
    values: Traj

    @classmethod
    def none(cls, like: Traj) -> "Pins":
        return cls(torch.zeros(like.shape[1:], dtype=torch.bool, device=like.device), like)

    def paint(self, x: Traj) -> Traj:
        """x with the pinned coordinates set."""
        return torch.where(self.mask, self.values.to(x), x)

    def free(self, direction: Traj) -> Traj:
        """A direction that leaves the pinned coordinates alone."""
        return torch.where(self.mask, 0.0, direction)


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

    def segment_max(self, x0: Tensor, x1: Tensor) -> Tensor:
        """The largest f on the straight segments from x0 to x1, exactly."""
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

    def segment_max(self, x0: Tensor, x1: Tensor) -> Tensor:
        return torch.maximum(self(x0), self(x1))


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

    def segment_max(self, x0: Tensor, x1: Tensor) -> Tensor:
        d = x1 - x0
        curvature, slope = ((d @ self.P) * d).sum(-1), (self.gradient(x0) * d).sum(-1)
        s = torch.where(curvature < 0, -slope / (2 * curvature), 0.0).clamp(0.0, 1.0)
        inside = self(x0) + s * slope + s * s * curvature
        return torch.maximum(inside, torch.maximum(self(x0), self(x1)))


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
        return self.side * self.m * (1 - self._scaled(x).norm(dim=-1))

    def _scaled(self, x: Tensor) -> Tensor:
        return (x @ self.which.T - self.centre) / self.axes

    def gradient(self, x: Tensor) -> Tensor:
        y = self._scaled(x)
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

    def segment_max(self, x0: Tensor, x1: Tensor) -> Tensor:
        if self.side < 0:
            return torch.maximum(self(x0), self(x1))
        y, d = self._scaled(x0), (x1 - x0) @ self.which.T / self.axes
        s = (-(y * d).sum(-1) / (d * d).sum(-1).clamp_min(1e-30)).clamp(0.0, 1.0)
        return self.m * (1 - (y + s[..., None] * d).norm(dim=-1))

    @property
    def is_ball(self) -> bool:
        return bool(torch.allclose(self.axes, self.axes[0], rtol=1e-6))

    def quadric(self) -> Quadric:
        """The same set as a Quadric: side * (1 - |(x - centre) / axes|^2) <= 0."""
        weight = self.which.T / self.axes**2
        P = weight @ self.which
        q = -2 * weight @ self.centre
        return Quadric(-self.side * P, -self.side * q, self.side * ((self.centre / self.axes).square().sum() - 1))


class Part(Protocol):
    """Some rows of a constraint."""

    @property
    def name(self) -> str: ...
    def labels(self, horizon: int) -> list[str]: ...
    def __call__(self, x: Traj) -> Rows: ...
    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        """g(x); w -> w^T dg/dx; and per row a bound of |dg/dx|^2 that counts the rows it shares coordinates with."""
        ...

    def map(self, change: Callable[[Level], Level]) -> Self: ...
    def shift(self, margin: float) -> Self: ...
    def segment_max(self, x: Traj) -> Rows:
        """The largest unsafe value on the segments between waypoints [batch, horizon - 1]."""
        ...


@dataclass(frozen=True)
class Waypoints:
    """f(x^tau) <= 0 at every waypoint: one row a waypoint."""

    name: str
    level: Level

    def labels(self, horizon: int) -> list[str]:
        return [f"{self.name}@{tau}" for tau in range(horizon)]

    def __call__(self, x: Traj) -> Rows:
        return self.level(x)

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        slope = self.level.gradient(x)
        return self.level(x), lambda w: w[..., None] * slope, self.level.size(x)

    def map(self, change: Callable[[Level], Level]) -> "Waypoints":
        return replace(self, level=change(self.level))

    def shift(self, margin: float) -> "Waypoints":
        return replace(self, level=self.level.shift(margin))

    def segment_max(self, x: Traj) -> Rows:
        if x.shape[1] < 2:
            return self(x)
        return self.level.segment_max(x[:, :-1], x[:, 1:])


@dataclass(frozen=True)
class Chain:
    """Discrete control barrier function h = -f:  (1 - alpha) h(x^tau) - h(x^{tau+1}) <= 0 (paper, section 5.1)."""

    name: str
    level: Level
    alpha: float

    def labels(self, horizon: int) -> list[str]:
        return [f"{self.name}@{tau}-{tau + 1}" for tau in range(horizon - 1)]

    def __call__(self, x: Traj) -> Rows:
        h = -self.level(x)
        return (1 - self.alpha) * h[:, :-1] - h[:, 1:]

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        slope, keep = self.level.gradient(x), 1 - self.alpha

        def pull(w: Rows) -> Traj:
            out = torch.zeros_like(x)
            out[:, :-1] -= keep * w[..., None] * slope[:, :-1]
            out[:, 1:] += w[..., None] * slope[:, 1:]
            return out

        size = self.level.size(x)
        return self(x), pull, (1 + keep) ** 2 * torch.maximum(size[:, :-1], size[:, 1:])

    def map(self, change: Callable[[Level], Level]) -> "Chain":
        return replace(self, level=change(self.level))

    def shift(self, margin: float) -> "Chain":
        """g <= -margin is the same chain over h - margin / alpha."""
        return replace(self, level=self.level.shift(margin / self.alpha))

    def segment_max(self, x: Traj) -> Rows:
        """-h between waypoints: the barrier itself, which is what the chain keeps non-negative."""
        if x.shape[1] < 2:
            return self.level(x)
        return self.level.segment_max(x[:, :-1], x[:, 1:])


@dataclass(frozen=True)
class Opaque:
    """Rows of which only the function is known: differentiated by autograd, projected by sequential linearisation.

    fn      trajectory in environment units -> rows, differentiable
    count   number of rows at a horizon
    """

    name: str
    fn: Callable[[Traj], Rows]
    count: Callable[[int], int]
    margin: float = 0.0

    def labels(self, horizon: int) -> list[str]:
        return [f"{self.name}@{i}" for i in range(self.count(horizon))]

    def __call__(self, x: Traj) -> Rows:
        return self.fn(x) + self.margin

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        with torch.enable_grad():
            leaf = x.detach().clone().requires_grad_()
            rows = self(leaf)

            def pull(w: Rows) -> Traj:
                return torch.autograd.grad(rows, leaf, w, retain_graph=True)[0]

        size = pull(torch.ones_like(rows)).square().sum((1, 2))
        return rows.detach(), pull, size[:, None].expand_as(rows)

    def map(self, change: Callable[[Level], Level]) -> "Opaque":
        return self

    def shift(self, margin: float) -> "Opaque":
        return replace(self, margin=self.margin + margin)

    def segment_max(self, x: Traj) -> Rows:
        return self(x)


@dataclass(frozen=True)
class Constraint:
    """g(x) <= 0, row by row: a tuple of parts, each in environment units or all pulled back."""

    parts: tuple[Part, ...]

    def __call__(self, x: Traj) -> Rows:
        rows = [part(x) for part in self.parts]
        return torch.cat(rows, 1) if rows else x.new_zeros(len(x), 0)

    def labels(self, horizon: int) -> list[str]:
        return [label for part in self.parts for label in part.labels(horizon)]

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        """g(x) [batch, n]; the pull w -> w^T dg/dx without a Jacobian; and row by row a bound of the largest eigenvalue
        that the row can give to J J^T, for step sizes.
        """
        each = [part.linearise(x) for part in self.parts]
        if not each:
            empty = x.new_zeros(len(x), 0)
            return empty, lambda _: torch.zeros_like(x), empty
        sizes = [len(rows[0]) for rows, _, _ in each] if len(x) else [rows.shape[1] for rows, _, _ in each]

        def pull(w: Rows) -> Traj:
            total, at = torch.zeros_like(x), 0
            for (_, part_pull, _), size in zip(each, sizes, strict=True):
                total = total + part_pull(w[:, at : at + size])
                at += size
            return total

        return torch.cat([e[0] for e in each], 1), pull, len(each) * torch.cat([e[2] for e in each], 1)

    def tighten(self, margin: float) -> "Constraint":
        """The constraint g <= -margin (margin in the units of g)."""
        return Constraint(tuple(part.shift(margin) for part in self.parts))

    def to(self, like: Tensor) -> "Constraint":
        """The same constraint with its numbers in the dtype and on the device of `like`."""

        def move(level: Level) -> Level:
            tensors = {f.name: getattr(level, f.name) for f in fields(level)}  # type: ignore[arg-type]
            moved = {name: value.to(like) for name, value in tensors.items() if isinstance(value, Tensor)}
            return replace(level, **moved)  # type: ignore[type-var]

        return Constraint(tuple(part.map(move) for part in self.parts))


def stack(constraints: Sequence[Constraint]) -> Constraint:
    """All of them at once."""
    return Constraint(tuple(part for constraint in constraints for part in constraint.parts))


def pull_back(g: Constraint, centre: Tensor, scale: Tensor) -> Constraint:
    """The same set in normalised coordinates z, x = centre + scale * z; the rows keep their values and units."""

    def change(part: Part) -> Part:
        if isinstance(part, Opaque):
            fn = part.fn
            return replace(part, fn=lambda z: fn(centre.to(z) + scale.to(z) * z))
        return part.map(lambda level: level.pull_back(centre, scale))

    return Constraint(tuple(change(part) for part in g.parts))
