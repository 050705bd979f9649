"""Linear dynamics: fitting them, their rows by hand, and the nearest reachable trajectory against a
QP solver.
"""

from dataclasses import replace

import numpy as np
import pytest
import qpsolvers
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.dynamics import (
    LinearDynamics,
    LinearDynamicsConstraint,
    dynamics_of,
    split,
)
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import RateLimit, rate_bounds
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.projection.dynamics import project_dynamics
from cdiff_cli.projection.project import project, project_reachable
from cdiff_cli.training.system_identification import fit
from tests.problems import F64, ball, normal, num, pin, saddle, vec

seeds = st.integers(0, 10_000)
WEIGHT = vec(1.0, 1.0, 0.02, 0.02)
QP = 1e-6  # of the distance, relative: ProxQP's and ADMM's own accuracy; 2e-8 was measured


def double_integrator(bound=1.0, dt=1.0):
    """p' = p + dt v + dt^2 u / 2, v' = v + dt u, on a line."""
    return LinearDynamics(
        torch.tensor([[1.0, dt], [0.0, 1.0]], dtype=F64),
        vec(dt**2 / 2, dt)[:, None],
        vec(0, 0),
        vec(-bound),
        vec(bound),
    )


def maze(bound=1.0):
    """The maze's ball: p' = p + .00998 v + .00238 u, v' = .9976 v + .2382 u."""
    eye, o = torch.eye(2, dtype=F64), torch.zeros(2, 2, dtype=F64)
    A = torch.cat((torch.cat((eye, 0.00998 * eye), 1), torch.cat((o, 0.9976 * eye), 1)))
    B = torch.cat((0.00238 * eye, 0.2382 * eye))
    return LinearDynamics(A, B, torch.zeros(4, dtype=F64), vec(-bound, -bound), vec(bound, bound))


def reachable(dynamics, tolerance=1e-5, weight=None):
    n = len(dynamics.c)
    one = torch.ones(n, dtype=F64)
    return LinearDynamicsConstraint(
        "dyn",
        dynamics,
        torch.zeros(n, dtype=F64),
        one,
        one if weight is None else weight,
        tolerance,
    )


def noisy_path(dynamics, seed, batch, horizon, noise=0.02):
    """A trajectory under random inputs and, beside it, itself with noise on all states but the
    first.
    """
    u = torch.clamp(normal(seed, batch, horizon - 1, 2, scale=0.8), -1, 1)
    path = dynamics.rollout(normal(seed + 1, batch, 4) * vec(0.5, 0.5, 2, 2), u)
    z = path + noise * normal(seed + 2, batch, horizon, 4) * vec(1, 1, 15, 15)
    z[:, 0] = path[:, 0]
    return path, z


def solve(dynamics, z, pins, parts=(), rounds=3000, columns=(0, 1), **more):
    settings = {
        "columns": columns if parts or more.get("others") else (),
        "weight": WEIGHT,
        "rounds": rounds,
        "tolerance": 1e-9,
    }
    return project_dynamics(dynamics, parts, more.pop("others", None), z, pins, **(settings | more))


def distance(x, z):
    return ((x - z).square() * WEIGHT).sum((-2, -1)).sqrt()


