"""A state constraint that holds all along the straight segments between waypoints."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj
from cdiff_cli.constraints.state_sets import (
    Quadric,
    QuadricInFrame,
    StateSet,
    converted,
    segment_max,
    selected,
)
from cdiff_cli.constraints.trajectory import TrajectoryConstraint


@dataclass(frozen=True)
class OnSegments:
    """f <= 0 all along the straight segments between waypoints: one row a segment, its largest f."""

    name: str
    level: StateSet

    spans = True
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

    def state_values(self, x: Traj) -> Rows:
        return self.level(x)

    def on_segments(self) -> "tuple[TrajectoryConstraint, ...]":
        return (self,)


def keep_on_segments(name: str, level: StateSet) -> OnSegments:
    """The level on the segments; a quadric that is the outside of a ball or ellipsoid as such, which has an exact form there."""
    ball = level.ball() if isinstance(level, Quadric | QuadricInFrame) else None
    return OnSegments(name, ball or level)
