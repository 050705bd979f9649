"""Dykstra's algorithm: the projection onto several sets, by projections onto each."""

from collections.abc import Callable, Sequence

import torch

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.projection.sequential_qp import free_rows

MAX_ROUNDS = 200  # rounds over all sets before the next strategy is tried


def dykstra(
    g: Constraint,
    projections: Sequence[Callable[[Traj], Traj]],
    z: Traj,
    pins: Pins,
    tolerance: float,
    corrected: bool = True,
) -> Traj:
    """The projection of z onto an intersection of convex sets, by projections onto each of them.

    For sets that are not convex the result is a heuristic and must be checked.

    g           the constraint that describes the intersection; the rounds end when it is satisfied
    corrected   False: alternating projections, which end at some point of the intersection
    """
    x, corrections = z, [torch.zeros_like(z) for _ in projections]
    for _ in range(MAX_ROUNDS):
        before = x
        for i, projection in enumerate(projections):
            y = projection(x + corrections[i])
            if corrected:
                corrections[i] = x + corrections[i] - y
            x = y
        if float((x - before).abs().max()) <= tolerance / 10 and bool(
            (free_rows(g, x, pins) <= tolerance).all()
        ):
            break
    return x