def qp(dynamics, z, pinned, a=None, b=0.0):
    """The same by ProxQP over all states and inputs at once: a.x <= b at every waypoint that is not
    pinned.
    """
    (H, n), m = z.shape, dynamics.B.shape[1]
    N, M = H * n, (H - 1) * m
    w = np.tile(WEIGHT.numpy(), H)
    eye = np.eye(N + M)
    step = np.zeros((N - n, N + M))
    for tau in range(H - 1):
        rows = slice(tau * n, tau * n + n)
        step[rows, (tau + 1) * n : (tau + 2) * n] = np.eye(n)
        step[rows, tau * n : tau * n + n] = -dynamics.A.numpy()
        step[rows, N + tau * m : N + tau * m + m] = -dynamics.B.numpy()
    held = [tau * n + i for tau in pinned for i in range(n)]
    E, e = (
        np.concatenate((step, eye[held])),
        np.concatenate((np.tile(dynamics.c.numpy(), H - 1), z.numpy().ravel()[held])),
    )
    free = [tau for tau in range(H) if tau not in pinned]
    walls = (
        None
        if a is None
        else np.stack([np.pad(a.numpy(), (tau * n, N + M - tau * n - n)) for tau in free])
    )
    low, high = (
        np.concatenate((np.full(N, s * 1e6), np.tile(v.numpy(), H - 1)))
        for s, v in ((-1, dynamics.low), (1, dynamics.high))
    )
    x = qpsolvers.solve_qp(
        np.diag(np.concatenate((w, np.full(M, 1e-12)))),
        np.concatenate((-w * z.numpy().ravel(), np.zeros(M))),
        walls,
        None if a is None else np.full(len(free), b),
        E,
        e,
        low,
        high,
        solver="proxqp",
        eps_abs=1e-9,
        max_iter=100_000,
    )
    assert x is not None
    return torch.from_numpy(x[:N].reshape(H, n))


# by hand ------------------------------------------------------------------------------------------


def test_rollout_of_a_double_integrator_by_hand():
    x = double_integrator().rollout(vec(0.0, 1.0)[None], torch.tensor([[[1.0], [-1.0]]], dtype=F64))
    torch.testing.assert_close(
        x, torch.tensor([[[0.0, 1.0], [1.5, 2.0], [3.0, 1.0]]], dtype=F64), atol=1e-15, rtol=0
    )


def test_inputs_of_a_path_are_those_that_made_it_and_are_cut_to_their_bounds():
    d, u = double_integrator(), torch.tensor([[[0.5], [-3.0], [1.0]]], dtype=F64)
    x = d.rollout(vec(0.0, 1.0)[None], u)
    torch.testing.assert_close(d.unbounded_inputs(x), u, atol=1e-12, rtol=0)
    torch.testing.assert_close(
        d.inputs(x), torch.tensor([[[0.5], [-1.0], [1.0]]], dtype=F64), atol=1e-12, rtol=0
    )


def test_residual_by_hand():
    """u = -3 is cut to -1: the step misses by 2 (1/2, 1). A step sideways to B = (1/2, 1) is missed
    whole.
    """
    d = double_integrator()
    x = d.rollout(vec(0.0, 1.0)[None], torch.tensor([[[0.5], [-3.0]]], dtype=F64))
    torch.testing.assert_close(d.residual(x), vec(0.0, 2 * 1.25**0.5)[None], atol=1e-12, rtol=0)
    x = torch.stack((vec(0.0, 0.0), vec(1.0, -0.5)))[None]
    torch.testing.assert_close(d.residual(x), vec(1.25**0.5)[None], atol=1e-12, rtol=0)


def test_dynamics_have_one_row_per_step_minus_the_tolerance():
    part = reachable(double_integrator(), tolerance=0.25)
    x = torch.stack((vec(0.0, 0.0), vec(1.0, -0.5), vec(0.5, -0.5)))[None]
    torch.testing.assert_close(part(x), vec(1.25**0.5 - 0.25, -0.25)[None], atol=1e-12, rtol=0)
    assert part.labels(3) == ["dyn@0-1", "dyn@1-2"]
    assert torch.equal(part.tighten(0.125)(x), part(x) + 0.125)
    assert torch.equal(part.segment_max(x), part(x))
    assert part.on_segments() == (part,)


@settings(max_examples=20, deadline=None)
@given(seed=seeds)
def test_pulled_back_dynamics_keep_their_rows(seed):
    part, centre, scale = reachable(maze()), normal(seed + 1, 4), normal(seed + 2, 4).abs() + 0.1
    z = normal(seed, 2, 5, 4)
    torch.testing.assert_close(
        part.pull_back(centre, scale)(z), part(centre + scale * z), atol=1e-12, rtol=1e-12
    )
    twice = part.pull_back(centre, scale).pull_back(scale, scale)
    torch.testing.assert_close(
        twice(z), part(centre + scale * (scale + scale * z)), atol=1e-12, rtol=1e-12
    )


