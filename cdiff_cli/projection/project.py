"""Euclidean projection onto {x : g(x) <= 0, pinned coordinates fixed}: exact forms where the structure is known.

    P(z) = argmin |x - z|^2  s.t.  g(x) <= 0          (paper, the projection operator)

half-space, ball, ellipsoid, any quadric at waypoints    closed form, or one scalar root
segments outside balls and ellipsoids, with half-spaces  a tangent plane a segment (segments.py), then exact, a local solution
control-barrier chain over a half-space or a ball        weighted isotonic regression, or of high order a small QP (projection/barrier.py)
limits on the rate of change between waypoints           ADMM on the differences (rate.py), convex
limits on rates around balls and ellipsoids              interior points (rate_dynamics.py), tangent planes as above
linear dynamics with bounded inputs, and any of these    active set (projection/dynamics.py), with rates interior points, ADMM for what has
                                                         no rows; a local solution
several of these together                                Dykstra's algorithm over the exact forms
anything else                                            sequential linearisation, each QP by ProxQP (qpsolvers)
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast

import torch

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.dynamics import dynamics_of, split
from cdiff_cli.constraints.hocbf import BallHOCBF
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import RateLimit
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.state_sets import Ellipsoid, HalfSpace, Quadric, QuadricInFrame
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.projection.barrier import project_barrier
from cdiff_cli.projection.dykstra import _dykstra
from cdiff_cli.projection.dynamics import ActiveSetWarmStart, project_dynamics
from cdiff_cli.projection.infeasible import _conflict, _refuse_pinned_violations, _worst_row
from cdiff_cli.projection.rate import RateProjection
from cdiff_cli.projection.rate_dynamics import (
    bounds_only,
    limits_steps,
    project_rate_dynamics,
    project_rates,
)
from cdiff_cli.projection.segments import crossed, excludes_ellipsoid, nearest_around
from cdiff_cli.projection.sequential_qp import _free_rows, _holds, _linearised
from cdiff_cli.projection.state import project_state

REFINEMENTS = 3  # choices of the tangent planes; within sampling one: the others change a plan's distance by 2.5 % at most
ADMM_ROUNDS = 600  # at most, where a part is met with dynamics by its projection alone (projection/dynamics.py)


def project(g: Constraint, z: Traj, pins: Pins, *, strict: bool = True) -> Traj:
    """The trajectory nearest to z [batch, horizon, dim] that satisfies g and the pins.

    Convex parts with a closed form: the global nearest point. Non-convex intersections: a feasible local one.

    strict   raise InfeasibleError, naming rows, where nothing feasible was found; otherwise, as within sampling, where the next
             estimate may be easier, return the best point that the tangent planes of segments gave
    """
    return project_reachable(g, z, pins)[0] if dynamics_of(g) else _project(g, z, pins, strict)


def project_reachable(
    g: Constraint,
    z: Traj,
    pins: Pins,
    warm: ActiveSetWarmStart | None = None,
    tolerance: float = 1e-6,
) -> tuple[Traj, ActiveSetWarmStart]:
    """The same for a g with dynamics: obeyed exactly, the other parts to the tolerance (environment units), from where an earlier
    call ended. In float64 within, the other parts on the coordinates that they constrain alone.
    """
    reachable, others = dynamics_of(g), split(g)[0].parts
    if len(reachable) > 1:
        raise InfeasibleError(
            f'two sets of dynamics, "{reachable[0].name}" and "{reachable[1].name}": a plan can obey only one'
        )
    kind, z, part = z, pins.paint(z).double(), reachable[0].to(z.double())
    back = (-part.centre / part.scale, 1 / part.scale)
    used = _coordinates(others, z.shape[-1])
    narrow = [_restricted(other.to(z).pull_back(*back), used) for other in others]
    around = cast(Any, [other for other in narrow if tangible(other)])
    rest = [other for other in narrow if not tangible(other)]
    paces = [other for other in rest if limits_steps(other)]
    target, held = part.decode(z), Pins(pins.mask, part.decode(pins.values.to(z)))
    if len(paces) == len(rest) > 0:
        begin = None if warm is None else part.dynamics.rollout(target[:, 0], warm.u)
        x, u = project_rate_dynamics(
            part.dynamics,
            around,
            paces,
            target,
            held,
            used=used,
            weight=part.weight,
            turns=REFINEMENTS,
            tolerance=tolerance,
            begin=begin,
        )
        none = u.new_zeros(len(u), 0)  # an interior point begins anew but for the inputs
        return pins.paint(part.encode(x).to(kind)), ActiveSetWarmStart(none, u, none, none, none)
    x, warm = project_dynamics(
        part.dynamics,
        around,
        _rest(rest),
        target,
        held,
        used=used,
        weight=part.weight,
        rounds=ADMM_ROUNDS,
        turns=REFINEMENTS,
        warm=warm,
        tolerance=tolerance,
    )
    return pins.paint(part.encode(x).to(kind)), warm


def _rest(parts: Sequence[TrajectoryConstraint]) -> Callable[[Traj, Pins], Traj] | None:
    """The projection onto these parts as ADMM asks for it, with the same pins round after round; None where there are none."""
    return (lambda p, held: _project(Constraint(tuple(parts)), p, held, False)) if parts else None


def _coordinates(parts: Sequence[TrajectoryConstraint], dim: int) -> list[int]:
    """The coordinates that the parts constrain."""
    found = torch.zeros(dim, dtype=torch.bool, device="cpu")
    for part in parts:
        level = part.acting if isinstance(part, DiscreteBarrier) else getattr(part, "level", None)
        if isinstance(level, HalfSpace):
            found |= (level.a != 0).view(-1, dim).any(0).cpu()
        elif isinstance(level, Ellipsoid):
            found |= (level.which != 0).view(-1, dim).any(0).cpu()
        elif isinstance(part, RateLimit):
            found |= (part.which != 0).any(0).cpu()
        else:
            found[:] = True
    return found.nonzero()[:, 0].tolist()


def _restricted(part: TrajectoryConstraint, used: Sequence[int]) -> TrajectoryConstraint:
    """The same part of those coordinates alone."""
    if isinstance(part, RateLimit):
        return replace(part, **{name: getattr(part, name)[..., used] for name in part.trailing})
    numbers: dict[str, Any] = {}
    for name in ("level", "ahead"):
        level = getattr(part, name, None)
        if isinstance(level, HalfSpace):
            numbers[name] = replace(level, a=level.a[..., used])
        elif isinstance(level, Ellipsoid):
            numbers[name] = replace(level, which=level.which[..., used])
    return cast(TrajectoryConstraint, replace(cast(Any, part), **numbers)) if numbers else part


def _project(g: Constraint, z: Traj, pins: Pins, strict: bool) -> Traj:
    z = pins.paint(z)
    tolerance = 1e-9 if z.dtype == torch.float64 else 2e-6
    if strict:
        _refuse_pinned_violations(g, z, pins, max(tolerance, 1e-6))
    if not g.parts or z.numel() == 0:
        return z
    sliding = any(isinstance(part, OnSegments) for part in g.parts)
    around = cast(Any, [part for part in g.parts if sliding and tangible(part)])
    others = [part for part in g.parts if not (sliding and tangible(part))]
    if (
        not around
        and len(others) > 1
        and pins.whole
        and (x := _onto_one(g, z, pins, tolerance)) is not None
    ):
        return x
    begin, turns, rates = (
        z,
        REFINEMENTS if strict else 1,
        [part for part in others if isinstance(part, RateLimit)],
    )
    paces = [part for part in others if limits_steps(part)]
    paced = bool(rates) and len(paces) == len(others) and bounds_only(pins)
    if paced and (around or len(rates) < len(paces)):
        begin = project_rates(around, paces, z, pins, turns)
        return (
            begin
            if not strict or _holds(g, begin, pins)
            else _sequential(g, z, begin, pins, tolerance)
        )
    if (pins.whole or not others) and all(has_exact_form(part) for part in others):
        onto = [lambda y: _around(around, y, pins, turns)] if around else []
        onto += [RateProjection(rates, pins)] if rates else []
        onto += [
            partial(exact, part, pins=pins) for part in others if not isinstance(part, RateLimit)
        ]
        x = onto[0](z) if len(onto) == 1 else _dykstra(g, onto, z, pins, tolerance)
        if len(g.parts) == 1 and not around and pins.loose[1] == z.shape[1]:
            return x  # one exact form misses only what is pinned behind what it moves
        if around and others and bool((_free_rows(g, x, pins) > 100 * tolerance).any()):
            x = _dykstra(
                g, onto, z, pins, tolerance, corrected=False
            )  # a feasible point, near if not the nearest
        if around and not strict:
            return x
        if not bool(
            (_free_rows(g, x, pins) > 100 * tolerance).any()
        ):  # pinned ends can contradict a chain between them
            return x
        if paced and _holds(g, x := project_rates((), paces, z, pins), pins):
            return x  # near to what the pins leave, ADMM takes more than its rounds
        begin = x if around else z  # near the set, on the side where the path passes
    return _sequential(g, z, begin, pins, tolerance)


def _onto_one(g: Constraint, z: Traj, pins: Pins, tolerance: float) -> Traj | None:
    """z where it obeys all parts, or its projection onto the only part that it does not obey, where that obeys the others too: the
    nearest point of a larger set that lies in the smaller one is the nearest of that. None where more have to be heard.
    """
    if not bool((g(z) > 0).any()):
        return z
    broken = [part for part in g.parts if bool((part(z) > 0).any())]
    if len(broken) > 1 or not has_exact_form(broken[0]):
        return None
    x = exact(broken[0], z, pins)
    return x if bool((_free_rows(g, x, pins) <= tolerance).all()) else None


def tangible(part: TrajectoryConstraint) -> bool:
    """Whether planes tangent to the part's surface, a few a waypoint, make a convex part of its set (segments.py)."""
    return (
        isinstance(part, AtWaypoints) and isinstance(part.level, HalfSpace)
    ) or excludes_ellipsoid(part)


