"""State sets whose parameters differ by plan and by waypoint.

pull_back into a frame relative to the present state produces them. Each plan and waypoint gets the
values that it gets alone.
"""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.dynamics import LinearDynamics, LinearDynamicsConstraint
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.protocol import converted, segment_max, selected
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.state_sets import Ellipsoid, HalfSpace, Quadric, QuadricInFrame
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.projection.project import project
from tests.problems import (
    F64,
    KINDS,
    LEVELS,
    ball,
    chain,
    free_projection,
    half_space,
    normal,
    num,
    opaque,
    pin,
    qp_project,
    vec,
)

seeds = st.integers(0, 10_000)
quick = settings(max_examples=10, deadline=None)
HORIZON = 4
frames = st.sampled_from([(3, HORIZON), (3, 1), (1, HORIZON), (1, 1)])
AROUND = {
    **KINDS,
    **{
        f"{name} on segments": Constraint((OnSegments("s", level),))
        for name, level in LEVELS.items()
    },
}
ROUNDING = 1e-9  # a few operations of float64, with 1 / scale up to 10 and 1 / r near a centre


def frame(seed, shape, shared=False):
    """Centre [batch | 1, horizon | 1, 2] and scale [horizon | 1, 2]; shared: one scale for both
    coordinates.
    """
    scale = normal(seed + 2, shape[1], 2).abs() + 0.2
    return normal(seed + 1, *shape, 2), scale[:, :1].expand(-1, 2) if shared else scale


def moving(level, seed, batch, horizon):
    """The level at another place for each plan and waypoint: f(x - offset)."""
    return level.pull_back(-normal(seed + 5, batch, horizon, 2), torch.ones(2, dtype=F64))


def at(level, plan, tau):
    """The level of one plan at one waypoint, with no dimensions in front."""
    level = selected(level, torch.tensor([plan]))
    new = {}
    for name, trailing in level.trailing.items():
        value = getattr(level, name)
        if value.ndim > trailing:
            value = value.reshape(-1, *value.shape[value.ndim - trailing :])
            new[name] = value[tau if len(value) > 1 else 0]
    return type(level)(**{**vars(level), **new})


# the same function --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", list(AROUND))
@quick
@given(seed=seeds, shape=frames)
def test_pull_back_with_a_frame_per_plan_and_waypoint_commutes_with_evaluation(kind, seed, shape):
    g, z = AROUND[kind], normal(seed, 3, HORIZON, 2)
    centre, scale = frame(seed, shape)
    back, x = pull_back(g, centre, scale), centre + scale * z
    torch.testing.assert_close(back(z), g(x), atol=ROUNDING, rtol=ROUNDING)
    torch.testing.assert_close(back.tighten(0.05)(z), g(x) + 0.05, atol=ROUNDING, rtol=ROUNDING)
    for mine, env in zip(back.parts, g.parts, strict=True):
        torch.testing.assert_close(
            mine.segment_max(z), env.segment_max(x), atol=ROUNDING, rtol=ROUNDING
        )


@pytest.mark.parametrize("kind", list(AROUND))
@quick
@given(seed=seeds, shape=frames)
def test_pulls_in_a_frame_per_plan_and_waypoint_equal_autograd(kind, seed, shape):
    g, z = pull_back(AROUND[kind], *frame(seed, shape)), normal(seed, 3, HORIZON, 2)
    rows, pull, size = g.linearise(z)
    w = normal(seed + 3, *rows.shape)
    leaf = z.clone().requires_grad_()
    (expected,) = torch.autograd.grad(g(leaf), leaf, w)
    torch.testing.assert_close(rows, g(z), atol=ROUNDING, rtol=ROUNDING)
    torch.testing.assert_close(
        pull(w), expected, atol=1e-8, rtol=1e-8
    )  # the square of such numbers
    assert rows.shape == size.shape


