"""Constraints g(x) <= 0 on trajectories, row by row.

A constraint is a tuple of parts. A part applies a state set (a scalar function f of one state, allowed where f <= 0) to the
trajectory: at every waypoint, on the segments, or as a discrete control barrier function along it. Gradients are written out, so
that a method pays for a few vector operations and no autograd graph.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, Self, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from cdiff_cli.arrays import Array, Pull, Rows, Traj
from cdiff_cli.constraints.affine_rows import AffineRows


class TrajectoryConstraint(Protocol):
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

    def select(self, which: Tensor) -> Self:
        """The same part of some plans of the batch alone."""
        ...

    def to(self, like: Tensor) -> Self:
        """The same part with its numbers in the dtype and on the device of `like`."""
        ...

    def tighten(self, margin: float) -> Self:
        """g <= -margin."""
        ...

    def tighten_level(self, margin: float) -> Self:
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

    def on_segments(self) -> "tuple[TrajectoryConstraint, ...]":
        """The parts that hold all along the segments, as far as the part's form allows; itself where they need no more."""
        ...


@runtime_checkable
class Bindable(Protocol):
    """A part that waits for observed quantities (observed.py)."""

    def bind(
        self, observed: Mapping[str, Tensor], dt: float, horizon: int
    ) -> tuple[TrajectoryConstraint, ...]: ...


@dataclass(frozen=True)
class Constraint:
    """g(x) <= 0, row by row: a tuple of parts, each in environment units or all pulled back.

    condensed   the rows of all parts at once, where they are affine and someone has written them so (`condense`)
    """

    parts: tuple[TrajectoryConstraint, ...]
    condensed: AffineRows | None = None

    @cached_property
    def waits(self) -> bool:
        """Whether a part waits for observed quantities."""
        return any(isinstance(part, Bindable) for part in self.parts)

    def bind(self, observed: Mapping[str, Tensor], dt: float, horizon: int) -> "Constraint":
        """The constraint with observed quantities filled in, each [batch], at waypoints dt seconds apart."""
        if not self.waits:
            return self
        bound = [
            part.bind(observed, dt, horizon) if isinstance(part, Bindable) else (part,)
            for part in self.parts
        ]
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
        sizes = (
            [len(rows[0]) for rows, _, _ in each]
            if len(x)
            else [rows.shape[1] for rows, _, _ in each]
        )

        def pull(w: Rows) -> Traj:
            total, at = torch.zeros_like(x), 0
            for (_, part_pull, _), size in zip(each, sizes, strict=True):
                total = total + part_pull(w[:, at : at + size])
                at += size
            return total

        return (
            torch.cat([e[0] for e in each], 1),
            pull,
            len(each) * torch.cat([e[2] for e in each], 1),
        )

    def state_values(self, x: Traj) -> Float[Tensor, "batch horizon parts"]:
        """Each part's value at every state, unsafe above 0 (Part.state_values)."""
        return (
            torch.stack([part.state_values(x) for part in self.parts], -1)
            if self.parts
            else x.new_empty((*x.shape[:2], 0))
        )

    def worst(self, x: Traj | Array) -> Array:
        """The largest g of each trajectory, at its waypoints and between them [batch].

        -inf without rows. Between waypoints a barrier counts by its value -h, and a black box by
        its rows alone.

        x   [batch, horizon, dim], numpy or torch
        """
        states = torch.as_tensor(x)
        rows = [
            values for part in self.parts for values in (part(states), part.segment_max(states))
        ]
        lowest = states.new_full((len(states), 1), -torch.inf)
        return torch.cat([lowest, *rows], 1).amax(1).numpy(force=True)

    def on_segments(self) -> "Constraint":
        """The constraint that holds all along the segments, as far as the form of each part allows."""
        return Constraint(tuple(part for whole in self.parts for part in whole.on_segments()))

    def condense(self, horizon: int, dim: int) -> AffineRows | None:
        """The rows as one matrix, float64, from their values and pulls at 0; None where a part is not affine.

        For short windows, where one call for all parts is faster than one call per part.
        """
        if not self.parts or not all(part.affine for part in self.parts):
            return None
        rows, pull, size = self.linearise(torch.zeros(1, horizon, dim, dtype=torch.float64))
        return AffineRows(
            pull(torch.eye(rows.shape[1], dtype=torch.float64)).flatten(1), rows, size
        )

    def tighten(self, margin: float) -> "Constraint":
        """The constraint g <= -margin (margin in the units of g)."""
        return Constraint(tuple(part.tighten(margin) for part in self.parts))

    def select(self, which: Tensor) -> "Constraint":
        """The same constraint of some plans of the batch alone."""
        return Constraint(tuple(part.select(which) for part in self.parts))

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
