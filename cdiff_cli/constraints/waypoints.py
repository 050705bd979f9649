"""A state constraint that holds at every waypoint."""

from dataclasses import dataclass, replace

from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj
from cdiff_cli.constraints.segments import _segments
from cdiff_cli.constraints.state_sets import Level, is_affine, moved, segment_max, take
from cdiff_cli.constraints.trajectory import Part


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
