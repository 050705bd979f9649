"""A state constraint that holds at every waypoint."""

from dataclasses import dataclass, replace

from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj
from cdiff_cli.constraints.segments import keep_on_segments
from cdiff_cli.constraints.state_sets import StateSet, converted, is_affine, segment_max, selected
from cdiff_cli.constraints.trajectory import TrajectoryConstraint


@dataclass(frozen=True)
class AtWaypoints:
    """f(x^tau) <= 0 at every waypoint: one row a waypoint."""

    name: str
    level: StateSet

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
        return self.level(x), lambda w: w[..., None] * slope, self.level.step_bound(x)

    def pull_back(self, centre: Tensor, scale: Tensor) -> "AtWaypoints":
        return replace(self, level=self.level.pull_back(centre, scale))

    def select(self, which: Tensor) -> "AtWaypoints":
        return replace(self, level=selected(self.level, which))

    def to(self, like: Tensor) -> "AtWaypoints":
        return replace(self, level=converted(self.level, like))

    def tighten(self, margin: float) -> "AtWaypoints":
        return replace(self, level=self.level.tighten(margin))

    tighten_level = tighten

    def segment_max(self, x: Traj) -> Rows:
        if x.shape[1] < 2:
            return self(x)
        return segment_max(self.level, x)

    def state_values(self, x: Traj) -> Rows:
        return self.level(x)

    def on_segments(self) -> "tuple[TrajectoryConstraint, ...]":
        return (self if self.level.convex else keep_on_segments(self.name, self.level),)
