"""Constraints whose numbers are observed while acting: what they are bound to at each control step, and parts that wait for it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NoReturn

import torch
from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj
from cdiff_cli.constraints.state_sets import StateSet
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.errors import CdiffError

ObservedValues = Mapping[str, Tensor]
"""Observed quantities by name, each [batch]."""


@dataclass(frozen=True)
class Observed:
    """A part that is known once its quantities are observed: bind makes it.

    names    the quantities
    make     observed quantities, seconds between waypoints, horizon -> the part, environment units
    changes  what was asked of the part before it was known, in order
    """

    name: str
    names: tuple[str, ...]
    make: Callable[[ObservedValues, float, int], TrajectoryConstraint]
    changes: tuple[Callable[[TrajectoryConstraint], Sequence[TrajectoryConstraint]], ...] = ()

    spans = True
    affine = False

    def bind(
        self, observed: ObservedValues, dt: float, horizon: int
    ) -> tuple[TrajectoryConstraint, ...]:
        """The part, filled in; CdiffError where a quantity is missing."""
        missing = [name for name in self.names if name not in observed]
        if missing:
            offered = ", ".join(observed) or "nothing"
            raise CdiffError(
                f'the constraint "{self.name}" observes {", ".join(missing)}; what is observed here is {offered}'
            )
        parts: Sequence[TrajectoryConstraint] = (self.make(observed, dt, horizon),)
        for change in self.changes:
            parts = [new for part in parts for new in change(part)]
        return tuple(parts)

    def example(self, horizon: int) -> tuple[TrajectoryConstraint, ...]:
        """The part as it is where every quantity is 1: its form, not its numbers."""
        return self.bind(
            {name: torch.ones(1, dtype=torch.float64) for name in self.names}, 1.0, horizon
        )

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

    def state_values(self, x: Traj) -> Rows:
        self.refuse()

    def refuse(self) -> NoReturn:
        """Raise the CdiffError that says why this part has no values."""
        raise CdiffError(
            f'the constraint "{self.name}" observes {", ".join(self.names)}, which is known only while acting: use `cdiff rollout`'
        )


def require_bound(g: Constraint) -> None:
    """Refuse a constraint that waits for what only acting observes; raises CdiffError."""
    for part in g.parts:
        if isinstance(part, Observed):
            part.refuse()


def carried(
    level: StateSet, velocity: Tensor, dt: float, horizon: int, ahead: float = 0.0
) -> StateSet:
    """The level moving at a velocity [dim] or [batch, 1, dim]: at waypoint k it stands where k dt + ahead of it have brought it."""
    way = velocity * (ahead + dt * torch.arange(horizon, dtype=velocity.dtype))[:, None]
    return level.pull_back(-way, velocity.new_ones(velocity.shape[-1]))
