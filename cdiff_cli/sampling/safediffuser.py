"""SafeDiffuser (Xiao et al., 2023): control barriers restrict each reverse step.

The step taken is the nearest one to the sampled step that satisfies them.

With b = -g (b >= 0 is safe) and the sampled step u0 = x_{t-1} - x_t:

    RoS   min |u - u0|^2 / 2   s.t.   db(x_t).u + k (b(x_t) - margin) >= 0,   x_{t-1} = x_t + u
    ReS   one slack r per row at cost r^2 / 2:   db.u + k (b - margin) >= w_t r,
          w_t = 100 while 10 or more steps remain, then 0
    TVS   b relaxed by 1 - sigmoid(5 - t), in units of g:
          db.u + k (b_t - margin) + sigmoid'(5 - t) >= 0, the sign of the last term as released

The rows are those of the compiled g. Where every row belongs to one waypoint, one QP is solved per
waypoint, as in the original. Rows that couple waypoints (barriers along the trajectory, segments)
make one QP per plan.
"""

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.projection.solvers.nonnegative_qp import nonnegative_least
from cdiff_cli.sampling.sampler import PlannerKind, Step

Variant = Literal["ros", "res", "tvs"]
Solver = Literal["closed-form", "proxqp"]
ROW_TOLERANCE = (
    1e-6  # [share of a row's size] accepted violation: float64 solutions of rows given in float32
)
PROXQP_SETTINGS: dict[str, Any] = {
    "eps_abs": 1e-9,
    "eps_rel": 0.0,
    "check_duality_gap": True,
    "eps_duality_gap_abs": 1e-9,
    "eps_duality_gap_rel": 0.0,
}
"""ProxQP's settings. Without the duality gap it stops up to 1e-4 inside several rows."""


@dataclass(frozen=True)
class SafeDiffuser:
    """SafeDiffuser restricts each reverse step by barrier rows.

    variant   ros: robust-safe, res: relaxed-safe, tvs: time-varying-safe
    solver    closed-form: the exact active set, the whole batch at once
              proxqp: one QP after another, by qpsolvers
    gain      k, the share of the barrier that a step may use up; 1 as released
    margin    value by which the rows tighten g, units of g; 0.01 as released
    """

    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    variant: Variant = "ros"
    solver: Solver = "closed-form"
    gain: float = 1.0
    margin: float = 0.01

    def init(self, x: Traj, g: Constraint) -> None:
        return None

    def step(self, step: Step, g: Constraint, state: None) -> tuple[Traj, None]:
        sampled = step.reverse(step.x0)
        if not g.parts:
            return sampled, None
        relaxed, drift = relaxation(step.left) if self.variant == "tvs" else (0.0, 0.0)
        slack_weight = 100.0 if self.variant == "res" and step.left >= 10 else 0.0
        rows = rows_of(g, step, -self.gain * (self.margin - relaxed) + drift, self.gain)
        u0 = (sampled - step.x).double().reshape(*rows.A.shape[:2], -1)
        solve = by_active_set if self.solver == "closed-form" else by_proxqp
        u = solve(rows, u0, slack_weight)
        moved = (step.x.double() + u.reshape(step.x.shape)).to(sampled)
        unchanged = (u == u0).reshape(sampled.shape)
        return step.pins.paint(torch.where(unchanged, sampled, moved)), None


class BarrierRows(NamedTuple):
    """Rows A u <= c of each group of k coordinates, a waypoint or a whole plan, in float64.

    A   [batch, groups, n, k]
    c   [batch, groups, n]
    """

    A: Tensor
    c: Tensor


def relaxation(left: int) -> tuple[float, float]:
    """Relaxation 1 - sigmoid(5 - t) of TVS and its slope sigmoid'(5 - t), with t = left."""
    s = (1 + math.tanh((5 - left) / 2)) / 2
    return 1 - s, s * (1 - s)


def rows_of(g: Constraint, step: Step, offset: float, gain: float) -> BarrierRows:
    """Barrier rows dg(x_t).u <= offset - gain g(x_t) on the free coordinates.

    Rows without a free coordinate get the bound inf.
    """
    x, free = step.x, ~step.pins.mask
    if all(part.support == 1 for part in g.parts):
        linearised = [part.linearise(x) for part in g.parts]
        gradients = [pull(torch.ones_like(values)) for values, pull, _ in linearised]
        A = torch.stack(gradients, 2) * free[:, None]
        values = torch.stack([values for values, _, _ in linearised], 2)
    else:
        A = torch.cat([jacobian(part, x) for part in g.parts], 1)
        A = (A * free).flatten(2)[:, None]
        values = g(x)[:, None]
    A, c = A.double(), offset - gain * values.double()
    return BarrierRows(A, torch.where(A.abs().amax(-1) > 1e-9, c, torch.inf))


