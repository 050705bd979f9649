"""Projection where no closed form serves: intersections, opaque rows, sequential linearisation, and
what is refused.
"""

import pytest
import torch

from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.black_box import BlackBox
from cdiff_cli.constraints.state_sets import HalfSpace, Quadric
from cdiff_cli.constraints.trajectory import Constraint, stack
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.projection.infeasible import MAX_FILTERED
from cdiff_cli.projection.project import project
from tests.problems import (
    F64,
    KINDS,
    QP,
    ball,
    chain,
    ellipsoid,
    free_projection,
    half_space,
    normal,
    num,
    opaque,
    pin,
    vec,
    waypoints,
)

# several, sequential, infeasible ------------------------------------------------------------------


def test_projection_onto_a_ball_and_a_half_space_ends_on_both_boundaries():
    g = stack(
        [
            waypoints(ball("inside", centre=(0.0, 0.0), radius=1.0), "b"),
            waypoints(HalfSpace(vec(1.0, 0.0), num(0.6)), "h"),
        ]
    )
    x = free_projection(g, vec(3.0, 3.0).reshape(1, 1, 2))
    torch.testing.assert_close(
        x.flatten(), vec(0.6, 0.8), atol=1e-6, rtol=0
    )  # the corner; Dykstra stops at 1e-10 a round


def test_projection_outside_two_balls_is_feasible():
    g = stack(
        [
            waypoints(ball("outside", centre=(0.0, 0.0), radius=1.0), "a"),
            waypoints(ball("outside", centre=(1.5, 0.0), radius=1.0), "b"),
        ]
    )
    x = free_projection(g, normal(2, 6, 4, 2, scale=0.8))
    assert float(g(x).max()) <= 1e-5  # what project promises of a non-convex intersection


def test_sequential_qp_of_a_black_box_half_space_agrees_with_the_closed_form():
    z = normal(3, 2, 3, 2)
    x = free_projection(opaque(lambda x: x[..., 0] - x[..., 1] - 0.2), z)
    torch.testing.assert_close(x, free_projection(waypoints(half_space()), z), atol=QP, rtol=0)


def test_sequential_qp_of_a_black_box_ball_agrees_with_the_closed_form():
    z = normal(4, 3, 2, 2, scale=2.0)
    x = free_projection(opaque(lambda x: x.square().sum(-1) - 1), z)
    torch.testing.assert_close(
        x,
        free_projection(waypoints(ball("inside", centre=(0.0, 0.0), radius=1.0)), z),
        atol=QP,
        rtol=0,
    )  # convex: the same


def test_black_box_that_couples_all_waypoints_keeps_the_pins():
    z = torch.zeros(1, 3, 1, dtype=F64)
    z[0, :, 0] = vec(1.0, 1.0, 1.0)
    total = Constraint((BlackBox("sum", lambda x: x.sum((1, 2))[:, None] - 1.0, lambda _: 1),))
    x = project(total, z, pin(z, 0))
    torch.testing.assert_close(x.flatten(), vec(1.0, 0.0, 0.0), atol=QP, rtol=0)


def test_barrier_over_an_ellipsoid_is_satisfied_by_sequential_qp():
    g, z = chain(ellipsoid("inside"), 0.5), normal(6, 2, 3, 2)
    assert float(g(free_projection(g, z)).max()) <= 1e-5  # what project promises


def test_conflict_of_two_half_spaces_names_both():
    g = stack(
        [
            waypoints(HalfSpace(vec(1.0, 0.0), num(-1.0)), "left"),
            waypoints(HalfSpace(vec(-1.0, 0.0), num(-1.0)), "right"),
        ]
    )
    with pytest.raises(InfeasibleError, match=r"(left|right)@0.*over"):
        free_projection(g, torch.zeros(1, 1, 2, dtype=F64))


def _slab(name, low, high):
    """low <= x <= high, two parts."""
    at_least, at_most = HalfSpace(vec(-1.0, 0.0), num(-low)), HalfSpace(vec(1.0, 0.0), num(high))
    return Constraint((AtWaypoints(f"{name}.low", at_least), AtWaypoints(f"{name}.high", at_most)))


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_conflict_of_two_slabs_names_the_facing_sides_and_not_a_disc(
    order,
):
    disc = waypoints(ball("outside", centre=(0.0, 3.0), radius=0.5), "disc")
    parts = [_slab("near", -1.0, 1.0), disc, _slab("far", 2.0, 3.0)]
    with pytest.raises(InfeasibleError) as caught:
        free_projection(stack([parts[i] for i in order]), normal(5, 1, 4, 2))
    said = str(caught.value).split("in conflict: ")[1]
    assert "near.high" in said
    assert "far.low" in said
    assert not any(name in said for name in ("disc", "near.low", "far.high"))


def test_conflict_beyond_the_filtered_parts_is_still_named():
    many = [_slab(f"slab{i}", -1.0 - i, 1.0 + i) for i in range(MAX_FILTERED)]
    with pytest.raises(InfeasibleError, match=r"slab0\.high.*far\.low"):
        free_projection(stack([*many, _slab("far", 1.5, 3.0)]), torch.zeros(1, 1, 2, dtype=F64))


def test_an_empty_quadric_is_refused():
    with pytest.raises(InfeasibleError, match="no feasible point at all"):
        free_projection(
            waypoints(Quadric(torch.eye(2, dtype=F64), vec(0.0, 0.0), num(-1.0))),
            torch.zeros(1, 1, 2, dtype=F64),
        )


@pytest.mark.parametrize("kind", ["half-space", "outside ball", "stack"])
def test_a_pinned_violation_is_named(kind):
    z = torch.zeros(2, 3, 2, dtype=F64)
    z[:, 2] = vec(0.5, -0.4)  # x - y = 0.9 > 0.2, inside the ball too
    name = KINDS[kind].labels(3)[2]
    with pytest.raises(InfeasibleError, match=f"pinned state violates {name}"):
        project(KINDS[kind], z, pin(z, 2))


def test_a_pinned_coordinate_that_alone_decides_a_row_is_named():
    z = torch.ones(1, 2, 2, dtype=F64)
    with pytest.raises(InfeasibleError, match="wall@1"):
        project(waypoints(HalfSpace(vec(1.0, 0.0), num(0.0)), "wall"), z, pin(z, 1, columns=[0]))


def test_conflict_of_pinned_ends_with_a_barrier_names_the_barrier():
    z = vec(3.0, 2.0, -1.0).reshape(1, 3, 1)  # h = x falls from 3 to -1: a chain never crosses 0
    with pytest.raises(InfeasibleError, match="c@1-2"):
        project(chain(HalfSpace(vec(-1.0), num(0.0)), 0.5), z, pin(z, 0, 2))


def test_two_neighbouring_pinned_waypoints_that_violate_a_barrier_are_refused():
    z = vec(3.0, 0.1, 0.0).reshape(1, 3, 1)
    g = Constraint(
        (
            DiscreteBarrier("speed", HalfSpace(vec(-1.0), num(0.0)), 0.5),
            AtWaypoints("w", HalfSpace(vec(1.0), num(9.0))),
        )
    )
    with pytest.raises(InfeasibleError, match="pinned state violates speed@0-1"):
        project(g, z, pin(z, 0, 1))
