"""SafeDiffuser (Xiao et al., 2023): each reverse step is the nearest one to the sampled step that control barriers allow.

With b = -g (b >= 0 safe) and u0 = x_{t-1} - x_t, the step as sampled:

    min |u - u0|^2 / 2   s.t.   db(x_t).u + k (b(x_t) - margin) >= 0,   x_{t-1} = x_t + u           (RoS)
    ReS    a slack r a row at cost r^2 / 2:  db.u + k (b - margin) >= w_t r,  w_t = 100 while 10 or more steps are left, then 0
    TVS    b relaxed by 1 - sigmoid(5 - t), in units of g:  db.u + k (b_t - margin) + sigmoid'(5 - t) >= 0, the sign of the last
           term as released

The rows are those of the compiled g. Where each belongs to one waypoint there is a QP a waypoint, as in the original; rows that
join waypoints (barrier chains, segments) make one QP a plan.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.projection.solvers.nonnegative_qp import nonnegative_least
from cdiff_cli.sampling.sampler import Step

Variant = Literal["ros", "res", "tvs"]
Solver = Literal["closed-form", "proxqp"]
SLACK = 1e-6  # rows may miss by this much of their size: float64 solutions of rows in float32
EXACT: dict[str, Any] = {
    "eps_abs": 1e-9,
    "eps_rel": 0.0,
    "check_duality_gap": True,
    "eps_duality_gap_abs": 1e-9,
    "eps_duality_gap_rel": 0.0,
}
"""ProxQP's settings: without the duality gap it stops up to 1e-4 inside several rows."""


@dataclass(frozen=True)
class SafeDiffuser:
    """Barrier rows on each reverse step.

    variant   ros: robust-safe, res: relaxed-safe, tvs: time-varying-safe
    solver    closed-form: the exact active set, the whole batch at once; proxqp: one QP after another, as qpsolvers solves them
    gain      k, the share of the barrier that a step may use up: 1 as released
    margin    how far inside the rows ask to be, units of g: 0.01 as released
    """

    variant: Variant = "ros"
    solver: Solver = "closed-form"
    gain: float = 1.0
    margin: float = 0.01

    def init(self, x: Traj, g: Constraint) -> None:
        return None

    def step(self, step: Step, g: Constraint, state: None) -> tuple[Traj, None]:
        asked = step.reverse(step.x0)
        if not g.parts:
            return asked, None
        relaxed, drift = relaxation(step.left) if self.variant == "tvs" else (0.0, 0.0)
        r = 100.0 if self.variant == "res" and step.left >= 10 else 0.0
        rows = rows_of(g, step, -self.gain * (self.margin - relaxed) + drift, self.gain)
        u0 = (asked - step.x).double().reshape(*rows.A.shape[:2], -1)
        u = (by_active_set if self.solver == "closed-form" else by_proxqp)(rows, u0, r)
        moved = (step.x.double() + u.reshape(step.x.shape)).to(asked)
        return step.pins.paint(torch.where((u == u0).reshape(asked.shape), asked, moved)), None


class BarrierRows(NamedTuple):
    """A u <= c: A [batch, groups, n, k], c [batch, groups, n], a group of k coordinates a waypoint or a whole plan; float64."""

    A: Tensor
    c: Tensor


def relaxation(left: int) -> tuple[float, float]:
    """(1 - sigmoid(5 - t), its slope's size) with t = `left`, the steps still to come."""
    s = (1 + math.tanh((5 - left) / 2)) / 2
    return 1 - s, s * (1 - s)