def jacobian(part: TrajectoryConstraint, x: Traj) -> Tensor:
    """Jacobian dg/dx   [batch, n, horizon, dim].

    Rows that share no waypoint are pulled back together.
    """
    values, pull, _ = part.linearise(x)
    n, horizon = values.shape[1], x.shape[1]
    reach = part.support
    out = x.new_zeros(len(x), n, horizon, x.shape[2])
    if not reach:
        for row in range(n):
            out[:, row] = pull(one_hot(row, values))
        return out
    for first in range(reach):
        rows = torch.arange(first, n, reach, device=x.device)
        which = torch.zeros_like(values)
        which[:, rows] = 1.0
        pulled = pull(which)
        for shift in range(reach):
            out[:, rows, rows + shift] = pulled[:, rows + shift]
    return out


def one_hot(row: int, like: Tensor) -> Tensor:
    """Weights that are one in the row and zero elsewhere."""
    out = torch.zeros_like(like)
    out[:, row] = 1.0
    return out


# the QP -------------------------------------------------------------------------------------------


def by_active_set(rows: BarrierRows, u0: Tensor, slack_weight: float = 0.0) -> Tensor:
    """Solve the QP exactly: argmin |u - u0|^2 + |r|^2 s.t. A u - slack_weight r <= c.

    u = u0 - A^T lam, where lam solves the dual problem.
    """
    over = (rows.A @ u0[..., None])[..., 0] - rows.c
    touched = (over > 0).any(-1)
    if not bool(touched.any()):
        return u0
    A, d = rows.A[touched], over[touched].clamp_min(-1e9)  # rows without effect have c = inf
    identity = torch.eye(A.shape[-2], dtype=A.dtype, device=A.device)
    lam = solve_dual(A @ A.mT + slack_weight**2 * identity, d)
    out = u0.clone()
    out[touched] = u0[touched] - (lam[:, None] @ A)[:, 0]
    _check(A, rows.c[touched], out[touched], slack_weight**2 * lam)
    return out


def solve_dual(M: Tensor, d: Tensor) -> Tensor:
    """Multipliers argmin lam.M lam / 2 - d.lam over lam >= 0   [batch, n].

    A ridge of 1e-11 of its largest diagonal entry makes M [batch, n, n] regular where rows depend
    on each other.
    """
    size = M.diagonal(dim1=-2, dim2=-1).amax(-1, keepdim=True).clamp_min(1e-12)
    M = M + 1e-11 * size[..., None] * torch.eye(d.shape[-1], dtype=M.dtype, device=M.device)
    tolerance = 1e-10 * (d.abs().where(d > -1e8, 0.0).amax(-1, keepdim=True) + 1e-6)
    return nonnegative_least(M, d, tolerance, tolerance / size)


def by_proxqp(rows: BarrierRows, u0: Tensor, slack_weight: float = 0.0) -> Tensor:
    """Solve the QP of by_active_set() by ProxQP, one group after another."""
    import qpsolvers

    A, c, target = (tensor.flatten(0, 1).cpu().numpy() for tensor in (rows.A, rows.c, u0))
    k = target.shape[1]
    n = c.shape[1] if slack_weight else 0
    P, out = np.eye(k + n), target.copy()
    for i in range(len(out)):
        used = np.isfinite(c[i])
        if not used.any():
            continue
        G = np.concatenate((A[i], slack_weight * np.eye(n)), 1)[used] if n else A[i][used]
        q = -np.concatenate((target[i], np.zeros(n)))
        u = qpsolvers.solve_qp(P, q, G, c[i][used], solver="proxqp", **PROXQP_SETTINGS)
        if u is None or not np.isfinite(u).all():
            raise _infeasible()
        out[i] = u[:k]
    return torch.from_numpy(out).to(u0).reshape(u0.shape)


def _check(A: Tensor, c: Tensor, u: Tensor, slack: Tensor) -> None:
    """Refuse a step that is not finite, or that violates a row by more than ROW_TOLERANCE."""
    missed = (A @ u[..., None])[..., 0] - slack - c
    size = A.norm(dim=-1) * (1 + u.norm(dim=-1, keepdim=True))
    if bool((missed > ROW_TOLERANCE * (1 + size)).any()) or not bool(u.isfinite().all()):
        raise _infeasible()


def _infeasible() -> InfeasibleError:
    return InfeasibleError(
        "safediffuser: at a noisy x_t the barrier rows contradict each other and no step "
        "satisfies them all; relax them with --set variant=res, or remove a constraint"
    )
