"""Constraints g(x) <= 0 on trajectories, row by row, and the pins that hold coordinates fixed.

A constraint is a tuple of parts. A part applies a level (a scalar function f of one state, allowed where f <= 0) to the
trajectory: at every waypoint, or as a discrete control barrier function along it. Knowing level and part, projection.py picks
an exact form; gradients are written out, so that a method pays for a few vector operations and no autograd graph.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cdiff_cli.affine_rows import AffineRows
from cdiff_cli.levels import Framed, Level, Quadric, is_affine, moved, segment_max, take

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

    @cached_property
    def whole(self) -> bool:
        """Whether each waypoint is fixed as a whole or not at all."""
        return bool((self.mask.all(1) == self.held).all())

    @cached_property
    def held(self) -> Bool[Tensor, "horizon"]:  # noqa: F821
        """Waypoints with a fixed coordinate."""
        return self.mask.any(1)

    @cached_property
    def loose(self) -> tuple[int, int]:
        """The first waypoint that is not held, and the one after the last."""
        free = [tau for tau, held in enumerate(self.held.tolist()) if not held]
        return (free[0], free[-1] + 1) if free else (0, 0)

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

    @property
    def affine(self) -> bool:
        """Whether the rows are affine in the trajectory, the same for every plan."""
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

    def shift(self, margin: float) -> Self:
        """g <= -margin."""
        ...

    def shift_level(self, margin: float) -> Self:
        """The level tightened to f <= -margin, a barrier to h >= margin; of a part without a level, g."""
        ...

    def segment_max(self, x: Traj) -> Rows:
        """The largest unsafe value on the segments between waypoints [batch, horizon - 1]."""
        ...

    def state_values(self, x: Traj) -> Rows:
        """One value per state [batch, horizon], unsafe above 0: the level, -h of a barrier; of what joins states, the row that
        ends there; of anything else, the plan's largest row.
        """
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

    @property
    def affine(self) -> bool:
        return is_affine(self.level)

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

    shift_level = shift

    def segment_max(self, x: Traj) -> Rows:
        if x.shape[1] < 2:
            return self(x)
        return segment_max(self.level, x)

    def state_values(self, x: Traj) -> Rows:
        return self.level(x)

    def on_segments(self) -> "tuple[Part, ...]":
        return (self if self.level.convex else _segments(self.name, self.level),)


@dataclass(frozen=True)
class Segments:
    """f <= 0 all along the straight segments between waypoints: one row a segment, its largest f."""

    name: str
    level: Level

    spans = True
    affine = False

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

    shift_level = shift

    def segment_max(self, x: Traj) -> Rows:
        return segment_max(self.level, x) if x.shape[1] > 1 else self.level(x)

    def state_values(self, x: Traj) -> Rows:
        return self.level(x)

    def on_segments(self) -> "tuple[Part, ...]":
        return (self,)


def _segments(name: str, level: Level) -> Segments:
    """The level on the segments; a quadric that is the outside of a ball or ellipsoid as such, which has an exact form there."""
    ball = level.ball() if isinstance(level, Quadric | Framed) else None
    return Segments(name, ball or level)


@dataclass(frozen=True)
class Chain:
    """Discrete control barrier function h = -f:  (1 - alpha) h(x^tau) - h(x^{tau+1}) <= 0 (paper, section 5.1).

    level    whose barrier is to stay non-negative
    alpha2   of a high-order barrier, of psi^tau = h^{tau+1} - (1 - alpha) h^tau:  (1 - alpha2) psi^tau - psi^{tau+1} <= 0
             (Xiong et al., 2022); None for the plain one
    ahead    the level that the rows are of, where it is another: of the place that the velocity leads to
    """

    name: str
    level: Level
    alpha: float
    alpha2: float | None = None
    ahead: Level | None = None

    spans = True

    @property
    def affine(self) -> bool:
        return is_affine(self.acting)

    @property
    def acting(self) -> Level:
        """The level that the rows are of."""
        return self.level if self.ahead is None else self.ahead

    @property
    def coefficients(self) -> tuple[float, ...]:
        """c with the rows -(c_0 h^tau + c_1 h^{tau+1} + ... + h^{tau+order}) <= 0."""
        gamma = 1 - self.alpha
        if self.alpha2 is None:
            return (-gamma, 1.0)
        return (gamma * (1 - self.alpha2), -gamma - (1 - self.alpha2), 1.0)

    def labels(self, horizon: int) -> list[str]:
        order = len(self.coefficients) - 1
        return [f"{self.name}@{tau}-{tau + order}" for tau in range(horizon - order)]

    def rows_of(self, f: Rows) -> Rows:
        """g where the level has the values f at the waypoints."""
        c, n = self.coefficients, f.shape[1] - len(self.coefficients) + 1
        if n < 1:
            return f[:, :0]
        rows = f[:, len(c) - 1 :]
        for k, weight in enumerate(c[:-1]):
            rows = rows + weight * f[:, k : k + n]
        return rows

    def __call__(self, x: Traj) -> Rows:
        return self.rows_of(self.acting(x))

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        level, c = self.acting, self.coefficients
        slope, n = level.gradient(x), max(x.shape[1] - len(c) + 1, 0)

        def pull(w: Rows) -> Traj:
            spread = w.new_zeros(len(w), x.shape[1])
            for k, weight in enumerate(c):
                spread[:, k : k + n] += weight * w
            return spread[..., None] * slope

        size = level.size(x)
        largest = size[:, :n]
        for k in range(1, len(c)):
            largest = torch.maximum(largest, size[:, k : k + n])
        return self(x), pull, sum(abs(weight) for weight in c) ** 2 * largest

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Chain":
        return self._each(lambda level: level.pull_back(centre, scale))

    def take(self, which: Tensor) -> "Chain":
        return self._each(lambda level: take(level, which))

    def to(self, like: Tensor) -> "Chain":
        return self._each(lambda level: moved(level, like))

    def shift(self, margin: float) -> "Chain":
        """g <= -margin is the same chain over h - margin / alpha, or / (alpha alpha2)."""
        return self.shift_level(margin / sum(self.coefficients))

    def shift_level(self, margin: float) -> "Chain":
        return self._each(lambda level: level.shift(margin))

    def _each(self, change: Callable[[Level], Level]) -> "Chain":
        return replace(self, level=change(self.level), ahead=None if self.ahead is None else change(self.ahead))

    def segment_max(self, x: Traj) -> Rows:
        """-h between waypoints: the barrier itself, which is what the chain keeps non-negative."""
        return Waypoints(self.name, self.level).segment_max(x)

    def state_values(self, x: Traj) -> Rows:
        return self.level(x)

    def on_segments(self) -> "tuple[Part, ...]":
        """The chain, and its barrier on the segments where the chain does not give it."""
        if not self.level.convex:
            return (self, _segments(self.name, self.level))
        return (self,) if self.ahead is None else (self, Waypoints(self.name, self.level))


@runtime_checkable
class Bindable(Protocol):
    """A part that waits for observed quantities (observed.py)."""

    def bind(self, observed: Mapping[str, Tensor], dt: float, horizon: int) -> tuple[Part, ...]: ...


@dataclass(frozen=True)
class Constraint:
    """g(x) <= 0, row by row: a tuple of parts, each in environment units or all pulled back.

    condensed   the rows of all parts at once, where they are affine and someone has written them so (`condense`)
    """

    parts: tuple[Part, ...]
    condensed: AffineRows | None = None

    @cached_property
    def waits(self) -> bool:
        """Whether a part waits for observed quantities."""
        return any(isinstance(part, Bindable) for part in self.parts)

    def bind(self, observed: Mapping[str, Tensor], dt: float, horizon: int) -> "Constraint":
        """The constraint with observed quantities filled in, each [batch], at waypoints dt seconds apart."""
        if not self.waits:
            return self
        bound = [part.bind(observed, dt, horizon) if isinstance(part, Bindable) else (part,) for part in self.parts]
        return Constraint(tuple(part for parts in bound for part in parts))

    def __call__(self, x: Traj) -> Rows:
        if self.condensed is not None:
            return self.condensed(x)
        if len(self.parts) == 1:
            return self.parts[0](x)
        rows = [part(x) for part in self.parts]
        return torch.cat(rows, 1) if rows else x.new_zeros(len(x), 0)

    def labels(self, horizon: int) -> list[str]:
        return [label for part in self.parts for label in part.labels(horizon)]

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        """g(x) [batch, n]; the pull w -> w^T dg/dx without a Jacobian; and row by row a bound of the largest eigenvalue
        that the row can give to J J^T, for step sizes.
        """
        if self.condensed is not None:
            return self.condensed.linearise(x)
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

    def state_values(self, x: Traj) -> Float[Tensor, "batch horizon parts"]:
        """Each part's value at every state, unsafe above 0 (Part.state_values)."""
        return torch.stack([part.state_values(x) for part in self.parts], -1) if self.parts else x.new_empty((*x.shape[:2], 0))

    def condense(self, horizon: int, dim: int) -> AffineRows | None:
        """The rows as one matrix, float64, from their values and pulls at 0; None where a part is not affine.

        For short windows, where one call for all parts is faster than one call per part.
        """
        if not self.parts or not all(part.affine for part in self.parts):
            return None
        rows, pull, size = self.linearise(torch.zeros(1, horizon, dim, dtype=torch.float64))
        return AffineRows(pull(torch.eye(rows.shape[1], dtype=torch.float64)).flatten(1), rows, size)

    def tighten(self, margin: float) -> "Constraint":
        """The constraint g <= -margin (margin in the units of g)."""
        return Constraint(tuple(part.shift(margin) for part in self.parts))

    def take(self, which: Tensor) -> "Constraint":
        """The same constraint of some plans of the batch alone."""
        return Constraint(tuple(part.take(which) for part in self.parts))

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
