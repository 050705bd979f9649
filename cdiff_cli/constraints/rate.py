"""Limits on how fast coordinates change between waypoints.

The rate of a segment is (x^{tau+1} - x^tau) / dt: on a straight segment the same all along, so one row per segment says it exactly.
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
from cdiff_cli.constraints.state_sets import selected
from cdiff_cli.constraints.trajectory import TrajectoryConstraint
from cdiff_cli.errors import InfeasibleError


@dataclass(frozen=True, eq=False)
class RateLimit:
    """A limit on the rate of change of some coordinates from each waypoint to the next. A row a segment, in their units a second.

    norm           whether g = |rate| - high, else g = max(rate - high, low - rate) of a single coordinate
    which          selects the coordinates                                          [k, dim]
    centre, scale  of the trajectories it is applied to: x = centre + scale * z     [dim]
    dt             seconds between waypoints
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
    spans = True
    affine = False  # a row has two sides

    def labels(self, horizon: int) -> list[str]:
        return [f"{self.name}@{tau}-{tau + 1}" for tau in range(horizon - 1)]

    def selected(self, x: Traj) -> Tensor:
        """The coordinates it limits, in environment units [batch, horizon, k]."""
        return (self.centre + self.scale * x) @ self.which.T

    def rates(self, x: Traj) -> Tensor:
        """[batch, horizon - 1, k]"""
        p = self.selected(x)
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
                f'no rate of change is {margin:g} within the limits of "{self.name}"; relax one of them'
            )
        return replace(self, low=low, high=high)

    tighten_level = tighten

    def segment_max(self, x: Traj) -> Rows:
        """A segment's own row: along it the rate does not change."""
        return self(x)

    def state_values(self, x: Traj) -> Rows:
        return torch.nn.functional.pad(self(x), (1, 0), value=-torch.inf)

    def on_segments(self) -> tuple[TrajectoryConstraint, ...]:
        return (self,)

    def cut(self, change: Tensor) -> Tensor:
        """Changes from waypoint to waypoint [k, ...] brought within the limit."""
        if self.norm:
            length = change.norm(dim=0, keepdim=True)
            return change * (self.high * self.dt / length.clamp_min(1e-30)).clamp_max(1.0)
        return change.clamp(self.low * self.dt, self.high * self.dt)

    def refuse_pins(self, pins: Pins, tolerance: float) -> None:
        """Pinned waypoints too far apart for the time between them can never be joined."""
        held = pins.mask[:, (self.which != 0).any(0)].all(1).nonzero()[:, 0].tolist()
        p = self.selected(pins.values)
        for first, last in pairwise(held):
            needed = (p[:, last] - p[:, first]) / ((last - first) * self.dt)
            over = self._excess(needed[:, None])
            if bool((over > tolerance).any()):
                worst = needed[int(over[:, 0].argmax())]
                asked = float(worst.norm()) if self.norm else float(worst[0])
                limit = self.low if not self.norm and asked < self.low else self.high
                raise InfeasibleError(
                    f'"{self.name}" excludes the pinned waypoints {first} and {last}: from one to the other in '
                    f"{(last - first) * self.dt:g} s takes a mean rate of {asked:.3g} a second, the limit is {limit:g}; "
                    "move the start or goal, or relax the limit"
                )


def refuse_contradiction(parts: Sequence[RateLimit]) -> None:
    """Limits that no change meets together: of each coordinate the slowest change that those of it alone allow is the easiest for
    the limits of lengths.
    """
    forced: dict[int, tuple[float, str]] = {}
    alone = [part for part in parts if not part.norm]
    for column in sorted({int(part.which[0].argmax()) for part in alone}):
        mine = [part for part in alone if int(part.which[0].argmax()) == column]
        least, most = max(mine, key=lambda part: part.low), min(mine, key=lambda part: part.high)
        if least.low > most.high:
            _contradict(least.name, most.name)
        slowest = least if least.low > 0 else most
        forced[column] = (min(max(0.0, least.low), most.high), slowest.name)
    for part in parts:
        met = [forced[c] for c in part.which.argmax(1).tolist() if c in forced]
        if part.norm and math.hypot(*(rate for rate, _ in met)) > part.high:
            _contradict(part.name, max(met, key=lambda one: abs(one[0]))[1])


def _contradict(one: str, other: str) -> None:
    raise InfeasibleError(
        f'no rate of change is within the limits of both "{one}" and "{other}"; relax one of them'
    )


def rate_bounds(low: float | None, high: float | None) -> tuple[float, float]:
    """Bounds, infinite where not given."""
    return (-math.inf if low is None else low), (math.inf if high is None else high)