@pytest.mark.parametrize("kind", [kind for kind in AROUND if kind != "opaque"])
@quick
@given(seed=seeds)
def test_row_bounds_in_a_frame_per_waypoint_bound_the_eigenvalues(kind, seed):
    g, z = (
        pull_back(AROUND[kind], *frame(seed, (1, HORIZON), shared=True)),
        normal(seed, 1, HORIZON, 2),
    )
    rows, _, size = g.linearise(z)
    J = torch.autograd.functional.jacobian(lambda v: g(v.reshape(z.shape))[0], z.flatten())
    largest = torch.linalg.eigvalsh(
        (J @ J.T) / (size[0].sqrt()[:, None] * size[0].sqrt()).clamp_min(1e-12)
    )[-1]
    assert (
        float(largest) < 2.0
    )  # as with fixed numbers (test_constraint.py): a dual step of 1 is stable
    assert rows.shape == size.shape


@pytest.mark.parametrize("kind", list(AROUND))
@quick
@given(seed=seeds)
def test_pull_back_into_two_frames_equals_pull_back_into_their_composition(kind, seed):
    g, z = AROUND[kind], normal(seed, 3, HORIZON, 2)
    outer, inner = frame(seed, (1, 1)), frame(seed + 3, (3, HORIZON))
    twice = pull_back(pull_back(g, outer[0][0, 0], outer[1][0]), *inner)
    torch.testing.assert_close(
        twice(z), g(outer[0] + outer[1] * (inner[0] + inner[1] * z)), atol=1e-8, rtol=1e-8
    )


@pytest.mark.parametrize("kind", list(AROUND))
def test_selected_plans_keep_their_parameters(kind):
    g, z = pull_back(AROUND[kind], *frame(0, (3, HORIZON))), normal(0, 3, HORIZON, 2)
    for which in (torch.tensor([2, 0]), torch.tensor([True, False, True])):
        torch.testing.assert_close(g.select(which)(z[which]), g(z)[which], atol=1e-12, rtol=0)
    shared = pull_back(AROUND[kind], *frame(0, (1, HORIZON)))
    torch.testing.assert_close(
        shared.select(torch.tensor([1]))(z[1:2]), shared(z)[1:2], atol=1e-12, rtol=0
    )


@pytest.mark.parametrize("kind", [kind for kind in AROUND if kind != "opaque"])
def test_parameters_per_plan_are_converted_to_float32(kind):
    g, z = pull_back(AROUND[kind], *frame(0, (3, HORIZON))), normal(0, 3, HORIZON, 2)
    small = g.to(z.float())(z.float())
    assert small.dtype == torch.float32
    torch.testing.assert_close(
        small.double(), g(z), atol=1e-4, rtol=1e-4
    )  # float32's rounding, times 1 / scale


@pytest.mark.parametrize("name", list(LEVELS))
@quick
@given(seed=seeds)
def test_moving_state_set_moves_linearly_between_waypoints(name, seed):
    """Dense points of the segment against the level at the place that it has reached there."""
    level, x, offset = LEVELS[name], normal(seed, 3, 2, 2), normal(seed + 5, 3, 2, 2)
    bound = segment_max(level.pull_back(-offset, torch.ones(2, dtype=F64)), x)[:, 0]
    share = torch.linspace(0, 1, 2001, dtype=F64)[:, None, None]
    relative = x - offset
    dense = level(relative[:, 0] + share * (relative[:, 1] - relative[:, 0])).amax(0)
    assert bool((bound >= dense - 1e-12).all())  # rounding
    assert (
        float((bound - dense).max()) < 1e-2
    )  # slopes of about 10, points 1 / 2000 of a segment apart


def test_path_across_the_track_of_a_moving_ball_is_safe_after_the_ball_has_passed():
    x = vec(-2.0, 0.0, 2.0, 0.0).reshape(1, 2, 2)
    standing = ball("outside", centre=(0.0, 0.0), radius=1.0)
    assert float(segment_max(standing, x)) == pytest.approx(1.0)
    offset = vec(0.0, -3.0, 0.0, 3.0).reshape(
        1, 2, 2
    )  # it crosses at the same time: they meet in the middle
    assert float(
        segment_max(standing.pull_back(-offset, torch.ones(2, dtype=F64)), x)
    ) == pytest.approx(1.0)
    offset = vec(0.0, -3.0, 0.0, -6.0).reshape(1, 2, 2)
    assert float(segment_max(standing.pull_back(-offset, torch.ones(2, dtype=F64)), x)) < -1.5


