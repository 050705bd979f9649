"""The nearest trajectory of linear dynamics within convex limits, by interior points.

    minimise over q = (x, u)   sum |x - z|^2_W / 2
    s.t.   x' = A x + B u + c,   o + L q in a cone at each waypoint,   start and goal pinned

Half-spaces, bounds of inputs and bounds of single rates are cones of length one; a bound of a
length is a longer cone (second_order_cone.py). The method is the primal-dual predictor-corrector of
Mehrotra (1992) in the scaling of Nesterov and Todd. A Newton step is a linear-quadratic problem
over the horizon (riccati.py). On plans of the mazes it takes 13 to 31 Newton steps, whatever the
limits.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from cdiff_cli.projection.solvers import riccati, second_order_cone

MAX_STEPS = 50  # Newton steps
RIDGE = 1e-9  # cost of the inputs, relative to a coordinate of weight 1
STEP_SHARE = 0.995  # share of the way to the boundary that a step takes
INITIAL_SLACK = (
    0.1  # least distance of initial slacks to the boundary; initial slack times multiplier
)
CONVERGED = 1e-12  # mean product of slacks and multipliers, and largest residual, at the end
LEAST_STEP = 1e-8  # share of a step below which a plan has stopped


class ConicLimits(NamedTuple):
    """o + L q in c cones at each waypoint.

    L   [batch | 1, horizon | 1, c, k + 1, n + m]
    o   [batch | 1, horizon | 1, c, k + 1]
    """

    L: Tensor
    o: Tensor

    def of_steps(self, horizon: int) -> "ConicLimits":
        """The limits L [c, k + 1, n + m], o [c, k + 1] on each step; the last waypoint has none."""
        L, o = (v.repeat(1, horizon, *(1,) * v.ndim) for v in self)
        L[:, -1], o[:, -1] = 0.0, 0.0
        o[:, -1, :, 0] = 1.0
        return ConicLimits(L, o)

    def select(self, which: Tensor) -> "ConicLimits":
        """The limits of some trajectories of the batch alone."""
        return ConicLimits(*(v[which] if len(v) > 1 else v for v in self))

    def __call__(self, q: Tensor) -> Tensor:
        """The slacks o + L q [batch, horizon, c, k + 1]."""
        return self.o + self.forward(q)

    def forward(self, d: Tensor) -> Tensor:
        """L d [batch, horizon, c, k + 1]."""
        return (self.L @ d[:, :, None, :, None])[..., 0]

    def back(self, y: Tensor) -> Tensor:
        """L^T y [batch, horizon, n + m]."""
        return (y[..., None, :] @ self.L)[..., 0, :].sum(2)

    def missed(self, q: Tensor) -> Tensor:
        """The distance of q to the cones, negative inside [batch]."""
        s = self(q)
        return (s[..., 1:].norm(dim=-1) - s[..., 0]).amax((1, 2))


class Slack(NamedTuple):
    """Slack per multiplier.

    limits    of the limits
    end       of the pinned last state
    carried   whether the last state's multipliers are carried from step to step, so that the state
              is reached in the end, whatever its slack
    """

    limits: float
    end: float
    carried: bool


HARD, YIELDING = Slack(1e-11, 1e-6, True), Slack(1e-7, 1e-4, False)


class Iterate(NamedTuple):
    """An iterate, or a step of one.

    q      trajectory                                   [batch, horizon, n + m]
    s, y   slacks and multipliers per kind of limits    [batch, horizon, c, k + 1]
    push   multiplier of the last state                 [batch, n]
    """

    q: Tensor
    s: list[Tensor]
    y: list[Tensor]
    push: Tensor


class LimitState(NamedTuple):
    """One kind of limits at an iterate.

    scaling        W of slacks and multipliers
    v              W y
    residual       slack minus o + L q, and minus what the limit gives way
    first, share   (W^2 + slack e e^T)^-1 = W^-2 - share first first^T, first = W^-2 e, e = (1, 0)
    """

    scaling: second_order_cone.Scaling
    v: Tensor
    residual: Tensor
    first: Tensor
    share: Tensor

    def solve(self, x: Tensor) -> Tensor:
        """(W^2 + slack e e^T)^-1 x."""
        along = second_order_cone.dot(self.first, x)
        return self.scaling.over_twice(x) - self.share * self.first * along

    def curvature(self, L: Tensor) -> Tensor:
        """L^T (W^2 + slack e e^T)^-1 L, summed over the cones [batch, horizon, n + m, n + m]."""
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
    start: Tensor,
    end: Tensor,
    slack: Slack = HARD,
) -> Tensor:
    """The trajectory q = (x, u) [batch, horizon, n + m] within the limits whose x is nearest to z.

    The last u has no effect.

    start    a trajectory of the dynamics; its first state and c are kept   [batch, horizon, n + m]
    weight   weight per coordinate in the distance                          [n]
    end      coordinates of the last state that must equal those of z       [n]
    """
    cost = _cost(B, z, weight, end, slack)
    blocks = riccati.blocks(A, B)
    iterate = _first_iterate(limits, start, z)
    todo = torch.ones(len(z), dtype=torch.bool, device=z.device)
    for _ in range(MAX_STEPS):
        states = [
            _limit_state(limit, iterate.q, s, y, slack.limits)
            for limit, s, y in zip(limits, iterate.s, iterate.y, strict=True)
        ]
        gap = _gap(iterate.s, iterate.y)
        residual = torch.stack([one.residual.abs().amax((1, 2, 3)) for one in states]).amax(0)
        todo = todo & ((gap > CONVERGED) | (residual > CONVERGED))
        if not bool(todo.any()):
            break
        factors = riccati.factor(blocks, cost.curvature(limits, states))
        minimiser = partial(riccati.minimiser, blocks, factors)
        step = _step(limits, states, cost.slope(limits, iterate), minimiser, slack, iterate, gap)
        share = (STEP_SHARE * _largest_step(iterate, step)).clamp_max(1.0)
        todo = todo & (share > LEAST_STEP) & step.q.isfinite().all(2).all(1)
        step = step._replace(push=cost.push(iterate, step))
        iterate = _moved(iterate, step, share, todo)
    return iterate.q


class Cost(NamedTuple):
    """|x - z|^2_W / 2 with an augmented Lagrangian of the pinned last state.

    The multiplier of that state is Iterate.push.

    target    z, with inputs 0                                    [batch, horizon, n + m]
    weight    weight per waypoint and coordinate                  [horizon, n + m]
    penalty   penalty weight per coordinate of the last state     [n]
    carried   whether the multiplier is carried from step to step
    """

    target: Tensor
    weight: Tensor
    penalty: Tensor
    carried: bool

    def curvature(self, limits: Sequence[ConicLimits], states: Sequence["LimitState"]) -> Tensor:
        """The second derivatives by q, with those of the limits [batch, horizon, n + m, n + m]."""
        batch, n = len(self.target), len(self.penalty)
        diagonal = self.weight.clone()
        diagonal[-1, :n] += self.penalty
        each = [
            state.curvature(limit.L).expand(batch, -1, -1, -1)
            for state, limit in zip(states, limits, strict=True)
        ]
        H = torch.stack(each).sum(0)
        H.diagonal(dim1=2, dim2=3).add_(diagonal)
        return H

    def slope(self, limits: Sequence[ConicLimits], iterate: "Iterate") -> Tensor:
        """The derivative of the Lagrangian by q [batch, horizon, n + m]."""
        n = len(self.penalty)
        slope = self.weight * (iterate.q - self.target)
        miss = iterate.q[:, -1, :n] - self.target[:, -1, :n]
        slope[:, -1, :n] += self.penalty * miss + iterate.push
        for limit, y in zip(limits, iterate.y, strict=True):
            slope -= limit.back(y)
        return slope

    def push(self, iterate: "Iterate", step: "Iterate") -> Tensor:
        """The step of the last state's multiplier [batch, n]."""
        if not self.carried:
            return torch.zeros_like(iterate.push)
        n = len(self.penalty)
        return self.penalty * (iterate.q + step.q - self.target)[:, -1, :n]


