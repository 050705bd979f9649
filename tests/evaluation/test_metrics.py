"""Every reported number by hand, on trajectories small enough to read."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint, stack
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.evaluation import metrics
from cdiff_cli.evaluation.metrics import (
    acceleration,
    boundary_mass,
    control_metrics,
    distance,
    hits_wall,
    jump,
    mean_speed,
    plan_metrics,
    residual,
    rollout_metrics,
    violation,
    worst_segment,
    worst_waypoint,
)
from cdiff_cli.planning.episodes import Episodes
from tests.problems import ball, chain, num, vec, waypoints

XY = (0, 1)
DISC = waypoints(ball("outside", centre=(0.0, 0.0), radius=1.0), "disc")
LEFT = waypoints(HalfSpace(vec(1.0, 0.0), num(1.0)), "left")  # x <= 1
BOX = np.array([[0.0, 0.0, 1.0, 1.0]])


def _plan(*points):
    return np.array([points], dtype=np.float64)


# violation --------------------------------------------------------------------------------------


def test_violation_sums_the_positive_rows_only():
    x = _plan((3.0, 0.0), (0.0, 0.0), (1.5, 0.0))
    assert violation(LEFT, x) == pytest.approx([2.5])  # 2 + 0 + 0.5
    assert violation(stack([LEFT, DISC]), x) == pytest.approx(
        [3.5]
    )  # and 1 at the centre of the disc


def test_worst_waypoint_is_the_largest_row_and_negative_when_safe():
    assert worst_waypoint(LEFT, _plan((3.0, 0.0), (0.0, 0.0))) == pytest.approx([2.0])
    assert worst_waypoint(LEFT, _plan((0.5, 0.0), (0.0, 0.0))) == pytest.approx([-0.5])


def test_worst_segment_sees_a_disc_crossed_between_safe_waypoints():
    x = _plan((-2.0, 0.25), (2.0, 0.25))
    assert worst_waypoint(DISC, x)[0] < 0
    assert violation(DISC, x) == pytest.approx([0.0])
    assert worst_segment(DISC, x) == pytest.approx([0.75])


def test_no_constraints_have_no_violation_and_no_worst():
    x = _plan((3.0, 0.0), (0.0, 0.0))
    assert violation(Constraint(()), x) == pytest.approx([0.0])
    assert worst_waypoint(Constraint(()), x)[0] == -np.inf
    assert worst_segment(Constraint(()), x)[0] == -np.inf


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_worst_segment_is_never_below_worst_waypoint(seed):
    x = np.random.default_rng(seed).normal(size=(4, 6, 2))
    g = stack([DISC, LEFT])
    assert (worst_segment(g, x) >= worst_waypoint(g, x)).all()


def test_boundary_mass_counts_unsafe_and_nearly_unsafe_samples():
    x = np.array([[[2.0, 0.0]], [[0.95, 0.0]], [[0.0, 0.0]], [[-5.0, 0.0]]])
    assert boundary_mass(LEFT, x, 0.1) == pytest.approx(0.5)


# motion -----------------------------------------------------------------------------------------


def test_distance_sums_lengths_in_the_named_columns_and_broadcasts():
    x = np.array([[[3.0, 4.0, 9.0], [0.0, 0.0, 9.0]], [[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]]])
    free = np.zeros((1, 2, 3))
    assert distance(x, free, XY) == pytest.approx([5.0, 2.0])
    assert distance(x, free, XY, 2.0) == pytest.approx([25.0, 4.0])


def test_jump_and_mean_speed_of_a_path_of_known_length():
    x = _plan((0.0, 0.0), (3.0, 4.0), (3.0, 5.0))
    assert jump(x, XY) == pytest.approx([5.0])
    assert mean_speed(x, XY, 0.5) == pytest.approx([6.0])  # 6 m in 2 steps of half a second


def test_one_waypoint_does_not_move():
    x = _plan((1.0, 2.0))
    assert jump(x, XY) == pytest.approx([0.0])
    assert mean_speed(x, XY, 0.5) == pytest.approx([0.0])
    assert not hits_wall(x + 50, XY, BOX).any()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), dt=st.floats(0.01, 1.0))
def test_residual_of_consistent_motion_is_zero(seed, dt):
    """MuJoCo's semi-implicit Euler: p' = p + v' dt."""
    v = np.random.default_rng(seed).normal(size=(3, 8, 2))
    p = np.cumsum(v * dt, axis=1)
    assert residual(np.concatenate((p, v), -1), XY, (2, 3), dt) == pytest.approx(
        np.zeros(3), abs=1e-12
    )  # rounding of sums


def test_residual_is_the_mean_contradiction_of_positions_and_velocities():
    x = np.zeros((1, 3, 4))
    x[0, 1:, 0] = 1.0  # p moves by 1 once, v says 0
    assert residual(x, XY, (2, 3), 0.1) == pytest.approx([0.5])