def test_dynamics_in_a_frame_per_plan_and_waypoint_commute_with_evaluation():
    A, B = torch.tensor([[1.0, 0.1], [0.0, 1.0]], dtype=F64), vec(0.0, 0.1)[:, None]
    part = LinearDynamicsConstraint.from_dynamics(
        "d", LinearDynamics(A, B, vec(0.0, 0.0), vec(-1.0), vec(1.0)), 1e-3
    )
    centre, scale = frame(0, (3, HORIZON))
    back, z = part.pull_back(centre, scale), normal(0, 3, HORIZON, 2)
    torch.testing.assert_close(back(z), part(centre + scale * z), atol=1e-12, rtol=0)
    rows, pull, _ = back.linearise(z)
    leaf, w = z.clone().requires_grad_(), normal(1, *rows.shape)
    (expected,) = torch.autograd.grad(back(leaf), leaf, w)
    torch.testing.assert_close(pull(w), expected, atol=1e-10, rtol=1e-10)
    torch.testing.assert_close(
        back.select(torch.tensor([1]))(z[1:2]), rows[1:2], atol=1e-12, rtol=0
    )


# projections --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(LEVELS))
@quick
@given(seed=seeds, shape=frames)
def test_projection_at_waypoints_of_a_batch_equals_that_of_each_waypoint_alone(name, seed, shape):
    level, z = LEVELS[name].pull_back(*frame(seed, shape)), normal(seed, 3, HORIZON, 2)
    x = free_projection(Constraint((AtWaypoints("w", level),)), z)
    for plan in range(3):
        for tau in range(HORIZON):
            one = at(level, plan, tau)
            fixed = one.multiplied_out() if isinstance(one, QuadricInFrame) else one
            alone = free_projection(
                Constraint((AtWaypoints("w", fixed),)), z[plan, tau].reshape(1, 1, 2)
            )
            torch.testing.assert_close(
                x[plan, tau], alone[0, 0], atol=1e-7, rtol=0
            )  # bisection of a flat quadric


@pytest.mark.parametrize("kind", ["half-space", "outside ball"])
@pytest.mark.parametrize("start", ["free", "start pinned"])
@quick
@given(seed=seeds, alpha=st.floats(0.01, 1.0))
def test_projection_onto_barriers_that_differ_by_plan_equals_that_of_each_plan_alone(
    kind, start, seed, alpha
):
    level, z = moving(LEVELS[kind], seed, 3, 1), normal(seed, 3, 7, 2)
    pins = pin(z, 0) if start == "start pinned" else Pins.none(z)
    x = project(chain(level, alpha), z, pins)
    for i in range(3):
        alone = project(chain(at(level, i, 0), alpha), z[i : i + 1], Pins(pins.mask, z[i : i + 1]))
        torch.testing.assert_close(x[i : i + 1], alone, atol=1e-12, rtol=0)


@quick
@given(seed=seeds)
def test_projection_around_balls_that_differ_by_plan_equals_that_of_each_plan_alone(seed):
    level, z = moving(ball("outside"), seed, 3, 1), normal(seed, 3, 7, 2)
    x = free_projection(Constraint((OnSegments("s", level),)), z)
    for i in range(3):
        alone = free_projection(Constraint((OnSegments("s", at(level, i, 0)),)), z[i : i + 1])
        torch.testing.assert_close(x[i : i + 1], alone, atol=1e-9, rtol=0)


@quick
@given(seed=seeds)
def test_projection_around_a_moving_ball_equals_that_around_a_fixed_one_in_its_frame(seed):
    """And in windows of another scale at each waypoint, distances are then those of the window."""
    z, offset = normal(seed, 3, 7, 2), 0.3 * normal(seed + 5, 3, 7, 2)
    x = free_projection(
        Constraint(
            (OnSegments("s", ball("outside").pull_back(-offset, torch.ones(2, dtype=F64))),)
        ),
        z,
    )
    resting = free_projection(Constraint((OnSegments("s", ball("outside")),)), z - offset)
    torch.testing.assert_close(x - offset, resting, atol=1e-9, rtol=0)
    back = pull_back(
        Constraint((OnSegments("s", ball("outside")),)), *frame(seed, (3, 7), shared=True)
    )
    assert float(back(free_projection(back, z)).max()) <= 1e-7  # what project promises


