"""Barriers of relative degree 2: high-order barriers and the look-ahead; short horizons."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.spec.kinds import Dcbf
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.projection.project import project
from cdiff_cli.projection.projectors import projector_of
from cdiff_cli.projection.solvers.isotonic import SHORT, pool_violators
from cdiff_cli.sampling.safediffuser import jacobian
from tests.problems import (
    F64,
    ball,
    dense_jacobian,
    ellipsoid,
    half_space,
    nearest_chain,
    normal,
    num,
    pin,
    qp_project,
    vec,
)

LAYOUT = ("x", "y", "vx", "vy")
seeds = st.integers(0, 10_000)
alphas = st.floats(0.02, 1.0)
quick = settings(max_examples=25, deadline=None)
QP = 1e-6  # ProxQP's own accuracy


def high(level, alpha, alpha2):
    return Constraint((DiscreteBarrier("c", level, alpha, alpha2),))


# short chains -------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    seed=seeds,
    n=st.integers(1, SHORT),
    alpha=st.floats(1e-3, 1.0),
    start=st.booleans(),
    by_plan=st.booleans(),
)
def test_max_min_formula_equals_pooled_violators(seed, n, alpha, start, by_plan):
    h, w = normal(seed, 3, n), normal(seed + 1, *((3, n) if by_plan else (n,))).abs() + 0.2
    fixed = torch.zeros(n, dtype=torch.bool)
    fixed[0] = start
    v = nearest_chain(h, 1 - alpha, w, fixed)
    if start:
        rest = pool_violators(h[:, 1:], 1 - alpha, w[..., 1:])[0] if n > 1 else h[:, 1:]
        power = (1 - alpha) ** torch.arange(1, n).to(F64)
        expected = torch.cat((h[:, :1], torch.maximum(rest, power * h[:, :1])), 1)
        assert torch.equal(v[:, 0], h[:, 0])
    else:
        expected = pool_violators(h, 1 - alpha, w)[0]
    torch.testing.assert_close(v, expected, atol=1e-12, rtol=1e-12)  # sums in another order


@quick
@given(seed=seeds, alpha=alphas)
def test_long_barriers_with_weights_per_plan_equal_each_plan_alone(seed, alpha):
    n = SHORT + 8
    h, w, fixed = (
        normal(seed, 3, n),
        normal(seed + 1, 3, n).abs() + 0.2,
        torch.zeros(n, dtype=torch.bool),
    )
    alone = torch.cat([nearest_chain(h[i : i + 1], 1 - alpha, w[i], fixed) for i in range(3)])
    torch.testing.assert_close(nearest_chain(h, 1 - alpha, w, fixed), alone, atol=1e-12, rtol=0)


@pytest.mark.parametrize("level", [half_space(), ball("outside")])
def test_satisfied_barrier_leaves_the_plan_unchanged_to_the_bit(level):
    z = normal(0, 1, 1, 2).expand(2, 6, 2) + vec(-9.0, 9.0)
    g = Constraint((DiscreteBarrier("c", level, 0.5),))
    assert float(g(z).max()) < 0
    assert torch.equal(project(g, z, pin(z, 0)), z)


# high-order chains --------------------------------------------------------------------------------


def test_rows_of_a_high_order_barrier_match_hand_calculation():
    """h = 4, 3, 2, 0: psi = h' - .5 h = 1, .5, -1; rows = .2 psi - psi'."""
    g = high(HalfSpace(vec(-1.0), num(0.0)), 0.5, 0.8)
    x = vec(4.0, 3.0, 2.0, 0.0).reshape(1, 4, 1)
    torch.testing.assert_close(g(x), vec(-0.3, 1.1)[None], atol=1e-15, rtol=0)
    assert g.labels(4) == ["c@0-2", "c@1-3"]
    assert g(x[:, :2]).shape == g.linearise(x[:, :2])[0].shape == (1, 0)
    torch.testing.assert_close(g.tighten(0.1)(x), g(x) + 0.1, atol=1e-15, rtol=0)


@quick
@given(seed=seeds, alpha=alphas, alpha2=alphas)
def test_pulls_of_high_order_barriers_equal_autograd_and_bounds_hold(seed, alpha, alpha2):
    for level in (half_space(), ball("outside"), ellipsoid("inside")):
        g, x = high(level, alpha, alpha2), normal(seed, 1, 6, 2)
        rows, pull, size = g.linearise(x)
        w, leaf = normal(seed + 1, *rows.shape), x.clone().requires_grad_()
        (expected,) = torch.autograd.grad(g(leaf), leaf, w)
        torch.testing.assert_close(pull(w), expected, atol=1e-10, rtol=1e-10)
        J = torch.autograd.functional.jacobian(
            lambda v, g=g, x=x: g(v.reshape(x.shape))[0], x.flatten()
        )
        scaled = J / size[0].clamp_min(1e-12).sqrt()[:, None]
        assert (
            float(torch.linalg.eigvalsh(scaled @ scaled.T).max()) < 2.0
        )  # a dual step of 1 is stable


@quick
@given(seed=seeds, alpha=alphas, alpha2=alphas, n=st.integers(3, 16), pinned=st.booleans())
def test_high_order_barrier_over_a_half_space_agrees_with_proxqp(seed, alpha, alpha2, n, pinned):
    z = normal(seed, 2, n, 2)
    g = pull_back(
        high(half_space(), alpha, alpha2),
        normal(seed + 1, 2, n, 2),
        normal(seed + 2, n, 2).abs() + 0.2,
    )
    pins = pin(z, 0) if pinned else Pins.none(z)
    assert projector_of(g.parts[0]) is not None
    x = project(g, z, pins)
    assert torch.equal(x[:, pins.held], z[:, pins.held])
    for i in range(2):
        J, offset = dense_jacobian(g.select(torch.tensor([i])), z[i : i + 1])
        expected = qp_project(J, -offset, z[i].flatten().numpy(), pins.mask.flatten().numpy())
        np.testing.assert_allclose(
            x[i].flatten().numpy(), expected, atol=10 * QP
        )  # rows of both signs cost a digit


@quick
@given(seed=seeds, alpha=alphas, alpha2=alphas, n=st.integers(3, 16), pinned=st.booleans())
def test_high_order_barrier_outside_a_ball_agrees_with_proxqp_along_the_radii(
    seed, alpha, alpha2, n, pinned
):
    z = normal(seed, 2, n, 2, scale=0.3) + vec(1.5, 0.0)
    g = high(ball("outside", centre=(0.0, 0.0), radius=0.7), alpha, alpha2)
    x = project(g, z, pin(z, 0) if pinned else Pins.none(z))
    away, ended = z.norm(dim=-1), x.norm(dim=-1)
    torch.testing.assert_close(x, z / away[..., None] * ended[..., None], atol=1e-8, rtol=0)
    D = -g.parts[0].rows_of(torch.eye(n, dtype=F64)).T.numpy()
    for i in range(2):
        expected = qp_project(
            D, D @ np.full(n, 0.7), away[i].numpy(), np.arange(n) == 0 if pinned else None
        )
        if expected.min() > 0:  # else it lies beyond the centre
            np.testing.assert_allclose(ended[i].numpy(), expected, atol=10 * QP)


@quick
@given(seed=seeds, alpha=alphas, alpha2=alphas, n=st.integers(3, 16), pinned=st.booleans())
def test_high_order_barrier_leads_out_of_a_ball_from_near_its_centre(
    seed, alpha, alpha2, n, pinned
):
    z = normal(seed, 2, n, 2, scale=0.2)
    g = high(ball("outside", centre=(0.0, 0.0), radius=0.7), alpha, alpha2)
    assert (
        float(g(project(g, z, pin(z, 0) if pinned else Pins.none(z))).max()) <= 1e-9
    )  # rounding of the solve


@quick
@given(seed=seeds, alpha=alphas, alpha2=alphas)
def test_plan_that_starts_with_positive_h_and_psi_stays_safe(seed, alpha, alpha2):
    """h >= 0 at the start and psi >= 0 there keep h >= 0 everywhere."""
    z = normal(seed, 2, 12, 2)
    z[:, 0], z[:, 1] = vec(1.5, 0.0), vec(1.45, 0.1)  # h = .8, then .75: psi >= 0 for alpha >= .07
    g = high(ball("outside", centre=(0.0, 0.0), radius=0.7), max(alpha, 0.07), alpha2)
    x = project(g, z, pin(z, 0, 1))
    assert float(g(x).max()) <= 1e-9  # rounding of the solve
    assert float((0.7 - x.norm(dim=-1)).max()) <= 1e-9


@pytest.mark.parametrize("alpha", [1e-3, 0.3, 1.0])
def test_long_high_order_barriers_are_projected(alpha):
    z = normal(0, 2, 200, 1).cumsum(1)
    g = high(HalfSpace(vec(-1.0), num(0.0)), alpha, alpha)
    x = project(g, z, pin(z, 0))
    assert float(g(x).max()) <= 1e-6  # what project promises
    again = project(g, x, pin(x, 0))
    torch.testing.assert_close(again, x, atol=1e-6, rtol=0)


def test_jacobian_of_a_high_order_barrier_equals_autograd():
    g, x = high(ball("outside"), 0.3, 0.5), normal(0, 1, 7, 2)
    J = jacobian(g.parts[0], x)[0].flatten(1)
    torch.testing.assert_close(J, torch.from_numpy(dense_jacobian(g, x)[0]), atol=1e-12, rtol=0)


# look-ahead ---------------------------------------------------------------------------------------

BALL = {"kind": "quadratic", "side": "outside", "centre": {"x": 0.5, "y": 0.0}, "radius": 1.0}
WALL = {"kind": "linear", "a": {"x": 2.0}, "b": 1.0}
LEAD = {"time": 0.2, "form": "place", "velocity": {"x": "vx", "y": "vy"}}


def leading(barrier=BALL, lead=LEAD, **more):
    spec = Dcbf(kind="dcbf", name="d", alpha=0.3, barrier=barrier, look_ahead=lead, **more)
    return Constraint((spec.compile(LAYOUT),))


def test_look_ahead_rows_use_the_place_ahead_and_state_values_the_place_itself():
    x = normal(0, 2, 5, 4)
    ahead = x.clone()
    ahead[..., :2] += 0.2 * x[..., 2:]
    plain = leading(lead=None)
    torch.testing.assert_close(leading()(x), plain(ahead), atol=1e-12, rtol=0)
    torch.testing.assert_close(leading().parts[0].level(x), plain.parts[0].level(x), atol=0, rtol=0)
    wall = leading(WALL, {"time": 0.5, "velocity": {"x": "vx"}})
    torch.testing.assert_close(
        wall.parts[0].acting(x), 2 * (x[..., 0] + 0.5 * x[..., 2]) - 1, atol=1e-12, rtol=0
    )


@quick
@given(seed=seeds, shared=st.booleans())
def test_look_ahead_in_a_frame_per_waypoint_keeps_values_and_pulls(seed, shared):
    scale = normal(seed + 1, 5, 2).abs() + 0.2
    scale = scale[:, [0, 0, 1, 1]] if shared else torch.cat((scale, scale.flip(0)), 1)
    centre, z = normal(seed + 2, 2, 5, 4), normal(seed, 2, 5, 4)
    for g in (leading(), leading(WALL, {"time": 0.5, "velocity": {"x": "vx"}}), leading(order=2)):
        back = pull_back(g, centre, scale)
        torch.testing.assert_close(back(z), g(centre + scale * z), atol=1e-10, rtol=1e-10)
        rows, pull, _ = back.linearise(z)
        w, leaf = normal(seed + 3, *rows.shape), z.clone().requires_grad_()
        (expected,) = torch.autograd.grad(back(leaf), leaf, w)
        torch.testing.assert_close(pull(w), expected, atol=1e-9, rtol=1e-9)
        assert projector_of(back.parts[0]) is not None or not shared


@quick
@given(seed=seeds)
def test_look_ahead_projection_moves_position_and_velocity_together(seed):
    """The nearest point has the normal's direction: a KKT residual of zero at every waypoint that
    moved.
    """
    scale = (normal(seed + 1, 6, 2).abs() + 0.2)[:, [0, 0, 1, 1]]
    back, z = pull_back(leading(), normal(seed + 2, 2, 6, 4), scale), normal(seed, 2, 6, 4)
    x = project(back, z, pin(z, 0))
    assert float(back(x).max()) <= 1e-9  # rounding
    moved, slope = x - z, back.parts[0].acting.gradient(x)
    along = (moved * slope).sum(-1, keepdim=True) / slope.square().sum(-1, keepdim=True) * slope
    torch.testing.assert_close(moved, along, atol=1e-9, rtol=0)


def test_look_ahead_on_segments_adds_the_state_set_of_the_place_itself():
    first, second = leading().parts[0].on_segments()
    assert isinstance(first, DiscreteBarrier)
    assert isinstance(second, OnSegments)
    assert second.level is first.level
    first, second = leading(WALL, {"time": 0.5, "velocity": {"x": "vx"}}).parts[0].on_segments()
    assert isinstance(second, AtWaypoints)
    assert second.level is first.level


def test_place_stays_in_a_convex_set_when_the_place_ahead_does():
    """p' = p + dt v with dt <= time: a barrier that holds ahead holds for the place itself."""
    x = torch.zeros(1, 30, 4, dtype=F64)
    x[0, 0] = vec(-2.0, 0.0, 4.0, 0.0)
    g, dt = leading(WALL, {"time": 0.2, "velocity": {"x": "vx"}}), 0.1
    for k in range(1, 30):  # as fast as the barrier ahead lets it
        ahead = x[0, k - 1, 0] + 0.2 * x[0, k - 1, 2]
        x[0, k, 0] = x[0, k - 1, 0] + dt * x[0, k - 1, 2]
        x[0, k, 2] = (0.5 - 0.7 * (0.5 - ahead) - x[0, k, 0]) / 0.2
    assert float(g(x).abs().max()) <= 1e-12
    assert float(g.parts[0].level(x).max()) <= 1e-12


def test_look_ahead_moves_the_obstacle_with_its_observed_velocity():
    barrier = BALL | {"centre": {"x": "o.x", "y": "o.y"}}
    g = leading(barrier, velocity={"x": "o.vx", "y": "o.vy"})
    seen = {"o.x": vec(1.0), "o.y": vec(2.0), "o.vx": vec(3.0), "o.vy": vec(-1.0)}
    part = g.bind(seen, 0.1, 4).parts[0]
    x = normal(0, 1, 4, 4)
    k = torch.arange(4, dtype=F64)[:, None]
    for level, time, at in (
        (part.level, 0.0, x[..., :2]),
        (part.acting, 0.2, x[..., :2] + 0.2 * x[..., 2:]),
    ):
        expected = 1 - (at - vec(1.0, 2.0) - (0.1 * k + time) * vec(3.0, -1.0)).norm(dim=-1)
        torch.testing.assert_close(level(x), expected, atol=1e-12, rtol=0)