def _cost(B: Tensor, z: Tensor, weight: Tensor, end: Tensor, slack: Slack) -> Cost:
    (n, m), (batch, horizon, _) = B.shape, z.shape
    target = torch.cat((z, z.new_zeros(batch, horizon, m)), 2)
    weights = torch.cat((weight, weight.new_full((m,), RIDGE))).repeat(horizon, 1)
    weights[-1, n:] = 1.0
    penalty = torch.where(end, 1 / slack.end, 0.0).to(weight)
    return Cost(target, weights, penalty, slack.carried)


def _first_iterate(limits: Sequence[ConicLimits], start: Tensor, z: Tensor) -> Iterate:
    """The start, with slacks inside their cones and multipliers on the central path."""
    slacks = [_inside(limit(start)) for limit in limits]
    multipliers = [
        INITIAL_SLACK * second_order_cone.flip(s) / second_order_cone.determinant(s) for s in slacks
    ]
    return Iterate(start, slacks, multipliers, torch.zeros_like(z[:, 0]))


def _step(
    limits: Sequence[ConicLimits],
    states: Sequence[LimitState],
    slope: Tensor,
    minimiser: Callable[[Tensor], Tensor],
    slack: Slack,
    iterate: Iterate,
    gap: Tensor,
) -> Iterate:
    """The predictor-corrector step.

    A predictor towards zero products determines how far to aim, and its curvature is corrected.
    """
    towards = partial(_newton_step, limits, states, slope, minimiser, slack.limits, iterate.push)
    squares = [second_order_cone.product(one.v, one.v) for one in states]
    step = towards([-square for square in squares])
    share = _largest_step(iterate, step).clamp_max(1.0)[:, None, None, None]
    left = _gap(
        [s + share * ds for s, ds in zip(iterate.s, step.s, strict=True)],
        [y + share * dy for y, dy in zip(iterate.y, step.y, strict=True)],
    )
    aim = (gap * (left / gap).clamp(0.0, 1.0) ** 3)[:, None, None, None]
    corrections = [
        second_order_cone.product(one.scaling.over(ds), one.scaling.times(dy))
        for one, ds, dy in zip(states, step.s, step.y, strict=True)
    ]
    return towards(
        [
            aim * _first(torch.ones_like(square)) - square - correction
            for square, correction in zip(squares, corrections, strict=True)
        ]
    )


