"""Discrete control barrier functions along a trajectory."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.protocol import StateSet, converted, selected
from cdiff_cli.constraints.segments import keep_on_segments
from cdiff_cli.constraints.state_sets import is_affine
from cdiff_cli.constraints.trajectory import TrajectoryConstraint, check_fixed_rows
from cdiff_cli.constraints.waypoints import AtWaypoints


@dataclass(frozen=True)
class DiscreteBarrier:
    """Discrete control barrier function h = -f.

        (1 - alpha) h(x^tau) - h(x^{tau+1}) <= 0                     (paper, section 5.1)

    A high-order barrier applies this twice, with psi^tau = h^{tau+1} - (1 - alpha) h^tau:

        (1 - alpha2) psi^tau - psi^{tau+1} <= 0                      (Xiong et al., 2022)

    level    the state set whose barrier h must stay non-negative
    alpha2   second factor of a high-order barrier; None for the plain one
    ahead    the state set that the rows use, where it is not `level`: at the place to which the
             velocity leads
    """

    name: str
    level: StateSet
    alpha: float
    alpha2: float | None = None
    ahead: StateSet | None = None

    spans = True
    exact_on_segments = True

    @property
    def support(self) -> int:
        return len(self.coefficients)

    @property
    def affine(self) -> bool:
        return is_affine(self.acting)

    @property
    def acting(self) -> StateSet:
        """The state set that the rows use."""
        return self.level if self.ahead is None else self.ahead

    @property
    def coefficients(self) -> tuple[float, ...]:
        """c of the rows -(c_0 h^tau + c_1 h^{tau+1} + ... + h^{tau+order}) <= 0."""
        gamma = 1 - self.alpha
        if self.alpha2 is None:
            return (-gamma, 1.0)
        return (gamma * (1 - self.alpha2), -gamma - (1 - self.alpha2), 1.0)

    def labels(self, horizon: int) -> list[str]:
        order = len(self.coefficients) - 1
        return [f"{self.name}@{tau}-{tau + order}" for tau in range(horizon - order)]

    def rows_of(self, f: Rows) -> Rows:
        """g for the values f [batch, horizon] of the state set at the waypoints."""
        c, n = self.coefficients, f.shape[1] - len(self.coefficients) + 1
        if n < 1:
            return f[:, :0]
        rows = f[:, len(c) - 1 :]
        for k, weight in enumerate(c[:-1]):
            rows = rows + weight * f[:, k : k + n]
        return rows

    def __call__(self, x: Traj) -> Rows:
        return self.rows_of(self.acting(x))

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        level, c = self.acting, self.coefficients
        slope, n = level.gradient(x), max(x.shape[1] - len(c) + 1, 0)

        def pull(w: Rows) -> Traj:
            spread = w.new_zeros(len(w), x.shape[1])
            for k, weight in enumerate(c):
                spread[:, k : k + n] += weight * w
            return spread[..., None] * slope

        size = level.step_bound(x)
        largest = size[:, :n]
        for k in range(1, len(c)):
            largest = torch.maximum(largest, size[:, k : k + n])
        return self(x), pull, sum(abs(weight) for weight in c) ** 2 * largest

    def pull_back(self, centre: Tensor, scale: Tensor) -> "DiscreteBarrier":
        return self._each(lambda level: level.pull_back(centre, scale))

    def select(self, which: Tensor) -> "DiscreteBarrier":
        return self._each(lambda level: selected(level, which))

    def to(self, like: Tensor) -> "DiscreteBarrier":
        return self._each(lambda level: converted(level, like))

    def tighten(self, margin: float) -> "DiscreteBarrier":
        """g <= -margin, which is the same barrier over h - margin / alpha, or / (alpha alpha2)."""
        return self.tighten_level(margin / sum(self.coefficients))

    def tighten_level(self, margin: float) -> "DiscreteBarrier":
        return self._each(lambda level: level.tighten(margin))

    def _each(self, change: Callable[[StateSet], StateSet]) -> "DiscreteBarrier":
        return replace(
            self, level=change(self.level), ahead=None if self.ahead is None else change(self.ahead)
        )

    def segment_max(self, x: Traj) -> Rows:
        """-h between waypoints: the value that the barrier keeps non-positive."""
        return AtWaypoints(self.name, self.level).segment_max(x)

    def segment_argmax(self, x: Traj) -> Rows:
        return self.level.segment_argmax(x)

    def state_values(self, x: Traj) -> Rows:
        return self.level(x)

    def on_segments(self) -> "tuple[TrajectoryConstraint, ...]":
        """The barrier, and its state set on the segments where the barrier does not imply that."""
        if not self.level.convex:
            return (self, keep_on_segments(self.name, self.level))
        return (self,) if self.ahead is None else (self, AtWaypoints(self.name, self.level))

    def coordinates(self, dim: int) -> list[int]:
        return sorted({*self.level.coordinates(), *self.acting.coordinates()})

    def restrict(self, columns: Sequence[int]) -> "DiscreteBarrier":
        return self._each(lambda level: level.restrict(columns))

    def check_pins(self, pins: Pins, tolerance: float) -> None:
        check_fixed_rows(self, pins, tolerance)
