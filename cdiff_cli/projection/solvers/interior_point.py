"""The nearest trajectory that linear dynamics make within convex limits of each waypoint, by a primal-dual interior-point method.

    minimise over q = (x, u)   sum |x - z|^2_W / 2   s.t.  x' = A x + B u + c,  o + L q in a cone,  start and goal pinned

at each waypoint: half-spaces, bounds of inputs and of single rates are cones of length one, a bound of a length is a longer one
(second_order_cone.py). Predictor and corrector by Mehrotra (1992) in the scaling of Nesterov and Todd; a Newton step is a linear-quadratic
problem over the horizon (riccati.py). On the mazes' plans it takes 13 to 31 of them, whatever the limits.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from cdiff_cli.projection.solvers import riccati, second_order_cone

STEPS = 50  # of Newton at most
RIDGE = 1e-9  # on the inputs
NEAR = 0.995  # share of the way to the boundary that a step goes
INITIAL_SLACK = 0.1  # how far within its cone a slack is at least, and its product with the multiplier, at the beginning
SMALL = 1e-12  # mean product of slacks and multipliers, and largest residual, at which it ends
STUCK = 1e-8  # share of a step from which no more is to be had


class ConicLimits(NamedTuple):
    """o + L q in a cone, at each waypoint   o [batch | 1, horizon | 1, c, k + 1], L [batch | 1, horizon | 1, c, k + 1, n + m]"""

    L: Tensor
    o: Tensor

    def of_steps(self, horizon: int) -> "ConicLimits":
        """Of each step the same L [c, k + 1, n + m] and o [c, k + 1]; after the last state there is no step."""
        L, o = (v.repeat(1, horizon, *(1,) * v.ndim) for v in self)
        L[:, -1], o[:, -1] = 0.0, 0.0
        o[:, -1, :, 0] = 1.0
        return ConicLimits(L, o)

    def select(self, which: Tensor) -> "ConicLimits":
        """Of some trajectories of the batch alone."""
        return ConicLimits(*(v[which] if len(v) > 1 else v for v in self))

    def __call__(self, q: Tensor) -> Tensor:
        """[batch, horizon, c, k + 1]"""
        return self.o + self.forward(q)

    def forward(self, d: Tensor) -> Tensor:
        return (self.L @ d[:, :, None, :, None])[..., 0]

    def back(self, y: Tensor) -> Tensor:
        """L^T y [batch, horizon, n + m]"""
        return (y[..., None, :] @ self.L)[..., 0, :].sum(2)

    def missed(self, q: Tensor) -> Tensor:
        """How far q is out of the cones, negative where it is inside [batch]."""
        s = self(q)
        return (s[..., 1:].norm(dim=-1) - s[..., 0]).amax((1, 2))


class Soft(NamedTuple):
    """What limits, and the pinned last state, give way by their multipliers; whether the last state's are carried on from step to
    step, so that it is met in the end whatever it gives way.
    """

    limits: float
    end: float
    carried: bool


HARD, YIELDING = Soft(1e-11, 1e-6, True), Soft(1e-7, 1e-4, False)


class Iterate(NamedTuple):
    """q, slacks and multipliers of each kind of limits, or a step of them; the multiplier of the last state [batch, n]."""

    q: Tensor
    s: list[Tensor]
    y: list[Tensor]
    push: Tensor


class Moment(NamedTuple):
    """Of one kind of limits at an iterate: its scaling, v = W y, by how much the slack differs from o + L q, and how it gives way.

    first, share   of (W^2 + soft e e^T)^-1 = W^-2 - share first first^T, first = W^-2 e, e = (1, 0)
    """

    scaling: second_order_cone.Scaling
    v: Tensor
    miss: Tensor
    first: Tensor
    share: Tensor

    def solve(self, x: Tensor) -> Tensor:
        return self.scaling.over_twice(x) - self.share * self.first * second_order_cone.dot(
            self.first, x
        )

    def curvature(self, L: Tensor) -> Tensor:
        """Sum of L^T (W^2 + soft e e^T)^-1 L   [batch, horizon, n + m, n + m]"""
        beta, v, w = (one[..., None, :] for one in self.scaling)
        of_columns = self._replace(
            scaling=second_order_cone.Scaling(beta, v, w),
            first=self.first[..., None, :],
            share=self.share[..., None, :],
        )
        return L.flatten(2, 3).mT @ of_columns.solve(L.mT).mT.flatten(2, 3)


def solve(
    A: Tensor,
    B: Tensor,
    limits: Sequence[ConicLimits],
    z: Tensor,
    weight: Tensor,
    begin: Tensor,
    end: Tensor,
    soft: Soft = HARD,
) -> Tensor:
    """The trajectory q = (x, u) [batch, horizon, n + m] within the limits whose x is nearest to z; the last u is idle.

    begin   a trajectory that the dynamics make: its first state stays, what A and B do not say of the dynamics is taken from it
    weight  of each coordinate in the distance   [n]
    end     which coordinates of the last state are to be those of z   [n]
    """
    (n, m), (batch, horizon, _) = B.shape, z.shape
    blocks, target = riccati.blocks(A, B), torch.cat((z, z.new_zeros(batch, horizon, m)), 2)
    W = torch.cat((weight, weight.new_full((m,), RIDGE))).repeat(horizon, 1)
    W[-1, n:] = 1.0
    firm = torch.where(end, 1 / soft.end, 0.0).to(weight)
    heavy = W.clone()
    heavy[-1, :n] += (
        firm  # an augmented Lagrangian of the pinned last state, whose multiplier is at.push
    )
    slacks = [_inside(each(begin)) for each in limits]
    at = Iterate(
        begin,
        slacks,
        [
            INITIAL_SLACK * second_order_cone.flip(v) / second_order_cone.determinant(v)
            for v in slacks
        ],
        torch.zeros_like(z[:, 0]),
    )
    todo = torch.ones(batch, dtype=torch.bool, device=z.device)
    for _ in range(STEPS):
        now = [
            _moment(each, at.q, s, y, soft.limits)
            for each, s, y in zip(limits, at.s, at.y, strict=True)
        ]
        mu = _gap(at.s, at.y)
        worst = torch.stack([one.miss.abs().amax((1, 2, 3)) for one in now]).amax(0)
        todo = todo & ((mu > SMALL) | (worst > SMALL))
        if not bool(todo.any()):
            break
        H = torch.stack(
            [
                one.curvature(each.L).expand(batch, -1, -1, -1)
                for one, each in zip(now, limits, strict=True)
            ]
        ).sum(0)
        H.diagonal(dim1=2, dim2=3).add_(heavy)
        slope = W * (at.q - target)
        slope[:, -1, :n] += firm * (at.q[:, -1, :n] - z[:, -1]) + at.push
        for each, y in zip(limits, at.y, strict=True):
            slope -= each.back(y)
        factors = riccati.factor(blocks, H)
        step = _step(limits, now, slope, partial(riccati.minimiser, blocks, factors), soft, at, mu)
        share = (NEAR * _far(at, step)).clamp_max(1.0)
        todo = todo & (share > STUCK) & step.q.isfinite().all(2).all(1)
        push = (
            firm * (at.q + step.q - target)[:, -1, :n]
            if soft.carried
            else torch.zeros_like(at.push)
        )
        at = _moved(at, step._replace(push=push), share, todo)
    return at.q


def _step(
    limits: Sequence[ConicLimits],
    now: Sequence[Moment],
    slope: Tensor,
    minimiser: Callable[[Tensor], Tensor],
    soft: Soft,
    at: Iterate,
    mu: Tensor,
) -> Iterate:
    """Mehrotra's step: what a step to products zero would do tells how far to aim, and the curvature on the way."""

    def towards(aims: Sequence[Tensor]) -> Iterate:
        pulls = [
            one.solve(one.miss + one.scaling.times(second_order_cone.quotient(aim, one.v)))
            for one, aim in zip(now, aims, strict=True)
        ]
        g = slope.clone()
        for each, pull in zip(limits, pulls, strict=True):
            g -= each.back(pull)
        d = minimiser(g)
        ahead = [each.forward(d) for each in limits]
        dy = [pull - one.solve(v) for one, pull, v in zip(now, pulls, ahead, strict=True)]
        ds = [
            v - one.miss + soft.limits * _first(w) for one, v, w in zip(now, ahead, dy, strict=True)
        ]
        return Iterate(d, ds, dy, at.push)

    here = [second_order_cone.product(one.v, one.v) for one in now]
    step = towards([-v for v in here])
    share = _far(at, step).clamp_max(1.0)[:, None, None, None]
    left = _gap(
        *(
            [v + share * dv for v, dv in zip(*pair, strict=True)]
            for pair in ((at.s, step.s), (at.y, step.y))
        )
    )
    aim = (mu * (left / mu).clamp(0.0, 1.0) ** 3)[:, None, None, None]
    bends = [
        second_order_cone.product(one.scaling.over(ds), one.scaling.times(dy))
        for one, ds, dy in zip(now, step.s, step.y, strict=True)
    ]
    return towards(
        [aim * _first(torch.ones_like(v)) - v - bend for v, bend in zip(here, bends, strict=True)]
    )


