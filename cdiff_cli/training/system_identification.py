"""Linear dynamics fitted to demonstrations by least squares."""

import numpy as np
import torch

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.dynamics import LinearDynamics


def fit(x: Array, u: Array, after: Array) -> tuple[LinearDynamics, float]:
    """Least squares on the transitions (x, u, after) [k, n], [k, m], [k, n], refitted to those within three median residuals
    until that set is stable, so that collisions and clipped speeds drop out. Also the share of transitions so explained, to
    one in ten thousand of the usual step of each coordinate.
    """
    known = np.concatenate((x, u, np.ones((len(x), 1))), 1)
    step = np.maximum(
        np.abs(after - x).mean(0), 1e-9 * (1 + np.abs(x).max(0))
    )  # one that never moves has rounding alone
    kept = np.ones(len(x), dtype=bool)
    for _ in range(20):
        coefficients = np.linalg.lstsq(known[kept], after[kept], rcond=None)[0]
        miss = (np.abs(after - known @ coefficients) / step).max(1)
        now = miss <= max(3 * float(np.median(miss)), 1e-9)
        if (now == kept).all():
            break
        kept = now
    n, m = x.shape[1], u.shape[1]
    A, B, c = np.split(coefficients.T, (n, n + m), axis=1)
    low, high = u.min(0), u.max(0)
    found = LinearDynamics(
        *(torch.from_numpy(np.ascontiguousarray(v)) for v in (A, B, c[:, 0], low, high))
    )
    return found, float((miss <= 1e-4).mean())
