"""The nearest trajectory within limits on rates, by ADMM on the differences between waypoints."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import RateLimit

MAX_ROUNDS = 6000  # rounds of ADMM; 1300 to 2000 reach 1e-9 on plans of the mazes from a cold start
RELAXATION = 1.7  # over-relaxation of ADMM
CHECKED = 5  # rounds between two tests for convergence
CONVERGED = {
    torch.float64: 1e-10,
    torch.float32: 1e-6,
}  # change per round at the end, environment units


@dataclass
class RateProjection:
    """The projection onto limits, for many calls with the same pins: each starts from the last one.

    parts      limits on trajectories in one frame
    previous   per group of coupled limits that were violated: the copies of the differences and
               their scaled multipliers, one limit after another   [k, horizon - 1, batch]
    """

    parts: Sequence[RateLimit]
    pins: Pins
    previous: dict[int, tuple[Tensor, Tensor]] = field(default_factory=dict)

    def __call__(self, z: Traj) -> Traj:
        """The nearest trajectory to z within the limits."""
        for i, group in enumerate(coupled(self.parts)):
            z = self._onto_group(i, group, z)
        return z

    def _onto_group(self, i: int, parts: Sequence[RateLimit], z: Traj) -> Traj:
        """The nearest trajectory to z within the i-th group of coupled limits."""
        if z.shape[1] < 2:
            return z
        if i not in self.previous and not any(bool((part(z) > 0).any()) for part in parts):
            return z
        if parts[0].scale.ndim == 3 and len(parts[0].scale) > 1:
            return torch.cat([_single(parts, self.pins, z, b) for b in range(len(z))])
        problem = _differences(parts, self.pins, z)
        x, copy, dual = _admm(parts, problem, self.previous.get(i), CONVERGED[z.dtype])
        self.previous[i] = copy, dual
        out = z.clone()
        out[..., problem.columns] += (x - problem.target).permute(2, 1, 0) / problem.scale
        return out


class Differences(NamedTuple):
    """The problem min |x - target|^2 s.t. limits on differences of x, per column and waypoint.

    columns     coordinates that are limited                     c of them
    scale       environment units per unit of z                  [..., c]
    target      in environment units                             [c, horizon, batch]
    column_of   the column of each copy                          [k]
    base        target at pinned waypoints, 0 elsewhere          [c, horizon, batch]
    inverse     see _solver                                      [c, horizon, horizon]
    pushes      see _solver                                      [k, horizon, horizon - 1]
    weight      weight per column and waypoint in the distance   [c, horizon]
    """

    columns: list[int]
    scale: Tensor
    target: Tensor
    column_of: Tensor
    base: Tensor
    inverse: Tensor
    pushes: Tensor
    weight: Tensor


def _differences(parts: Sequence[RateLimit], pins: Pins, z: Traj) -> Differences:
    """The problem of one group of coupled limits."""
    limited = torch.cat([part.which for part in parts]).argmax(1).tolist()
    columns = list(dict.fromkeys(limited))
    index = torch.tensor([columns.index(c) for c in limited], device=z.device)
    scale, centre = parts[0].scale[..., columns], parts[0].centre[..., columns]
    weight = scale.reshape(-1, len(columns)).expand(z.shape[1], -1).T.square().reciprocal()
    held = pins.mask[:, columns].T
    per_limit = [w.tolist() for w in torch.split(index, [len(part.which) for part in parts])]
    listed = (tuple(map(tuple, v)) for v in (held.tolist(), weight.tolist(), per_limit))
    inverse, pushes = _solver(*listed, z.dtype, z.device)
    target = (centre + scale * z[..., columns]).permute(2, 1, 0)
    base = torch.where(held[..., None], target, 0.0)
    return Differences(columns, scale, target, index, base, inverse, pushes, weight)


def _admm(
    parts: Sequence[RateLimit],
    problem: Differences,
    previous: tuple[Tensor, Tensor] | None,
    converged: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """The nearest x [c, horizon, batch], the copies of its differences and scaled multipliers."""
    _, _, target, index, base, inverse, pushes, weight = problem
    single = len(parts) == 1
    fixed, toward = base.diff(dim=1)[index], base + inverse @ (weight[..., None] * target)
    change = target.diff(dim=1)[index]
    copy, dual = previous or (_nearest_changes(parts, change), torch.zeros_like(change))
    x = target
    for k in range(1, MAX_ROUNDS + 1):
        push = pushes @ (copy - dual - fixed)
        x = toward + push if single else toward.index_add(0, index, push)
        change = x.diff(dim=1) if single else x.diff(dim=1)[index]
        relaxed = RELAXATION * change + (1 - RELAXATION) * copy + dual
        last, copy = copy, _nearest_changes(parts, relaxed)
        dual = relaxed - copy
        if k % CHECKED == 0:
            miss, moved = (change - copy).abs().max(), (copy - last).abs().max()
            if max(float(miss), float(moved)) < converged:
                break
    return x, copy, dual


def _nearest_changes(parts: Sequence[RateLimit], change: Tensor) -> Tensor:
    """The nearest changes within the limits, one limit after another along the first dimension."""
    if len(parts) == 1:
        return parts[0].nearest_change(change)
    each = torch.split(change, [len(part.which) for part in parts])
    near = [part.nearest_change(one) for part, one in zip(parts, each, strict=True)]
    return torch.cat(near)


def coupled(parts: Sequence[RateLimit]) -> list[list[RateLimit]]:
    """The limits in groups that share no coordinate.

    The projections onto the groups, one after another, are the projection onto all limits.
    """
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


def _single(parts: Sequence[RateLimit], pins: Pins, z: Traj, b: int) -> Traj:
    """The projection of plan b of a batch whose frames differ."""
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
    """The matrices of the nearest trajectory to targets and copies together.

    Per column the inverse of W + sum(rho) D^T D over the free waypoints, zero elsewhere, with the
    sum over the limits on that column. Per copy this inverse times rho D^T. D takes differences and
    W holds the weights of the waypoints in the distance. rho grows with the square of the horizon,
    as the number of rounds does that a change takes from one end to the other.

    held      whether each waypoint is pinned      per column
    weight    weight of each waypoint              per column
    limited   indices of the columns               per limit
    """
    fixed, w = torch.tensor(held), torch.tensor(weight, dtype=torch.float64)
    count, horizon = w.shape
    D = torch.eye(horizon, dtype=torch.float64).diff(dim=0)
    rho = [float(w[list(cs)].mean()) * max(1.0, (horizon / 20) ** 2) for cs in limited]
    total = [sum(r for r, cs in zip(rho, limited, strict=True) if c in cs) for c in range(count)]
    inverse = torch.zeros(count, horizon, horizon, dtype=torch.float64)
    for c in range(count):
        free = (~fixed[c]).nonzero()[:, 0]
        A = total[c] * D.T @ D + w[c].diag()
        inverse[c, free[:, None], free] = torch.linalg.inv(A[free[:, None], free])
    pushes = torch.cat([r * inverse[list(cs)] @ D.T for r, cs in zip(rho, limited, strict=True)])
    return inverse.to(device, dtype), pushes.to(device, dtype)
