"""Mazes and Gaussian: geometry in Gymnasium-Robotics, demonstrations, the exact denoiser."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.errors import CdiffError
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.tasks import TASKS, load_task
from cdiff_cli.tasks.gaussian2d import GAUSSIAN2D
from cdiff_cli.tasks.maze2d import BALL_RADIUS, LARGE, MAX_SPEED, UMAZE, Maze2D
from cdiff_cli.tasks.protocol import walls_of
from cdiff_cli.training.demonstrations import demonstrations

MAZES = [UMAZE, LARGE]
each_maze = pytest.mark.parametrize("maze", MAZES, ids=lambda maze: maze.name)


def clearance(maze: Maze2D, points: np.ndarray) -> np.ndarray:
    """Distance of each point to the nearest wall, 0 inside one."""
    box = maze.walls()
    nearest = np.clip(points[:, None], box[:, :2], box[:, 2:])
    return np.linalg.norm(nearest - points[:, None], axis=2).min(1)


# the table ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TASKS)
def test_every_task_has_names_and_units_for_its_coordinates(name):
    task = load_task(name)
    assert task.name == name
    assert len(task.layout) == len(task.units) == len(set(task.layout))
    assert set(task.positions) | set(task.velocities) <= set(task.layout)
    assert len(task.velocities) in (0, len(task.positions))
    assert {coordinate for group in task.shared_scale for coordinate in group} <= set(task.layout)
    assert task.dt > 0
    assert walls_of(task).shape[1] == 4


def test_unknown_task_error_names_the_closest_and_lists_all():
    with pytest.raises(CdiffError) as caught:
        load_task("maze2d-umase")
    assert str(
        caught.value
    ) == 'no task "maze2d-umase" (did you mean "maze2d-umaze"?); choose from ' + ", ".join(TASKS)


# the mazes ----------------------------------------------------------------------------------------


@each_maze
def test_map_centres_and_time_step_equal_gymnasium_robotics(maze):
    env = maze.make_env()
    try:
        own = env.unwrapped
        theirs = tuple("".join(" #"[cell] for cell in row) for row in own.maze.maze_map)
        assert maze.rows == theirs
        for cell in maze.cells(" "):
            assert maze.centre(cell) == pytest.approx(
                own.maze.cell_rowcol_to_xy(np.array(cell)), abs=1e-12
            )
        assert own.point_env.dt == pytest.approx(maze.dt)
    finally:
        env.close()


@each_maze
def test_centre_and_cell_are_inverse(maze):
    cells = maze.cells(" ") + maze.cells("#")
    assert len(cells) == len(maze.rows) * len(maze.rows[0])
    assert [maze.cell(maze.centre(cell)) for cell in cells] == cells


def test_centres_of_the_umaze_by_hand():
    assert UMAZE.centre((1, 1)).tolist() == [-1.0, 1.0]
    assert UMAZE.centre((3, 3)).tolist() == [1.0, -1.0]
    assert LARGE.centre((4, 6)).tolist() == [0.5, 0.0]


@each_maze
def test_walls_are_unit_boxes_over_the_wall_cells(maze):
    box = maze.walls()
    assert len(box) == sum(row.count("#") for row in maze.rows)
    assert np.allclose(box[:, 2:] - box[:, :2], 1.0)
    assert box[:, :2].min(0).tolist() == [-len(maze.rows[0]) / 2, -len(maze.rows) / 2]


def test_is_free_by_hand():
    assert UMAZE.is_free(np.array([1.0, 0.0]))  # the gap at the right
    assert not UMAZE.is_free(np.array([0.0, 0.0]))  # the wall in the middle
    assert not UMAZE.is_free(np.array([9.0, 0.0]))  # outside
    assert UMAZE.is_free(np.array([0.59, 0.0]), 0.08)  # 0.09 m from the wall that ends at x = 0.5
    assert not UMAZE.is_free(np.array([0.59, 0.0]), BALL_RADIUS)


@each_maze
@settings(max_examples=30, deadline=None)
@given(x=st.floats(-7, 7), y=st.floats(-6, 6))
def test_point_is_free_if_its_cell_is(maze, x, y):
    row, col = maze.cell(np.array([x, y]))
    inside = 0 <= row < len(maze.rows) and 0 <= col < len(maze.rows[0])
    if maze.is_free(np.array([x, y])):
        assert inside
        assert maze.rows[row][col] == " "


def test_shortest_route_around_the_u_is_known():
    route = UMAZE.route(UMAZE.centre((3, 1)), UMAZE.centre((1, 1)))
    assert route == [(3, 1), (3, 2), (3, 3), (2, 3), (1, 3), (1, 2), (1, 1)]
    assert UMAZE.path_length(UMAZE.centre((3, 1)), UMAZE.centre((1, 1))) == pytest.approx(6.0)


def test_route_into_a_wall_is_refused():
    with pytest.raises(
        CdiffError, match=r"no route in maze2d-umaze: the point \(-2, 0\) lies in a wall"
    ):
        UMAZE.route(UMAZE.centre((3, 1)), np.array([-2.0, 0.0]))


def test_route_takes_the_cheaper_way():
    start, goal = LARGE.centre((1, 1)), LARGE.centre((3, 4))
    short = LARGE.route(start, goal)
    assert len(short) == 6
    blocked = short[2]
    assert blocked not in LARGE.route(start, goal, lambda cell: 100.0 if cell == blocked else 1.0)


@each_maze
@settings(max_examples=20, deadline=None)
@given(data=st.data())
def test_routes_step_between_free_neighbours_and_have_equal_length_both_ways(maze, data):
    free = st.sampled_from(maze.cells(" "))
    start, goal = (maze.centre(data.draw(free)) for _ in range(2))
    route = maze.route(start, goal)
    assert route[0] == maze.cell(start)
    assert route[-1] == maze.cell(goal)
    assert all(maze.rows[row][col] == " " for row, col in route)
    assert all(abs(a[0] - b[0]) + abs(a[1] - b[1]) == 1 for a, b in pairwise(route))
    assert len(maze.route(goal, start)) == len(route)
    assert maze.path_length(start, goal) >= np.linalg.norm(goal - start) - 1e-9


@each_maze
def test_random_points_are_clear_of_the_walls(maze):
    rng = np.random.default_rng(0)
    points = np.array([maze.random_point(rng) for _ in range(200)])
    assert (
        clearance(maze, points).min() >= 0.2 - 1e-9
    )  # cells reach 0.5 from their centre, points 0.3


@pytest.fixture(scope="module", params=MAZES, ids=lambda maze: maze.name)
def demonstrated(request):
    return request.param, list(request.param.demonstrate(3000, 1))


def test_demonstrations_have_the_requested_steps(demonstrated):
    maze, episodes = demonstrated
    assert [len(episode["actions"]) for episode in episodes] == [2000, 1000]
    assert [len(maze.observe(episode["observations"][0])) for episode in episodes] == [4, 4]
    assert [len(episode["observations"]) for episode in episodes] == [2001, 1001]


def test_demonstrations_never_touch_a_wall(demonstrated):
    maze, episodes = demonstrated
    for episode in episodes:
        states = np.stack([maze.observe(obs) for obs in episode["observations"]])
        assert clearance(maze, states[:, :2]).min() > BALL_RADIUS


def test_demonstrated_forces_and_speeds_are_within_the_bounds_of_the_environment(demonstrated):
    maze, episodes = demonstrated
    for episode in episodes:
        assert np.abs(np.stack(episode["actions"])).max() <= 1.0
        states = np.stack([maze.observe(obs) for obs in episode["observations"]])
        assert (
            np.abs(states[:, 2:]).max() <= MAX_SPEED * 1.02
        )  # MuJoCo clips before it integrates the last force


def test_trips_start_and_end_at_rest(demonstrated):
    maze, episodes = demonstrated
    ends, misses = [], []
    for episode in episodes:
        states = np.stack([maze.observe(obs) for obs in episode["observations"]])
        goals = np.stack([obs["desired_goal"] for obs in episode["observations"]])
        last = (
            np.flatnonzero((np.diff(goals[1:], axis=0) != 0).any(1)) + 1
        )  # the next observation has another goal
        assert states[0, 2:].tolist() == [0.0, 0.0]
        ends += np.linalg.norm(states[last, 2:], axis=1).tolist()
        misses += np.linalg.norm(goals[last] - states[last, :2], axis=1).tolist()
    assert len(ends) >= 3
    assert max(misses) < 0.08  # m, distance at which a trip has arrived
    assert np.median(ends) < 0.06 * MAX_SPEED  # limit of rest in Windows.favour_trips


def test_demonstrations_repeat_with_their_seed():
    first, again, other = (next(UMAZE.demonstrate(50, seed))["actions"] for seed in (3, 3, 4))
    assert np.array_equal(np.stack(first), np.stack(again))
    assert not np.array_equal(np.stack(first), np.stack(other))


def test_reset_places_ball_and_goal():
    env = UMAZE.make_env()
    state, goal = np.array([0.3, -1.1, 0.5, -0.25]), np.array([0.1, 0.9, 0.0, 0.0])
    obs = UMAZE.reset_to(env.unwrapped, state, goal, seed=0)
    env.close()
    assert UMAZE.observe(obs) == pytest.approx(state)
    assert obs["desired_goal"] == pytest.approx(goal[:2])


def test_tracking_force_is_a_clipped_pd_controller():
    force = UMAZE.track(np.zeros(4), np.array([0.01, -9.0, 0.1, 0.0]))
    assert force == pytest.approx([20 * 0.01 + 2 * 0.1, -1.0])


def test_d4rl_states_are_converted_to_the_coordinates_of_the_task():
    state = LARGE.from_d4rl(np.array([[0.949, 2.936, 0.5, -1.5]]))
    assert state[0] == pytest.approx([-2.364, 2.851, -1.5, -0.5])


# the gaussian -------------------------------------------------------------------------------------


def test_covariance_has_the_stated_axes():
    values, vectors = torch.linalg.eigh(GAUSSIAN2D.covariance())
    assert values.tolist() == pytest.approx([1.0, 2.25])
    assert abs(float(vectors[0, 1])) == pytest.approx(math.cos(math.pi / 6))


@settings(max_examples=30, deadline=None)
@given(x=st.floats(-5, 5), y=st.floats(-5, 5), i=st.integers(1, 49))
def test_denoiser_is_the_analytic_posterior_mean(x, y, i):
    schedule = Schedule.cosine(50)
    a, t = schedule.alpha_bar[i], schedule.t[i]
    noisy = torch.tensor([[[x, y]]], dtype=torch.float64)
    precision = torch.linalg.inv(GAUSSIAN2D.covariance() / GAUSSIAN2D.scale**2)
    # prior N(0, S), likelihood N(x_t; sqrt(a) x_0, (1 - a) I):
    # (S^-1 + a / (1 - a) I) mean = sqrt(a) / (1 - a) x_t
    posterior = torch.linalg.solve(
        precision + a / (1 - a) * torch.eye(2, dtype=torch.float64),
        math.sqrt(a) / (1 - a) * noisy[0, 0],
    )
    assert torch.allclose(GAUSSIAN2D.denoiser(schedule)(noisy, t)[0, 0], posterior, atol=1e-9)


def test_denoiser_leaves_a_clean_point_unchanged():
    x = torch.tensor([[[0.3, -1.2]]], dtype=torch.float64)
    assert torch.allclose(GAUSSIAN2D.denoiser(Schedule.cosine(10))(x, 0), x)


def test_exact_samples_have_the_covariance():
    samples = GAUSSIAN2D.truth(20_000, seed=0)
    assert np.cov(samples.T) == pytest.approx(
        GAUSSIAN2D.covariance().numpy(), abs=0.1
    )  # 4 standard errors of a variance of 2


def test_gaussian_is_neither_trained_nor_rolled_out():
    with pytest.raises(CdiffError, match="its score is exact"):
        demonstrations(GAUSSIAN2D, 10, 0)
    with pytest.raises(CdiffError, match="not an environment"):
        GAUSSIAN2D.make_env()