def _around(parts: Sequence[AtWaypoints | OnSegments], z: Traj, pins: Pins, rounds: int) -> Traj:
    """Projection onto the half-spaces of tangent planes, chosen anew at each result; plans that obey already are left alone."""
    touched = crossed(parts, z).nonzero()[:, 0]
    if not len(touched):
        return z
    every = len(touched) == len(z)
    if every:
        return nearest_around(parts, z, pins, rounds)
    return z.index_copy(
        0,
        touched,
        nearest_around([part.select(touched) for part in parts], z[touched], pins, rounds),
    )


def has_exact_form(part: TrajectoryConstraint) -> bool:
    if isinstance(part, AtWaypoints):
        return isinstance(part.level, HalfSpace | Quadric | QuadricInFrame | Ellipsoid)
    if isinstance(part, RateLimit):
        return True
    if not isinstance(part, DiscreteBarrier):
        return False
    level = part.acting
    return isinstance(level, HalfSpace | BallHOCBF) or (
        isinstance(level, Ellipsoid) and level.side > 0 and level.is_ball
    )


def exact(part: TrajectoryConstraint, z: Traj, pins: Pins) -> Traj:
    """Projection onto one part that has an exact form."""
    if isinstance(part, AtWaypoints):
        return pins.paint(project_state(part.level, z))
    if isinstance(part, RateLimit):
        return RateProjection([part], pins)(z)
    assert isinstance(part, DiscreteBarrier)
    return pins.paint(project_barrier(part, z, pins))


def _sequential(g: Constraint, z: Traj, begin: Traj, pins: Pins, tolerance: float) -> Traj:
    """Sequential linearisation, one plan after another; InfeasibleError names the parts in conflict where nothing was found."""
    out = z.clone()
    for b in range(len(z)):
        target, x = z[b : b + 1].double(), begin[b : b + 1].double()
        held = Pins(pins.mask, x)
        one = g.select(torch.tensor([b], device=z.device)).to(x)
        at = _linearised(one, target, x, held, tolerance)
        if not _holds(one, at, held):
            kept = _conflict(one, target, x, held, tolerance)
            raise InfeasibleError(
                "no trajectory found that satisfies all constraints together; in conflict: "
                f"{', '.join(_worst_row(part, at, held) for part in kept)}; relax or remove one of them"
            )
        out[b] = at[0].to(z)
    return out