@settings(max_examples=20, deadline=None)
@given(seed=seeds, size=st.sampled_from([0.05, 1.0]))  # within and beyond what the inputs reach
def test_pull_of_dynamics_equals_autograd(seed, size):
    part = reachable(maze()).pull_back(normal(seed, 4), normal(seed + 1, 4).abs() + 0.5)
    _, x = noisy_path(maze(), seed, 2, 5, noise=size)
    x = part.encode(x)
    w = normal(seed + 3, 2, 4)
    rows, pull, bound = part.linearise(x)
    leaf = x.clone().requires_grad_()
    value = part(leaf)
    (slope,) = torch.autograd.grad((w * value).sum(), leaf)
    torch.testing.assert_close(rows, value.detach(), atol=1e-12, rtol=0)
    torch.testing.assert_close(
        pull(w), slope, atol=1e-8, rtol=1e-6
    )  # rows divide by their length, 1e-3 and more
    for k in range(4):
        alone = pull(torch.eye(4, dtype=F64)[k].expand(2, 4))
        assert bool((alone.square().sum((1, 2)) <= bound[:, k] + 1e-12).all())


# fitting ------------------------------------------------------------------------------------------


def transitions(seed, k):
    rng = np.random.default_rng(seed)
    A, B, c = np.eye(3) + 0.1 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), rng.normal(size=3)
    x, u = rng.normal(size=(k, 3)), rng.uniform(-1, 0.5, size=(k, 2))
    return (A, B, c), (x, u, x @ A.T + u @ B.T + c)


@pytest.mark.parametrize("corrupted", [0.0, 0.05])
def test_fit_recovers_the_dynamics_though_one_step_in_twenty_is_a_collision(corrupted):
    (A, B, c), (x, u, after) = transitions(0, 2000)
    bad = np.arange(2000) < corrupted * 2000
    after = np.where(bad[:, None], after + np.random.default_rng(1).normal(size=after.shape), after)
    found, share = fit(x, u, after)
    for mine, true in ((found.A, A), (found.B, B), (found.c, c)):
        np.testing.assert_allclose(mine, true, atol=1e-10)
    np.testing.assert_array_equal(found.low, u.min(0))
    np.testing.assert_array_equal(found.high, u.max(0))
    assert share == pytest.approx(1 - corrupted, abs=1e-12)


def test_poor_fit_has_a_small_share_of_linear_steps():
    _, (x, u, after) = transitions(0, 2000)
    assert fit(x, u, after + 0.3 * np.sin(5 * x))[1] < 0.01


def test_a_coordinate_that_never_moves_is_fitted():
    (A, B, c), (x, u, _) = transitions(0, 500)
    x[:, 2] = 1.5
    after = x @ A.T + u @ B.T + c
    after[:, 2] = 1.5
    found, share = fit(x, u, after)
    assert share == 1.0
    np.testing.assert_allclose(found(torch.from_numpy(x), torch.from_numpy(u)), after, atol=1e-9)


