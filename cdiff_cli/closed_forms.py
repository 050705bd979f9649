"""Exact projections onto one set: of a state onto a level's allowed set, of a trajectory onto a control-barrier chain."""

import torch
from torch import Tensor

from cdiff_cli.constraint import Chain, Pins, Rows, Traj
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.levels import Affine, Ellipsoid, Framed, Level, Quadric, dot, times


def nearest(level: Level, z: Tensor) -> Tensor:
    """The nearest state with f <= 0, for states z [..., dim]."""
    if isinstance(level, Affine):
        size = level.a.square().sum(-1).clamp_min(1e-30)
        return z - (level(z).clamp_min(0) / size)[..., None] * level.a
    if isinstance(level, Ellipsoid):
        return _nearest_ball(level, z) if level.is_ball else _nearest_quadric(level.quadric(), z)
    assert isinstance(level, Quadric | Framed)
    return _nearest_quadric(level if isinstance(level, Quadric) else level.multiplied_out(), z)


def _nearest_ball(ball: Ellipsoid, z: Tensor) -> Tensor:
    """Radially to the sphere; a point at the very centre goes along the first axis."""
    inner = z @ ball.which.T
    radial, radius = inner - ball.centre, ball.axes[..., :1]
    length = radial.norm(dim=-1, keepdim=True)
    first = torch.zeros_like(radial)
    first[..., 0] = 1.0
    unit = torch.where(length > 1e-12, radial / length.clamp_min(1e-12), first)
    wrong = length < radius if ball.side > 0 else length > radius
    moved = torch.where(wrong, ball.centre + radius * unit, inner)
    return z + (moved - inner) @ ball.which


def _nearest_quadric(quadric: Quadric, z: Tensor) -> Tensor:
    """min |x - z|^2 s.t. x.P x + q.x <= r, for P of any signature, by its scalar secular equation.

    In the eigenbasis of P stationarity reads y(mu) = (y0 - mu q / 2) / (1 + mu lambda); f(y(mu)) falls on
    0 <= mu < -1 / min(lambda), and its root there is the global minimiser (S-lemma). Bisection in float64.
    """
    wrong = quadric(z) > 0
    if not bool(wrong.any()):
        return z
    P, q, r = _of_states(quadric, wrong)
    eigenvalue, basis = torch.linalg.eigh(P)
    y0, q = times(z[wrong].double(), basis), times(q, basis)
    lowest = eigenvalue[..., 0]  # where it is below 0, f has a stationary point, and there its root would be missed: step off it
    stuck = (lowest < 0) & ((2 * y0[:, 0] * lowest + q[..., 0]).abs() < 1e-9 * eigenvalue.abs().amax(-1))
    y0[:, 0] = torch.where(stuck, y0[:, 0] + 1e-6, y0[:, 0])
    ceiling = torch.where(lowest < 0, -1 / lowest, torch.inf)

    def y(mu: Tensor) -> Tensor:
        return (y0 - mu[:, None] * q / 2) / (1 + mu[:, None] * eigenvalue)

    def f(mu: Tensor) -> Tensor:
        at = y(mu)
        return (at.square() * eigenvalue).sum(-1) + dot(at, q) - r

    low = torch.zeros(len(y0), dtype=torch.float64, device=z.device)
    high = torch.where(lowest < 0, ceiling * (1 - 1e-12), 1.0).expand_as(low)
    for _ in range(200):
        short = (f(high) > 0) & (lowest >= 0)
        if not bool(short.any()):
            break
        high = torch.where(short, 4 * high, high)
    if bool((f(high) > 1e-6 * (1 + r.abs())).any()):
        raise InfeasibleError("a quadratic constraint has no feasible point at all: x.P x + q.x never falls to r; raise r")
    for _ in range(100):
        middle = (low + high) / 2
        above = f(middle) > 0
        low, high = torch.where(above, middle, low), torch.where(above, high, middle)
    out = z.clone()
    out[wrong] = times(y(high), basis.mT).to(z)
    return out


