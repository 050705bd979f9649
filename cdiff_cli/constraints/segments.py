"""A state constraint that holds all along the straight segments between waypoints."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.protocol import StateSet, converted, segment_max, selected
from cdiff_cli.constraints.state_sets import as_ellipsoid
from cdiff_cli.constraints.trajectory import TrajectoryConstraint, check_fixed_rows


@dataclass(frozen=True)
class OnSegments:
    """f <= 0 all along the straight segments between waypoints.

    One row per segment: the largest f on it.
    """

    name: str
    level: StateSet

    support = 2
    spans = True
    exact_on_segments = True
    affine = False

    def labels(self, horizon: int) -> list[str]:
        return [f"{self.name}@{tau}~{tau + 1}" for tau in range(horizon - 1)]

    def __call__(self, x: Traj) -> Rows:
        return self.segment_max(x)[:, : x.shape[1] - 1]

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        at = self.level.on_segment(x, self.level.segment_argmax(x))

        def pull(w: Rows) -> Traj:
            out = torch.zeros_like(x)
            out[:, :-1] += w[..., None] * at.back
            out[:, 1:] += w[..., None] * at.on
            return out

        return at.value, pull, 2 * at.size

    def pull_back(self, centre: Tensor, scale: Tensor) -> "OnSegments":
        return replace(self, level=self.level.pull_back(centre, scale))

    def select(self, which: Tensor) -> "OnSegments":
        return replace(self, level=selected(self.level, which))

    def to(self, like: Tensor) -> "OnSegments":
        return replace(self, level=converted(self.level, like))

    def tighten(self, margin: float) -> "OnSegments":
        return replace(self, level=self.level.tighten(margin))

    tighten_level = tighten

    def segment_max(self, x: Traj) -> Rows:
        return segment_max(self.level, x) if x.shape[1] > 1 else self.level(x)

    def segment_argmax(self, x: Traj) -> Rows:
        return self.level.segment_argmax(x)

    def state_values(self, x: Traj) -> Rows:
        return self.level(x)

    def on_segments(self) -> "tuple[TrajectoryConstraint, ...]":
        return (self,)

    def coordinates(self, dim: int) -> list[int]:
        return self.level.coordinates()

    def restrict(self, columns: Sequence[int]) -> "OnSegments":
        return replace(self, level=self.level.restrict(columns))

    def check_pins(self, pins: Pins, tolerance: float) -> None:
        check_fixed_rows(self, pins, tolerance)


def keep_on_segments(name: str, level: StateSet) -> OnSegments:
    """The set on the segments, as an Ellipsoid where it is the outside of one."""
    return OnSegments(name, as_ellipsoid(level))