def _newton_step(
    limits: Sequence[ConicLimits],
    states: Sequence[LimitState],
    slope: Tensor,
    minimiser: Callable[[Tensor], Tensor],
    slack: float,
    push: Tensor,
    aims: Sequence[Tensor],
) -> Iterate:
    """The Newton step that changes the products of slacks and multipliers by `aims`."""
    pulls = [
        one.solve(one.residual + one.scaling.times(second_order_cone.quotient(aim, one.v)))
        for one, aim in zip(states, aims, strict=True)
    ]
    g = slope.clone()
    for limit, pull in zip(limits, pulls, strict=True):
        g -= limit.back(pull)
    d = minimiser(g)
    changes = [limit.forward(d) for limit in limits]
    dy = [pull - one.solve(v) for one, pull, v in zip(states, pulls, changes, strict=True)]
    ds = [
        v - one.residual + slack * _first(w) for one, v, w in zip(states, changes, dy, strict=True)
    ]
    return Iterate(d, ds, dy, push)


def _moved(at: Iterate, step: Iterate, share: Tensor, todo: Tensor) -> Iterate:
    """The iterate after a share of the step, for the plans `todo`."""

    def move(v: Tensor, d: Tensor) -> Tensor:
        wide = (-1, *(1,) * (v.ndim - 1))
        return torch.where(todo.view(wide), v + share.view(wide) * d, v)

    s, y = (
        [move(v, d) for v, d in zip(*pair, strict=True)]
        for pair in ((at.s, step.s), (at.y, step.y))
    )
    return Iterate(move(at.q, step.q), s, y, move(at.push, step.push))


def _largest_step(at: Iterate, step: Iterate) -> Tensor:
    """The share of the step at which the first slack or multiplier leaves its cone [batch]."""
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
    """s with s_0 raised to INITIAL_SLACK within the cone."""
    least = s[..., 1:].norm(dim=-1, keepdim=True) + INITIAL_SLACK
    return torch.cat((torch.maximum(s[..., :1], least), s[..., 1:]), -1)


def _first(x: Tensor) -> Tensor:
    """The vector (x_0, 0)."""
    return torch.cat((x[..., :1], torch.zeros_like(x[..., 1:])), -1)


def _limit_state(limits: ConicLimits, q: Tensor, s: Tensor, y: Tensor, slack: float) -> LimitState:
    """The limits at the iterate q, s, y."""
    scaling = second_order_cone.scaling(s, y)
    first = scaling.over_twice(_first(torch.ones_like(s)))
    return LimitState(
        scaling,
        scaling.times(y),
        s - limits(q) - slack * _first(y),
        first,
        slack / (1 + slack * first[..., :1]),
    )
