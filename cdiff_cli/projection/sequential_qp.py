"""Projection by sequential linearisation: any smooth constraint, each quadratic program solved by ProxQP."""

import warnings

import numpy as np
import torch
from torch import Tensor

from cdiff_cli.arrays import Rows, Traj
from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import RateLimit
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints


def _linearised(
    g: Constraint, z: Traj, begin: Traj, pins: Pins, tolerance: float, rounds: int = 50
) -> Traj:
    """Of one plan in float64: min |x - z|^2 s.t. g(x_k) + J(x_k) (x - x_k) <= 0, from x_0 = begin. The last x_k."""
    import qpsolvers
    from scipy import sparse

    x, target, free = begin, z.cpu().numpy().ravel(), ~pins.mask.flatten().cpu().numpy()
    matrix = (
        np.asarray if free.sum() <= 512 else sparse.csc_matrix
    )  # ProxQP's sparse backend is 1e-5 off on small problems
    for _ in range(rounds):
        rows, pull, _ = g.linearise(x)
        jacobian = np.stack(
            [
                pull(w[None]).flatten().cpu().numpy()
                for w in torch.eye(rows.shape[1], dtype=x.dtype, device=x.device)
            ]
        )[:, free]
        slack = -rows[0].cpu().numpy() + jacobian @ x.flatten().cpu().numpy()[free]
        useful = np.abs(jacobian).max(1) > 1e-12
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # ProxQP's format advice
            step = qpsolvers.solve_qp(
                matrix(np.eye(int(free.sum()))),
                -target[free],
                matrix(jacobian[useful]),
                slack[useful],
                solver="proxqp",
                eps_abs=min(tolerance, 1e-9),
            )
        if step is None or not np.isfinite(step).all():
            break
        flat = x.flatten().clone()
        flat[torch.from_numpy(free).to(x.device)] = torch.from_numpy(step).to(x)
        moved = float((flat - x.flatten()).abs().max())
        x = flat.reshape(x.shape)
        if moved < 1e-9:
            break
    return x


def _holds(g: Constraint, x: Traj, pins: Pins) -> bool:
    return bool((_free_rows(g, x, pins) <= 1e-5).all())


def _free_rows(g: Constraint, x: Traj, pins: Pins) -> Rows:
    """g(x), without the rows that touch pinned coordinates alone (those are checked once, up front)."""
    rows = g(x)
    return torch.where(_movable(g, x, pins), rows, rows.clamp_max(0.0))


def _movable(g: Constraint, x: Traj, pins: Pins) -> Tensor:
    """Rows [n] that some free coordinate of the trajectory enters."""
    free = (~pins.mask).any(1)
    each = []
    for part in g.parts:
        if isinstance(part, AtWaypoints):
            each.append(free)
        elif isinstance(part, DiscreteBarrier | OnSegments | RateLimit):
            order = len(part.coefficients) - 1 if isinstance(part, DiscreteBarrier) else 1
            each.append(free.unfold(0, order + 1, 1).any(1) if len(free) > order else free[:0])
        else:
            each.append(torch.ones(len(part.labels(x.shape[1])), dtype=torch.bool, device=x.device))
    return torch.cat(each)
