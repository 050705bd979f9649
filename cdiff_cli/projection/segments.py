"""Trajectories whose straight segments stay outside balls and ellipsoids.

A segment avoids a ball exactly when some tangent plane of the ball has both its endpoints on the
outer side. One tangent plane is chosen per segment. The safe set then contains, waypoint by
waypoint, an intersection of a few half-spaces, which is convex and separable. Along a part of the
path that crosses the ball the normals turn from the entry to the exit (sphere_normals.py), so that
the projected path goes around the ball on one side. Pushing the waypoints straight outwards would
tear it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from typing import TypeGuard

import torch
from jaxtyping import Bool
from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj, each_end, times
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.state_sets import Ellipsoid, HalfSpace
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.projection.solvers.half_spaces import NEVER, HalfSpaces, nearest_in_half_spaces
from cdiff_cli.projection.solvers.sphere_normals import ahead, nearest_points, normals_of

MAX_CHOICES = (
    3  # choices of tangent half-spaces per projection; sampling makes one, at most 2.5 % farther
)

Obstacle = AtWaypoints | OnSegments
"""A half-space at waypoints, or the outside of an ellipsoid on segments."""
Plans = Bool[Tensor, "batch"]


def excludes_ellipsoid(part: TrajectoryConstraint) -> TypeGuard[OnSegments]:
    """Whether the part keeps segments outside an ellipsoid, which has tangent planes."""
    return (
        isinstance(part, OnSegments)
        and isinstance(part.level, Ellipsoid)
        and part.level.side == "outside"
    )


def has_half_spaces(part: TrajectoryConstraint) -> TypeGuard[Obstacle]:
    """Whether half-spaces per waypoint describe the part, or a convex subset of what it allows."""
    half_space = isinstance(part, AtWaypoints) and isinstance(part.level, HalfSpace)
    return half_space or excludes_ellipsoid(part)


def half_space_count(parts: Sequence[Obstacle]) -> int:
    """The number of half-spaces per waypoint that describe the parts."""
    return sum(1 if isinstance(part.level, HalfSpace) else 2 for part in parts)


def tangent_half_spaces(parts: Sequence[Obstacle], x: Traj, pins: Pins) -> HalfSpaces:
    """Half-spaces of each waypoint that together imply the parts, chosen at x.

    A half-space part is its own. An ellipsoid gets the tangent planes of the segments before and
    after the waypoint.
    """
    batch, horizon, dim = x.shape
    m = half_space_count(parts)
    a = x.new_zeros(dim, batch, m, horizon)  # torch sums over a short leading dimension fast
    b = x.new_full((batch, m, horizon), NEVER)
    slopes, bounds, row = a.permute(2, 1, 3, 0), b.transpose(0, 1), 0
    levels = [part.level for part in parts if isinstance(part.level, Ellipsoid)]
    each_normal = iter(_each_normals(levels, x, pins))
    for part in parts:
        level = part.level
        if isinstance(level, HalfSpace):
            slopes[row], bounds[row] = level.a, level.b
            row += 1
            continue
        assert isinstance(level, Ellipsoid)
        before, after = _tangents(level, next(each_normal))
        slopes[row, :, 1:], bounds[row, :, 1:] = before
        slopes[row + 1, :, :-1], bounds[row + 1, :, :-1] = after
        row += 2
    return HalfSpaces(a.permute(1, 3, 2, 0), b.transpose(1, 2))


def _tangents(level: Ellipsoid, normal: Tensor) -> tuple[HalfSpaces, HalfSpaces]:
    """The tangent half-space of each segment, for its last and for its first waypoint."""
    first, last = zip(
        each_end(level.which, 2), each_end(level.centre, 1), each_end(level.axes, 1), strict=True
    )
    at_last = _tangent(normal, *last)
    if all(v is w for v, w in zip(first, last, strict=True)):
        return at_last, at_last
    return at_last, _tangent(normal, *first)


def _tangent(n: Tensor, which: Tensor, centre: Tensor, axes: Tensor) -> HalfSpaces:
    """The half-spaces n.y >= 1 as a.x <= b, where y is Ellipsoid.scaled(x)."""
    slope = n / axes
    return HalfSpaces(-times(slope, which), -1 - (slope * centre).sum(-1))


def crossed(parts: Sequence[Obstacle], x: Traj, tolerance: float = 0.0) -> Plans:
    """Which trajectories violate one of the parts by more than the tolerance [batch]."""
    violated = []
    for part in parts:
        level = part.level
        if isinstance(level, HalfSpace):
            violated.append((level(x) > tolerance).any(1))
        else:
            assert isinstance(level, Ellipsoid)
            y = ahead(level.scaled(x))
            least = 1 - tolerance / level.m if tolerance else 1.0
            violated.append((nearest_points(y[:, :-1], y[:, 1:])[1] < least).any(1))
    if len(violated) == 1:
        return violated[0]
    return torch.stack(violated).any(0) if violated else x.new_zeros(len(x), dtype=torch.bool)


# the loop around obstacles ------------------------------------------------------------------------


@dataclass
class TangentChoice:
    """The half-spaces chosen so far for each plan of a batch.

    parts       act on the coordinates of x
    x           targets, of which only the shape and dtype are used   [batch, horizon, k]
    pins        pinned coordinates of x
    chosen      plans that have half-spaces                           [batch]
    complete    whether all plans have half-spaces
    """

    parts: Sequence[Obstacle]
    x: Traj
    pins: Pins
    chosen: Plans
    complete: bool = False

    @classmethod
    def none(cls, parts: Sequence[Obstacle], x: Traj, pins: Pins) -> "TangentChoice":
        """No plan has half-spaces."""
        return cls(parts, x, pins, torch.zeros(len(x), dtype=torch.bool, device=x.device))

    @cached_property
    def half_spaces(self) -> HalfSpaces:
        """Half-spaces of all plans; those never chosen restrict nothing."""
        (batch, horizon, dim), m = self.x.shape, half_space_count(self.parts)
        a = self.x.new_zeros(batch, horizon, m, dim)
        return HalfSpaces(a, self.x.new_full((batch, horizon, m), NEVER))

    def choose(self, x: Traj, plans: Tensor) -> None:
        """Choose the half-spaces of the plans with these indices at x."""
        if not len(plans):
            return
        if len(plans) == len(x):
            self.half_spaces = tangent_half_spaces(self.parts, x, self.pins)
            self.chosen, self.complete = torch.ones_like(self.chosen), True
            return
        pins = Pins(self.pins.mask, self.pins.values[plans])
        a, b = tangent_half_spaces([part.select(plans) for part in self.parts], x[plans], pins)
        self.half_spaces.a[plans], self.half_spaces.b[plans] = a, b
        self.chosen = self.chosen.index_fill(0, plans, True)
        self.complete = bool(self.chosen.all())

    def newly_unsafe(self, x: Traj, tolerance: float) -> Plans:
        """Plans without half-spaces that violate a part by more than the tolerance."""
        if self.complete:
            return ~self.chosen
        return crossed(self.parts, x, tolerance) & ~self.chosen


def around_obstacles(
    solve: Callable[[HalfSpaces, Tensor], tuple[Traj, Plans]],
    choice: TangentChoice,
    x: Traj,
    unsafe: Tensor,
    max_choices: int,
    tolerance: float = 0.0,
) -> Traj:
    """The last solutions of a problem whose obstacles are replaced by tangent half-spaces.

    Half-spaces are chosen first at x for its unsafe plans, then at each solution: for the plans
    that have half-spaces, because the set that the new ones describe contains the solution and may
    come nearer; and once for every plan that became unsafe.

    solve         (half-spaces of all plans, indices of the plans to solve) -> their trajectories,
                  and whether to keep their half-spaces from then on
    x             trajectories in the coordinates of the parts
    unsafe        indices of the plans that get half-spaces before the first solution
    max_choices   how often the half-spaces of a plan are chosen
    tolerance     violation of a part that is accepted
    """
    choice.choose(x, unsafe)
    x, kept = solve(choice.half_spaces, torch.arange(len(x), device=x.device))
    for k in range(1, max_choices + 1):
        if choice.complete and k == max_choices:
            break
        again = choice.newly_unsafe(x, tolerance)
        if k < max_choices:
            again = again | choice.chosen & ~kept
        plans = again.nonzero()[:, 0]
        if not len(plans):
            break
        choice.choose(x, plans)
        solution, keep = solve(choice.half_spaces, plans)
        if len(plans) == len(x):
            x, kept = solution, keep
        else:
            x, kept = x.index_copy(0, plans, solution), kept.index_copy(0, plans, keep)
    return x


def project_segments(parts: Sequence[Obstacle], z: Traj, pins: Pins, max_choices: int) -> Traj:
    """The nearest trajectory in tangent half-spaces of the parts; safe plans are left unchanged.

    A later choice of half-spaces never increases the distance to z, because its set contains the
    last solution.
    """
    plans = crossed(parts, z).nonzero()[:, 0]
    if not len(plans):
        return z
    if len(plans) < len(z):
        near = _around([part.select(plans) for part in parts], z[plans], pins, max_choices)
        return z.index_copy(0, plans, near)
    return _around(parts, z, pins, max_choices)


def _around(parts: Sequence[Obstacle], z: Traj, pins: Pins, max_choices: int) -> Traj:
    """The nearest trajectory in tangent half-spaces of the parts, which every plan gets."""
    choice = TangentChoice.none(parts, z, pins)
    again = choice.chosen  # no plan keeps its half-spaces

    def solve(half_spaces: HalfSpaces, _: Tensor) -> tuple[Traj, Plans]:
        return nearest_in_half_spaces(z, half_spaces, pins.held), again

    every = torch.arange(len(z), device=z.device)
    return around_obstacles(solve, choice, z, every, max_choices)


# tangent planes as rows ---------------------------------------------------------------------------


@dataclass(frozen=True)
class TangentPlanes:
    """A constraint in which tangent half-spaces replace the parts that exclude ellipsoids.

    Its rows are those of the other parts, then per ellipsoid the rows of the segment before each
    waypoint and of the segment after it. They are in the units of the parts, and -1 where there is
    no such segment.

    rest          the other parts
    half_spaces   [batch, horizon, m, dim] and [batch, horizon, m], in the units of the parts
    """

    rest: Constraint
    half_spaces: HalfSpaces

    def __call__(self, x: Traj) -> Rows:
        return self.linearise(x)[0]

    @cached_property
    def leading(self) -> HalfSpaces:
        """a [dim, batch, m, horizon] and b [batch, m, horizon], as they are in memory.

        Sums over a short last dimension are several times slower.
        """
        a, b = self.half_spaces
        return HalfSpaces(a.permute(3, 0, 2, 1), b.transpose(1, 2))

    def _values(self, x: Traj) -> Rows:
        a, b = self.leading
        return ((a * x.movedim(-1, 0).contiguous()[:, :, None]).sum(0) - b).flatten(1)

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        """The values, the pull and the bounds, as Constraint.linearise returns them."""
        parts, m = len(self.rest.parts), self.half_spaces.b.shape[2]
        size = (parts + m) * self.leading.a.square().sum(0).flatten(1)
        if not parts:
            return self._values(x), self._pull, size
        rows, rest_pull, rest_size = self.rest.linearise(x)
        n = rows.shape[1]
        sizes = torch.cat((rest_size * ((parts + m) / parts), size), 1)
        return (
            torch.cat((rows, self._values(x)), 1),
            lambda w: rest_pull(w[:, :n]) + self._pull(w[:, n:]),
            sizes,
        )

    def _pull(self, w: Rows) -> Traj:
        a, b = self.leading
        return (w.reshape(b.shape) * a).sum(2).movedim(0, -1)


def split_excluded(g: Constraint) -> tuple[list[OnSegments], Constraint]:
    """The parts of g that exclude ellipsoids from segments, and the others."""
    excluding = [part for part in g.parts if excludes_ellipsoid(part)]
    if not excluding:
        return [], g
    return excluding, Constraint(tuple(part for part in g.parts if not excludes_ellipsoid(part)))


def row_blocks(g: Constraint, horizon: int, planes: bool) -> list[slice]:
    """Where the multipliers of g stand, block by block; the rows of a block follow the waypoints.

    A plan that is shifted by some waypoints shifts each block by as many rows.

    planes   True: the rows of with_tangent_planes(g), False: the rows of g itself
    """
    excluding, rest = split_excluded(g) if planes else ([], g)
    counts = [len(part.labels(horizon)) for part in rest.parts] + 2 * len(excluding) * [horizon]
    ends = list(accumulate(counts, initial=0))
    return [slice(begin, end) for begin, end in pairwise(ends)]


def with_tangent_planes(g: Constraint, x: Traj, pins: Pins) -> Constraint | TangentPlanes:
    """g with tangent planes chosen at x in the place of each part that excludes an ellipsoid."""
    excluding, rest = split_excluded(g)
    if not excluding:
        return g
    planes = TangentPlanes(rest, tangent_half_spaces(excluding, x, pins))
    a, b = planes.leading
    for k, part in enumerate(excluding):
        assert isinstance(part.level, Ellipsoid)
        rows, m = slice(2 * k, 2 * k + 2), part.level.m.expand(x.shape[:2])[:, None]
        a[:, :, rows] *= m
        b[:, rows] = torch.where(b[:, rows] == NEVER, 1.0, m * b[:, rows])
    return planes


def normals(level: Ellipsoid, x: Traj, pins: Pins) -> Tensor:
    """Normals of the tangent planes, one per segment [batch, horizon - 1, k].

    They are in the coordinates in which the surface is the unit sphere (sphere_normals.py).
    """
    return _each_normals([level], x, pins)[0]


def _each_normals(levels: Sequence[Ellipsoid], x: Traj, pins: Pins) -> Sequence[Tensor]:
    """The normals of several ellipsoids, in one call where their shapes and pins agree."""
    scaled = [level.scaled(x) for level in levels]
    held = [
        pins.held if pins.whole else pins.mask[:, level.which.argmax(-1)].all(1) for level in levels
    ]
    alike = len({y.shape[-1] for y in scaled}) == 1 and all(
        h is held[0] or torch.equal(h, held[0]) for h in held[1:]
    )
    if not alike or len(levels) == 1:
        return [normals_of(ahead(y), pinned) for y, pinned in zip(scaled, held, strict=True)]
    return normals_of(ahead(torch.cat(scaled)), held[0]).chunk(len(levels))