def test_acceleration_is_the_largest_change_of_velocity_over_dt():
    x = np.zeros((1, 3, 4))
    x[0, :, 2] = (0.0, 0.5, 0.2)
    assert acceleration(x, (2, 3), 0.1) == pytest.approx([5.0])


# walls ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("a", "b", "hit"),
    [
        ((-1.0, 0.5), (2.0, 0.5), True),  # horizontally through, both ends outside
        ((0.5, -1.0), (0.5, 2.0), True),  # vertically through
        ((-0.5, 0.4), (0.4, -0.5), False),  # past a corner, outside it
        ((-0.2, 0.4), (0.4, -0.2), True),  # cuts the corner
        ((0.4, 0.4), (0.6, 0.6), True),  # inside altogether
        ((0.5, 0.5), (0.5, 0.5), True),  # standing inside
        ((0.5, 0.5), (5.0, 5.0), True),  # leaving
        ((2.0, 2.0), (0.9, 0.9), True),  # arriving
        ((-1.0, 1.0), (2.0, 1.0), False),  # along a side: touching is not entering
        ((1.0, -1.0), (1.0, 2.0), False),
        ((-1.0, 0.5), (0.0, 0.5), False),  # ends on a side
        ((-1.0, 0.0), (1.0, 2.0), False),  # touches the corner (0, 1) only
        ((-3.0, 0.5), (-1.0, 0.5), False),  # on the line through it, too short
        ((0.5, 3.0), (0.5, 1.5), False),
        ((2.0, 2.0), (2.0, 2.0), False),  # standing outside
    ],
)
def test_a_segment_hits_a_box_exactly_when_it_enters_it(a, b, hit):
    assert hits_wall(_plan(a, b), XY, BOX).tolist() == [hit]
    assert hits_wall(_plan(b, a), XY, BOX).tolist() == [hit]


def test_walls_are_told_apart_by_plan_and_any_box_counts():
    x = np.array([[[2.0, 2.0], [3.0, 3.0]], [[-1.0, 0.5], [2.0, 0.5]], [[9.5, 9.0], [9.5, 11.0]]])
    boxes = np.array([[0.0, 0.0, 1.0, 1.0], [9.0, 10.0, 10.0, 10.5]])
    assert hits_wall(x, XY, boxes).tolist() == [False, True, True]
    assert hits_wall(x, XY, np.empty((0, 4))).tolist() == [False, False, False]


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_a_densely_sampled_point_inside_a_box_is_always_a_hit(seed):
    x = np.random.default_rng(seed).uniform(-1, 2, size=(20, 2, 2))
    s = np.linspace(0, 1, 400)[:, None]
    points = x[:, :1] + s * (x[:, 1:] - x[:, :1])
    sampled = ((points > 1e-9) & (points < 1 - 1e-9)).all(-1).any(1)
    assert (hits_wall(x, XY, BOX) >= sampled).all()


def test_a_single_waypoint_inside_a_box_is_a_hit():
    assert hits_wall(_plan((0.5, 0.5)), XY, BOX).tolist() == [True]


# tables -----------------------------------------------------------------------------------------


def test_rollout_metrics_stop_where_the_episode_stops():
    x = np.full((2, 4, 2), np.nan)
    x[0, :3] = [(0.0, 0.0), (3.0, 0.0), (1.5, 0.0)]
    x[1] = [(0.0, 0.0)] * 4
    reward = np.array([[1.0, 0.5, np.nan], [0.0, 0.0, 2.0]])
    first, second = rollout_metrics(LEFT, x, reward, np.array([True, False]), np.array([0.1, 2.0]))
    assert first == {
        "reward": 1.5,
        "safe_executed": 0.0,
        "executed_violation": 2.5,
        "executed_worst": 2.0,
        "violation_rate": pytest.approx(200 / 3),
        "steps": 2.0,
        "success": 1.0,
        "goal_distance": 0.1,
    }
    assert second["steps"] == 3.0
    assert second["violation_rate"] == 0.0
    assert second["executed_worst"] == -1.0


def test_rollout_metrics_of_a_chain_count_states_beyond_the_barrier_not_rows():
    g = chain(HalfSpace(vec(1.0, 0.0), num(1.0)), 0.5)  # h = 1 - x
    x = np.array([[(0.0, 0.0), (0.9, 0.0), (1.2, 0.0), (np.nan, np.nan)]])
    (row,) = rollout_metrics(g, x, np.zeros((1, 3)), np.array([0]), np.array([0.0]))
    assert row["executed_violation"] == pytest.approx(0.4 + 0.25)  # 0.5 * 1 - 0.1,  0.5 * 0.1 + 0.2
    assert row["violation_rate"] == pytest.approx(100 / 3)  # only x = 1.2 is outside


def test_rollout_metrics_without_constraints_are_safe():
    (row,) = rollout_metrics(
        Constraint(()), np.zeros((1, 3, 2)), np.ones((1, 2)), np.array([1]), np.array([0.0])
    )
    assert (row["executed_violation"], row["violation_rate"], row["executed_worst"]) == (
        0.0,
        0.0,
        -np.inf,
    )


