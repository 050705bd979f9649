"""Limits on how fast coordinates change between waypoints.

The rate on a segment is (x^{tau+1} - x^tau) / dt. It is constant along a straight segment, so one
row per segment is exact.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj, each_end
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.protocol import nonzero_columns, selected
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.errors import InfeasibleError


@dataclass(frozen=True, eq=False)
class RateLimit:
    """A limit on the rate of change of some coordinates from each waypoint to the next.

    One row per segment, in the units of the coordinates per second.

    which          selects the coordinates                                             [k, dim]
    low, high      limits, units of the coordinates per second
    norm           g = |rate| - high; if False g = max(rate - high, low - rate) of one coordinate
    dt             seconds between waypoints
    centre, scale  the trajectories z that it is applied to are x = centre + scale * z   [dim]
    """

    name: str
    which: Tensor
    low: float
    high: float
    norm: bool
    dt: float
    centre: Tensor
    scale: Tensor

    trailing: ClassVar = {"which": 2, "centre": 1, "scale": 1}
    level = None
    support = 2
    spans = True
    affine = False  # a row is the larger of two sides
    exact_on_segments = True

    def labels(self, horizon: int) -> list[str]:
        return [f"{self.name}@{tau}-{tau + 1}" for tau in range(horizon - 1)]

    def limited(self, x: Traj) -> Tensor:
        """The limited coordinates, in environment units [batch, horizon, k]."""
        return (self.centre + self.scale * x) @ self.which.T

    def rates(self, x: Traj) -> Tensor:
        """The rates of the limited coordinates [batch, horizon - 1, k]."""
        p = self.limited(x)
        return (p[:, 1:] - p[:, :-1]) / self.dt

    def __call__(self, x: Traj) -> Rows:
        return self._excess(self.rates(x))

    def _excess(self, rate: Tensor) -> Rows:
        if self.norm:
            return rate.norm(dim=-1) - self.high
        return torch.maximum(rate - self.high, self.low - rate)[..., 0]

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        rate = self.rates(x)
        if self.norm:
            unit = rate / rate.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        else:
            unit = torch.where(rate - self.high >= self.low - rate, 1.0, -1.0).to(x)
        slope = unit @ self.which / self.dt
        first, last = each_end(self.scale, 1)
        back, on = slope * first, slope * last

        def pull(w: Rows) -> Traj:
            out = torch.zeros_like(x)
            out[:, :-1] -= w[..., None] * back
            out[:, 1:] += w[..., None] * on
            return out

        return self._excess(rate), pull, 2 * (back.square().sum(-1) + on.square().sum(-1))

    def pull_back(self, centre: Tensor, scale: Tensor) -> "RateLimit":
        return replace(self, centre=self.centre + self.scale * centre, scale=self.scale * scale)

    def select(self, which: Tensor) -> "RateLimit":
        return selected(self, which)

    def to(self, like: Tensor) -> "RateLimit":
        return replace(self, **{name: getattr(self, name).to(like) for name in self.trailing})

    def tighten(self, margin: float) -> "RateLimit":
        low, high = self.low + margin, self.high - margin
        if high < (0.0 if self.norm else low):
            raise InfeasibleError(
                f'no rate of change is {margin:g} within the limits of "{self.name}"; relax one of'
                " them"
            )
        return replace(self, low=low, high=high)

    tighten_level = tighten

    def segment_max(self, x: Traj) -> Rows:
        """The row of each segment, along which the rate is constant."""
        return self(x)

    def segment_argmax(self, x: Traj) -> Rows:
        """0: the rate is the same at every point, and the first one is named."""
        return x.new_zeros(len(x), x.shape[1] - 1)

    def state_values(self, x: Traj) -> Rows:
        return torch.nn.functional.pad(self(x), (1, 0), value=-torch.inf)

    def on_segments(self) -> tuple[TrajectoryConstraint, ...]:
        return (self,)

    def coordinates(self, dim: int) -> list[int]:
        return nonzero_columns(self.which)

    def restrict(self, columns: Sequence[int]) -> "RateLimit":
        parameters = {name: getattr(self, name)[..., columns] for name in self.trailing}
        return replace(self, **parameters)

    def nearest_change(self, change: Tensor) -> Tensor:
        """The nearest changes between waypoints [k, ...] within the limit, environment units."""
        if self.norm:
            length = change.norm(dim=0, keepdim=True)
            return change * (self.high * self.dt / length.clamp_min(1e-30)).clamp_max(1.0)
        return change.clamp(self.low * self.dt, self.high * self.dt)

    def check_pins(self, pins: Pins, tolerance: float) -> None:
        """Raise InfeasibleError for pinned waypoints too far apart for the time between them."""
        held = pins.mask[:, (self.which != 0).any(0)].all(1).nonzero()[:, 0].tolist()
        p = self.limited(pins.values)
        for first, last in pairwise(held):
            needed = (p[:, last] - p[:, first]) / ((last - first) * self.dt)
            over = self._excess(needed[:, None])
            if bool((over > tolerance).any()):
                worst = needed[int(over[:, 0].argmax())]
                rate = float(worst.norm()) if self.norm else float(worst[0])
                limit = self.low if not self.norm and rate < self.low else self.high
                raise InfeasibleError(
                    f'"{self.name}" excludes the pinned waypoints {first} and {last}: from one to'
                    f" the other in {(last - first) * self.dt:g} s takes a mean rate of"
                    f" {rate:.3g} per second, the limit is {limit:g}; move the start or goal, or"
                    " relax the limit"
                )


def limits_of(g: Constraint) -> list[RateLimit]:
    """The parts of g that limit rates."""
    return [part for part in g.parts if isinstance(part, RateLimit)]


def max_rate(g: Constraint, columns: set[int]) -> float:
    """The largest length of the rate of these coordinates that g allows; inf without a limit."""
    limits = [
        part.high
        for part in limits_of(g)
        if part.norm and set(part.which.argmax(1).tolist()) == columns
    ]
    return min(limits, default=math.inf)


def check_rates(g: Constraint) -> None:
    """Raise InfeasibleError for rate limits that no rate of change satisfies together.

    Per coordinate, the slowest rate that its limits allow is the easiest one for limits on lengths.
    """
    limits = limits_of(g)
    slowest: dict[int, tuple[float, str]] = {}
    single = [part for part in limits if not part.norm]
    for column in sorted({int(part.which[0].argmax()) for part in single}):
        same = [part for part in single if int(part.which[0].argmax()) == column]
        least, most = max(same, key=lambda part: part.low), min(same, key=lambda part: part.high)
        if least.low > most.high:
            raise _contradiction(least.name, most.name)
        binding = least if least.low > 0 else most
        slowest[column] = (min(max(0.0, least.low), most.high), binding.name)
    for part in limits:
        forced = [slowest[c] for c in part.which.argmax(1).tolist() if c in slowest]
        if part.norm and math.hypot(*(rate for rate, _ in forced)) > part.high:
            raise _contradiction(part.name, max(forced, key=lambda one: abs(one[0]))[1])


def _contradiction(one: str, other: str) -> InfeasibleError:
    return InfeasibleError(
        f'no rate of change is within the limits of both "{one}" and "{other}"; relax one of them'
    )


def rate_bounds(low: float | None, high: float | None) -> tuple[float, float]:
    """The bounds, infinite where not given."""
    return (-math.inf if low is None else low), (math.inf if high is None else high)
