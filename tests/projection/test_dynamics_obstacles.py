"""The active set of the projection with dynamics: optimality by its own conditions, hard and
infeasible problems, warm starts.
"""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.projection.dynamics import project_dynamics
from cdiff_cli.projection.segments import tangent_half_spaces
from cdiff_cli.projection.solvers.active_set import MAX_CHANGES_AGAIN, Bounds, _at_active
from cdiff_cli.projection.solvers.active_set import solve as settle
from cdiff_cli.projection.solvers.lq_tracking import tracking
from tests.problems import F64, ball, normal, num, pin, vec
from tests.projection.test_dynamics import WEIGHT, distance, maze, noisy_path, qp, solve, trip

seeds = st.integers(0, 10_000)
WALL = vec(1.0, 0.5, 0.0, 0.0)


def wall(b):
    return AtWaypoints("wall", HalfSpace(WALL[:2], num(b)))


@settings(max_examples=15, deadline=None)
@given(seed=seeds, horizon=st.sampled_from([3, 20, 50]))
def test_no_other_reachable_trajectory_is_nearer(seed, horizon):
    """Of a convex problem the minimiser x has <x - z, y - x>_W >= 0 for every feasible y: here
    other inputs' trajectories.
    """
    d = maze()
    _, z = noisy_path(d, seed, 2, horizon)
    x, warm = solve(d, z, pin(z, 0))
    assert float(warm.u.abs().max()) <= 1 + 1e-8
    for k in range(5):
        y = d.rollout(z[:, 0], torch.clamp(normal(seed + 10 + k, 2, horizon - 1, 2), -1, 1))
        slope = ((x - z) * WEIGHT * (y - x)).sum((1, 2))
        assert bool(
            (slope >= -1e-6 * (1 + distance(y, x))).all()
        )  # what a row at its bound gives way, times its multiplier


@pytest.mark.parametrize("seed", [6, 7, 8])
def test_problem_with_half_of_its_rows_active_is_solved_from_a_cold_start(seed):
    """Noise that asks for six times the inputs there are, towards a wall: many rows change sides
    many times.
    """
    d = maze()
    _, z = noisy_path(d, seed, 1, 16)
    z[:, 0, :2] = -0.05
    expected = qp(d, z[0], [0], WALL, 0.0)
    x, warm = solve(d, z, pin(z, 0), [wall(0.0)])
    assert int(warm.active.abs().sum()) >= 10
    torch.testing.assert_close(distance(x[0], z[0]), distance(expected, z[0]), atol=0, rtol=1e-6)
    assert float((x[0] @ WALL).max()) <= 1e-8


def test_changing_one_row_at_a_time_ends_at_the_same_point(monkeypatch):
    d = maze()
    _, z = noisy_path(d, 5, 3, 16)
    z[:, 0, :2] = -0.2
    expected, _ = solve(d, z, pin(z, 0), [wall(0.0)])
    assert float((expected @ WALL).max()) <= 1e-8
    monkeypatch.setattr("cdiff_cli.projection.solvers.active_set.STALLED_AFTER", -1)
    x, _ = solve(d, z, pin(z, 0), [wall(0.0)])
    torch.testing.assert_close(x, expected, atol=1e-6, rtol=0)


def test_warm_start_at_the_solution_solves_one_system_per_plan_with_active_rows(
    monkeypatch,
):
    d = maze()
    _, z = noisy_path(d, 5, 3, 16)
    _, warm = solve(d, z, pin(z, 0), [wall(2.0)])
    assert bool(warm.active.any())
    solved = []
    monkeypatch.setattr(
        "cdiff_cli.projection.solvers.active_set._at_active",
        lambda *of: solved.append(int(of[1].active.flatten(1).any(1).sum())) or _at_active(*of),
    )
    solve(d, z, pin(z, 0), [wall(2.0)], warm=warm)
    assert solved == [int(warm.active.flatten(1).any(1).sum())]
    solved.clear()
    path = d.rollout(z[:, 0], torch.zeros(3, 15, 2, dtype=F64))
    torch.testing.assert_close(solve(d, path, pin(path, 0))[0], path, atol=1e-9, rtol=0)
    assert sum(solved) == 0


def test_safe_plans_get_no_tangent_half_spaces(monkeypatch):
    d, z = maze(), torch.cat((trip(), trip()))
    z[1, :, 1] += 1.0
    asked = []
    monkeypatch.setattr(
        "cdiff_cli.projection.segments.tangent_half_spaces",
        lambda parts, x, pins: asked.append(len(x)) or tangent_half_spaces(parts, x, pins),
    )
    x, _ = solve(
        d, z, pin(z, 0, 63), [OnSegments("disc", ball("outside", centre=(0.0, 0.0), radius=0.12))]
    )
    assert set(asked) == {1}
    torch.testing.assert_close(x[1], z[1], atol=1e-8, rtol=0)


def test_later_choices_of_half_spaces_come_nearer():
    d, z = maze(), trip()
    part = OnSegments("disc", ball("outside", centre=(0.0, 0.0), radius=0.12))
    far = [
        float(distance(solve(d, z, pin(z, 0, 63), [part], max_choices=choices)[0], z))
        for choices in (1, 2, 3)
    ]
    assert far[2] <= far[1] + 1e-9 <= far[0] + 2e-9
    for choices in (1, 3):
        x, _ = solve(d, z, pin(z, 0, 63), [part], max_choices=choices)
        assert float(part(x[..., :2]).max()) <= 1e-8


