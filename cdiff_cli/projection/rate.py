"""The nearest trajectory within limits on rates: ADMM on the differences between waypoints."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import torch
from torch import Tensor

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import RateLimit

ROUNDS = 6000  # of ADMM at most; from nothing to 1e-9 it takes 1300 to 2000 on the mazes' plans
RELAXATION = 1.7


@dataclass
class RateProjection:
    """The projection onto limits with the same pins, again and again: each call begins where the last one ended.

    parts  of one frame, as those of a constraint are
    warm   by group of limits that was not obeyed: copies of the differences and their scaled multipliers, the limits' one after
           another   [k, horizon - 1, batch]
    """

    parts: Sequence[RateLimit]
    pins: Pins
    warm: dict[int, tuple[Tensor, Tensor]] = field(default_factory=dict)

    def __call__(self, z: Traj) -> Traj:
        """The nearest trajectory to z within the limits."""
        for i, group in enumerate(coupled(self.parts)):
            z = self._onto(i, group, z)
        return z

    def _onto(self, i: int, parts: Sequence[RateLimit], z: Traj) -> Traj:
        batch, horizon, _ = z.shape
        if horizon < 2 or (
            i not in self.warm and not any(bool((part(z) > 0).any()) for part in parts)
        ):
            return z
        scale, centre = parts[0].scale, parts[0].centre
        if scale.ndim == 3 and len(scale) > 1:
            return torch.cat([_alone(parts, self.pins, z, b) for b in range(batch)])
        limited = torch.cat([part.which for part in parts]).argmax(1).tolist()
        columns = list(dict.fromkeys(limited))
        of = torch.tensor(
            [columns.index(c) for c in limited], device=z.device
        )  # the column of each copy
        scale, centre = scale[..., columns], centre[..., columns]
        each = torch.split(of, [len(part.which) for part in parts])
        weight = scale.reshape(-1, len(columns)).expand(horizon, -1).T.square().reciprocal()
        held = self.pins.mask[:, columns].T
        listed = (
            tuple(map(tuple, v))
            for v in (held.tolist(), weight.tolist(), [w.tolist() for w in each])
        )
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
            if (
                k % 5 == 4
                and max(float((made - copy).abs().max()), float((copy - before).abs().max()))
                < close
            ):
                break
        self.warm[i] = copy, dual
        out = z.clone()
        out[..., columns] += (x - target).permute(2, 1, 0) / scale
        return out


def _cut(parts: Sequence[RateLimit], change: Tensor) -> Tensor:
    """Changes, the limits' one after another, each brought within its own."""
    if len(parts) == 1:
        return parts[0].cut(change)
    each = torch.split(change, [len(part.which) for part in parts])
    return torch.cat([part.cut(one) for part, one in zip(parts, each, strict=True)])


def coupled(parts: Sequence[RateLimit]) -> list[list[RateLimit]]:
    """The limits in groups of which no two share a coordinate: their projections, one after another, are then that onto all."""
    groups: list[list[RateLimit]] = []
    for part in parts:
        meeting = [
            group
            for group in groups
            if any(bool((part.which.sum(0) * other.which.sum(0) != 0).any()) for other in group)
        ]
        groups = [group for group in groups if group not in meeting] + [
            [*(one for group in meeting for one in group), part]
        ]
    return groups


def _alone(parts: Sequence[RateLimit], pins: Pins, z: Traj, b: int) -> Traj:
    """The projection of one plan of a batch whose frames differ."""
    which = torch.tensor([b], device=z.device)
    return RateProjection(
        [part.select(which) for part in parts], Pins(pins.mask, pins.values[which])
    )(z[which])


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
