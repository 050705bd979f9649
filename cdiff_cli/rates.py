"""Limits on how fast coordinates change between waypoints, and the nearest trajectory within them.

The rate of a segment is (x^{tau+1} - x^tau) / dt: on a straight segment the same all along, so a row a segment says it exactly.
The projection onto them is convex. ADMM solves it: each limit cuts its own copy of the differences, and one product with a matrix
that depends on the pins, the weights and the horizon alone finds the trajectory nearest to all copies and target together.
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

    def state_values(self, x: Traj) -> Rows:
        return torch.nn.functional.pad(self(x), (1, 0), value=-torch.inf)

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
    """The projection onto limits with the same pins, again and again: each call begins where the last one ended.

    parts  of one frame, as those of a constraint are
    warm   by group of limits that was not obeyed: copies of the differences and their scaled multipliers, the limits' one after
           another   [k, horizon - 1, batch]
    """

    parts: Sequence[Rate]
    pins: Pins
    warm: dict[int, tuple[Tensor, Tensor]] = field(default_factory=dict)

    def __call__(self, z: Traj) -> Traj:
        """The nearest trajectory to z within the limits."""
        for i, group in enumerate(coupled(self.parts)):
            z = self._onto(i, group, z)
        return z

    def _onto(self, i: int, parts: Sequence[Rate], z: Traj) -> Traj:
        batch, horizon, _ = z.shape
        if horizon < 2 or (i not in self.warm and not any(bool((part(z) > 0).any()) for part in parts)):
            return z
        scale, centre = parts[0].scale, parts[0].centre
        if scale.ndim == 3 and len(scale) > 1:
            return torch.cat([_alone(parts, self.pins, z, b) for b in range(batch)])
        limited = torch.cat([part.which for part in parts]).argmax(1).tolist()
        columns = list(dict.fromkeys(limited))
        of = torch.tensor([columns.index(c) for c in limited], device=z.device)  # the column of each copy
        scale, centre = scale[..., columns], centre[..., columns]
        each = torch.split(of, [len(part.which) for part in parts])
        weight = scale.reshape(-1, len(columns)).expand(horizon, -1).T.square().reciprocal()
        held = self.pins.mask[:, columns].T
        listed = (tuple(map(tuple, v)) for v in (held.tolist(), weight.tolist(), [w.tolist() for w in each]))
        inverse, M = _solver(*listed, z.dtype, z.device)
        single = len(parts) == 1
        target = (centre + scale * z[..., columns]).permute(2, 1, 0)
        base = torch.where(held[..., None], target, 0.0)
        still, toward = base.diff(dim=1)[of], base + inverse @ (weight[..., None] * target)
        step = target.diff(dim=1)[of]
        copy, dual = self.warm.get(i) or (_cut(parts, step), torch.zeros_like(step))
        close, x = 1e-10 if z.dtype == torch.float64 else 1e-6, target
        for k in range(ROUNDS):
            pushed = M @ (copy - dual - still)
            x = toward + pushed if single else toward.index_add(0, of, pushed)
            made = x.diff(dim=1) if single else x.diff(dim=1)[of]
            over = RELAXATION * made + (1 - RELAXATION) * copy + dual
            before, copy = copy, _cut(parts, over)
            dual = over - copy
            if k % 5 == 4 and max(float((made - copy).abs().max()), float((copy - before).abs().max())) < close:
                break
        self.warm[i] = copy, dual
        out = z.clone()
        out[..., columns] += (x - target).permute(2, 1, 0) / scale
        return out


def _cut(parts: Sequence[Rate], change: Tensor) -> Tensor:
    """Changes, the limits' one after another, each brought within its own."""
    if len(parts) == 1:
        return parts[0].cut(change)
    each = torch.split(change, [len(part.which) for part in parts])
    return torch.cat([part.cut(one) for part, one in zip(parts, each, strict=True)])


def coupled(parts: Sequence[Rate]) -> list[list[Rate]]:
    """The limits in groups of which no two share a coordinate: their projections, one after another, are then that onto all."""
    groups: list[list[Rate]] = []
    for part in parts:
        meeting = [group for group in groups if any(bool((part.which.sum(0) * other.which.sum(0) != 0).any()) for other in group)]
        groups = [group for group in groups if group not in meeting] + [[*(one for group in meeting for one in group), part]]
    return groups


def _alone(parts: Sequence[Rate], pins: Pins, z: Traj, b: int) -> Traj:
    """The projection of one plan of a batch whose frames differ."""
    which = torch.tensor([b], device=z.device)
    return Slowed([part.take(which) for part in parts], Pins(pins.mask, pins.values[which]))(z[which])


@lru_cache(maxsize=16)
def _solver(
    held: tuple[tuple[bool, ...], ...],
    weight: tuple[tuple[float, ...], ...],
    limited: tuple[tuple[int, ...], ...],
    dtype: torch.dtype,
    device: torch.device,
) -> tuple[Tensor, Tensor]:
    """For the nearest trajectory to targets and copies together: the inverse of W + (sum of rho over the limits) D^T D over the
    free waypoints, zero elsewhere, of each column; and, of each copy, that of its column times rho D^T, [., horizon, .]. D takes
    differences, W holds the weights of the waypoints in the distance, `limited` the columns of each limit. rho grows with the
    square of the horizon, as the time that a change takes from one end to the other.
    """
    fixed, w = torch.tensor(held), torch.tensor(weight, dtype=torch.float64)
    count, horizon = w.shape
    D = torch.eye(horizon, dtype=torch.float64).diff(dim=0)
    rho = [float(w[list(own)].mean()) * max(1.0, (horizon / 20) ** 2) for own in limited]
    total = [sum(r for r, own in zip(rho, limited, strict=True) if c in own) for c in range(count)]
    inverse = torch.zeros(count, horizon, horizon, dtype=torch.float64)
    for c in range(count):
        free = (~fixed[c]).nonzero()[:, 0]
        A = total[c] * D.T @ D + w[c].diag()
        inverse[c, free[:, None], free] = torch.linalg.inv(A[free[:, None], free])
    pushes = torch.cat([r * inverse[list(own)] @ D.T for r, own in zip(rho, limited, strict=True)])
    return inverse.to(device, dtype), pushes.to(device, dtype)


def refuse_contradiction(parts: Sequence[Rate]) -> None:
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
    raise InfeasibleError(f'no rate of change is within the limits of both "{one}" and "{other}"; relax one of them')


def limits(low: float | None, high: float | None) -> tuple[float, float]:
    """Bounds, infinite where not given."""
    return (-math.inf if low is None else low), (math.inf if high is None else high)
