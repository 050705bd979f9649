"""Dykstra's algorithm: the projection onto several sets, by projections onto each."""

from collections.abc import Callable, Sequence

import torch

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.projection.sequential_qp import _free_rows

DYKSTRA_ROUNDS = 200  # of Dykstra's algorithm before sequential linearisation takes over


def _dykstra(
    g: Constraint,
    onto: Sequence[Callable[[Traj], Traj]],
    z: Traj,
    pins: Pins,
    tolerance: float,
    corrected: bool = True,
) -> Traj:
    """Dykstra's algorithm over projections onto sets whose intersection is g: the projection onto it where they are convex; on
    others a heuristic that is checked. Uncorrected it is plain alternation, which ends at some point of the intersection.
    """
    x, left = z, [torch.zeros_like(z) for _ in onto]
    for _ in range(DYKSTRA_ROUNDS):
        before = x
        for i, nearest_of in enumerate(onto):
            y = nearest_of(x + left[i])
            if corrected:
                left[i] = x + left[i] - y
            x = y
        if float((x - before).abs().max()) <= tolerance / 10 and bool(
            (_free_rows(g, x, pins) <= tolerance).all()
        ):
            break
    return x
