"""The interior-point method: its cones, its linear-quadratic steps, its results against ProxQP and
ADMM.
"""

import numpy as np
import pytest
import qpsolvers
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.dynamics import LinearDynamics
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.projection.project import project
from cdiff_cli.projection.rate import RateProjection
from cdiff_cli.projection.rate_dynamics import project_rate_dynamics, project_rates
from cdiff_cli.projection.solvers import riccati, second_order_cone
from tests.problems import F64, half_space, normal, pin
from tests.projection.test_rate import rate

quick = settings(max_examples=20, deadline=None)
seeds = st.integers(0, 10_000)
DT = 0.1
PUSHED = LinearDynamics(  # x, y, vx, vy of a mass that two forces push
    torch.eye(4, dtype=F64) + DT * torch.diag(torch.ones(2, dtype=F64), 2),
    torch.cat((0.5 * DT**2 * torch.eye(2), DT * torch.eye(2))).double(),
    torch.zeros(4, dtype=F64),
    -torch.ones(2, dtype=F64),
    torch.ones(2, dtype=F64),
)


def inside(seed, k, depth):
    """Points of a cone of length k + 1, near its boundary as depth is small."""
    s = normal(seed, 7, k + 1)
    s[:, 0] = s[:, 1:].norm(dim=1) + depth * (1e-3 + s[:, 0].abs())
    return s


# cones --------------------------------------------------------------------------------------------

SIZES = (0, 1, 2, 3)


