"""Constraints g(x) <= 0 on trajectories, row by row.

A constraint is a tuple of parts. A part applies a state set to the trajectory: at every waypoint,
on the segments, or as a discrete control barrier function along it. Other parts limit rates of
change or require linear dynamics. Gradients are written out, so that a method pays for a few vector
operations and no autograd graph.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, Self, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from cdiff_cli.arrays import Array, Pull, Rows, Traj
from cdiff_cli.constraints.affine_rows import AffineRows
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.protocol import StateSet
from cdiff_cli.errors import InfeasibleError


class TrajectoryConstraint(Protocol):
    """Some rows of a constraint, and what a caller may ask about them."""

    @property
    def name(self) -> str: ...
    @property
    def level(self) -> StateSet | None:
        """The state set that the constraint is about; None where there is none."""
        ...

    @property
    def support(self) -> int:
        """Number of consecutive waypoints per row: row k uses the waypoints k to k + support - 1.

        0 where this is not known.
        """
        ...

    @property
    def spans(self) -> bool:
        """Whether it restricts the segments between waypoints, and not the waypoints alone."""
        ...

    @property
    def affine(self) -> bool:
        """Whether the rows are affine in the trajectory and the same for every plan."""
        ...

    @property
    def exact_on_segments(self) -> bool:
        """Whether segment_max is the exact maximum, so that a value <= 0 proves a segment safe."""
        ...

    def labels(self, horizon: int) -> list[str]: ...
    def __call__(self, x: Traj) -> Rows: ...
    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        """g(x); the pull w -> w^T dg/dx; and per row a bound of |dg/dx|^2.

        The bound counts the rows that share coordinates with the row.
        """
        ...

    def pull_back(self, centre: Tensor, scale: Tensor) -> Self:
        """The same part as a function of z, x = centre + scale * z; the rows keep their units."""
        ...

    def select(self, which: Tensor) -> Self:
        """The same part for some plans of the batch alone."""
        ...

    def to(self, like: Tensor) -> Self:
        """The same part with its parameters in the dtype and on the device of `like`."""
        ...

    def tighten(self, margin: float) -> Self:
        """The part g <= -margin."""
        ...

    def tighten_level(self, margin: float) -> Self:
        """The part with its state set tightened to f <= -margin, which is h >= margin of a barrier.

        A part without a state set is tightened to g <= -margin.
        """
        ...

    def segment_max(self, x: Traj) -> Rows:
        """The largest unsafe value on the segments between waypoints [batch, horizon - 1]."""
        ...

    def segment_argmax(self, x: Traj) -> Rows | None:
        """The share of each segment before the point of segment_max [batch, horizon - 1].

        None where segment_max belongs to no point of the segment.
        """
        ...

    def state_values(self, x: Traj) -> Rows:
        """One value per state [batch, horizon], unsafe above 0.

        f of the state set (-h of a barrier). A part that joins states gives each state the row that
        ends there; any other part gives every state the largest row of the plan.
        """
        ...

    def on_segments(self) -> "tuple[TrajectoryConstraint, ...]":
        """The parts that hold all along the segments, as far as the form of this part allows."""
        ...

    def coordinates(self, dim: int) -> list[int]:
        """The coordinates that the rows depend on, of states [dim]."""
        ...

    def restrict(self, columns: Sequence[int]) -> Self:
        """The same part of trajectories that have the coordinates `columns` alone.

        columns   indices that include all of coordinates()
        """
        ...

    def check_pins(self, pins: Pins, tolerance: float) -> None:
        """Raise InfeasibleError where the pinned waypoints alone violate a row by the tolerance."""
        ...


@runtime_checkable
class Bindable(Protocol):
    """A part that waits for observed quantities (observed.py)."""

    @property
    def names(self) -> tuple[str, ...]: ...
    def bind(
        self, observed: Mapping[str, Tensor], dt: float, horizon: int
    ) -> tuple[TrajectoryConstraint, ...]: ...
    def example(self, horizon: int) -> tuple[TrajectoryConstraint, ...]: ...


@dataclass(frozen=True)
class Constraint:
    """g(x) <= 0, row by row: a tuple of parts, each in environment units or all pulled back.

    condensed   the rows of all parts as one matrix (`condense`), where they are affine
    """

    parts: tuple[TrajectoryConstraint, ...]
    condensed: AffineRows | None = None

    @cached_property
    def waits(self) -> bool:
        """Whether a part waits for observed quantities."""
        return any(isinstance(part, Bindable) for part in self.parts)

    @cached_property
    def observes(self) -> frozenset[str]:
        """The names of the quantities that the parts wait for."""
        waiting = (part.names for part in self.parts if isinstance(part, Bindable))
        return frozenset(name for names in waiting for name in names)

    def bind(self, observed: Mapping[str, Tensor], dt: float, horizon: int) -> "Constraint":
        """The constraint with observed quantities filled in.

        observed   each [batch]
        dt         seconds between waypoints
        """
        if not self.waits:
            return self
        bound = [
            part.bind(observed, dt, horizon) if isinstance(part, Bindable) else (part,)
            for part in self.parts
        ]
        return Constraint(tuple(part for parts in bound for part in parts))

    def example(self, horizon: int) -> "Constraint":
        """The constraint with 1 for every observed quantity: its form, not its parameters."""
        forms = [
            part.example(horizon) if isinstance(part, Bindable) else (part,) for part in self.parts
        ]
        return Constraint(tuple(part for parts in forms for part in parts))

    def known(self) -> "Constraint":
        """The parts that wait for no observation."""
        return Constraint(tuple(part for part in self.parts if not isinstance(part, Bindable)))

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
        """g(x) [batch, n]; the pull w -> w^T dg/dx without a Jacobian; and a bound per row.

        The bound is of the largest eigenvalue that the row can give to J J^T, for step sizes.
        """
        if self.condensed is not None:
            return self.condensed.linearise(x)
        each = [part.linearise(x) for part in self.parts]
        if not each:
            empty = x.new_zeros(len(x), 0)
            return empty, lambda _: torch.zeros_like(x), empty
        sizes = [rows.shape[1] for rows, _, _ in each]

        def pull(w: Rows) -> Traj:
            total, begin = torch.zeros_like(x), 0
            for (_, part_pull, _), size in zip(each, sizes, strict=True):
                total = total + part_pull(w[:, begin : begin + size])
                begin += size
            return total

        values, bounds = torch.cat([e[0] for e in each], 1), torch.cat([e[2] for e in each], 1)
        return values, pull, len(each) * bounds

    def state_values(self, x: Traj) -> Float[Tensor, "batch horizon parts"]:
        """The value of each part at every state, unsafe above 0."""
        if not self.parts:
            return x.new_empty((*x.shape[:2], 0))
        return torch.stack([part.state_values(x) for part in self.parts], -1)

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
        """The constraint on whole segments, as far as the form of each part allows."""
        return Constraint(tuple(part for whole in self.parts for part in whole.on_segments()))

    def condense(self, horizon: int, dim: int) -> AffineRows | None:
        """The rows as one matrix in float64, from their values and pulls at 0; None if not affine.

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
        """The same constraint for some plans of the batch alone."""
        return Constraint(tuple(part.select(which) for part in self.parts))

    def to(self, like: Tensor) -> "Constraint":
        """The same constraint with its parameters in the dtype and on the device of `like`."""
        return Constraint(tuple(part.to(like) for part in self.parts))


