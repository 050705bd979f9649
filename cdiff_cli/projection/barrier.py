"""The nearest trajectory that satisfies a discrete barrier, exactly.

The values of the barrier h are projected onto

    h_{k+1} >= gamma h_k                                         plain: isotonic regression
    h_{k+2} - (gamma + gamma2) h_{k+1} + gamma gamma2 h_k >= 0   high-order: a small QP

weighted by the distance that a waypoint moves per change of h. Each waypoint then moves to its new
level set. Level sets of half-spaces are planes and those of balls are spheres, so the nearest point
is along the normal and the result is the nearest trajectory.
"""

import torch
from torch import Tensor

from cdiff_cli.arrays import Rows, Traj, times
from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.hocbf import BallHOCBF
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.state_sets import Ellipsoid, HalfSpace
from cdiff_cli.projection.solvers.isotonic import nearest_between, powers
from cdiff_cli.projection.solvers.nonnegative_qp import nonnegative_least

MAX_LINEARISATIONS = 12  # linearisations of a barrier; three or four reach rounding
NUDGE = 1e-18  # added to the first axis, so that the centre of a ball itself has a direction


def has_barrier_projection(part: DiscreteBarrier) -> bool:
    """Whether project_barrier takes the state set of the part."""
    level = part.acting
    outside_ball = isinstance(level, Ellipsoid) and level.side == "outside" and level.is_ball
    return isinstance(level, HalfSpace | BallHOCBF) or outside_ball


def project_barrier(chain: DiscreteBarrier, z: Traj, pins: Pins) -> Traj:
    """The nearest trajectory to z with g <= 0; waypoints are pinned as a whole or not at all."""
    level = chain.acting
    if isinstance(level, BallHOCBF):
        return _by_linearising(chain, level, z, pins)
    if isinstance(level, HalfSpace):
        h, unit = -level(z), -level.a
        way = level.a.square().sum(-1).clamp_min(1e-30).rsqrt()
        low = None
        unit = unit * way[..., None]
    else:
        assert isinstance(level, Ellipsoid)
        y = level.scaled(z)
        y[..., 0] += NUDGE
        length = y.norm(dim=-1)
        h, way, low = level.m * (length - 1), level.axes[..., 0] / level.m, -level.m
    if not bool((chain.rows_of(-h) > 0).any()):
        return z
    target = _nearest_values(chain, h, way.square().expand(*way.shape[:-1], h.shape[1]), low, pins)
    step = (target - h) * way
    if isinstance(level, Ellipsoid):
        return z + times((step / length)[..., None] * y, level.which)
    return z + step[..., None] * unit


def _by_linearising(chain: DiscreteBarrier, level: BallHOCBF, z: Traj, pins: Pins) -> Traj:
    """A locally nearest trajectory to z, by projections onto linearised barriers.

    The barrier of each waypoint is linearised at the last iterate, and the waypoint moves along its
    gradient. The last iterate satisfies the barrier up to rounding.
    """
    x = z
    for _ in range(MAX_LINEARISATIONS):
        h = -level(x)
        if not bool((chain.rows_of(-h) > 0).any()) and x is not z:
            break
        slope = -level.gradient(x)
        size = slope.square().sum(-1).clamp_min(1e-30)
        h_at_z = h + (slope * (z - x)).sum(-1)  # of the linearised barrier
        target = _nearest_values(chain, h_at_z, 1 / size, None, pins)
        x = z + ((target - h_at_z) / size)[..., None] * slope
    return x


def _nearest_values(
    chain: DiscreteBarrier, h: Rows, weight: Tensor, low: Tensor | None, pins: Pins
) -> Rows:
    """The nearest values to h that the barrier allows, with those of pinned waypoints kept.

    low   the lowest possible value, h at the centre of a ball: [] or with leading dimensions as a
          parameter of the state set
    """
    first, last = pins.loose
    if chain.alpha2 is not None:
        return _nearest_under(chain, h, weight, low, first, last)
    gamma = 1 - chain.alpha
    target = nearest_between(h, gamma, weight, first, last)
    by_waypoint = low is not None and low.ndim > 0 and low.shape[-1] > 1
    if low is not None and (first == 0 or by_waypoint):
        return torch.where(pins.held, target, torch.maximum(target, _lowest_chain(low, gamma, h)))
    return target


def _lowest_chain(low: Tensor, gamma: float, h: Rows) -> Tensor:
    """The lowest values that satisfy the barrier and are nowhere below `low`.

    v_k = max over i <= k of gamma^(k - i) low_i. This is exact where all balls have the same size.

    low   [], [horizon | 1] or [batch | 1, horizon | 1]
    """
    power = powers(gamma, h.shape[1] - 1, h)
    if low.ndim == 0 or low.shape[-1] == 1:
        return power * low
    index = torch.arange(h.shape[1], device=h.device)
    past = index - index[:, None]
    return torch.where(past >= 0, power[past.clamp_min(0)] * low[..., None], -torch.inf).amax(-2)


# high-order barriers ------------------------------------------------------------------------------


def _nearest_under(
    chain: DiscreteBarrier, h: Rows, weight: Tensor, low: Tensor | None, first: int, last: int
) -> Rows:
    """min sum_k w_k (v_k - h_k)^2  s.t.  D v >= 0,  v_k = h_k outside first to last, by its dual.

    Where the solution is below `low`, the least values that `low` and D allow replace it: feasible,
    if not the nearest.
    """
    one, free = torch.eye(h.shape[1], dtype=torch.float64, device=h.device), slice(first, last)
    D, v = chain.rows_of(one).T, h.to(torch.float64, copy=True)
    v[:, free] += _by_dual(D[:, free], v @ D.T, 1 / weight.double()[..., free])
    if low is not None and bool((v < low).any()):
        order = len(chain.coefficients) - 1
        v = torch.maximum(v, low)
        for k in range(max(first, order), last):
            least = sum(
                (-c * v[:, k - order + i] for i, c in enumerate(chain.coefficients[:-1])),
                torch.zeros_like(v[:, 0]),
            )
            v[:, k] = torch.maximum(v[:, k], least)
    return v.to(h)


def _by_dual(D: Tensor, b: Tensor, way: Tensor) -> Tensor:
    """min sum_k d_k^2 / way_k  s.t.  b + D d >= 0, by its dual: d [batch, n].

        d = way D^T lam,   lam >= 0,   b + Q lam >= 0,   lam (b + Q lam) = 0,   Q = D way D^T

    D [r, n], b [batch, r], way [n] or [batch, n]
    """
    Q = (D * way[..., None, :]) @ D.T
    return (nonnegative_least(Q, -b, 1e-12 * (1 + b.abs().amax(1, keepdim=True))) @ D) * way
