"""Projection by sequential quadratic programming: any smooth constraint, each program by ProxQP."""

import warnings

import numpy as np
import torch

from cdiff_cli.arrays import Array, Rows, Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint, movable_rows

MAX_PROGRAMS = 50  # quadratic programs per plan
DENSE_UNKNOWNS = 512  # unknowns up to which ProxQP's dense backend is used
SATISFIED = 1e-5  # value of g up to which a row counts as satisfied, environment units


def sequential_qp(
    g: Constraint,
    z: Traj,
    start: Traj,
    pins: Pins,
    tolerance: float,
    max_programs: int = MAX_PROGRAMS,
) -> Traj:
    """The last iterate for one plan in float64, from x_0 = start.

    x_{k+1} = argmin |x - z|^2  s.t.  g(x_k) + J(x_k) (x - x_k) <= 0,  pinned coordinates fixed
    """
    x, target, free = start, z.cpu().numpy().ravel(), ~pins.mask.flatten().cpu().numpy()
    for _ in range(max_programs):
        step = _next_iterate(g, x, target, free, min(tolerance, 1e-9))
        if step is None or not np.isfinite(step).all():
            break
        flat = x.flatten().clone()
        flat[torch.from_numpy(free).to(x.device)] = torch.from_numpy(step).to(x)
        change = float((flat - x.flatten()).abs().max())
        x = flat.reshape(x.shape)
        if change < 1e-9:
            break
    return x


def _next_iterate(
    g: Constraint, x: Traj, target: Array, free: Array, tolerance: float
) -> Array | None:
    """The free coordinates of the next iterate; None where ProxQP finds none."""
    import qpsolvers
    from scipy import sparse

    rows, pull, _ = g.linearise(x)
    jacobian = np.stack(
        [
            pull(w[None]).flatten().cpu().numpy()
            for w in torch.eye(rows.shape[1], dtype=x.dtype, device=x.device)
        ]
    )[:, free]
    bound = -rows[0].cpu().numpy() + jacobian @ x.flatten().cpu().numpy()[free]
    useful = np.abs(jacobian).max(1) > 1e-12
    # ProxQP's sparse backend is 1e-5 off on small problems.
    matrix = np.asarray if free.sum() <= DENSE_UNKNOWNS else sparse.csc_matrix
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ProxQP's advice on the matrix format
        return qpsolvers.solve_qp(
            matrix(np.eye(int(free.sum()))),
            -target[free],
            matrix(jacobian[useful]),
            bound[useful],
            solver="proxqp",
            eps_abs=tolerance,
        )


def holds(g: Constraint, x: Traj, pins: Pins) -> bool:
    """Whether x satisfies all rows of g that pins alone do not decide, up to SATISFIED."""
    return bool((free_rows(g, x, pins) <= SATISFIED).all())


def free_rows(g: Constraint, x: Traj, pins: Pins) -> Rows:
    """g(x), with rows that depend on pinned waypoints alone counted as satisfied.

    Those rows are checked once, before anything moves (infeasible.py).
    """
    rows = g(x)
    movable = [movable_rows(part, pins) for part in g.parts]
    free = movable[0] if len(movable) == 1 else torch.cat(movable)
    return torch.where(free, rows, rows.clamp_max(0.0))