def test_plan_metrics_measure_each_plan_in_the_tasks_columns():
    task = SimpleNamespace(
        layout=("x", "y", "vx", "vy"),
        positions=("x", "y"),
        velocities=("vx", "vy"),
        dt=1.0,
        walls=lambda: BOX,
        footprint=0.0,
        is_free=lambda *_: True,
    )
    g = Constraint((AtWaypoints("left", HalfSpace(vec(1.0, 0.0, 0.0, 0.0), num(1.0))),))
    x = np.zeros((2, 2, 4))
    x[0] = [(-1.0, 0.5, 0.0, 0.0), (2.0, 0.5, 3.0, 0.0)]
    units = SimpleNamespace(violation=10.0, distance_power=2.0)
    free = np.zeros((2, 2, 4))
    first, second = plan_metrics(task, g, x, free, units)
    assert first["violation"] == pytest.approx(1.0)
    assert first["violation_paper"] == pytest.approx(10.0)
    assert first["distance"] == pytest.approx(1.25**0.5 + 4.25**0.5)
    assert first["distance_paper"] == pytest.approx(1.25 + 4.25)
    assert (
        first["jump"],
        first["mean_speed"],
        first["residual"],
        first["acceleration"],
    ) == pytest.approx((3.0, 3.0, 0.0, 3.0))
    assert (first["wall"], second["wall"]) == (1.0, 0.0)
    assert second["violation"] == 0.0


def test_a_single_plan_has_no_distance_to_the_mean_of_several():
    task = SimpleNamespace(
        layout=("x", "y"), positions=("x", "y"), velocities=(), dt=1.0, walls=lambda: BOX[:0]
    )
    (row,) = plan_metrics(
        task,
        Constraint(()),
        _plan((0.0, 0.0), (1.0, 0.0)),
        _plan((0.0, 0.0), (1.0, 1.0)),
        SimpleNamespace(violation=1.0),
    )
    assert "distance_paper" not in row
    assert row["distance"] == pytest.approx(1.0)


def test_wall_hits_need_walls_not_velocities():
    def columns(velocities, boxes):
        task = SimpleNamespace(
            layout=("x", "y", "vx", "vy"),
            positions=("x", "y"),
            velocities=velocities,
            dt=1.0,
            walls=lambda: boxes,
            footprint=0.0,
            is_free=lambda *_: True,
        )
        x = np.full((1, 2, 4), 0.5)
        return plan_metrics(task, Constraint(()), x, x, SimpleNamespace(violation=1.0))[0]

    assert columns((), BOX)["wall"] == 1.0
    assert "mean_speed" not in columns((), BOX)
    assert "wall" not in columns(("vx", "vy"), BOX[:0])


def test_only_contact_of_what_the_environment_reports_is_a_metric():
    episodes = Episodes(
        x=np.zeros((1, 3, 2)),
        u=np.array([[[1.0], [0.2]]]),
        reward=np.array([[1.0, np.nan]]),
        predicted=np.zeros((1, 3, 2)),
        predicted_levels=np.zeros((1, 3, 1)),
        observed={},
        violation=np.array([[0.5, np.nan]]),
        calls=np.array([[4.0, np.nan]]),
        braked=np.array([[1.0, 0.0]]),
        info={"contact": np.array([[1.0, np.nan]]), "height": np.array([[3.0, 3.0]])},
        fell=np.array([True]),
        diverged=np.array([False]),
        latency_s=np.array([0.3, 0.1]),
        network_s=np.array([0.1, 0.1]),
    )
    levels = np.array([[[-1.0], [0.25], [np.nan]]])
    (row,) = control_metrics(episodes, levels, (np.array([-1.0]), np.array([1.0])))
    assert list(row.items()) == [
        ("reward", 1.0),
        ("plan_violation", 0.5),
        ("safe_plans", 0.0),
        ("safe_executed", 0.0),
        ("executed_violation", 0.25),
        ("executed_worst", 0.25),
        ("violation_rate", 50.0),  # one of two states
        ("fell", 1.0),
        ("diverged", 0.0),
        ("braked", 100.0),
        ("saturation", 100.0),
        ("steps", 1.0),
        ("calls", 4.0),
        ("latency_ms", pytest.approx(200.0)),
        ("latency_p95", pytest.approx(290.0)),
        ("overhead", pytest.approx(100.0)),
        ("contacts", 1.0),
    ]


def test_a_plan_is_smooth_up_to_a_fifth_more_than_the_data():
    assert [metrics.smooth(jump, 0.5) for jump in (0.0, 0.59, 0.61)] == [True, True, False]


def test_overhead_is_the_time_outside_the_network_over_that_inside():
    assert metrics.overhead(3.0, 2.0) == 50.0
    assert metrics.overhead(2.0, 2.0) == 0.0
    assert np.isfinite(metrics.overhead(1.0, 0.0))