# chains with a scale a waypoint -------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(seed=seeds, alpha=st.floats(0.01, 1.0), n=st.integers(2, 20), pinned=st.booleans())
def test_barrier_over_a_half_space_with_a_scale_per_waypoint_agrees_with_proxqp(
    seed, alpha, n, pinned
):
    z = normal(seed, 2, n, 2)
    centre, scale = normal(seed + 1, 2, n, 2), normal(seed + 2, n, 2).abs() + 0.2
    g = pull_back(chain(half_space(), alpha), centre, scale)
    pins = pin(z, 0) if pinned else Pins.none(z)
    x = project(g, z, pins)
    for i in range(2):
        one = g.select(torch.tensor([i]))
        rows, pull, _ = one.linearise(z[i : i + 1])
        A = torch.stack([pull(w[None]).flatten() for w in torch.eye(n - 1, dtype=F64)]).numpy()
        flat = z[i].flatten().numpy()
        expected = qp_project(A, A @ flat - rows[0].numpy(), flat, pins.mask.flatten().numpy())
        np.testing.assert_allclose(x[i].flatten().numpy(), expected, atol=1e-6)  # ProxQP's accuracy


@settings(max_examples=25, deadline=None)
@given(seed=seeds, alpha=st.floats(0.01, 1.0), n=st.integers(2, 20), pinned=st.booleans())
def test_barrier_outside_a_ball_with_a_scale_per_waypoint_agrees_with_proxqp(
    seed, alpha, n, pinned
):
    """h_k = s_k (|z_k - c_k| - r_k): the nearest trajectory moves radially, and |z_k - c_k| solves
    a QP with bounds at 0.
    """
    z = normal(seed, 2, n, 2)
    centre, scale = normal(seed + 1, 2, n, 2), (normal(seed + 2, n, 1).abs() + 0.2).expand(-1, 2)
    g = pull_back(chain(ball("outside"), alpha), centre, scale)
    x = project(g, z, pin(z, 0) if pinned else Pins.none(z))
    level, s, gamma = g.parts[0].level, scale[:, 0].numpy(), 1 - alpha
    away, ended = (((v - level.centre).norm(dim=-1)).numpy() for v in (z, x))
    unit = (z - level.centre) / (z - level.centre).norm(dim=-1, keepdim=True)
    torch.testing.assert_close(
        x, level.centre + torch.from_numpy(ended)[..., None] * unit, atol=1e-9, rtol=0
    )
    m = float(level.m)
    for i in range(2):
        A = gamma * np.eye(n)[:-1] - np.eye(n)[1:]
        rows = np.concatenate((A * s, -np.eye(n)))
        bound = np.concatenate((A @ np.full(n, m), np.zeros(n)))
        fixed = np.arange(n) == 0 if pinned else None
        np.testing.assert_allclose(
            ended[i], qp_project(rows, bound, away[i], fixed), atol=1e-6
        )  # ProxQP's accuracy


def test_waypoints_move_to_the_radius_of_their_waypoint():
    """alpha = 1 is clipping: each waypoint to its own radius."""
    radius = vec(1.0, 2.0, 3.0)
    level = Ellipsoid(
        torch.eye(2, dtype=F64),
        torch.zeros(2, dtype=F64),
        radius[:, None].expand(3, 2),
        radius,
        "outside",
    )
    z = vec(0.5, 0.0, 0.5, 0.0, 5.0, 0.0).reshape(1, 3, 2)
    x = project(chain(level, 1.0), z, pin(z, 0))
    torch.testing.assert_close(
        x, vec(0.5, 0.0, 2.0, 0.0, 5.0, 0.0).reshape(1, 3, 2), atol=1e-12, rtol=0
    )


