"""The nearest trajectory that linear dynamics make within convex limits of each waypoint, by a primal-dual interior-point method.

    minimise over q = (x, u)   sum |x - z|^2_W / 2   s.t.  x' = A x + B u + c,  o + L q in a cone,  start and goal pinned

at each waypoint: half-spaces, bounds of inputs and of single rates are cones of length one, a bound of a length is a longer one
(cones.py). Predictor and corrector by Mehrotra (1992) in the scaling of Nesterov and Todd; a Newton step is a linear-quadratic
problem over the horizon (stages.py). It takes 10 to 20 steps whatever the limits are, where active sets that act on changes, many
neighbours at once, take hundreds.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from cdiff_cli import cones, stages
from cdiff_cli.dynamics import LinearDynamics

STEPS = 50  # of Newton at most
RIDGE = 1e-9  # on the inputs
NEAR = 0.995  # share of the way to the boundary that a step goes
BEGIN = 0.1  # how far within its cone a slack is at least, and its product with the multiplier, at the beginning
SMALL = 1e-9  # mean product of slacks and multipliers, and residual, at which it ends
STUCK = 1e-8  # share of a step from which no more is to be had


class Limits(NamedTuple):
    """o + L q in a cone, at each waypoint   o [batch | 1, horizon | 1, c, k + 1], L [batch | 1, horizon | 1, c, k + 1, n + m]"""

    L: Tensor
    o: Tensor

    def of_steps(self, horizon: int) -> "Limits":
        """Of each step the same L [c, k + 1, n + m] and o [c, k + 1]; after the last state there is no step."""
        L, o = (v.repeat(1, horizon, *(1,) * v.ndim) for v in self)
        L[:, -1], o[:, -1] = 0.0, 0.0
        o[:, -1, :, 0] = 1.0
        return Limits(L, o)

    def __call__(self, q: Tensor) -> Tensor:
        """[batch, horizon, c, k + 1]"""
        return self.o + self.forward(q)

    def forward(self, d: Tensor) -> Tensor:
        return (self.L @ d[:, :, None, :, None])[..., 0]

    def back(self, y: Tensor) -> Tensor:
        """L^T y [batch, horizon, n + m]"""
        return (y[..., None, :] @ self.L)[..., 0, :].sum(2)


class Soft(NamedTuple):
    """What limits, and the pinned last state, give way by their multipliers; whether the last state's are carried on from step to
    step, so that it is met in the end whatever it gives way.
    """

    limits: float
    end: float
    carried: bool


HARD, YIELDING = Soft(1e-9, 1e-6, True), Soft(1e-7, 1e-4, False)


class Moment(NamedTuple):
    """Of one kind of limits at an iterate: its scaling, W y, by how much o + L q misses the slack, and how it gives way.

    first, share   of (W^2 + soft e e^T)^-1 = W^-2 - share first first^T, first = W^-2 e, e = (1, 0)
    """

    scaling: cones.Scaling
    v: Tensor
    miss: Tensor
    first: Tensor
    share: Tensor

    def solve(self, x: Tensor) -> Tensor:
        return self.scaling.over_twice(x) - self.share * self.first * (self.first * x).sum(-1, keepdim=True)

    def curvature(self, L: Tensor) -> Tensor:
        """Sum of L^T (W^2 + soft e e^T)^-1 L   [batch, horizon, n + m, n + m]"""
        columns = Moment(*(cones.Scaling(*(v[..., None, :] for v in self.scaling)), *(v[..., None, :] for v in self[1:])))
        return L.flatten(2, 3).mT @ columns.solve(L.mT).mT.flatten(2, 3)


def nearest(
    dynamics: LinearDynamics, limits: Sequence[Limits], z: Tensor, weight: Tensor, u: Tensor, end: Tensor, soft: Soft = HARD
) -> tuple[Tensor, Tensor]:
    """States [batch, horizon, n] nearest to z and the inputs that make them [batch, horizon - 1, m], begun at the inputs u.

    weight  of each coordinate in the distance   [n]
    end     which coordinates of the last state are to be those of z   [n]
    """
    n, m = dynamics.B.shape
    batch, horizon, _ = z.shape
    blocks = stages.blocks(dynamics)
    W = torch.cat((weight, weight.new_full((m,), RIDGE))).repeat(horizon, 1)
    W[-1, n:] = 1.0  # after the last state there is no input
    firm = torch.where(end, 1 / soft.end, 0.0).to(weight)
    heavy = W.clone()
    heavy[-1, :n] += firm
    target = torch.cat((z, z.new_zeros(batch, horizon, m)), 2)
    q = torch.cat((dynamics.rollout(z[:, 0], u), torch.nn.functional.pad(u, (0, 0, 0, 1))), 2)
    push = torch.zeros_like(z[:, 0])
    s = [_inside(each(q)) for each in limits]
    y = [BEGIN * cones.flip(v) / cones.determinant(v) for v in s]
    rank = horizon * sum(each.o.shape[2] for each in limits)
    open_ = torch.ones(batch, 1, 1, dtype=torch.bool, device=z.device)

    def far(ds: Sequence[Tensor], dy: Sequence[Tensor]) -> Tensor:
        ways = [cones.way_out(v, d).flatten(1).amin(1) for v, d in zip((*s, *y), (*ds, *dy), strict=True)]
        return torch.stack(ways).amin(0)[:, None, None]

    for _ in range(STEPS):
        now = [_moment(each, q, *pair, soft.limits) for each, *pair in zip(limits, s, y, strict=True)]
        mu = sum((v * w).sum((1, 2, 3)) for v, w in zip(s, y, strict=True))[:, None, None] / rank
        worst = torch.stack([one.miss.abs().amax((1, 2, 3)) for one in now]).amax(0)[:, None, None]
        open_ = open_ & ((mu > SMALL) | (worst > SMALL))
        if not bool(open_.any()):
            break
        H = sum(one.curvature(each.L) for one, each in zip(now, limits, strict=True))
        H.diagonal(dim1=2, dim2=3).add_(heavy)
        factors = stages.factor(blocks, H)
        slope = W * (q - target) - sum(each.back(w) for each, w in zip(limits, y, strict=True))
        slope[:, -1, :n] += firm * (q[:, -1, :n] - z[:, -1]) + push

        def step(aims: Sequence[Tensor]) -> tuple[Tensor, list[Tensor], list[Tensor]]:
            pulls = [one.solve(one.miss + one.scaling.times(cones.quotient(aim, one.v))) for one, aim in zip(now, aims, strict=True)]
            g = slope - sum(each.back(pull) for each, pull in zip(limits, pulls, strict=True))
            d = stages.minimiser(blocks, factors, g)
            ahead = [each.forward(d) for each in limits]
            dy = [pull - one.solve(v) for one, pull, v in zip(now, pulls, ahead, strict=True)]
            ds = [v - one.miss + soft.limits * _first(w) for one, v, w in zip(now, ahead, dy, strict=True)]
            return d, ds, dy

        here = [cones.product(one.v, one.v) for one in now]
        _, ds, dy = step([-v for v in here])
        a = far(ds, dy).clamp_max(1.0)[..., None]
        left = sum(((v + a * dv) * (w + a * dw)).sum((1, 2, 3)) for v, dv, w, dw in zip(s, ds, y, dy, strict=True))
        aim = mu * (left[:, None, None] / rank / mu).clamp(0.0, 1.0) ** 3
        bends = [cones.product(one.scaling.over(dv), one.scaling.times(dw)) for one, dv, dw in zip(now, ds, dy, strict=True)]
        d, ds, dy = step([aim[..., None] * _first(torch.ones_like(v)) - v - bend for v, bend in zip(here, bends, strict=True)])
        a = (NEAR * far(ds, dy)).clamp_max(1.0)
        open_ = open_ & (a > STUCK) & d.isfinite().all(2, keepdim=True).all(1, keepdim=True)
        a = torch.where(open_, a, 0.0)
        if soft.carried:
            push = push + a[:, 0] * firm * (q + d - target)[:, -1, :n]
        q = torch.where(open_, q + a * d, q)
        s = [torch.where(open_[..., None], v + a[..., None] * dv, v) for v, dv in zip(s, ds, strict=True)]
        y = [torch.where(open_[..., None], w + a[..., None] * dw, w) for w, dw in zip(y, dy, strict=True)]
    return q[..., :n], q[:, :-1, n:]


def _inside(s: Tensor) -> Tensor:
    """s, with s_0 raised where it is not well inside."""
    return torch.cat((torch.maximum(s[..., :1], s[..., 1:].norm(dim=-1, keepdim=True) + BEGIN), s[..., 1:]), -1)


def _first(x: Tensor) -> Tensor:
    """(x_0, 0)."""
    return torch.cat((x[..., :1], torch.zeros_like(x[..., 1:])), -1)


def _moment(limits: Limits, q: Tensor, s: Tensor, y: Tensor, soft: float) -> Moment:
    scaling = cones.scaling(s, y)
    first = scaling.over_twice(_first(torch.ones_like(s)))
    return Moment(scaling, scaling.times(y), s - limits(q) - soft * _first(y), first, soft / (1 + soft * first[..., :1]))
