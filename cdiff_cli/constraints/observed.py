"""Constraints whose parameters are observed in closed loop, and bound at each control step."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NoReturn

import torch
from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.protocol import StateSet
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.errors import CdiffError

ObservedValues = Mapping[str, Tensor]
"""Observed quantities per name, each [batch]."""


@dataclass(frozen=True)
class Observed:
    """A part that is known once its quantities are observed; `bind` then returns it.

    names    the quantities
    make     (observed quantities, seconds between waypoints, horizon) -> the part
    changes  operations on the part that bind applies in order, such as pull_back and tighten
    """

    name: str
    names: tuple[str, ...]
    make: Callable[[ObservedValues, float, int], TrajectoryConstraint]
    changes: tuple[Callable[[TrajectoryConstraint], Sequence[TrajectoryConstraint]], ...] = ()

    level = None
    support = 0
    spans = True
    affine = False
    exact_on_segments = False

    def bind(
        self, observed: ObservedValues, dt: float, horizon: int
    ) -> tuple[TrajectoryConstraint, ...]:
        """The part for these observations; raises CdiffError where a quantity is missing."""
        missing = [name for name in self.names if name not in observed]
        if missing:
            offered = ", ".join(observed) or "nothing"
            raise CdiffError(
                f'the constraint "{self.name}" observes {", ".join(missing)}; what is observed here'
                f" is {offered}"
            )
        parts: Sequence[TrajectoryConstraint] = (self.make(observed, dt, horizon),)
        for change in self.changes:
            parts = [new for part in parts for new in change(part)]
        return tuple(parts)

    def example(self, horizon: int) -> tuple[TrajectoryConstraint, ...]:
        """The part with 1 for every quantity: its form, not its parameters."""
        ones = {name: torch.ones(1, dtype=torch.float64) for name in self.names}
        return self.bind(ones, 1.0, horizon)

    def labels(self, horizon: int) -> list[str]:
        return [label for part in self.example(horizon) for label in part.labels(horizon)]

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Observed":
        return self._then(lambda part: (part.pull_back(centre, scale),))

    def select(self, which: Tensor) -> "Observed":
        return self._then(lambda part: (part.select(which),))

    def to(self, like: Tensor) -> "Observed":
        return self._then(lambda part: (part.to(like),))

    def tighten(self, margin: float) -> "Observed":
        return self._then(lambda part: (part.tighten(margin),))

    def tighten_level(self, margin: float) -> "Observed":
        return self._then(lambda part: (part.tighten_level(margin),))

    def on_segments(self) -> "tuple[Observed, ...]":
        return (self._then(lambda part: part.on_segments()),)

    def coordinates(self, dim: int) -> list[int]:
        return list(range(dim))

    def restrict(self, columns: Sequence[int]) -> "Observed":
        return self._then(lambda part: (part.restrict(columns),))

    def check_pins(self, pins: Pins, tolerance: float) -> None:
        """Pins are not checked before the quantities are observed."""

    def _then(
        self, change: Callable[[TrajectoryConstraint], Sequence[TrajectoryConstraint]]
    ) -> "Observed":
        return replace(self, changes=(*self.changes, change))

    def __call__(self, x: Traj) -> Rows:
        self.refuse()

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        self.refuse()

    def segment_max(self, x: Traj) -> Rows:
        self.refuse()

    def segment_argmax(self, x: Traj) -> None:
        self.refuse()

    def state_values(self, x: Traj) -> Rows:
        self.refuse()

    def refuse(self) -> NoReturn:
        """Raise the CdiffError that says why this part has no values."""
        raise CdiffError(
            f'the constraint "{self.name}" observes {", ".join(self.names)}, which is known only'
            " while acting: use `cdiff rollout`"
        )


def require_bound(g: Constraint) -> None:
    """Raise CdiffError if a part of g waits for observed quantities."""
    for part in g.parts:
        if isinstance(part, Observed):
            part.refuse()


def carried(
    level: StateSet, velocity: Tensor, dt: float, horizon: int, ahead: float = 0.0
) -> StateSet:
    """The set moving at a constant velocity: at waypoint k it has moved for k dt + ahead seconds.

    velocity   [dim] or [batch, 1, dim], environment units per second
    """
    offset = velocity * (ahead + dt * torch.arange(horizon, dtype=velocity.dtype))[:, None]
    return level.pull_back(-offset, velocity.new_ones(velocity.shape[-1]))
