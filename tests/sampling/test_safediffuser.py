"""SafeDiffuser: known answers of each variant, the two solvers agree, what never moves."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.black_box import BlackBox
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import CdiffError, InfeasibleError
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.sampling import make_method
from cdiff_cli.sampling.baselines import Unconstrained
from cdiff_cli.sampling.safediffuser import SafeDiffuser, jacobian, relaxation, solve_dual
from cdiff_cli.sampling.sampler import Step, sample
from tests.problems import (
    F64,
    KINDS,
    ball,
    chain,
    dense_jacobian,
    draws,
    gaussian_denoiser,
    half_space,
    normal,
    num,
    pin,
    qp_project,
    vec,
    waypoints,
)

COUPLED = ["dcbf over half-space", "dcbf over outside ball", "stack", "opaque"]


def step_of(x, sampled, left=0, pins=None):
    """The step from x to `sampled`."""
    return Step(x, x, 0.1, 1.0, lambda _: sampled, pins or Pins.none(x), left == 0, left)


def moved(method, g, x, sampled, left=0, pins=None):
    return method.step(step_of(x, sampled, left, pins), g, None)[0]


def test_ros_moves_a_half_space_violation_by_its_closed_form():
    """a.u <= k (b - margin - a.x): x + u0 - a [a.u0 - k (b - margin - a.x)]_+ / |a|^2."""
    x, sampled = normal(0, 5, 4, 2), normal(1, 5, 4, 2)
    a, b = vec(1.0, -2.0), 0.3
    out = moved(SafeDiffuser(gain=0.5, margin=0.1), waypoints(HalfSpace(a, num(b))), x, sampled)
    over = ((sampled - x) @ a - 0.5 * (b - 0.1 - x @ a)).clamp_min(0)
    assert float(over.max()) > 0.5
    torch.testing.assert_close(
        out, sampled - over[..., None] * a / 5.0, atol=1e-9, rtol=0
    )  # a ridge of 1e-11 in the dual


def test_gain_one_satisfies_a_half_space_by_the_margin():
    g = waypoints(half_space(b=-1.0))
    out = moved(SafeDiffuser(), g, normal(0, 5, 4, 2), normal(1, 5, 4, 2))
    assert float(g(out).max()) == pytest.approx(-0.01, abs=1e-9)


def test_gain_one_keeps_plans_outside_a_ball():
    """The tangent half-space lies within the outside of a ball: with gain one x_{t-1} is safe by
    the margin or more.
    """
    g, x, sampled = waypoints(ball("outside")), normal(2, 20, 3, 2), normal(3, 20, 3, 2, scale=0.5)
    assert float(g(sampled).max()) > 0.1
    assert float(g(moved(SafeDiffuser(), g, x, sampled)).max()) <= -0.01 + 1e-9


def test_res_hardly_changes_early_steps_and_equals_ros_in_the_last_ten():
    """At cost r^2 / 2 and weight w a row moves u by over / (|a|^2 + w^2) of it: w = 100 while 10
    steps are left, then 0.
    """
    g, x, sampled = waypoints(half_space(b=-1.0)), normal(0, 5, 4, 2), normal(1, 5, 4, 2)
    ros = moved(SafeDiffuser(), g, x, sampled) - sampled
    early = moved(SafeDiffuser(variant="res"), g, x, sampled, left=10) - sampled
    torch.testing.assert_close(early, ros * 2 / (2 + 100**2), atol=1e-9, rtol=0)
    torch.testing.assert_close(
        moved(SafeDiffuser(variant="res"), g, x, sampled, left=9) - sampled, ros
    )


def test_tvs_relaxes_the_barrier_by_a_sigmoid_of_the_steps_left():
    assert relaxation(5) == (0.5, 0.25)
    assert relaxation(1000) == pytest.approx((1.0, 0.0))
    s = 1 / (1 + math.exp(-5))
    assert relaxation(0) == pytest.approx((1 - s, s * (1 - s)))
    g, x = waypoints(half_space(b=-1.0)), torch.zeros(1, 1, 2, dtype=F64)
    sampled = x + vec(2.0, -2.0)  # g = x - y + 1: 1 at x_t, 5 when sampled
    out = moved(SafeDiffuser(variant="tvs"), g, x, sampled, left=5)
    assert float(g(out)) == pytest.approx(
        0.5 - 0.01 + 0.25, abs=1e-9
    )  # g + dg.u <= gamma - margin + slope


@pytest.mark.parametrize(
    "kind", ["half-space", "outside ball", "inside ellipsoid", "general quadric", *COUPLED]
)
@pytest.mark.parametrize("variant", ["ros", "res", "tvs"])
def test_active_set_and_proxqp_agree(kind, variant):
    g, x, sampled = KINDS[kind], normal(4, 4, 6, 2), normal(5, 4, 6, 2)
    pins = (
        Pins.none(x) if kind == "stack" else pin(x, 0)
    )  # whose rows contradict each other once x_t's first state is held
    sampled = pins.paint(sampled)
    both = [
        moved(SafeDiffuser(variant, solver), g, x, sampled, left=3, pins=pins)
        for solver in ("closed-form", "proxqp")
    ]
    torch.testing.assert_close(
        *both, atol=1e-6, rtol=0
    )  # ProxQP's 1e-9 over the conditioning of a dozen coupled rows


def test_rows_of_several_barriers_at_one_waypoint_are_solved_together():
    g = Constraint(
        tuple(
            AtWaypoints(str(i), HalfSpace(vec(math.cos(i), math.sin(i)), num(0.1)))
            for i in range(6)
        )
    )
    x, sampled = 0.1 * normal(6, 30, 4, 2), normal(7, 30, 4, 2, scale=2.0)
    both = [
        moved(SafeDiffuser(solver=solver), g, x, sampled) for solver in ("closed-form", "proxqp")
    ]
    torch.testing.assert_close(*both, atol=1e-7, rtol=0)
    assert float(g(both[0]).max()) <= -0.01 + 1e-9


@settings(max_examples=40, deadline=None)
@given(n=st.integers(1, 12), k=st.integers(1, 12), seed=st.integers(0, 10_000))
def test_dual_solution_satisfies_the_optimality_conditions(n, k, seed):
    """lam >= 0, M lam >= d, lam.(M lam - d) = 0, where M = A A^T + I / 10 is positive definite."""
    A, d = normal(seed, 3, n, k), normal(seed + 1, 3, n)
    M = A @ A.mT + 0.1 * torch.eye(n, dtype=F64)
    lam = solve_dual(M, d)
    gap = (M @ lam[..., None])[..., 0] - d
    assert float(lam.min()) >= 0
    assert (
        float(gap.min()) >= -1e-7
    )  # the ridge of 1e-11 |M|, |M| up to 50, times multipliers up to 100
    assert float((lam * gap).abs().max()) <= 1e-5  # again times those multipliers


@pytest.mark.parametrize("kind", ["dcbf over outside ball", "stack", "opaque"])
def test_jacobian_equals_autograd(kind):
    x = normal(8, 1, 5, 2)
    J = torch.cat([jacobian(part, x) for part in KINDS[kind].parts], 1)
    torch.testing.assert_close(
        J[0].flatten(1), torch.from_numpy(dense_jacobian(KINDS[kind], x)[0]), atol=1e-12, rtol=0
    )


def test_barrier_along_the_trajectory_is_one_qp_per_plan():
    """Against ProxQP on the rows written out by autograd: J u <= -margin - g(x)."""
    g, x, sampled = chain(half_space(), 0.2), normal(9, 1, 8, 2), normal(10, 1, 8, 2)
    J, _ = dense_jacobian(g, x)
    u = qp_project(J, (-0.01 - g(x)[0]).numpy(), (sampled - x).flatten().numpy())
    torch.testing.assert_close(
        moved(SafeDiffuser(), g, x, sampled),
        x + torch.from_numpy(u).reshape(x.shape),
        atol=1e-7,
        rtol=0,
    )


@pytest.mark.parametrize("solver", ["closed-form", "proxqp"])
@pytest.mark.parametrize("kind", ["half-space", "dcbf over half-space"])
def test_pinned_waypoints_do_not_move(kind, solver):
    x = normal(11, 4, 5, 2, scale=2.0)
    ends = [0] if "dcbf" in kind else [0, -1]  # both ends of a chain held anywhere contradict it
    pins = pin(x, *ends)
    sampled = pins.paint(normal(12, 4, 5, 2, scale=2.0))
    out = moved(SafeDiffuser(solver=solver), KINDS[kind], x, sampled, pins=pins)
    assert torch.equal(out[:, ends], x[:, ends])
    assert not torch.equal(out, sampled)


def test_safe_steps_stay_as_sampled_to_the_bit():
    g, x, sampled = (
        waypoints(half_space(b=50.0)),
        normal(13, 4, 5, 2).float(),
        normal(14, 4, 5, 2).float(),
    )
    assert torch.equal(moved(SafeDiffuser(), g.to(x), x, sampled), sampled)


@pytest.mark.parametrize("solver", ["closed-form", "proxqp"])
def test_contradicting_barriers_are_refused(solver):
    g = Constraint(
        (
            AtWaypoints("up", HalfSpace(vec(-1.0, 0.0), num(-1.0))),
            AtWaypoints("down", HalfSpace(vec(1.0, 0.0), num(-1.0))),
        )
    )
    x = torch.zeros(1, 2, 2, dtype=F64)
    with pytest.raises(InfeasibleError, match=r"contradict each other.*variant=res"):
        moved(SafeDiffuser(solver=solver), g, x, x + 1)


@pytest.mark.parametrize("variant", ["ros", "res"])
def test_plans_are_safe_after_the_last_step(variant):
    schedule = Schedule.cosine(20)
    g, like = waypoints(HalfSpace(vec(1.0, 1.0), num(0.8))), torch.zeros(8, 4, 2, dtype=F64)
    plans = [
        sample(
            gaussian_denoiser(schedule, 0.5, 0.1),
            schedule,
            method,
            g,
            Pins.none(like),
            draws(7, 8, 4, 2),
        ).x
        for method in (Unconstrained(), SafeDiffuser(variant))
    ]
    assert float(g(plans[0]).max()) > 0.1
    assert float(g(plans[1]).max()) <= -0.01 + 1e-9


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"variant": "rose"}, "safediffuser.variant: expected one of ros, res, tvs, found 'rose'"),
        (
            {"solver": "qpth"},
            "safediffuser.solver: expected one of closed-form, proxqp, found 'qpth'",
        ),
        ({"margin": -1}, "safediffuser.margin: expected a positive number"),
        ({"kind": 1}, 'safediffuser has no setting "kind".*variant, solver, gain, margin'),
    ],
)
def test_a_bad_setting_is_one_clear_line(values, message):
    with pytest.raises(CdiffError, match=message):
        make_method("safediffuser", values)


def test_rows_of_a_black_box_are_coupled():
    g = Constraint((BlackBox("sum", lambda x: x.sum((1, 2))[:, None] - 1.0, lambda _: 1),))
    x = torch.zeros(1, 3, 2, dtype=F64)
    out = moved(SafeDiffuser(), g, x, x + 1.0)  # sum 6: the nearest with sum 0.99
    torch.testing.assert_close(out, torch.full_like(x, 0.99 / 6), atol=1e-9, rtol=0)
