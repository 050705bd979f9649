"""Linear dynamics fitted to demonstrations by least squares."""

from collections.abc import Sequence

import numpy as np
import torch

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.dynamics import LinearDynamics

ROUNDS = 20  # refits at most
OUTLIER = 3.0  # residual, in medians, above which a transition is left out of the fit
EXPLAINED = 1e-4  # residual, in mean steps of its coordinate, up to which dynamics explain it
LEAST_STEP = 1e-9  # smallest step, relative to the coordinate: one that never moves only rounds


def fit_dynamics(
    episodes: Sequence[Array], inputs: Sequence[Array]
) -> tuple[LinearDynamics, float] | None:
    """Linear dynamics of the episodes and the share of the transitions that they explain.

    Returns None without inputs.

    episodes   states [n, dim] of each
    inputs     inputs [n - 1, m] of each, or [n, m]
    """
    if not inputs:
        return None
    parts = [(x[:-1], u[: len(x) - 1], x[1:]) for x, u in zip(episodes, inputs, strict=True)]
    x, u, after = (np.concatenate(part) for part in zip(*parts, strict=True))
    return fit(x, u, after)


def fit(x: Array, u: Array, after: Array) -> tuple[LinearDynamics, float]:
    """Least squares on the transitions after = A x + B u + c, and the share that they explain.

    The fit is repeated on the transitions within OUTLIER median residuals until these stay the
    same, so that collisions and clipped speeds drop out. A residual is the largest over the
    coordinates, each in units of its mean step.

    x, after   [k, n];  u   [k, m]
    """
    known = np.concatenate((x, u, np.ones((len(x), 1))), 1)
    step = np.maximum(np.abs(after - x).mean(0), LEAST_STEP * (1 + np.abs(x).max(0)))
    kept = np.ones(len(x), dtype=bool)
    for _ in range(ROUNDS):
        coefficients = np.linalg.lstsq(known[kept], after[kept], rcond=None)[0]
        residual = (np.abs(after - known @ coefficients) / step).max(1)
        near = residual <= max(OUTLIER * float(np.median(residual)), 1e-9)
        if (near == kept).all():
            break
        kept = near
    n, m = x.shape[1], u.shape[1]
    A, B, c = np.split(coefficients.T, (n, n + m), axis=1)
    values = (A, B, c[:, 0], u.min(0), u.max(0))
    dynamics = LinearDynamics(*(torch.from_numpy(np.ascontiguousarray(v)) for v in values))
    return dynamics, float((residual <= EXPLAINED).mean())
