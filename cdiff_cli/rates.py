"""Limits on how fast coordinates change between waypoints, and the nearest trajectory within them.

The rate of a segment is (x^{tau+1} - x^tau) / dt: on a straight segment the same all along, so a row a segment says it exactly.
The projection onto them is convex. ADMM solves it: copies of the differences are cut to the limit, and one product with a matrix
that depends on the pins, the weights and the horizon alone finds the trajectory nearest to copies and target together.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor

from cdiff_cli.constraint import Part, Pins, Pull, Rows, Traj
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.levels import each_end, take

ROUNDS = 6000  # of ADMM at most; from nothing to 1e-9 it takes 1300 to 2000 on the mazes' plans
RELAXATION = 1.7


@dataclass(frozen=True, eq=False)
class Rate:
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

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Rate":
        return replace(self, centre=self.centre + self.scale * centre, scale=self.scale * scale)

    def take(self, which: Tensor) -> "Rate":
        return take(self, which)

    def to(self, like: Tensor) -> "Rate":
        return replace(self, **{name: getattr(self, name).to(like) for name in self.trailing})

    def shift(self, margin: float) -> "Rate":
        low, high = self.low + margin, self.high - margin
        if high < (0.0 if self.norm else low):
            raise InfeasibleError(f'no rate of change is {margin:g} within the limits of "{self.name}"; relax one of them')
        return replace(self, low=low, high=high)

    shift_level = shift

    def segment_max(self, x: Traj) -> Rows:
        """A segment's own row: along it the rate does not change."""
        return self(x)

    def on_segments(self) -> tuple[Part, ...]:
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


@dataclass
class Slowed:
    """The projection onto limits of which no two share a coordinate, with the same pins, again and again: each call begins where
    the last one ended.

    close  how near the copies are to the differences in the end, environment units; None: 1e-10, in float32 1e-6
    warm   of each part that was not obeyed: copies of the differences and their scaled multipliers   [k, horizon - 1, batch]
    """

    parts: Sequence[Rate]
    pins: Pins
    close: float | None = None
    warm: dict[int, tuple[Tensor, Tensor]] = field(default_factory=dict)

    def __call__(self, z: Traj) -> Traj:
        """The nearest trajectory to z within the limits."""
        for i, part in enumerate(self.parts):
            z = self._onto(i, part, z)
        return z

    def _onto(self, i: int, part: Rate, z: Traj) -> Traj:
        batch, horizon, _ = z.shape
        if horizon < 2 or (i not in self.warm and not bool((part(z) > 0).any())):
            return z
        scale = part.scale @ part.which.T
        if scale.ndim == 3 and len(scale) > 1:
            return torch.cat([_alone(part, self.pins, z, b) for b in range(batch)])
        weight = scale.reshape(-1, scale.shape[-1]).expand(horizon, -1).T.square().reciprocal()
        held = self.pins.mask[:, part.which.argmax(1)].T
        fixed, M = _solver(tuple(map(tuple, held.tolist())), tuple(map(tuple, weight.tolist())), z.dtype, z.device)
        target = part.selected(z).permute(2, 1, 0)
        base = torch.where(held[..., None], target, 0.0)
        still, toward = base.diff(dim=1), base + fixed @ (weight[..., None] * target)
        step = target.diff(dim=1)
        copy, dual = self.warm.get(i) or (part.cut(step), torch.zeros_like(step))
        close, x = self.close or (1e-10 if z.dtype == torch.float64 else 1e-6), target
        for k in range(ROUNDS):
            x = toward + M @ (copy - dual - still)
            made = x.diff(dim=1)
            over = RELAXATION * made + (1 - RELAXATION) * copy + dual
            before, copy = copy, part.cut(over)
            dual = over - copy
            if k % 5 == 4 and max(float((made - copy).abs().max()), float((copy - before).abs().max())) < close:
                break
        self.warm[i] = copy, dual
        return z + ((x - target).permute(2, 1, 0) / scale) @ part.which


def _alone(part: Rate, pins: Pins, z: Traj, b: int) -> Traj:
    """The projection of one plan of a batch whose frames differ."""
    which = torch.tensor([b], device=z.device)
    return Slowed([part.take(which)], Pins(pins.mask, pins.values[which]))(z[which])


@lru_cache(maxsize=16)
def _solver(
    held: tuple[tuple[bool, ...], ...], weight: tuple[tuple[float, ...], ...], dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """The inverse of W + rho D^T D over the free waypoints, zero elsewhere, and its product with rho D^T, each [k, horizon, .]:
    D takes differences, W holds the weights of the waypoints in the distance. rho grows with the square of the horizon, as the
    time that a change takes from one end to the other.
    """
    fixed, w = torch.tensor(held), torch.tensor(weight, dtype=torch.float64)
    k, horizon = w.shape
    D = torch.eye(horizon, dtype=torch.float64).diff(dim=0)
    rho = float(w.mean()) * max(1.0, (horizon / 20) ** 2)
    inverse = torch.zeros(k, horizon, horizon, dtype=torch.float64)
    for c in range(k):
        free = (~fixed[c]).nonzero()[:, 0]
        A = rho * D.T @ D + w[c].diag()
        inverse[c, free[:, None], free] = torch.linalg.inv(A[free[:, None], free])
    return inverse.to(device, dtype), (rho * inverse @ D.T).to(device, dtype)


def independent(parts: Sequence[Rate]) -> bool:
    """Whether no two of them limit the same coordinate: their projections, one after another, are then that onto all."""
    limited = [name for part in parts for name in (part.which != 0).any(0).nonzero()[:, 0].tolist()]
    return len(limited) == len(set(limited))


def limits(low: float | None, high: float | None) -> tuple[float, float]:
    """Bounds, infinite where not given."""
    return (-math.inf if low is None else low), (math.inf if high is None else high)