def test_contradicting_rows_share_the_violation():
    """A wall that the start is 0.1 m behind: position and inputs give way, and the result is
    finite.
    """
    d = maze()
    z = trip()
    z[:, 0] = vec(0.1, 0.0, 1.0, 0.0)
    x, warm = solve(d, z, pin(z, 0), [wall(0.0)])
    assert bool(torch.isfinite(x).all())
    assert float((x @ WALL).max()) > 0.01
    assert float(warm.u.abs().max()) > 1.5


def test_infeasible_plan_costs_three_systems_in_the_next_call_and_is_solved_once_feasible(
    monkeypatch,
):
    """A disc that three tenths of the inputs do not get past, a millimetre further on; then one far
    from the way.
    """
    d = maze(bound=0.3)
    z = trip()
    near, far = (
        OnSegments("disc", ball("outside", centre=(0.0, y), radius=0.3)) for y in (0.0, 1.0)
    )
    _, warm = solve(d, z, pin(z, 0, 63), [near])
    assert warm.infeasible.tolist() == [True]
    solved = []
    monkeypatch.setattr(
        "cdiff_cli.projection.solvers.active_set._at_active",
        lambda *of: solved.append(int(of[1].active.flatten(1).any(1).sum())) or _at_active(*of),
    )
    x, warm = solve(d, z + 1e-3, pin(z + 1e-3, 0, 63), [near], warm=warm, max_choices=3)
    assert len(solved) <= 1 + MAX_CHANGES_AGAIN
    assert warm.infeasible.tolist() == [True]
    assert bool(torch.isfinite(x).all())
    expected, _ = solve(maze(), z, pin(z, 0, 63), [far])
    for _ in range(
        4
        # rows that pull where nothing is in the way any more leave all at once, then the inputs
        # settle
    ):
        x, warm = solve(maze(), z, pin(z, 0, 63), [far], warm=warm)
    assert warm.infeasible.tolist() == [False]
    torch.testing.assert_close(x, expected, atol=1e-8, rtol=0)


def test_infeasible_rows_are_violated_by_least_squares_weighted_by_their_slack():
    """Two walls that face away from each other, a decimetre apart: the path ends in the middle
    between them.
    """
    d, z = maze(bound=1e6), torch.zeros(1, 3, 4, dtype=F64)
    z[:, 1:, 0] = 0.05
    walls = [
        AtWaypoints("below", HalfSpace(vec(1.0, 0.0), num(0.0))),
        AtWaypoints("above", HalfSpace(vec(-1.0, 0.0), num(-0.1))),
    ]
    x, warm = solve(d, z, pin(z, 0), walls)
    assert warm.infeasible.tolist() == [True]
    torch.testing.assert_close(
        x[0, 1:, 0], vec(0.05, 0.05), atol=1e-4, rtol=0
    )  # the way there has a cost too: 1e-5


def test_result_of_a_plan_does_not_depend_on_its_batch():
    d = maze()
    _, z = noisy_path(d, 9, 6, 40)
    z[:, 0, :2] -= 0.5
    part = OnSegments("disc", ball("outside", centre=(0.0, 0.0), radius=0.2))
    whole, _ = solve(d, z, pin(z, 0), [part, wall(0.3)])
    alone = torch.cat([solve(d, one[None], pin(one[None], 0), [part, wall(0.3)])[0] for one in z])
    torch.testing.assert_close(whole, alone, atol=1e-8, rtol=0)


def test_half_spaces_in_three_coordinates_are_satisfied():
    """Rows over used coordinates out of order and with a gap: position y and both velocities."""
    d, a = maze(), vec(0.3, 1.0, 0.2)
    _, z = noisy_path(d, 2, 2, 30)
    whole = vec(0.0, 0.3, 1.0, 0.2)
    b = float((z[:, 0] @ whole).max()) + 0.1
    x, _ = project_dynamics(
        d,
        [AtWaypoints("w", HalfSpace(a, num(b)))],
        None,
        z,
        pin(z, 0),
        columns=(1, 2, 3),
        weight=WEIGHT,
        rounds=1,
        tolerance=1e-9,
    )
    for k in range(2):
        expected = qp(d, z[k], [0], whole, b)
        torch.testing.assert_close(
            distance(x[k], z[k]), distance(expected, z[k]), atol=0, rtol=1e-6
        )


def test_part_without_half_spaces_is_satisfied_by_admm():
    """A slab |y| <= 0.04 given as a projection alone is met as its half-spaces are."""
    d, z = maze(), trip()
    z[:, 0, 1] = 0.0
    upper, lower = (
        AtWaypoints("u", HalfSpace(vec(0.0, 1.0), num(0.04))),
        AtWaypoints("l", HalfSpace(vec(0.0, -1.0), num(0.04))),
    )
    expected, _ = solve(d, z, pin(z, 0), [upper, lower])

    def onto(x, _):
        return torch.stack((x[..., 0], x[..., 1].clamp(-0.04, 0.04)), -1)

    x, _ = solve(d, z, pin(z, 0), others=onto, rounds=2000, tolerance=1e-7)
    torch.testing.assert_close(x[..., :2], expected[..., :2], atol=1e-4, rtol=0)


def test_active_set_of_an_empty_batch_returns_the_unconstrained_solution():
    d = maze()
    w0 = 0.1 * normal(0, 2, 7, 6)
    numbers = tuple(tuple(v.flatten().tolist()) for v in (d.A, d.B, d.c))
    track = tracking(numbers, tuple(WEIGHT.tolist()), 7, False, w0.device)
    none = torch.zeros(2, 7, 2, dtype=torch.int8)
    empty = (w0.new_zeros(2, 7, 0, 0), w0.new_zeros(2, 7, 0))
    w, active, soft = settle(
        track, w0, Bounds(d.low, d.high, [], 1e-9), *empty, none, torch.zeros(2).bool()
    )
    assert torch.equal(w, w0)
    assert not bool(active.any() | soft.any())
