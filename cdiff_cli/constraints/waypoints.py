"""A state constraint that holds at every waypoint."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.protocol import StateSet, converted, segment_max, selected
from cdiff_cli.constraints.segments import keep_on_segments
from cdiff_cli.constraints.state_sets import is_affine
from cdiff_cli.constraints.trajectory import TrajectoryConstraint, check_fixed_rows


@dataclass(frozen=True)
class AtWaypoints:
    """f(x^tau) <= 0 at every waypoint: one row per waypoint."""

    name: str
    level: StateSet

    support = 1
    spans = True
    exact_on_segments = True

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

    def segment_argmax(self, x: Traj) -> Rows:
        return self.level.segment_argmax(x)

    def state_values(self, x: Traj) -> Rows:
        return self.level(x)

    def on_segments(self) -> "tuple[TrajectoryConstraint, ...]":
        return (self if self.level.convex else keep_on_segments(self.name, self.level),)

    def coordinates(self, dim: int) -> list[int]:
        return self.level.coordinates()

    def restrict(self, columns: Sequence[int]) -> "AtWaypoints":
        return replace(self, level=self.level.restrict(columns))

    def check_pins(self, pins: Pins, tolerance: float) -> None:
        check_fixed_rows(self, pins, tolerance)
