"""Why no trajectory was found: pinned states that violate a row, and parts in conflict."""

import torch

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import RateLimit, refuse_contradiction
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.projection.sequential_qp import _free_rows, _holds, _linearised, _movable

FILTERED = 8  # parts at most that are left out in turn to find which are in conflict


def _conflict(
    g: Constraint, z: Traj, begin: Traj, pins: Pins, tolerance: float
) -> list[TrajectoryConstraint]:
    """Parts of g, and the pins, that together leave no feasible point that linearisation finds, and without any one of which it
    finds one: a deletion filter (Chinneck and Dravnieks, 1991), over the first FILTERED parts; the others are all kept.
    """
    kept = list(g.parts)
    for part in g.parts[:FILTERED]:
        rest = [other for other in kept if other is not part]
        fewer = Constraint(tuple(rest))
        if rest and not _holds(
            fewer, _linearised(fewer, z, begin, pins, tolerance, rounds=10), pins
        ):
            kept = rest
    return kept


def _worst_row(part: TrajectoryConstraint, x: Traj, pins: Pins) -> str:
    """The part by its worst row at x, or by its name where all of them hold."""
    rows = _free_rows(Constraint((part,)), x, pins)[0]
    if not bool((rows > 1e-5).any()):
        return part.name
    worst = int(rows.argmax())
    return f"{part.labels(x.shape[1])[worst]} ({float(rows[worst]):.3g} over)"


def _refuse_pinned_violations(g: Constraint, z: Traj, pins: Pins, tolerance: float) -> None:
    """Limits in contradiction, or a pinned state outside the set, can never be repaired: say so before moving anything else."""
    refuse_contradiction([part for part in g.parts if isinstance(part, RateLimit)])
    if not bool(pins.mask.any()) or not g.parts or z.numel() == 0:
        return
    for part in g.parts:
        if isinstance(part, RateLimit):
            part.refuse_pins(pins, tolerance)
    stuck = torch.where(_movable(g, z, pins), 0.0, g(z)) > tolerance
    if bool(stuck.any()):
        row = int(stuck.any(0).nonzero()[0])
        raise InfeasibleError(
            f"the pinned state violates {g.labels(z.shape[1])[row]}; move the start or goal, or the constraint"
        )