def rows_of(g: Constraint, step: Step, offset: float, gain: float) -> BarrierRows:
    """dg(x_t).u <= offset - gain g(x_t) on the free coordinates; rows that move none of them ask nothing."""
    x, free = step.x, ~step.pins.mask
    if all(part.support == 1 for part in g.parts):
        each = [part.linearise(x) for part in g.parts]
        A = (
            torch.stack([pull(torch.ones_like(values)) for values, pull, _ in each], 2)
            * free[:, None]
        )
        values = torch.stack([values for values, _, _ in each], 2)
    else:
        A = torch.cat([jacobian(part, x) for part in g.parts], 1)
        A = (A * free).flatten(2)[:, None]
        values = g(x)[:, None]
    A, c = A.double(), offset - gain * values.double()
    return BarrierRows(A, torch.where(A.abs().amax(-1) > 1e-9, c, torch.inf))


def jacobian(part: TrajectoryConstraint, x: Traj) -> Tensor:
    """dg/dx [batch, n, horizon, dim]: rows that share no waypoint are pulled back together."""
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
    out = torch.zeros_like(like)
    out[:, row] = 1.0
    return out


# the QP ---------------------------------------------------------------------------------------------------------------


def by_active_set(rows: BarrierRows, u0: Tensor, r: float = 0.0) -> Tensor:
    """argmin |u - u0|^2 + |slack|^2 s.t. A u + r slack <= c, exactly: u = u0 - A^T lam, where lam solves the dual."""
    over = (rows.A @ u0[..., None])[..., 0] - rows.c
    touched = (over > 0).any(-1)
    if not bool(touched.any()):
        return u0
    A, d = rows.A[touched], over[touched].clamp_min(-1e9)  # rows that ask nothing have c = inf
    lam = _multipliers(A @ A.mT + r**2 * torch.eye(A.shape[-2], dtype=A.dtype, device=A.device), d)
    out = u0.clone()
    out[touched] = u0[touched] - (lam[:, None] @ A)[:, 0]
    _check(A, rows.c[touched], out[touched], r**2 * lam)
    return out


def _multipliers(M: Tensor, d: Tensor) -> Tensor:
    """argmin over lam >= 0 of lam.M lam / 2 - d.lam, M [batch, n, n]; rows that depend on each other get a ridge."""
    size = M.diagonal(dim1=-2, dim2=-1).amax(-1, keepdim=True).clamp_min(1e-12)
    M = M + 1e-11 * size[..., None] * torch.eye(d.shape[-1], dtype=M.dtype, device=M.device)
    tolerance = 1e-10 * (d.abs().where(d > -1e8, 0.0).amax(-1, keepdim=True) + 1e-6)
    return nonnegative_least(M, d, tolerance, tolerance / size)


def by_proxqp(rows: BarrierRows, u0: Tensor, r: float = 0.0) -> Tensor:
    """The same by ProxQP, one QP after another."""
    import qpsolvers

    A, c, wanted = (tensor.flatten(0, 1).cpu().numpy() for tensor in (rows.A, rows.c, u0))
    k, n = wanted.shape[1], c.shape[1] if r else 0
    P, out = np.eye(k + n), wanted.copy()
    for i in range(len(out)):
        used = np.isfinite(c[i])
        if not used.any():
            continue
        G = np.concatenate((A[i], r * np.eye(n)), 1)[used] if r else A[i][used]
        q = -np.concatenate((wanted[i], np.zeros(n)))
        u = qpsolvers.solve_qp(P, q, G, c[i][used], solver="proxqp", **EXACT)
        if u is None or not np.isfinite(u).all():
            raise _conflict()
        out[i] = u[:k]
    return torch.from_numpy(out).to(u0).reshape(u0.shape)


def _check(A: Tensor, c: Tensor, u: Tensor, slack: Tensor) -> None:
    missed = (A @ u[..., None])[..., 0] - slack - c
    size = A.norm(dim=-1) * (1 + u.norm(dim=-1, keepdim=True))
    if bool((missed > SLACK * (1 + size)).any()) or not bool(u.isfinite().all()):
        raise _conflict()


def _conflict() -> InfeasibleError:
    return InfeasibleError(
        "safediffuser: at a noisy x_t the barrier rows contradict each other and no step obeys them all; "
        "relax them with --set variant=res, or remove a constraint"
    )