def _moved(at: Iterate, step: Iterate, share: Tensor, todo: Tensor) -> Iterate:
    """The iterate after its share of the step, where there is something to do."""

    def move(v: Tensor, d: Tensor) -> Tensor:
        wide = (-1, *(1,) * (v.ndim - 1))
        return torch.where(todo.view(wide), v + share.view(wide) * d, v)

    s, y = (
        [move(v, d) for v, d in zip(*pair, strict=True)]
        for pair in ((at.s, step.s), (at.y, step.y))
    )
    return Iterate(move(at.q, step.q), s, y, move(at.push, step.push))


def _far(at: Iterate, step: Iterate) -> Tensor:
    """The share of the step at which a slack or a multiplier leaves its cone [batch]."""
    ways = [
        second_order_cone.way_out(v, d).flatten(1).amin(1)
        for v, d in zip((*at.s, *at.y), (*step.s, *step.y), strict=True)
    ]
    return torch.stack(ways).amin(0)


def _gap(s: Sequence[Tensor], y: Sequence[Tensor]) -> Tensor:
    """The mean product of slacks and multipliers [batch]."""
    rank = sum(v.shape[1] * v.shape[2] for v in s)
    return torch.stack([(v * w).sum((1, 2, 3)) for v, w in zip(s, y, strict=True)]).sum(0) / rank


def _inside(s: Tensor) -> Tensor:
    """s, with s_0 raised where it is not well inside."""
    return torch.cat(
        (
            torch.maximum(s[..., :1], s[..., 1:].norm(dim=-1, keepdim=True) + INITIAL_SLACK),
            s[..., 1:],
        ),
        -1,
    )


def _first(x: Tensor) -> Tensor:
    """(x_0, 0)."""
    return torch.cat((x[..., :1], torch.zeros_like(x[..., 1:])), -1)


def _moment(limits: ConicLimits, q: Tensor, s: Tensor, y: Tensor, soft: float) -> Moment:
    scaling = second_order_cone.scaling(s, y)
    first = scaling.over_twice(_first(torch.ones_like(s)))
    return Moment(
        scaling,
        scaling.times(y),
        s - limits(q) - soft * _first(y),
        first,
        soft / (1 + soft * first[..., :1]),
    )