def test_no_waypoint_leaves_a_shrinking_ball_through_its_centre():
    radius = vec(3.0, 0.1, 0.1)
    level = Ellipsoid(
        torch.eye(2, dtype=F64),
        torch.zeros(2, dtype=F64),
        radius[:, None].expand(3, 2),
        radius,
        "outside",
    )
    z = torch.full((1, 3, 2), 0.01, dtype=F64)
    x = project(chain(level, 0.1), z, Pins.none(z))
    assert float(chain(level, 0.1)(x).max()) <= 1e-12  # rounding
    assert bool((x * z >= 0).all())


# a start that is unsafe already -------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_barrier_over_a_half_space_recovers_from_an_unsafe_start(dtype):
    g = chain(HalfSpace(vec(-1.0), num(0.0)), 0.5)  # h = x
    z = vec(-4.0, -3.0, -3.0, 1.0).reshape(1, 4, 1).to(dtype)
    x = project(g.to(z), z, pin(z, 0))
    torch.testing.assert_close(
        x.flatten().double(), vec(-4.0, -2.0, -1.0, 1.0), atol=1e-6, rtol=0
    )  # the constraint's tolerance


@pytest.mark.parametrize("start", [(0.0, 0.0), (0.4, 0.0), (1e-9, 0.0)])
@settings(max_examples=25, deadline=None)
@given(seed=seeds, alpha=st.floats(0.01, 1.0))
def test_barrier_leads_out_of_a_ball(start, seed, alpha):
    g = chain(ball("outside", centre=(0.0, 0.0), radius=1.0), alpha)
    z = normal(seed, 2, 9, 2, scale=0.3)
    z[:, 0] = vec(*start)
    x = project(g, z, pin(z, 0))
    h = x.norm(dim=-1) - 1
    assert torch.equal(x[:, 0], z[:, 0])
    assert bool((h[:, 1:] >= h[:, :1] * (1 - alpha) ** torch.arange(1, 9).to(F64) - 1e-12).all())
    assert float(g(x).max()) <= 1e-12  # rounding


def test_path_at_rest_at_the_centre_of_a_ball_leaves_along_the_first_axis():
    z = torch.zeros(1, 3, 2, dtype=F64)
    x = project(chain(ball("outside", centre=(0.0, 0.0), radius=2.0), 0.5), z, pin(z, 0))
    torch.testing.assert_close(
        x, vec(0.0, 0.0, 1.0, 0.0, 1.5, 0.0).reshape(1, 3, 2), atol=1e-12, rtol=0
    )


# what has no closed form --------------------------------------------------------------------------


def test_barrier_over_batched_ellipsoid_is_projected_plan_by_plan():
    level = LEVELS["outside ellipsoid"]
    z = normal(0, 2, 3, 2)
    both = Constraint((DiscreteBarrier("c", moving(level, 0, 2, 3), 0.4),))
    x = free_projection(both, z)
    assert float(both(x).max()) <= 1e-5  # what the fallback promises
    alone = free_projection(both.select(torch.tensor([1])), z[1:2])
    torch.testing.assert_close(x[1:2], alone, atol=1e-6, rtol=0)


def test_black_box_can_be_pulled_back_into_a_frame_per_plan():
    g, z = opaque(lambda x: x[..., 0] - 1.0), normal(0, 2, 3, 2)
    back = pull_back(g, *frame(0, (2, 3)))
    assert float(back(free_projection(back, z)).max()) <= 1e-5  # what the fallback promises


def test_quadric_in_a_frame_per_waypoint_keeps_one_matrix():
    level = LEVELS["general quadric"].pull_back(*frame(0, (3, HORIZON)))
    assert isinstance(level, QuadricInFrame)
    assert converted(level, torch.zeros(1)).quadric.P.dtype == torch.float32
    z = normal(0, 3, HORIZON, 2)
    torch.testing.assert_close(level.multiplied_out()(z), level(z), atol=1e-10, rtol=1e-10)
    assert isinstance(LEVELS["general quadric"].pull_back(vec(0.0, 1.0), vec(1.0, 2.0)), Quadric)
