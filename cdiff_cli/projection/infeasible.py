"""Why no trajectory satisfies a constraint: pins that violate it, and parts in conflict."""

import torch

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import check_rates
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.projection.sequential_qp import SATISFIED, free_rows, holds, sequential_qp

MAX_FILTERED = 8  # parts that are left out in turn to find those in conflict
FILTER_PROGRAMS = 10  # quadratic programs per part that is left out


def check_pins(g: Constraint, pins: Pins, tolerance: float) -> None:
    """Raise InfeasibleError for what no free coordinate can repair.

    That is rate limits that contradict each other, and pinned waypoints that alone violate a row by
    the tolerance.
    """
    check_rates(g)
    if not bool(pins.mask.any()) or pins.values.numel() == 0:
        return
    for part in g.parts:
        part.check_pins(pins, tolerance)


def explain(
    g: Constraint, z: Traj, start: Traj, last: Traj, pins: Pins, tolerance: float
) -> InfeasibleError:
    """The error for the first plan whose last iterate violates g; it names the parts in conflict.

    start, last   where sequential QP began and where it ended, float64   [batch, horizon, dim]
    """
    for b in range(len(z)):
        plan = slice(b, b + 1)
        held = Pins(pins.mask, start[plan])
        one = g.select(torch.tensor([b], device=z.device)).to(last)
        if not holds(one, last[plan], held):
            break
    parts = _conflict(one, z[plan].double(), start[plan], held, tolerance)
    return InfeasibleError(
        "no trajectory found that satisfies all constraints together; in conflict: "
        f"{', '.join(_worst_row(part, last[plan], held) for part in parts)}; relax or remove one of"
        " them"
    )


def _conflict(
    g: Constraint, z: Traj, start: Traj, pins: Pins, tolerance: float
) -> list[TrajectoryConstraint]:
    """Parts of g that, with the pins, leave no feasible point that sequential QP finds.

    Without any one of them it finds a point. This is a deletion filter (Chinneck and Dravnieks,
    1991) over the first MAX_FILTERED parts; all further parts are returned too.
    """
    kept = list(g.parts)
    for part in g.parts[:MAX_FILTERED]:
        rest = [other for other in kept if other is not part]
        fewer = Constraint(tuple(rest))
        if rest and not holds(
            fewer, sequential_qp(fewer, z, start, pins, tolerance, FILTER_PROGRAMS), pins
        ):
            kept = rest
    return kept


def _worst_row(part: TrajectoryConstraint, x: Traj, pins: Pins) -> str:
    """The label and value of the part's worst row at x, or its name where it is satisfied."""
    rows = free_rows(Constraint((part,)), x, pins)[0]
    if not bool((rows > SATISFIED).any()):
        return part.name
    worst = int(rows.argmax())
    return f"{part.labels(x.shape[1])[worst]} ({float(rows[worst]):.3g} over)"