def stack(constraints: Sequence[Constraint]) -> Constraint:
    """One constraint with the parts of all of them."""
    return Constraint(tuple(part for constraint in constraints for part in constraint.parts))


def pull_back(g: Constraint, centre: Tensor, scale: Tensor) -> Constraint:
    """The same set in normalised coordinates z, x = centre + scale * z; the rows keep their units.

    centre, scale   [dim], or [horizon | 1, dim], or [batch | 1, horizon | 1, dim]
    """
    return Constraint(tuple(part.pull_back(centre, scale) for part in g.parts))


def movable_rows(part: TrajectoryConstraint, pins: Pins) -> Bool[Tensor, "n"]:  # noqa: F821
    """Which rows of the part depend on a waypoint that is not pinned as a whole.

    All rows count as movable where the support of the part is not known.
    """
    free = (~pins.mask).any(1)
    if part.support == 1:
        return free
    if not part.support:
        return free.new_ones(len(part.labels(len(free))))
    if len(free) < part.support:
        return free[:0]
    return free.unfold(0, part.support, 1).any(1)


def check_fixed_rows(part: TrajectoryConstraint, pins: Pins, tolerance: float) -> None:
    """Raise InfeasibleError where a row that pins alone decide is violated by the tolerance."""
    fixed = ~movable_rows(part, pins)
    if not bool(fixed.any()):
        return
    violated = (fixed & (part(pins.values) > tolerance)).any(0)
    if bool(violated.any()):
        row = int(violated.nonzero()[0])
        raise InfeasibleError(
            f"the pinned state violates {part.labels(len(pins.mask))[row]}; move the start or goal,"
            " or the constraint"
        )
