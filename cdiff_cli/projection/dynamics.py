"""The nearest trajectory that linear dynamics with bounded inputs can produce, around obstacles.

    minimise |x - z|^2_W   s.t.   x' = A x + B u + c,   low <= u <= high,
                                  a.x <= b at waypoints,   start and goal pinned

All plans of a batch are solved at once. Without the inequalities the solution is one product with a
matrix that the batch shares (lq_tracking.py). The active inequalities are found by active_set.py,
and the half-spaces a.x <= b around obstacles are chosen by segments.py.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.dynamics import LinearDynamics
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.projection.segments import (
    Obstacle,
    Plans,
    TangentChoice,
    around_obstacles,
    crossed,
    half_space_count,
)
from cdiff_cli.projection.solvers.active_set import Bounds, solve
from cdiff_cli.projection.solvers.half_spaces import NEVER, HalfSpaces
from cdiff_cli.projection.solvers.lq_tracking import Tracking, tracking

ADMM_PENALTY = 50.0  # weight of the distance to the copy, relative to a coordinate of weight 1
ADMM_RELAXATION = 1.6  # over-relaxation of ADMM
ADMM_CHOICES = (10, 20, 40)  # rounds of ADMM after which half-spaces are chosen again
ADMM_CHECKED = 5  # rounds of ADMM between two tests for convergence


class ActiveSetWarmStart(NamedTuple):
    """Where the last projection ended.

    active       1 where a row is active at its upper bound, -1 at its lower   [batch, steps, rows]
    u            inputs                                                        [batch, steps, m]
    copy, push   ADMM's copy and scaled multipliers, where it was used         [batch, horizon, k]
    infeasible   plans whose rows could not all be satisfied                   [batch]
    """

    active: Tensor
    u: Tensor
    copy: Tensor
    push: Tensor
    infeasible: Plans

    def select(self, which: Tensor) -> "ActiveSetWarmStart":
        """The warm start of some plans of the batch alone."""
        return ActiveSetWarmStart(*(v[which] for v in self))


@dataclass
class TrackingBatch:
    """A batch of tracking problems, and where the active set of each plan stands.

    x            targets [batch, horizon, n], float64; their first states are fixed
    held         pinned waypoints [horizon]; half-spaces do not apply to them
    w0, w        trajectories (x', u) per step: unconstrained, last solution   [batch, steps, n + m]
    """

    track: Tracking
    bounds: Bounds
    x: Traj
    held: Tensor
    w0: Tensor
    w: Tensor
    active: Tensor
    infeasible: Plans

    def solve(self, half_spaces: HalfSpaces, plans: Tensor) -> Traj:
        """The solutions of some plans, in the coordinates of the half-spaces [n, horizon, k]."""
        m, columns = len(self.bounds.low), self.bounds.used
        a = half_spaces.a[:, 1:]
        b = torch.where(self.held[1:, None], NEVER, half_spaces.b[:, 1:])
        self.active[..., m:] *= b < NEVER  # a warm start may have rows that no longer exist
        count = m + bool((half_spaces.b < NEVER).any()) * b.shape[2]
        self.w[plans], self.active[plans, :, :count], self.infeasible[plans] = solve(
            self.track,
            self.w0[plans],
            self.bounds,
            a[plans, :, : count - m],
            b[plans, :, : count - m],
            self.active[plans, :, :count],
            self.infeasible[plans],
        )
        states = self.w if len(plans) == len(self.w) else self.w[plans]
        start = self.x[plans][:, :1, columns]
        return torch.cat((start, states[..., columns]), 1)


def project_dynamics(
    dynamics: LinearDynamics,
    parts: Sequence[Obstacle],
    others: Callable[[Traj, Pins], Traj] | None,
    z: Traj,
    pins: Pins,
    *,
    columns: Sequence[int],
    weight: Tensor,
    rounds: int,
    max_choices: int = 1,
    warm: ActiveSetWarmStart | None = None,
    tolerance: float = 0.0,
) -> tuple[Traj, ActiveSetWarmStart]:
    """The nearest trajectory to z that the dynamics produce from its first state, and a warm start.

    The inputs stay within their bounds, the parts are satisfied, and a pinned last state is
    reached. Where this is impossible, rows give way by slack (active_set.py).

    parts         act on the coordinates `columns` alone
    others        projection onto all other parts, on `columns`; None where there are none
    weight        weight per coordinate in |x - z|^2   [n]
    rounds        largest number of rounds of ADMM, which is used where there are `others`; it ends
                  once its copy is within the tolerance
    max_choices   how often the half-spaces of a plan are chosen: first at its target, then at each
                  solution. Plans with a safe target get none. Plans that stay infeasible keep their
                  first choice.
    tolerance     violation of a row that is accepted, environment units
    """
    held = Pins(pins.mask[:, columns], z[..., columns].double())
    warm = _fitting(warm, parts, held.values, dynamics.B.shape[1])
    if len(z) == 0 or z.shape[1] == 1:
        return z, warm
    penalised = frozenset(columns) if others else frozenset()
    batch = TrackingBatch(
        _tracking(dynamics, weight, penalised, z.shape[1] - 1, pins),
        Bounds(dynamics.low.double(), dynamics.high.double(), list(columns), max(tolerance, 1e-9)),
        z.double(),
        held.mask.any(1),
        z.new_empty(0),
        z.new_zeros(len(z), z.shape[1] - 1, z.shape[2] + dynamics.B.shape[1], dtype=torch.float64),
        warm.active.clone(),
        warm.infeasible.clone(),
    )
    choice = TangentChoice.none(parts, held.values, held)
    if others:
        copy, push = _by_admm(batch, choice, others, held, weight.double(), warm, rounds, tolerance)
    else:
        _by_active_set(batch, choice, held.values, warm.infeasible, max_choices)
        copy, push = warm.copy, warm.push
    n = z.shape[2]
    out = torch.cat((batch.x[:, :1], batch.w[..., :n]), 1)
    return out.to(z), ActiveSetWarmStart(
        batch.active, batch.w[..., n:], copy, push, batch.infeasible
    )


def _fitting(
    warm: ActiveSetWarmStart | None, parts: Sequence[Obstacle], z: Traj, m: int
) -> ActiveSetWarmStart:
    """The warm start, or one in which no row is active where it does not fit the problem."""
    batch, horizon, _ = z.shape
    rows = (batch, horizon - 1, m + half_space_count(parts))
    if warm is not None and warm.active.shape == rows:
        return warm
    active = torch.zeros(rows, dtype=torch.int8, device=z.device)
    feasible = torch.zeros(batch, dtype=torch.bool, device=z.device)
    u = z.new_zeros(batch, horizon - 1, m)
    return ActiveSetWarmStart(active, u, z, torch.zeros_like(z), feasible)


def _tracking(
    dynamics: LinearDynamics, weight: Tensor, penalised: frozenset[int], steps: int, pins: Pins
) -> Tracking:
    """The shared matrix, with the penalty of ADMM added to the weight of penalised coordinates."""
    weights = tuple(v + ADMM_PENALTY * (i in penalised) for i, v in enumerate(weight.tolist()))
    numbers = tuple(tuple(v.flatten().tolist()) for v in (dynamics.A, dynamics.B, dynamics.c))
    return tracking(numbers, weights, steps, bool(pins.mask[-1].all()), pins.mask.device)


def _by_active_set(
    batch: TrackingBatch, choice: TangentChoice, z: Traj, infeasible: Plans, max_choices: int
) -> None:
    """Solve the batch, whose obstacles are all half-spaces.

    z            targets in the coordinates of the half-spaces
    infeasible   plans that were infeasible in the last projection
    """
    batch.w0 = batch.track.solve(batch.x, torch.zeros_like(batch.w))

    def solve_plans(half_spaces: HalfSpaces, plans: Tensor) -> tuple[Traj, Plans]:
        x = batch.solve(half_spaces, plans)
        return x, (batch.infeasible & infeasible)[plans]

    unsafe = crossed(choice.parts, z).nonzero()[:, 0]
    around_obstacles(solve_plans, choice, z, unsafe, max_choices, batch.bounds.tolerance)


def _by_admm(
    batch: TrackingBatch,
    choice: TangentChoice,
    others: Callable[[Traj, Pins], Traj],
    held: Pins,
    weight: Tensor,
    warm: ActiveSetWarmStart,
    rounds: int,
    tolerance: float,
) -> tuple[Traj, Traj]:
    """Solve the batch with a copy of its `columns` that satisfies the other parts.

    Returns the copy and its scaled multipliers.
    """
    columns, every = list(batch.bounds.used), torch.arange(len(batch.x), device=batch.x.device)
    copy, push = warm.copy, warm.push
    choice.choose(held.values, crossed(choice.parts, held.values).nonzero()[:, 0])
    for k in range(1, rounds + 1):
        target = _between(batch.x, weight, copy - push, columns)
        batch.w0 = batch.track.solve(target, torch.zeros_like(batch.w))
        x = batch.solve(choice.half_spaces, every)
        relaxed = ADMM_RELAXATION * x + (1 - ADMM_RELAXATION) * copy + push
        copy = others(relaxed, held)
        push = relaxed - copy
        if tolerance and k % ADMM_CHECKED == 0 and float((x - copy).abs().max()) < tolerance:
            break
        unsafe = choice.newly_unsafe(x, batch.bounds.tolerance)
        plans = unsafe | choice.chosen if k in ADMM_CHOICES else unsafe
        choice.choose(x, plans.nonzero()[:, 0])
    return copy, push


def _between(z: Traj, weight: Tensor, copy: Traj, columns: list[int]) -> Traj:
    """The target whose penalised distance is that to z and to the copy together."""
    out = z.clone()
    out[..., columns] = (weight[columns] * z[..., columns] + ADMM_PENALTY * copy) / (
        weight[columns] + ADMM_PENALTY
    )
    return out
