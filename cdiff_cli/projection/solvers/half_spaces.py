"""Half-spaces per waypoint, and the nearest trajectory that satisfies a few of them."""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from cdiff_cli.arrays import Traj

NEVER = 1e30  # bound b of a half-space that restricts nothing


class HalfSpaces(NamedTuple):
    """Half-spaces a.x <= b of each waypoint.

    a   [batch, horizon, m, dim]
    b   [batch, horizon, m]; NEVER where there is none
    """

    a: Tensor
    b: Tensor

    def select(self, plans: Tensor) -> "HalfSpaces":
        """The half-spaces of some plans of the batch alone."""
        return HalfSpaces(self.a[plans], self.b[plans])


def nearest_in_half_spaces(z: Traj, half_spaces: HalfSpaces, held: Tensor) -> Traj:
    """The nearest trajectory to z [batch, horizon, dim] with a.x <= b at every free waypoint.

    Exact with up to two active half-spaces per waypoint, which is always enough in the plane. Where
    more are active, the best point that two of them give.

    held   waypoints that stay as they are   [horizon]
    """
    a, b = half_spaces
    value = (a * z[:, :, None]).sum(-1) - b
    wrong = (value.amax(2) > 0) & ~held
    at = wrong.flatten().nonzero()[:, 0]
    if not len(at):
        return z
    m, dim = a.shape[2:]
    rows = a.permute(3, 2, 0, 1).reshape(dim, m, -1).index_select(2, at).double()
    step = _step(rows, value.permute(2, 0, 1).reshape(m, -1).index_select(1, at).double())
    return z.flatten(0, 1).index_add(0, at, step.T.to(z)).view(z.shape)


@lru_cache(maxsize=16)
def _pairs(m: int, device: torch.device) -> Tensor:
    """The first and the second row of every pair, or the only row twice [2, pairs]."""
    return torch.triu_indices(m, m, 1 if m > 1 else 0, device=device)


def _step(a: Tensor, value: Tensor) -> Tensor:
    """The shortest d with value + a.d <= 0, among those for which one row or two rows are active.

    Two unit rows with cosine c have the multipliers mu = (v - c v_other) / (1 - c^2) if neither is
    negative. A row whose partner has no multiplier is active alone, with mu = [v]_+.

    a [dim, m, n], value [m, n] -> d [dim, n]
    """
    size = a.square().sum(0).sqrt_().clamp_min_(1e-15)
    a, value = a / size, value / size
    if a.shape[1] == 2:
        two, v = a[:, :, None], value[:, None]
    else:
        pairs = _pairs(a.shape[1], a.device)
        two, v = a[:, pairs], value[pairs]  # [dim, 2, pairs, n], [2, pairs, n]
    cosine = (two[:, 0] * two[:, 1]).sum(0)
    det = 1 - cosine.square()
    parallel = det < 1e-9
    mu = v - cosine * v.flip(0)
    if bool(parallel.any()):
        larger = v[0] >= v[1]
        mu = torch.where(parallel, torch.stack((larger, ~larger)).to(mu) - 0.5, mu)
        det = torch.where(parallel, 1.0, det)
    mu = torch.where(mu.flip(0) > 0, (mu / det).clamp_min_(0), v.clamp_min(0))
    d = -(mu * two).sum(1)  # [dim, pairs, n]
    if d.shape[1] == 1:
        return d[:, 0]
    missed = ((d[:, :, None] * a[:, None]).sum(0) + value).amax(1)  # [pairs, n]
    cost = torch.where(missed <= 1e-9, d.square().sum(0), 1e12 * (1 + missed))
    return d.gather(1, cost.argmin(0).expand(len(d), 1, -1))[:, 0]
