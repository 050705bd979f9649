"""A state constraint that holds all along the straight segments between waypoints."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj
from cdiff_cli.constraints.state_sets import Framed, Level, Quadric, moved, segment_max, take
from cdiff_cli.constraints.trajectory import Part


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
