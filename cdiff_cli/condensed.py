"""Affine constraints of short windows as one matrix: a row costs a dot product, and all of them one call, where part by part the
calls cost more than the sums.
"""

import torch

from cdiff_cli.affine_rows import AffineRows
from cdiff_cli.constraint import Chain, Constraint, Waypoints
from cdiff_cli.levels import Affine


def condensed(g: Constraint, horizon: int, dim: int) -> AffineRows | None:
    """The rows of g as a matrix, float64, read off g itself: its values and pulls at 0; None where a part is not affine."""
    levels = [part.acting if isinstance(part, Chain) else part.level for part in g.parts if isinstance(part, Chain | Waypoints)]
    if not levels or len(levels) < len(g.parts) or not all(isinstance(level, Affine) and level.a.ndim == 1 for level in levels):
        return None
    rows, pull, size = g.linearise(torch.zeros(1, horizon, dim, dtype=torch.float64))
    A = pull(torch.eye(rows.shape[1], dtype=torch.float64)).flatten(1)
    return AffineRows(A, rows, size)