def _of_states(quadric: Quadric, which: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """P, q, r in float64 of some states of a batch; those that all states share as they are."""
    P, q, r = (v.double() for v in (quadric.P, quadric.q, quadric.r))
    return (
        P if P.ndim == 2 else P.expand(*which.shape, *P.shape[-2:])[which],
        q if q.ndim == 1 else q.expand(*which.shape, q.shape[-1])[which],
        r if r.ndim == 0 else r.expand(which.shape)[which],
    )


# chains ---------------------------------------------------------------------------------------------------------------


def nearest_on_chain(chain: Chain, z: Traj, pins: Pins) -> Traj:
    """Project h(x^tau) onto the chain, then each waypoint onto its new level of h."""
    level, gamma = chain.level, 1 - chain.alpha
    if isinstance(level, Affine):
        slope = torch.where(pins.mask, 0.0, level.a)  # [horizon, dim], or by plan: only free coordinates move
        size = slope.square().sum(-1)
        h = -level(z)
        target = nearest_chain(h, gamma, 1 / size.clamp_min(1e-30), (size == 0).view(-1, z.shape[1]).all(0))
        return z - ((target - h) / size.clamp_min(1e-30))[..., None] * slope
    assert isinstance(level, Ellipsoid)
    y = level.scaled(z)
    length = y.norm(dim=-1, keepdim=True)
    unit = y / length.clamp_min(1e-12)
    unit[..., 0] = torch.where(length[..., 0] > 1e-12, unit[..., 0], 1.0)
    h = level.m * (length[..., 0] - 1)
    way = level.axes[..., 0] / level.m  # that a waypoint moves radially for h to grow by 1
    fixed = pins.mask[:, level.which.argmax(1)].any(1)
    target = nearest_chain(h, gamma, way.square().expand(*way.shape[:-1], h.shape[1]), fixed)
    if not fixed[0] or level.m.ndim > 0:
        target = torch.where(fixed, target, torch.maximum(target, _lowest_chain(-level.m, gamma, h)))
    step = (target - h) * way
    return z + (step[..., None] * unit) @ level.which


def _lowest_chain(low: Tensor, gamma: float, h: Rows) -> Tensor:
    """The lowest chain whose values are nowhere below `low` [], [horizon] or [batch, horizon]: v_k = max over i <= k of
    gamma^(k - i) low_i. Here h at the centre of a ball, below which it never falls: a bound on the first index, which the chain
    hands on, exact where the balls are all of one size.
    """
    power = _powers(gamma, h.shape[1] - 1, h)
    if low.ndim == 0 or low.shape[-1] == 1:
        return power * low
    index = torch.arange(h.shape[1], device=h.device)
    past = index - index[:, None]
    return torch.where(past >= 0, power[past.clamp_min(0)] * low[..., None], -torch.inf).amax(-2)


def nearest_chain(h: Rows, gamma: float, weight: Tensor, fixed: Tensor) -> Rows:
    """min sum_k w_k (v_k - h_k)^2  s.t.  v_{k+1} >= gamma v_k, v_k = h_k where fixed.

    In y_k = v_k / gamma^k this is isotonic regression: pooled adjacent violators. The fixed ends bound it, and a bounded
    isotonic regression is the clipped one. Computed in float64, returned in the dtype of h.

    h [batch, n], weight [n] or [batch, n] > 0, fixed [n] (only a first and a last run of indices may be fixed)
    """
    n = h.shape[1]
    free = torch.nonzero(~fixed)[:, 0]
    if len(free) == 0:
        return h
    first, last = int(free[0]), int(free[-1]) + 1
    best, _ = pool_violators(h[:, first:last].double(), gamma, weight[..., first:last].double())
    if last - first == n:
        return best.to(h)
    power = _powers(gamma, last - first, best)[1:]
    if first > 0:
        best = torch.maximum(best, power * h[:, first - 1 : first])
    if last < n:  # powers are kept off 0: a last value of 0 bounds all by 0, and a bound must fit into the dtype of h
        best = torch.minimum(best, h[:, last : last + 1] / power.flip(0).clamp_min(torch.finfo(h.dtype).tiny ** 0.5))
    return torch.cat((h[:, :first], best.to(h), h[:, last:]), 1)


def pool_violators(h: Rows, gamma: float, weight: Tensor) -> tuple[Rows, int]:
    """The nearest chain to h by pooled adjacent violators, and the number of rounds it took.

    A block of value v that starts at index s stands for v, gamma v, gamma^2 v, ...; the value nearest to its h is

        v = N / D,   N = sum_k w_k gamma^(k - s) h_k,   D = sum_k w_k gamma^(2 (k - s))

    and the next block violates if its value is < gamma^length v. A round merges every run of consecutive violators, of all
    plans at once. Powers count from the first index of the merged block: they are at most 1, the first is 1, and one that
    underflows belongs to a term that no longer counts.

    Rounds (tests/benchmarks/chain.py): at gamma = 0.95 at most 17 for noise, random walks and smooth curves up to n = 1536; at
    gamma = 0.999 and n = 384 noise takes 10, a walk 25, a smooth curve 47. The worst measured is a lone value far below the
    end of a rise or far above its beginning, which takes in one neighbour a round: as many as n rounds, or about
    log(distance) / log(1 / gamma) where that is fewer.

    h [batch, n], weight [n] or [batch, n] > 0
    """
    batch, n = h.shape
    power = _powers(gamma, n, h)
    powers = torch.stack((power, power.square()))
    sums = h.new_full((2, batch, n + 1), torch.nan)  # N and D of all plans on one line; a NaN between two violates nothing
    sums[0, :, :n], sums[1, :, :n] = weight * h, weight
    sums = sums.flatten(1)
    index = torch.arange(sums.shape[1] + 1, device=h.device)
    start, value, rounds = index, sums[0] / sums[1], 0  # start: of each block, then the end of the line
    due = gamma * value  # what the next block has to reach
    while True:
        leads = torch.ones_like(start, dtype=torch.bool)  # the blocks that stay, then the end of the line
        torch.logical_not(value[1:] < due[:-1], out=leads[1:-1])
        lead = leads.nonzero()[:, 0]
        if len(lead) == len(start):
            break
        rounds += 1
        into = leads[:-1].cumsum(0) - 1
        merged = start.index_select(0, lead)
        scale = powers.index_select(1, start[:-1] - merged.index_select(0, into))
        sums = sums.new_zeros(2, len(lead) - 1).index_add_(1, into, scale * sums)
        start, value = merged, sums[0] / sums[1]
        due = power.index_select(0, start[1:] - start[:-1]) * value
    if rounds == 0:
        return h, 0
    block = torch.repeat_interleave(start[1:] - start[:-1])
    v = value.index_select(0, block) * power.index_select(0, index[:-1] - start.index_select(0, block))
    return v.view(batch, n + 1)[:, :n], rounds


def _powers(gamma: float, n: int, like: Tensor) -> Tensor:
    """gamma^0, ..., gamma^n."""
    return gamma ** torch.arange(n + 1, device=like.device).to(like.dtype)
