"""Constraints g(x) <= 0 on trajectories, row by row, and the pins that hold coordinates fixed.

A constraint is a tuple of parts. A part applies a level (a scalar function f of one state, allowed where f <= 0) to the
trajectory: at every waypoint, or as a discrete control barrier function along it. Knowing level and part, projection.py picks
an exact form; gradients are written out, so that a method pays for a few vector operations and no autograd graph.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cdiff_cli.levels import Framed, Level, Quadric, moved, segment_max, take

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


class Part(Protocol):
    """Some rows of a constraint."""

    @property
    def name(self) -> str: ...
    @property
    def spans(self) -> bool:
        """Whether it asks anything of the segments between waypoints; one that does not is as safe there as at them."""
        ...

    def labels(self, horizon: int) -> list[str]: ...
    def __call__(self, x: Traj) -> Rows: ...
    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        """g(x); w -> w^T dg/dx; and per row a bound of |dg/dx|^2 that counts the rows it shares coordinates with."""
        ...

    def pull_back(self, centre: Tensor, scale: Tensor) -> Self:
        """The same part of z, x = centre + scale * z; the rows keep their values and units."""
        ...

    def take(self, which: Tensor) -> Self:
        """The same part of some plans of the batch alone."""
        ...

    def to(self, like: Tensor) -> Self:
        """The same part with its numbers in the dtype and on the device of `like`."""
        ...

    def shift(self, margin: float) -> Self: ...
    def segment_max(self, x: Traj) -> Rows:
        """The largest unsafe value on the segments between waypoints [batch, horizon - 1]."""
        ...

    def on_segments(self) -> "tuple[Part, ...]":
        """The parts that hold all along the segments, as far as the part's form allows; itself where they need no more."""
        ...


@dataclass(frozen=True)
class Waypoints:
    """f(x^tau) <= 0 at every waypoint: one row a waypoint."""

    name: str
    level: Level

    spans = True

    def labels(self, horizon: int) -> list[str]:
        return [f"{self.name}@{tau}" for tau in range(horizon)]

    def __call__(self, x: Traj) -> Rows:
        return self.level(x)

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        slope = self.level.gradient(x)
        return self.level(x), lambda w: w[..., None] * slope, self.level.size(x)

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Waypoints":
        return replace(self, level=self.level.pull_back(centre, scale))

    def take(self, which: Tensor) -> "Waypoints":
        return replace(self, level=take(self.level, which))

    def to(self, like: Tensor) -> "Waypoints":
        return replace(self, level=moved(self.level, like))

    def shift(self, margin: float) -> "Waypoints":
        return replace(self, level=self.level.shift(margin))

    def segment_max(self, x: Traj) -> Rows:
        if x.shape[1] < 2:
            return self(x)
        return segment_max(self.level, x)

    def on_segments(self) -> "tuple[Part, ...]":
        return (self if self.level.convex else _segments(self.name, self.level),)


@dataclass(frozen=True)
class Segments:
    """f <= 0 all along the straight segments between waypoints: one row a segment, its largest f."""

    name: str
    level: Level

    spans = True

    def labels(self, horizon: int) -> list[str]:
        return [f"{self.name}@{tau}~{tau + 1}" for tau in range(horizon - 1)]

    def __call__(self, x: Traj) -> Rows:
        return self.segment_max(x)[:, : x.shape[1] - 1]

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        at = self.level.between(x, self.level.worst(x))

        def pull(w: Rows) -> Traj:
            out = torch.zeros_like(x)
            out[:, :-1] += w[..., None] * at.back
            out[:, 1:] += w[..., None] * at.on
            return out

        return at.value, pull, 2 * at.size

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Segments":
        return replace(self, level=self.level.pull_back(centre, scale))

    def take(self, which: Tensor) -> "Segments":
        return replace(self, level=take(self.level, which))

    def to(self, like: Tensor) -> "Segments":
        return replace(self, level=moved(self.level, like))

    def shift(self, margin: float) -> "Segments":
        return replace(self, level=self.level.shift(margin))

    def segment_max(self, x: Traj) -> Rows:
        return Waypoints(self.name, self.level).segment_max(x)

    def on_segments(self) -> "tuple[Part, ...]":
        return (self,)


