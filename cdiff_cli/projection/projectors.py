"""The projection onto one part of a constraint, by the type of the part."""

from collections.abc import Callable
from typing import Any, NamedTuple

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.dynamics import LinearDynamicsConstraint
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import RateLimit
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.trajectory import TrajectoryConstraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.projection.barrier import has_barrier_projection, project_barrier
from cdiff_cli.projection.rate import RateProjection
from cdiff_cli.projection.segments import MAX_CHOICES, excludes_ellipsoid, project_segments
from cdiff_cli.projection.state import has_state_projection, project_state


class Projector(NamedTuple):
    """How the nearest trajectory that satisfies a part is computed.

    method    as `cdiff check` prints it
    applies   part -> whether the part has the form that the method needs
    project   (part, trajectory, pins) -> the nearest trajectory; waypoints are pinned as a whole or
              not at all
    """

    method: str
    applies: Callable[[Any], bool]
    project: Callable[[Any, Traj, Pins], Traj]


def _at_waypoints(part: AtWaypoints, z: Traj, pins: Pins) -> Traj:
    return pins.paint(project_state(part.level, z))


def _on_segments(part: OnSegments, z: Traj, pins: Pins) -> Traj:
    assert excludes_ellipsoid(part)
    return project_segments([part], z, pins, MAX_CHOICES)


def _on_barrier(part: DiscreteBarrier, z: Traj, pins: Pins) -> Traj:
    return pins.paint(project_barrier(part, z, pins))


def _within_rate(part: RateLimit, z: Traj, pins: Pins) -> Traj:
    return RateProjection([part], pins)(z)


PROJECTORS: dict[type, Projector] = {
    AtWaypoints: Projector("exact", has_state_projection, _at_waypoints),
    OnSegments: Projector("tangent half-spaces", excludes_ellipsoid, _on_segments),
    DiscreteBarrier: Projector("exact", has_barrier_projection, _on_barrier),
    RateLimit: Projector("ADMM", lambda _: True, _within_rate),
}
"""Parts of any other form are projected by sequential QP."""


def projector_of(part: TrajectoryConstraint) -> Projector | None:
    """The projector of the part, None where it has no form that a projector takes."""
    projector = PROJECTORS.get(type(part))
    return projector if projector is not None and projector.applies(part) else None


def projection_method(part: TrajectoryConstraint) -> str:
    """How a trajectory is projected onto the part, as `cdiff check` prints it."""
    if isinstance(part, LinearDynamicsConstraint):
        return "active set"
    projector = projector_of(part)
    return "sequential (ProxQP)" if projector is None else projector.method
