"""Projections: known answers, agreement with a QP solver and with brute force, idempotence, pins."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.state_sets import Ellipsoid, HalfSpace, Quadric
from cdiff_cli.constraints.trajectory import Constraint, stack
from cdiff_cli.projection.project import project
from cdiff_cli.projection.state import project_state
from tests.problems import (
    F64,
    KINDS,
    LEVELS,
    QP,
    ball,
    chain,
    ellipsoid,
    free_projection,
    half_space,
    nearest_of,
    normal,
    num,
    pin,
    qp_projection,
    saddle,
    vec,
    waypoints,
)

seeds = st.integers(0, 10_000)
quick = settings(max_examples=30, deadline=None)
CONVEX = [
    "half-space",
    "inside ball",
    "inside ball squared",
    "inside ellipsoid",
    "dcbf over half-space",
]
EXACT = [
    *CONVEX,
    "outside ball",
    "outside ball squared",
    "outside ellipsoid",
    "general quadric",
    "dcbf over outside ball",
]


# known answers ------------------------------------------------------------------------------------


def test_half_space_moves_along_its_normal():
    x = free_projection(
        waypoints(HalfSpace(vec(3.0, 4.0), num(0.0))), vec(3.0, 4.0).reshape(1, 1, 2)
    )
    torch.testing.assert_close(x.flatten(), vec(0.0, 0.0), atol=1e-15, rtol=0)  # rounding


@pytest.mark.parametrize(
    ("side", "start", "end"),
    [
        ("outside", (0.5, 0.0), (2.0, 0.0)),
        ("outside", (0.0, 3.0), (0.0, 3.0)),
        ("outside", (0.0, 0.0), (2.0, 0.0)),  # the centre goes along the first axis
        ("inside", (3.0, 4.0), (1.2, 1.6)),
        ("inside", (0.5, 0.0), (0.5, 0.0)),
    ],
)
def test_ball_moves_radially_to_its_sphere(side, start, end):
    x = free_projection(
        waypoints(ball(side, centre=(0.0, 0.0), radius=2.0)), vec(*start).reshape(1, 1, 2)
    )
    torch.testing.assert_close(x.flatten(), vec(*end), atol=1e-14, rtol=0)  # rounding


def test_ball_leaves_coordinates_it_does_not_name():
    level = Ellipsoid(torch.eye(2, 4, dtype=F64), vec(0.0, 0.0), vec(1.0, 1.0), num(1.0), "outside")
    x = free_projection(waypoints(level), vec(0.5, 0.0, 7.0, -7.0).reshape(1, 1, 4))
    torch.testing.assert_close(x.flatten(), vec(1.0, 0.0, 7.0, -7.0), atol=1e-15, rtol=0)


def test_centre_of_an_ellipsoid_leaves_along_its_short_axis():
    x = free_projection(
        waypoints(ellipsoid("outside", centre=(0.0, 0.0), axes=(3.0, 1.0))),
        torch.zeros(1, 1, 2, dtype=F64),
    )
    torch.testing.assert_close(
        x.abs().flatten(), vec(0.0, 1.0), atol=2e-6, rtol=0
    )  # a stationary point is stepped off by 1e-6


def test_quadric_of_deficient_rank_leaves_the_other_coordinates():
    level = Quadric(torch.diag(vec(0.0, 1.0, 2.0)), vec(0.0, 0.0, 0.0), num(1.0))
    x = free_projection(waypoints(level), vec(5.0, 3.0, 0.0).reshape(1, 1, 3))
    torch.testing.assert_close(
        x.flatten(), vec(5.0, 1.0, 0.0), atol=1e-9, rtol=0
    )  # bisection to float64's resolution


def test_rotated_quadric_of_deficient_rank_leaves_its_null_direction():
    turn = torch.linalg.qr(normal(3, 3, 3)).Q
    level = Quadric(
        turn @ torch.diag(vec(0.0, 0.0, 1.0)) @ turn.T, torch.zeros(3, dtype=F64), num(1.0)
    )
    x = free_projection(waypoints(level), (turn @ vec(1.0, -2.0, 4.0)).reshape(1, 1, 3))
    torch.testing.assert_close(
        x.flatten() @ turn, vec(1.0, -2.0, 1.0), atol=1e-9, rtol=0
    )  # the same, after a rotation


def test_barrier_of_two_waypoints_moves_both_by_their_weights():
    # h = x; x' >= x / 2.  (2, 0): minimise (a - 2)^2 + (a / 2)^2, a = 1.6
    x = free_projection(chain(HalfSpace(vec(-1.0), num(0.0)), 0.5), vec(2.0, 0.0).reshape(1, 2, 1))
    torch.testing.assert_close(x.flatten(), vec(1.6, 0.8), atol=1e-14, rtol=0)


def test_barrier_from_a_pinned_start_moves_later_waypoints_only():
    z = vec(2.0, 0.0, 0.0).reshape(1, 3, 1)
    x = project(chain(HalfSpace(vec(-1.0), num(0.0)), 0.5), z, pin(z, 0))
    torch.testing.assert_close(x.flatten(), vec(2.0, 1.0, 0.5), atol=1e-14, rtol=0)


@quick
@given(seed=seeds, horizon=st.integers(1, 12))
def test_barrier_with_alpha_one_is_clipping_after_the_first_waypoint(seed, horizon):
    z = normal(seed, 2, horizon, 2)
    x = free_projection(chain(half_space(), 1.0), z)
    clipped = torch.cat((z[:, :1], project_state(half_space(), z[:, 1:])), 1)
    torch.testing.assert_close(x, clipped, atol=1e-14, rtol=0)


def test_a_plan_at_the_centre_of_a_ball_leaves_it_as_slowly_as_the_barrier_allows():
    z = torch.zeros(1, 3, 2, dtype=F64)
    x = free_projection(
        chain(ball("outside", centre=(0.0, 0.0), radius=1.0), 0.5), z
    )  # h = |x| - 1 >= -1: -1, -1/2, -1/4
    torch.testing.assert_close(x.norm(dim=-1), vec(0.0, 0.5, 0.75)[None], atol=1e-14, rtol=0)


# properties ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", EXACT)
@settings(max_examples=15, deadline=None)
@given(seed=seeds, horizon=st.integers(1, 6))
def test_projection_is_feasible_and_idempotent(kind, seed, horizon):
    x = free_projection(KINDS[kind], normal(seed, 3, horizon, 2, scale=1.5))
    rows = KINDS[kind](x)
    assert (
        rows.numel() == 0 or float(rows.max()) <= 1e-9
    )  # the secular root is bisected to float64's resolution
    torch.testing.assert_close(free_projection(KINDS[kind], x), x, atol=1e-8, rtol=0)


@pytest.mark.parametrize("kind", EXACT)
@settings(max_examples=15, deadline=None)
@given(seed=seeds)
def test_feasible_trajectories_are_unchanged(kind, seed):
    z = normal(seed, 40, 2, 2, scale=1.5)
    z = z[(KINDS[kind](z) <= -1e-9).all(1)]
    torch.testing.assert_close(
        free_projection(KINDS[kind], z), z, atol=1e-14, rtol=0
    )  # a chain re-averages single values: rounding


@pytest.mark.parametrize("kind", CONVEX)
@settings(max_examples=20, deadline=None)
@given(seed=seeds, horizon=st.integers(1, 8))
def test_projection_onto_convex_sets_is_non_expansive(kind, seed, horizon):
    a, b = normal(seed, 4, horizon, 2, scale=2.0), normal(seed + 1, 4, horizon, 2, scale=2.0)
    moved = (
        (free_projection(KINDS[kind], a) - free_projection(KINDS[kind], b)).flatten(1).norm(dim=1)
    )
    assert bool(
        (moved <= (a - b).flatten(1).norm(dim=1) + 1e-9).all()
    )  # 1e-9: the bisection's resolution


@pytest.mark.parametrize("kind", EXACT)
@settings(max_examples=8, deadline=None)
@given(seed=seeds, horizon=st.integers(2, 5))
def test_pinned_waypoints_never_move(kind, seed, horizon):
    z = normal(seed, 3, horizon, 2)
    z[:, 0] = (
        vec(0.2, 0.1) if "inside" in kind else vec(0.0, 1.1)
    )  # allowed: a pinned start that is not is refused
    x = project(KINDS[kind], z, pin(z, 0))
    assert torch.equal(x[:, 0], z[:, 0])
    assert float(KINDS[kind](x).max()) <= 1e-9  # the bisection's resolution


def test_empty_batches_come_back_empty():
    for g in KINDS.values():
        z = torch.empty(0, 4, 2, dtype=F64)
        assert project(g, z, Pins.none(z)).shape == (0, 4, 2)


def test_no_constraint_only_paints_the_pins():
    z, values = normal(0, 2, 3, 2), normal(1, 2, 3, 2)
    x = project(Constraint(()), z, pin(values, 0))
    assert torch.equal(x[:, 0], values[:, 0])
    assert torch.equal(x[:, 1:], z[:, 1:])


@pytest.mark.parametrize("kind", EXACT)
def test_float32_projections_are_feasible_to_float32(kind):
    z = normal(5, 8, 6, 2, scale=1.5).float()
    g = KINDS[kind].to(z)
    x = project(g, z, Pins.none(z))
    assert x.dtype == torch.float32
    assert float(g(x).max()) <= 1e-5  # values up to about 5, 24 bits


# against a QP solver ------------------------------------------------------------------------------


@quick
@given(seed=seeds)
def test_half_space_agrees_with_proxqp(seed):
    a, z = normal(seed, 2), normal(seed + 1, 2, 3, 2)
    g = waypoints(HalfSpace(a, num(0.1)))
    torch.testing.assert_close(free_projection(g, z), qp_projection(g, z), atol=QP, rtol=0)


@quick
@given(seed=seeds, n=st.integers(2, 4))
def test_stacks_of_half_spaces_agree_with_proxqp(seed, n):
    """b > 0 keeps the origin feasible; normals stand 0.9 rad apart or more: Dykstra is slow between
    nearly parallel walls.
    """
    z = normal(seed, 1, 3, 2)
    turn = 2.4 * torch.arange(n) + float(normal(seed + 1, 1))
    g = stack(
        [
            waypoints(HalfSpace(torch.stack((a.cos(), a.sin())).to(z), num(0.2)), f"w{i}")
            for i, a in enumerate(turn)
        ]
    )
    torch.testing.assert_close(
        free_projection(g, z), qp_projection(g, z), atol=1e-5, rtol=0
    )  # Dykstra stops when a round moves 1e-10; at sharp corners slower


def test_half_space_with_a_barrier_agrees_with_proxqp():
    g, z = (
        stack([chain(half_space(), 0.3), waypoints(HalfSpace(vec(0.0, 1.0), num(0.1)))]),
        normal(7, 3, 5, 2),
    )
    torch.testing.assert_close(
        free_projection(g, z), qp_projection(g, z), atol=1e-5, rtol=0
    )  # as above


@pytest.mark.parametrize("alpha", [1e-3, 0.02, 0.3, 0.9, 1.0])
@pytest.mark.parametrize("horizon", [1, 2, 16, 64])
@pytest.mark.parametrize("pinned", ["free", "start pinned"])
def test_barrier_over_a_half_space_agrees_with_proxqp(horizon, alpha, pinned):
    z = normal(horizon, 2, horizon, 2)
    z[:, 0] = vec(-0.5, 0.5)  # h = 1.2
    g = chain(half_space(), alpha)
    pins = pin(z, 0) if pinned == "start pinned" else Pins.none(z)
    x = project(g, z, pins)
    if horizon == 1:
        assert torch.equal(x, z)
        return
    assert float(g(x).max()) <= 1e-12  # rounding
    torch.testing.assert_close(x, qp_projection(g, z, pins), atol=QP, rtol=0)


@settings(max_examples=15, deadline=None)
@given(seed=seeds, horizon=st.integers(3, 12), alpha=st.floats(1e-3, 1.0))
def test_barrier_between_two_pinned_ends_agrees_with_proxqp(seed, horizon, alpha):
    z = normal(seed, 1, horizon, 2)
    z[:, 0], z[:, -1] = vec(-0.2, 0.2), vec(-0.5, 0.5)  # h rises from 0.6 to 1.2: always possible
    g, pins = chain(half_space(), alpha), pin(z, 0, -1)
    x = project(g, z, pins)
    assert torch.equal(x[:, [0, -1]], z[:, [0, -1]])
    torch.testing.assert_close(x, qp_projection(g, z, pins), atol=QP, rtol=0)


def test_barrier_moves_only_the_free_coordinates_of_a_partly_pinned_waypoint():
    z = normal(9, 2, 4, 2)
    z[:, 0] = vec(-0.5, 0.5)
    pins = pin(z, 0, 2, columns=[0])
    x = project(chain(half_space(), 0.3), z, pins)
    assert torch.equal(x[:, [0, 2], 0], z[:, [0, 2], 0])
    torch.testing.assert_close(x, qp_projection(chain(half_space(), 0.3), z, pins), atol=QP, rtol=0)


def test_half_space_moves_only_the_free_coordinate_of_a_pinned_state():
    z = vec(1.0, 0.0).reshape(1, 1, 2)
    x = project(waypoints(HalfSpace(vec(1.0, 1.0), num(0.0))), z, pin(z, 0, columns=[0]))
    torch.testing.assert_close(x.flatten(), vec(1.0, -1.0), atol=QP, rtol=0)


# against brute force ------------------------------------------------------------------------------


def _boundary(level, reach=6.0, n=1201):
    """Points of {f = 0}: the zeros of f along the lines of a fine grid, each interpolated then
    polished by Newton steps.
    """
    line = torch.linspace(-reach, reach, n, dtype=F64)
    grid = torch.stack(torch.meshgrid(line, line, indexing="ij"), -1)
    f = level(grid)
    crossing = (f[:-1] * f[1:] <= 0) | (f[:-1] * torch.cat((f[1:, 1:], f[1:, -1:]), 1) <= 0)
    points = grid[:-1][crossing]
    for _ in range(6):
        slope = level.gradient(points)
        points = points - (level(points) / slope.square().sum(-1).clamp_min(1e-9))[:, None] * slope
    return points[level(points).abs() < 1e-9]


@pytest.mark.parametrize("name", [name for name in LEVELS if name != "half-space"])
def test_quadric_projection_is_the_nearest_boundary_point(name):
    level, z = (
        LEVELS[name],
        torch.cat((normal(11, 60, 2, scale=1.5), vec(0.3, -0.2) + normal(12, 40, 2, scale=0.3))),
    )
    z = z[level(z) > 1e-3]
    moved = (project_state(level, z) - z).norm(dim=-1)
    best = nearest_of(_boundary(level), z)
    # the grid is 0.01 wide, so the cloud has a point within 0.0071 of the nearest one
    assert bool((moved <= best + 1e-8).all())
    assert bool((moved >= best - 0.0071).all())


@quick
@given(seed=seeds)
def test_projection_onto_a_random_indefinite_quadric_is_stationary(seed):
    P = normal(seed, 3, 3)
    level = Quadric((P + P.T) / 2, normal(seed + 1, 3), num(0.3))
    z = normal(seed + 2, 5, 3)
    z = z[level(z) > 0]
    x = project_state(level, z)
    n, d = level.gradient(x), z - x
    assert (
        float(level(x).abs().max() if len(x) else 0.0) <= 1e-6
    )  # f on the boundary; gradients of about 10, roots to 1e-9
    along = (n * d).sum(-1, keepdim=True) / n.square().sum(-1, keepdim=True)
    torch.testing.assert_close(
        d, along * n, atol=1e-5, rtol=0
    )  # z - x is a positive multiple of the normal
    assert bool((along >= 0).all())


def test_saddle_projection_is_the_global_one_of_two_near_branches():
    z = vec(3.0, 0.0).reshape(1, 2)
    moved = (project_state(saddle(), z) - z).norm()
    assert float(moved) <= float(nearest_of(_boundary(saddle()), z)) + 1e-8  # 1e-8: bisection


@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_barrier_outside_a_ball_is_optimal_against_brute_force(alpha, seed):
    level = ball("outside", centre=(0.0, 0.0), radius=1.0)
    z = normal(seed, 1, 3, 2, scale=0.7)
    g = chain(level, alpha)
    x = free_projection(g, z)
    assert float(g(x).max()) <= 1e-12
    # only radii matter: each waypoint moves along its own ray, so three radii are searched on a
    # grid
    r = torch.linspace(0, 3, 151, dtype=F64)
    a, b, c = torch.meshgrid(r, r, r, indexing="ij")
    length = z.norm(dim=-1)[0]
    cost = (a - length[0]) ** 2 + (b - length[1]) ** 2 + (c - length[2]) ** 2
    allowed = (b - 1 >= (1 - alpha) * (a - 1)) & (c - 1 >= (1 - alpha) * (b - 1))
    best = float(cost[allowed].min())
    mine = float((x - z).square().sum())
    assert mine <= best + 1e-9
    assert mine >= best - 0.15  # the grid's spacing of 0.02 on displacements up to 2 a waypoint


@pytest.mark.parametrize("pinned", [False, True])
def test_barrier_outside_a_ball_keeps_a_pinned_start(pinned):
    level = ball("outside", centre=(0.0, 0.0), radius=1.0)
    z = vec(2.0, 0.0, 0.5, 0.1, 0.2, -0.4, 0.0, 0.1).reshape(1, 4, 2)
    g = chain(level, 0.3)
    x = project(g, z, pin(z, 0) if pinned else Pins.none(z))
    assert float(g(x).max()) <= 1e-12
    assert torch.equal(x[:, 0], z[:, 0]) == pinned