def _segments(name: str, level: Level) -> Segments:
    """The level on the segments; a quadric that is the outside of a ball or ellipsoid as such, which has an exact form there."""
    ball = level.ball() if isinstance(level, Quadric | Framed) else None
    return Segments(name, ball or level)


@dataclass(frozen=True)
class Chain:
    """Discrete control barrier function h = -f:  (1 - alpha) h(x^tau) - h(x^{tau+1}) <= 0 (paper, section 5.1)."""

    name: str
    level: Level
    alpha: float

    spans = True

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

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Chain":
        return replace(self, level=self.level.pull_back(centre, scale))

    def take(self, which: Tensor) -> "Chain":
        return replace(self, level=take(self.level, which))

    def to(self, like: Tensor) -> "Chain":
        return replace(self, level=moved(self.level, like))

    def shift(self, margin: float) -> "Chain":
        """g <= -margin is the same chain over h - margin / alpha."""
        return replace(self, level=self.level.shift(margin / self.alpha))

    def segment_max(self, x: Traj) -> Rows:
        """-h between waypoints: the barrier itself, which is what the chain keeps non-negative."""
        return Waypoints(self.name, self.level).segment_max(x)

    def on_segments(self) -> "tuple[Part, ...]":
        """The chain, and its barrier on the segments where the waypoints' safety does not give it."""
        return (self,) if self.level.convex else (self, _segments(self.name, self.level))


@dataclass(frozen=True)
class Opaque:
    """Rows of which only the function is known: differentiated by autograd, projected by sequential linearisation.

    fn             trajectory in environment units -> rows, differentiable
    count          number of rows at a horizon
    centre, scale  of the trajectories it is applied to, where they are not in environment units: those are centre + scale * x
    """

    name: str
    fn: Callable[[Traj], Rows]
    count: Callable[[int], int]
    margin: float = 0.0
    centre: Tensor | None = None
    scale: Tensor | None = None

    trailing: ClassVar = {"centre": 1, "scale": 1}
    spans = True

    def labels(self, horizon: int) -> list[str]:
        return [f"{self.name}@{i}" for i in range(self.count(horizon))]

    def __call__(self, x: Traj) -> Rows:
        if self.centre is not None and self.scale is not None:
            x = self.centre.to(x) + self.scale.to(x) * x
        return self.fn(x) + self.margin

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        with torch.enable_grad():
            leaf = x.detach().clone().requires_grad_()
            rows = self(leaf)

            def pull(w: Rows) -> Traj:
                return torch.autograd.grad(rows, leaf, w, retain_graph=True)[0]

        size = pull(torch.ones_like(rows)).square().sum((1, 2))
        return rows.detach(), pull, size[:, None].expand_as(rows)

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Opaque":
        if self.centre is None or self.scale is None:
            return replace(self, centre=centre, scale=scale)
        return replace(self, centre=self.centre + self.scale * centre, scale=self.scale * scale)

    def take(self, which: Tensor) -> "Opaque":
        return take(self, which)

    def to(self, like: Tensor) -> "Opaque":
        return self

    def shift(self, margin: float) -> "Opaque":
        return replace(self, margin=self.margin + margin)

    def segment_max(self, x: Traj) -> Rows:
        return self(x)

    def on_segments(self) -> "tuple[Part, ...]":
        """Nothing is known of it between the waypoints."""
        return (self,)


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

    def take(self, which: Tensor) -> "Constraint":
        """The same constraint of some plans of the batch alone."""
        return Constraint(tuple(part.take(which) for part in self.parts))

    def bind(self, observed: Mapping[str, Tensor], dt: float, horizon: int) -> "Constraint":
        """The constraint with observed quantities filled in; none observes anything yet."""
        return self

    def to(self, like: Tensor) -> "Constraint":
        """The same constraint with its numbers in the dtype and on the device of `like`."""
        return Constraint(tuple(part.to(like) for part in self.parts))


def stack(constraints: Sequence[Constraint]) -> Constraint:
    """All of them at once."""
    return Constraint(tuple(part for constraint in constraints for part in constraint.parts))


def pull_back(g: Constraint, centre: Tensor, scale: Tensor) -> Constraint:
    """The same set in normalised coordinates z, x = centre + scale * z; the rows keep their values and units.

    centre, scale   [dim], or by plan and waypoint: [horizon | 1, dim] or [batch | 1, horizon | 1, dim]
    """
    return Constraint(tuple(part.pull_back(centre, scale) for part in g.parts))