# the nearest reachable trajectory -----------------------------------------------------------------


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("horizon", [2, 8, 24])
def test_projection_without_bounds_is_the_least_squares_solution(horizon, ends):
    """x = F x0 + G u with the first state given: min |W^(1/2) (G u - r)|^2, s.t. the last state
    where pinned, by its KKT system.
    """
    d = replace(maze(bound=1e6), c=vec(0.01, 0.0, 0.02, -0.01))
    path, z = noisy_path(d, horizon, 1, horizon)
    ends = ends and horizon > 2  # one step reaches no state of four coordinates exactly
    if ends:
        z[:, -1] = path[:, -1]
    zero = torch.zeros(1, horizon - 1, 2, dtype=F64)
    drift = d.rollout(z[:, 0], zero)
    columns = torch.eye(2 * (horizon - 1), dtype=F64).reshape(-1, horizon - 1, 2)
    G = (d.rollout(z[:, 0].expand(len(columns), -1), columns) - drift).flatten(1).T
    W = WEIGHT.repeat(horizon)[:, None]
    K, right = G.T @ (W * G), G.T @ (W[:, 0] * (z - drift).flatten())
    if ends:
        L = G[-4:]
        K = torch.cat((torch.cat((K, L.T), 1), torch.cat((L, torch.zeros(4, 4, dtype=F64)), 1)))
        right = torch.cat((right, (z - drift)[0, -1]))
    u = (torch.linalg.pinv(K, hermitian=True) @ right)[: G.shape[1]]
    expected = drift + (G @ u).reshape(z.shape)
    x, _ = solve(d, z, pin(z, 0, horizon - 1) if ends else pin(z, 0), rounds=5000, tolerance=1e-12)
    torch.testing.assert_close(distance(x, z), distance(expected, z), atol=1e-9, rtol=1e-6)
    torch.testing.assert_close(x[..., :2], expected[..., :2], atol=1e-4, rtol=0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("wall", [False, True])
@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("horizon", [8, 24])
def test_projection_with_tight_bounds_and_a_half_space_agrees_with_proxqp(
    horizon, ends, wall, seed
):
    d, a = maze(), vec(1.0, -1.0, 0.0, 0.0)
    path, z = noisy_path(d, seed, 1, horizon)
    pinned = [0, horizon - 1] if ends else [0]
    z[:, pinned] = path[:, pinned]
    along = path[0] @ a
    b = (
        float(along.max()) + 1e-4
        if ends
        else max(float(along.max()) - 0.003, float(along[0]) + 1e-6)
    )
    x, warm = solve(
        d, z, pin(z, *pinned), [AtWaypoints("wall", HalfSpace(a[:2], num(b)))] if wall else []
    )
    expected = qp(d, z[0], pinned, a if wall else None, b)
    torch.testing.assert_close(distance(x[0], z[0]), distance(expected, z[0]), atol=0, rtol=QP)
    assert float((warm.u.abs() - 1).max()) <= 1e-9
    assert not wall or float((x[0] @ a - b).max()) <= 1e-8
    torch.testing.assert_close(x[:, pinned], z[:, pinned], atol=1e-12, rtol=0)


@pytest.mark.parametrize("rounds", [1, 3, 50])
def test_every_iterate_satisfies_the_dynamics(rounds):
    d = maze()
    _, z = noisy_path(d, 0, 3, 16)
    x, warm = solve(
        d,
        z,
        pin(z, 0),
        [OnSegments("s", ball("outside", centre=(0.1, 0.0), radius=0.2))],
        rounds=rounds,
    )
    torch.testing.assert_close(
        x, d.rollout(z[:, 0], warm.u), atol=1e-12, rtol=0
    )  # rounding of matrix powers


def test_projection_of_a_batch_equals_that_of_each_plan():
    d, part = maze(), AtWaypoints("w", HalfSpace(vec(1.0, 0.5), num(0.3)))
    _, z = noisy_path(d, 5, 4, 12)
    z[:, 0, :2] -= 0.6
    whole, _ = solve(d, z, pin(z, 0), [part], rounds=200, tolerance=0.0)
    alone = torch.cat(
        [solve(d, one[None], pin(one[None], 0), [part], rounds=200, tolerance=0.0)[0] for one in z]
    )
    torch.testing.assert_close(whole, alone, atol=1e-12, rtol=0)


def test_warm_start_reaches_the_same_point():
    d, part = maze(), AtWaypoints("w", HalfSpace(vec(1.0, 0.5), num(0.0)))
    _, z = noisy_path(d, 6, 2, 16)
    z[:, 0, :2] = -0.05
    once, _ = solve(d, z, pin(z, 0), [part], rounds=1000)
    _, warm = solve(d, z, pin(z, 0), [part], rounds=7)
    again, _ = solve(d, z, pin(z, 0), [part], rounds=1000, warm=warm)
    torch.testing.assert_close(again, once, atol=1e-4, rtol=0)
    _, other = solve(d, z + 0.01, pin(z, 0), [part], rounds=50)
    torch.testing.assert_close(
        solve(d, z, pin(z, 0), [part], rounds=1000, warm=other)[0], once, atol=1e-4, rtol=0
    )


@pytest.mark.parametrize("batch", [0, 2])
@pytest.mark.parametrize("horizon", [1, 2])
def test_short_horizons_and_empty_batches_are_returned(batch, horizon):
    g = Constraint((reachable(maze()), OnSegments("s", ball("outside", dim=4))))
    z = normal(0, batch, horizon, 4) + 3.0
    assert project(g, z, pin(z, 0)).shape == z.shape


# projection ---------------------------------------------------------------------------------------


def trip(horizon=64, length=0.8):
    """A reachable trip along y = .05 at constant acceleration, then deceleration, from rest to
    rest.
    """
    half = (horizon - 1) // 2
    u = torch.zeros(1, horizon - 1, 2, dtype=F64)
    u[0, :half, 0], u[0, half : 2 * half, 0] = 1.0, -1.0
    x = maze().rollout(vec(0.0, 0.0, 0.0, 0.0)[None], u)
    u *= length / float(x[0, -1, 0])
    return maze().rollout(vec(-length / 2, 0.05, 0.0, 0.0)[None], u)


@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_segments_avoid_a_disc_within_the_input_bounds(dtype):
    z = trip()
    disc = OnSegments("disc", ball("outside", centre=(0.0, 0.0), radius=0.12, dim=4))
    assert float(disc(z).max()) > 0.05
    g = Constraint((reachable(maze(), weight=WEIGHT), disc)).to(z.to(dtype))
    z = z.to(dtype)
    x, warm = project_reachable(g, z, pin(z, 0, 63), None, 1e-3)
    assert x.dtype == dtype
    tolerance = (
        1e-4 if dtype == F64 else 1e-3
    )  # where the active set stops; 2e-5 was measured in float64
    assert float(disc(x.double()).max()) <= tolerance
    assert float(warm.u.abs().max()) <= 1 + tolerance
    torch.testing.assert_close(x[:, [0, 63]], z[:, [0, 63]], atol=tolerance, rtol=0)
    assert float(g.parts[0](x).max()) <= 1e-4


def test_projection_of_pulled_back_dynamics_is_the_pulled_back_projection():
    z, centre, scale = trip(), vec(0.3, -0.2, 0.1, 0.0), vec(1.3, 1.3, 4.0, 4.0)
    g = Constraint(
        (
            reachable(maze(), weight=WEIGHT),
            OnSegments("disc", ball("outside", centre=(0.0, 0.0), radius=0.12, dim=4)),
        )
    )
    x = project(g, z, pin(z, 0, 63))
    back = Constraint(tuple(part.pull_back(centre, scale) for part in g.parts))
    scaled = (z - centre) / scale
    torch.testing.assert_close(
        centre + scale * project(back, scaled, pin(scaled, 0, 63)), x, atol=1e-9, rtol=0
    )


def test_trajectory_that_satisfies_everything_is_unchanged():
    z = trip()
    g = Constraint(
        (
            reachable(maze(), weight=WEIGHT),
            OnSegments("disc", ball("outside", centre=(0.0, 1.0), radius=0.12, dim=4)),
        )
    )
    torch.testing.assert_close(project(g, z, pin(z, 0, 63)), z, atol=1e-6, rtol=0)


def test_unreachable_goal_is_missed_without_an_error():
    """64 steps of full force go 4.2 m; asked are 20."""
    z = trip()
    z[:, -1, 0] = 20.0
    g = Constraint((reachable(maze(), weight=WEIGHT),))
    x, warm = project_reachable(g, z, pin(z, 0, 63), None, 1e-3)
    assert bool(torch.isfinite(x).all())
    assert float(warm.u.abs().max()) > 1.5  # what the goal would take
    assert float(g(x).max()) > 0.05  # and g says so
    executed = maze().rollout(z[:, 0], torch.clamp(warm.u, -1, 1))
    assert float((executed[:, -1] - z[:, -1]).abs().max()) > 10


@pytest.mark.parametrize(
    "other",
    [
        DiscreteBarrier("c", HalfSpace(vec(0.0, 0.0, 1.0, 0.0), num(2.0)), 0.3),
        AtWaypoints("q", ball("inside", centre=(-0.1, 0.0), radius=0.41, dim=4).quadric()),
        AtWaypoints(
            "s",
            replace(
                saddle(), P=torch.diag(vec(1.0, -1.0, 0.0, 0.0)), q=vec(0.2, 0, 0, 0), r=num(0.14)
            ),
        ),
    ],
    ids=["chain over a half-space", "inside a quadric", "saddle"],
)
def test_barriers_and_quadrics_are_satisfied_with_dynamics(other):
    z = trip()
    g = Constraint((reachable(maze(), weight=WEIGHT), other))
    assert float(other(z).max()) > 1e-3
    x, warm = project_reachable(g, z, pin(z, 0), None, 1e-3)
    assert float(other(x).max()) <= 5e-3  # which a polish leaves
    assert float(warm.u.abs().max()) <= 1 + 5e-3
    torch.testing.assert_close(x[:, 0], z[:, 0], atol=1e-12, rtol=0)


def test_barrier_disc_and_wall_are_satisfied_with_dynamics():
    z = trip()
    g = Constraint(
        (
            reachable(maze(), weight=WEIGHT),
            OnSegments("disc", ball("outside", centre=(0.0, 0.0), radius=0.12, dim=4)),
            AtWaypoints("wall", HalfSpace(vec(0.0, 1.0, 0.0, 0.0), num(0.2))),
            DiscreteBarrier("slow", HalfSpace(vec(0.0, 0.0, 1.0, 0.0), num(2.3)), 0.3),
        )
    )
    x, _ = project_reachable(g, z, pin(z, 0, 63), None, 1e-3)
    assert (
        float(g(x).max()) <= 1e-3
    )  # no closed form holds them all at once, and ADMM has not ended


def test_speed_limit_and_disc_are_satisfied_with_dynamics():
    """The limit has no half-spaces at waypoints: its own projection (rate.py) takes turns with the
    active set.
    """
    z = trip()
    one = torch.ones(4, dtype=F64)
    slow = RateLimit(
        "slow",
        torch.eye(4, dtype=F64)[:2],
        *rate_bounds(None, 2.3),
        True,
        0.01,
        torch.zeros_like(one),
        one,
    )
    g = Constraint(
        (
            reachable(maze(), weight=WEIGHT),
            slow,
            OnSegments("disc", ball("outside", centre=(0.0, 0.0), radius=0.12, dim=4)),
        )
    )
    assert float(slow(z).max()) > 0.3
    x, warm = project_reachable(g, z, pin(z, 0, 63), None, 5e-5)
    assert (
        float(slow(x).max()) <= 2 * 5e-5 / 0.01
    )  # m/s: both ends of a segment within the tolerance, over dt
    assert float(g.parts[2](x).max()) <= 5e-5
    assert float(warm.u.abs().max()) <= 1 + 5e-5
    torch.testing.assert_close(x[:, [0, 63]], z[:, [0, 63]], atol=1e-9, rtol=0)


def test_two_sets_of_dynamics_are_refused():
    g = Constraint((reachable(maze()), replace(reachable(maze()), name="more")))
    with pytest.raises(InfeasibleError, match='"dyn" and "more": a plan can satisfy only one'):
        project(g, torch.zeros(1, 3, 4, dtype=F64), Pins.none(torch.zeros(1, 3, 4, dtype=F64)))


def test_split_separates_the_dynamics_from_the_other_parts():
    part, wall = reachable(maze()), AtWaypoints("w", HalfSpace(vec(1.0, 0, 0, 0), num(0.0)))
    assert dynamics_of(Constraint((wall, part))) == [part]
    assert split(Constraint((wall, part))) == (Constraint((wall,)), Constraint((part,)))
