"""Segments outside balls: known answers, safety, pins, and how near the result is to the best one."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.state_sets import Ellipsoid, HalfSpace
from cdiff_cli.constraints.trajectory import Constraint, stack
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.projection.project import project
from cdiff_cli.projection.segments import MAX_CHOICES, normals, tangent_half_spaces
from cdiff_cli.projection.solvers.half_spaces import NEVER, HalfSpaces, nearest_in_half_spaces
from tests.problems import F64, ball, chain, least_distance, normal, num, pin, vec, waypoints

SAFE = {
    F64: 1e-9,
    torch.float32: 1e-5,
}  # rounding of coordinates of a few metres, in units of the smallest radius, 0.2
UNIT = ball("outside", centre=(0.0, 0.0), radius=1.0)
quick = settings(max_examples=25, deadline=None)
seeds = st.integers(0, 10_000)


def segments(level, name="s"):
    return Constraint((OnSegments(name, level),))


def outside(k, radius, dim=None):
    return ball("outside", centre=(0.0,) * k, radius=radius, dim=dim)


def free(g, z):
    return project(g, z, Pins.none(z))


def one(*points):
    return torch.tensor([points], dtype=F64)


def random_path(kind, seed, batch, horizon, k):
    """Rough: independent points. Smooth: a random walk around the origin. Straight: through its
    neighbourhood, evenly.
    """
    if kind == "rough":
        return normal(seed, batch, horizon, k)
    if kind == "smooth":
        walk = 0.3 * normal(seed, batch, horizon, k).cumsum(1)
        return walk - walk.mean(1, keepdim=True)
    a, b = normal(seed, batch, 1, k), normal(seed + 1, batch, 1, k, scale=0.3)
    return b + 2 * torch.linspace(-1, 1, horizon, dtype=F64)[:, None] * a / a.norm(
        dim=-1, keepdim=True
    )


def pushed_out(z, radius, by, *at):
    """z with these waypoints at least so far outside the ball."""
    z = z.clone()
    for tau in at:
        length = z[:, tau].norm(dim=-1, keepdim=True)
        z[:, tau] = torch.where(length < radius + by, z[:, tau] / length * (radius + by), z[:, tau])
    return z


# known answers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_straight_path_through_a_disc_goes_around_on_the_side_on_which_it_passes(side):
    s = torch.linspace(-2, 2, 21, dtype=F64)
    z = torch.stack((s, torch.full_like(s, 0.2 * side)), -1)[None]
    x = free(segments(UNIT), z)
    assert float(segments(UNIT)(x).max()) <= 1e-9
    assert float((side * x[0, :, 1]).min()) >= 0.1  # above all along, or below
    assert (
        float(x[0].diff(dim=0).norm(dim=-1).max()) <= 3 * 0.2
    )  # untorn: steps stretch to about twice
    torch.testing.assert_close(
        x[0, :, 0].flip(0), -x[0, :, 0], atol=1e-9, rtol=0
    )  # as symmetric as the problem


@pytest.mark.parametrize("k", [2, 3])
def test_a_path_through_the_very_centre_chooses_a_side(k):
    z = torch.zeros(1, 20, k, dtype=F64)
    z[0, :, 0] = torch.linspace(-2, 2, 20, dtype=F64)
    x = free(segments(outside(k, 1.0)), z)
    assert float(segments(outside(k, 1.0))(x).max()) <= 1e-9
    assert float(x[0].diff(dim=0).norm(dim=-1).max()) <= 3 * 0.21


def test_a_path_that_crosses_the_centre_with_a_waypoint_on_it_chooses_a_side():
    z = one((-2.0, 0.0), (-1.0, 0.0), (0.0, 0.0), (1.0, 0.0), (2.0, 0.0))
    assert float(segments(UNIT)(free(segments(UNIT), z)).max()) <= 1e-9


@pytest.mark.parametrize("at", [(0.5, 0.0), (0.0, 0.0)])
def test_path_at_rest_inside_a_ball_leaves_it_as_a_whole(at):
    x = free(segments(UNIT), torch.tensor(at, dtype=F64).expand(1, 4, 2).clone())
    assert float(segments(UNIT)(x).max()) <= 1e-9
    torch.testing.assert_close(x, x[:, :1].expand_as(x), atol=1e-9, rtol=0)
    torch.testing.assert_close(x[0, 0].norm(), num(1.0), atol=1e-9, rtol=0)


def test_single_segment_across_a_disc_moves_both_ends_to_the_tangent():
    x = free(segments(UNIT), one((-3.0, 0.6), (3.0, 0.6)))
    torch.testing.assert_close(x, one((-3.0, 1.0), (3.0, 1.0)), atol=1e-12, rtol=0)


def test_an_affine_change_makes_an_ellipsoid_a_ball():
    axes = vec(2.0, 0.5)
    level, s = (
        Ellipsoid(torch.eye(2, dtype=F64), vec(0.3, -0.1), axes, num(0.5), "outside"),
        torch.linspace(-3, 3, 31, dtype=F64),
    )
    z = torch.stack((s, 0.1 + 0 * s), -1)[None]
    assert torch.equal(
        normals(level, z, Pins.none(z)), normals(UNIT, level.scaled(z), Pins.none(z))
    )
    assert float(segments(level)(free(segments(level), z)).max()) <= 1e-9


def test_coordinates_that_the_ball_does_not_use_are_unchanged():
    z = normal(1, 2, 12, 4)
    x = free(segments(outside(2, 0.8, dim=4)), z)
    assert not torch.equal(x[..., :2], z[..., :2])
    assert torch.equal(x[..., 2:], z[..., 2:])


def test_half_space_is_the_same_half_space_at_every_waypoint():
    wall, z = HalfSpace(vec(1.0, 2.0), num(0.7)), normal(0, 2, 3, 2)
    a, b = tangent_half_spaces((AtWaypoints("w", wall),), z, Pins.none(z))
    assert torch.equal(a, wall.a.expand(2, 3, 1, 2))
    assert torch.equal(b, wall.b.expand(2, 3, 1))


def test_half_spaces_of_a_disc_are_tangent_and_absent_beyond_the_ends():
    z = normal(0, 2, 5, 2)
    a, b = tangent_half_spaces(segments(ball("outside")).parts, z, Pins.none(z))
    assert bool((b[:, 0, 0] == NEVER).all())
    assert bool((b[:, -1, 1] == NEVER).all())
    assert torch.equal(a[:, 1:, 0], a[:, :-1, 1])  # a segment's plane holds at both of its ends
    away = (b[:, 1:, 0] - a[:, 1:, 0] @ ball("outside").centre) / a[:, 1:, 0].norm(dim=-1)
    torch.testing.assert_close(away, torch.full_like(away, -0.7), atol=1e-12, rtol=0)


@pytest.mark.parametrize("by", [0.0, 1e-6, 0.01, 0.3])
def test_half_space_of_a_pinned_end_near_the_surface_contains_that_end(by):
    z = one((-1.0 - by, 0.0), (-0.5, 0.1), (0.0, 0.2), (0.5, 0.1), (1.0 + by, 0.0))
    x = project(segments(UNIT), z, pin(z, 0, 4))
    assert torch.equal(x[:, [0, 4]], z[:, [0, 4]])
    assert float(segments(UNIT)(x).max()) <= 1e-7  # what project promises
    n = normals(UNIT, z, pin(z, 0, 4))
    assert float(n[0, 0] @ z[0, 0]) >= 1 - 1e-12
    assert float(n[0, -1] @ z[0, -1]) >= 1 - 1e-12


def test_single_segment_pinned_on_opposite_sides_of_a_disc_is_refused():
    z = one((-2.0, 0.0), (2.0, 0.0))
    with pytest.raises(InfeasibleError):
        project(
            Constraint(
                (OnSegments("disc", UNIT), AtWaypoints("far", HalfSpace(vec(0.0, 1.0), num(9.0))))
            ),
            z,
            pin(z, 0, 1),
        )


def test_two_discs_are_both_avoided():
    g = stack(
        [
            segments(ball("outside", centre=(0.0, 0.0), radius=1.0), "a"),
            segments(ball("outside", centre=(2.6, 0.5), radius=0.8), "b"),
        ]
    )
    s = torch.linspace(-2, 5, 60, dtype=F64)
    z = torch.stack((s, 0.3 + 0 * s), -1)[None]
    x = project(g, z, pin(z, 0, 59))
    assert float(g(x).max()) <= 1e-7  # what project promises
    assert float((x - z).norm(dim=-1).max()) <= 1.5


def test_disc_and_wall_are_satisfied_together():
    """The wall y <= 1.2 leaves a gap of 0.2 above the disc, which the path has to thread."""
    g = stack([segments(UNIT), waypoints(HalfSpace(vec(0.0, 1.0), num(1.2)), "wall")])
    s = torch.linspace(-2, 2, 41, dtype=F64)
    z = torch.stack((s, 0.3 + 0 * s), -1)[None]
    x = free(g, z)
    assert float(g(x).max()) <= 1e-7
    assert float(x[0, 20, 1]) >= 1.0


BESIDE = {
    "inside a larger disc": (
        segments(ball("outside", centre=(0.0, 0.0), radius=0.5)),
        waypoints(ball("inside", centre=(0.0, 0.0), radius=2.1)),
    ),
    "a chain over a wall": (
        segments(ball("outside", centre=(0.0, 0.0), radius=0.5)),
        chain(HalfSpace(vec(0.0, 1.0), num(0.8)), 0.3),
    ),
    "a chain over the same disc": (
        Constraint(
            chain(ball("outside", centre=(0.0, 0.0), radius=0.5), 0.3).parts[0].on_segments()
        ),
    ),
}


@pytest.mark.parametrize("dtype", [F64, torch.float32])
@pytest.mark.parametrize("case", BESIDE)
def test_barriers_and_inner_discs_hold_together_with_an_outer_disc(case, dtype):
    s = torch.linspace(-2, 2, 64, dtype=F64)
    z = (torch.stack((s, 0.05 + 0 * s), -1) + 0.01 * normal(0, 2, 64, 2)).to(dtype)
    z[:, [0, -1]] *= 0.98
    g = stack(list(BESIDE[case])).to(z)
    x = project(g, z, pin(z, 0, 63))
    assert float(g(x).max()) <= (1e-7 if dtype == F64 else 2e-4)  # what project promises
    around = project(
        segments(ball("outside", centre=(0.0, 0.0), radius=0.5)).to(z), z, pin(z, 0, 63)
    )
    assert float((x - z).norm()) <= 1.2 * float(
        (around - z).norm()
    )  # hardly further than for the disc alone


# on a line ----------------------------------------------------------------------------------------


def test_a_path_on_a_line_goes_as_a_whole_to_the_side_that_is_nearer():
    x = free(segments(outside(1, 1.0)), one((-3.0,), (0.5,), (2.0,), (0.9,)))
    left = sum((v + 1) ** 2 for v in (0.5, 2.0, 0.9))  # 14.86
    right = (1 + 3) ** 2 + 0.5**2 + 0.1**2  # 16.26
    assert left < right
    torch.testing.assert_close(x, one((-3.0,), (-1.0,), (-1.0,), (-1.0,)), atol=1e-12, rtol=0)


def test_a_path_on_a_line_stays_on_the_side_of_its_pinned_start():
    z = one((1.5,), (-2.0,), (-3.0,))
    torch.testing.assert_close(
        project(segments(outside(1, 1.0)), z, pin(z, 0)),
        one((1.5,), (1.0,), (1.0,)),
        atol=1e-12,
        rtol=0,
    )


def test_pinned_ends_on_both_sides_of_an_interval_are_refused():
    z = one((1.5,), (0.0,), (-3.0,))
    with pytest.raises(InfeasibleError, match="no trajectory found"):
        project(segments(outside(1, 1.0)), z, pin(z, 0, 2))


# properties ---------------------------------------------------------------------------------------

paths = {
    "kind": st.sampled_from(["rough", "smooth", "straight"]),
    "seed": seeds,
    "horizon": st.sampled_from([1, 2, 3, 5, 12, 40]),
    "radius": st.sampled_from([0.2, 0.7, 1.5]),
    "dtype": st.sampled_from([F64, torch.float32]),
}


@pytest.mark.parametrize("k", [1, 2, 3])
@quick
@given(**paths)
def test_projection_on_segments_is_safe_and_idempotent(k, kind, seed, horizon, radius, dtype):
    z = random_path(kind, seed, 3, horizon, k).to(dtype)
    g = segments(outside(k, radius)).to(z)
    x = free(g, z)
    assert (x.dtype, x.shape) == (dtype, z.shape)
    far = (
        float(x.abs().max()) if horizon > 1 else 1.0
    )  # a tiny path around a ball's centre is sent far: so is its rounding
    assert float(g(x).amax() if horizon > 1 else 0.0) <= SAFE[dtype] * max(1.0, far)
    assert float((free(g, x) - x).abs().max()) <= 100 * SAFE[dtype] * max(
        1.0, far
    )  # two nearly parallel planes cost digits


@pytest.mark.parametrize("k", [2, 3])
@quick
@given(**paths, by=st.sampled_from([1e-5, 0.01, 0.2]))
def test_pinned_ends_never_move_and_the_result_is_safe(k, kind, seed, horizon, radius, dtype, by):
    horizon = max(
        horizon, 4
    )  # with three waypoints and a way of half a turn, the middle one is sent to infinity
    z = pushed_out(random_path(kind, seed, 3, horizon, k), radius, by, 0, -1).to(dtype)
    g = segments(outside(k, radius)).to(z)
    x = project(g, z, pin(z, 0, horizon - 1))
    assert torch.equal(x[:, [0, -1]], z[:, [0, -1]])
    assert float(g(x).max()) <= 2e-4 if dtype == torch.float32 else 1e-7  # what project promises


@quick
@given(**paths)
def test_safe_path_is_unchanged_to_the_bit(kind, seed, horizon, radius, dtype):
    z = random_path(kind, seed, 20, horizon, 2).to(dtype)
    g = segments(outside(2, radius)).to(z)
    z = z[(g(z) <= -1e-4).all(1)]
    assert torch.equal(free(g, z), z)


@pytest.mark.parametrize("k", [1, 2, 3])
@quick
@given(**paths)
def test_later_choices_of_half_spaces_never_increase_the_distance(
    k, kind, seed, horizon, radius, dtype
):
    z = random_path(kind, seed, 3, horizon, k).to(dtype)
    g, pins, x, last = segments(outside(k, radius)).to(z), Pins.none(z), z, None
    for _ in range(2 * MAX_CHOICES):
        x = nearest_in_half_spaces(z, tangent_half_spaces(g.parts, x, pins), pins.held)
        now = (x - z).norm(dim=(1, 2))
        rounding = (
            1e-7 if dtype == F64 else 3e-3
        )  # relative; where a waypoint lies between two nearly opposite planes
        assert last is None or bool((now <= last * (1 + rounding) + rounding).all())
        last = now


@pytest.mark.parametrize("horizon", [1, 2, 3])
def test_empty_batches_come_back_empty(horizon):
    z = torch.empty(0, horizon, 2, dtype=F64)
    assert free(segments(UNIT), z).shape == (0, horizon, 2)


def test_single_waypoint_has_no_segment():
    z = torch.zeros(2, 1, 2, dtype=F64)
    assert torch.equal(free(segments(UNIT), z), z)


# the nearest point in the planes ------------------------------------------------------------------


@quick
@given(seed=seeds, m=st.integers(1, 5))
def test_the_nearest_point_in_half_planes_is_the_least_distance_and_has_multipliers(seed, m):
    """b >= 0.2 keeps the origin feasible. Stationarity: z - x is a non-negative sum of the active
    normals.
    """
    a, b, z = (
        normal(seed, 2, 4, m, 2),
        normal(seed + 1, 2, 4, m).abs() + 0.2,
        normal(seed + 2, 2, 4, 2, scale=2.0),
    )
    x = nearest_in_half_spaces(z, HalfSpaces(a, b), Pins.none(z).held)
    assert float(((a * x[:, :, None]).sum(-1) - b).max()) <= 1e-9
    for i in range(2):
        for tau in range(4):
            A, at, to = a[i, tau].numpy(), z[i, tau].numpy(), x[i, tau].numpy()
            np.testing.assert_allclose(
                to, least_distance(A, b[i, tau].numpy(), at), atol=1e-6
            )  # the rounding of nnls
            active = A[A @ to - b[i, tau].numpy() > -1e-9]
            if not len(active):
                np.testing.assert_array_equal(to, at)
                continue
            mu, *_ = np.linalg.lstsq(active.T, at - to, rcond=None)
            assert np.abs(active.T @ mu - (at - to)).max() <= 1e-9
            assert len(active) > 2 or mu.min() >= -1e-9


def test_pinned_waypoints_ignore_half_spaces():
    z = normal(0, 1, 3, 2) + 5.0
    half_spaces = HalfSpaces(torch.ones(1, 3, 1, 2, dtype=F64), torch.zeros(1, 3, 1, dtype=F64))
    x = nearest_in_half_spaces(z, half_spaces, pin(z, 1).held)
    assert torch.equal(x[:, 1], z[:, 1])
    torch.testing.assert_close(
        x[:, [0, 2]].sum(-1), torch.zeros(1, 2, dtype=F64), atol=1e-12, rtol=0
    )


# against brute force ------------------------------------------------------------------------------


def slsqp(level, z, restarts=8):
    """The least distance of a segment-safe path from z [horizon, k] that SLSQP finds from random
    beginnings.
    """
    part, target, rng, best = OnSegments("s", level), z.numpy(), np.random.default_rng(0), math.inf
    shape, each = (1, *z.shape), torch.eye(len(z) - 1, dtype=F64)

    def room(v):
        return -part(torch.from_numpy(v.reshape(shape)))[0].numpy()

    def slope(v):
        _, pull, _ = part.linearise(torch.from_numpy(v.reshape(shape)))
        return -np.stack([pull(w[None]).flatten().numpy() for w in each])

    t = target.ravel()
    for i in range(restarts):
        found = minimize(
            lambda v: ((v - t) ** 2).sum(),
            t + rng.normal(size=t.shape) * (0.3, 1.0)[i % 2],
            jac=lambda v: 2 * (v - t),
            constraints={"type": "ineq", "fun": room, "jac": slope},
            method="SLSQP",
        )
        if room(found.x).min() >= -1e-6:
            best = min(best, math.sqrt(found.fun))
    return best


def test_distance_is_near_the_best_of_many_restarts_on_small_problems():
    """Straight paths of 4 to 8 waypoints through a disc: measured 1.00 to 1.17 times the best, 1.05
    in the middle.
    """
    ratios = []
    for seed in range(12):
        horizon, level = (4, 6, 8)[seed % 3], outside(2, (0.5, 0.8)[seed % 2])
        z = random_path("straight", seed, 1, horizon, 2)
        moved, best = float((free(segments(level), z) - z).norm()), slsqp(level, z[0])
        if best > 1e-3:
            ratios.append(moved / best)
    assert len(ratios) >= 8
    assert min(ratios) >= 1 - 1e-3  # SLSQP's own accuracy
    assert np.median(ratios) <= 1.1
    assert max(ratios) <= 1.3