@pytest.mark.parametrize("k", SIZES)
@quick
@given(seed=seeds, depth=st.sampled_from([1e-4, 1.0]))
def test_the_scaling_maps_slack_and_multiplier_to_one_point(k, seed, depth):
    s, y = inside(seed, k, depth), inside(seed + 1, k, depth)
    W = second_order_cone.scaling(s, y)
    v = W.times(y)
    torch.testing.assert_close(
        W.times(v), s, atol=1e-8, rtol=1e-8
    )  # 1e-16 over the smallest determinant
    torch.testing.assert_close(W.over(W.times(s)), s, atol=1e-8, rtol=1e-8)
    torch.testing.assert_close(W.over_twice(W.times(v)), W.over(v), atol=1e-6, rtol=1e-6)
    torch.testing.assert_close((v * v).sum(1), (s * y).sum(1), atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("k", SIZES)
@quick
@given(seed=seeds)
def test_a_quotient_times_its_divisor_is_the_dividend(k, seed):
    s, r = inside(seed, k, 1.0), normal(seed + 1, 7, k + 1)
    torch.testing.assert_close(
        second_order_cone.product(s, second_order_cone.quotient(r, s)), r, atol=1e-7, rtol=1e-7
    )


@pytest.mark.parametrize("k", SIZES)
@quick
@given(seed=seeds)
def test_the_way_out_ends_on_the_boundary(k, seed):
    s, d = inside(seed, k, 1.0), normal(seed + 1, 7, k + 1)
    a = second_order_cone.way_out(s, d)[:, None]
    left, leaves = torch.where(a.isfinite(), a, 1e3), a.isfinite()[:, 0]
    on = s + left * d
    torch.testing.assert_close(
        on[leaves, 1:].norm(dim=1), on[leaves, 0], atol=1e-7, rtol=1e-7
    )  # of digits lost in differences
    before = s + 0.999 * left * d
    assert bool((before[:, 0] > before[:, 1:].norm(dim=1)).all())


# steps --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("horizon", [2, riccati.BLOCK, riccati.BLOCK + 1, 3 * riccati.BLOCK - 2])
def test_riccati_recursion_solves_the_dense_system(horizon):
    n, m, batch = 4, 2, 2
    root, g = normal(0, batch, horizon, 6, 6), normal(1, batch, horizon, 6)
    H = root @ root.mT + 0.1 * torch.eye(6, dtype=F64)
    blocks = riccati.blocks(PUSHED.A, PUSHED.B)
    q = riccati.minimiser(blocks, riccati.factor(blocks, H), g)
    unit = torch.eye(horizon * m, dtype=F64).view(-1, horizon, m)
    x = PUSHED.rollout(torch.zeros(len(unit), n, dtype=F64), unit[:, :-1])
    columns = torch.cat((x, unit), 2).flatten(1).T  # every trajectory is a sum of these
    for b in range(batch):
        whole = columns.T @ torch.block_diag(*H[b]) @ columns
        known = columns @ torch.linalg.solve(whole, -columns.T @ g[b].flatten())
        torch.testing.assert_close(q[b].flatten(), known, atol=1e-8, rtol=1e-8)


# results ------------------------------------------------------------------------------------------

WEIGHT = torch.tensor([1.0, 1.0, 0.02, 0.02], dtype=F64)


def by_proxqp(z, rates, wall, goal):
    """min over inputs of |x - z|^2_W, from rest in the origin."""
    steps = z.shape[1] - 1
    unit = torch.eye(2 * steps, dtype=F64).view(-1, steps, 2)
    columns = PUSHED.rollout(torch.zeros(len(unit), 4, dtype=F64), unit)  # [inputs, horizon, 4]
    rows, bounds = [columns @ wall.level.a], [wall.level.b.expand(steps + 1)]
    for one in rates:
        change = columns.diff(dim=1)[..., int(one.which.argmax())] / DT
        rows += [change, -change]
        bounds += [
            torch.full((steps,), bound, dtype=F64).clamp_max(1e3) for bound in (one.high, -one.low)
        ]
    G, h, P = (
        torch.cat(rows, 1).T,
        torch.cat(bounds),
        torch.einsum("ihk,k,jhk->ij", columns, WEIGHT, columns),
    )
    E, e = (columns[:, -1].T.numpy(), z[0, -1].numpy()) if goal else (None, None)
    one = np.ones(2 * steps)
    cost = -torch.einsum("ihk,k,hk->i", columns, WEIGHT, z[0])
    found = qpsolvers.solve_qp(  # a cost scaled up, which ProxQP is stricter with
        1e3 * P.numpy(),
        1e3 * cost.numpy(),
        G.numpy(),
        h.numpy(),
        E,
        e,
        -one,
        one,
        solver="proxqp",
        eps_abs=1e-8,
        eps_rel=0.0,
    )
    return torch.einsum("i,ihk->hk", torch.from_numpy(found), columns)[None]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("goal", [True, False])
def test_rates_of_single_coordinates_with_dynamics_agree_with_proxqp(seed, goal):
    u = normal(seed, 1, 14, 2).clamp(-1, 1)
    still = torch.zeros(1, 4, dtype=F64)
    z = PUSHED.rollout(still, 2 * u) + 0.05 * normal(seed + 9, 1, 15, 4)
    z[:, 0] = 0.0
    slow = PUSHED.rollout(still, 0.1 * u)  # obeys all
    if goal:
        z[:, -1] = slow[:, -1]
    rates = [
        rate(4, (2,), low=-0.6, high=0.8, dt=DT, name="ax"),
        rate(4, (0,), high=0.15, dt=DT, name="vx"),
    ]
    wall = AtWaypoints(
        "wall", half_space((1.0, 1.0, 0.0, 0.0), 0.01 + float(slow[..., :2].sum(-1).max()))
    )
    pins = pin(z, 0, -1) if goal else pin(z, 0)
    x, made = project_rate_dynamics(
        PUSHED,
        [wall],
        rates,
        z,
        pins,
        columns=range(4),
        weight=WEIGHT,
        max_choices=1,
        tolerance=1e-9,
    )
    torch.testing.assert_close(PUSHED.rollout(still, made), x, atol=1e-9, rtol=0)
    assert any(float(one(x).max()) > -1e-6 for one in rates)
    torch.testing.assert_close(
        x, by_proxqp(z, rates, wall, goal), atol=1e-4, rtol=0
    )  # the cost is flat: its 1e-8 is more in x


@quick
@given(seed=seeds, horizon=st.sampled_from([2, 5, 40]), held=st.sampled_from([(0,), (0, -1)]))
def test_interior_points_without_dynamics_agree_with_admm(seed, horizon, held):
    limits = [
        rate(2, (0, 1), high=0.5, norm=True, dt=DT),
        rate(2, (1,), low=-0.3, high=0.4, dt=DT, name="y"),
    ]
    z = 0.05 * normal(seed, 2, horizon, 2)
    z[:, -1] = z[:, 0] + torch.tensor([0.02, -0.01], dtype=F64) * (horizon - 1) / 2
    pins = pin(z, *held)
    torch.testing.assert_close(
        project_rates((), limits, z, pins), RateProjection(limits, pins)(z), atol=5e-6, rtol=0
    )  # as SMALL**0.5


def test_limit_that_leaves_hardly_any_time_is_satisfied():
    """Where ADMM has not converged after its rounds."""
    s = torch.linspace(0, 1, 128, dtype=F64)
    z = torch.stack((s**3, (3 * s).sin() * (1 - s)), -1)[None]
    limit = rate(2, (0, 1), high=1.02 / 127, norm=True)
    x = project(Constraint((limit,)), z, pin(z, 0, -1))
    assert float(limit(x).max()) <= 1e-9
    assert torch.equal(x[:, [0, -1]], z[:, [0, -1]])


def test_result_of_a_plan_does_not_depend_on_its_batch():
    z = 0.3 * normal(0, 3, 30, 4).cumsum(1)
    z[2] *= 1e-3  # nothing to do, and done early
    limits = [
        rate(4, (0, 1), high=0.5, norm=True, dt=DT),
        rate(4, (3,), high=0.4, dt=DT, name="ay"),
    ]

    def paced(z):
        return project_rate_dynamics(
            PUSHED,
            [],
            limits,
            z,
            pin(z, 0),
            columns=range(4),
            weight=WEIGHT,
            max_choices=1,
            tolerance=1e-9,
        )[0]

    together = paced(z)
    for b in range(3):
        torch.testing.assert_close(
            together[b : b + 1], paced(z[b : b + 1]), atol=1e-6, rtol=0
        )  # of a flat cost


def test_limits_hold_and_an_unreachable_goal_is_missed():
    """In 2.9 s at 0.2 a second it gets 0.58 far, less what it takes to start and stop."""
    z = torch.zeros(1, 30, 4, dtype=F64)
    z[:, :, 0] = torch.linspace(0, 1, 30, dtype=F64)
    limits = [rate(4, (0, 1), high=0.2, norm=True, dt=DT)]
    x, u = project_rate_dynamics(
        PUSHED,
        [],
        limits,
        z,
        pin(z, 0, -1),
        columns=range(4),
        weight=WEIGHT,
        max_choices=1,
        tolerance=1e-9,
    )
    assert float(limits[0](x).max()) <= 1e-4  # of the limits, as far as they give way
    assert float(u.abs().max()) <= 1 + 1e-4
    assert 0.5 < float(x[0, -1, 0]) < 0.58


def test_empty_batch_of_interior_points_is_returned():
    for z in (torch.zeros(0, 5, 4, dtype=F64), torch.zeros(2, 1, 4, dtype=F64)):
        x, u = project_rate_dynamics(
            PUSHED,
            [],
            [],
            z,
            Pins.none(z),
            columns=range(4),
            weight=WEIGHT,
            max_choices=1,
            tolerance=1e-9,
        )
        assert (x.shape, u.shape) == (z.shape, (len(z), z.shape[1] - 1, 2))
