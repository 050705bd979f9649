"""Pictures: what part of the plane they show, what their axes say, what they leave alone."""

import subprocess
import sys
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest

from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint, stack
from cdiff_cli.evaluation.figures import episodes, plans, style
from tests.problems import ball, num, vec, waypoints

BOXES = np.array([[0.0, 0.0, 1.0, 1.0], [9.0, 10.0, 10.0, 10.5]])
DISC = waypoints(ball("outside", centre=(0.0, 0.0), radius=5.0), "disc")


def task(walls=BOXES[:0], units=("m", "m")):
    return SimpleNamespace(
        layout=("x", "y"),
        positions=("x", "y"),
        units=units,
        dt=0.1,
        walls=lambda: walls,
        footprint=0.0,
        is_free=lambda *_: True,
    )


def test_axis_labels_name_the_unit_if_there_is_one():
    assert style.position_labels(task(units=("km", ""))) == ["x / km", "y"]


def test_walls_set_the_extent_whatever_the_plans():
    x = np.full((1, 2, 2), 50.0)
    assert plans._extent(task(BOXES), DISC, [x]) == (0.0, 10.0, 0.0, 10.5)


def test_without_walls_every_plan_is_inside_the_extent():
    x = np.array([[[-100.0, 3.0], [300.0, 5.0], [np.nan, np.nan]]])
    x0, x1, y0, y1 = plans._extent(task(), DISC, [x, x[:, :1]])
    assert (x0, x1) == pytest.approx((-120.0, 320.0))  # a tenth wider than 400
    assert (y0, y1) == pytest.approx((-106.0, 114.0))  # half as high as wide


def test_extent_of_a_single_point_is_not_empty():
    assert plans._extent(task(), DISC, [np.ones((1, 1, 2))]) == pytest.approx((-0.1, 2.1) * 2)


def test_without_plans_the_extent_shows_the_boundary_of_every_set():
    beyond = waypoints(HalfSpace(vec(1.0, 0.0), num(10.0)), "x <= 10")
    none = [np.empty((0, 2, 2))]
    assert plans._extent(task(), DISC, none) == (-4.0, 4.0, -4.0, 4.0)  # corners are 5.7 away
    assert plans._extent(task(), stack([DISC, beyond]), none) == (-16.0, 16.0, -16.0, 16.0)
    assert plans._extent(task(), Constraint(()), none) == (-2.0, 2.0, -2.0, 2.0)


def test_observed_quantities_are_a_point_only_as_a_pair_of_positions():
    observed = {"ball.x": np.zeros((1, 2)), "ball.y": np.ones((1, 2)), "limit": np.ones((1, 2))}
    (point,) = episodes._observed_points(task(), SimpleNamespace(observed=observed))
    assert [coordinate.tolist() for coordinate in point] == [[[0.0, 0.0]], [[1.0, 1.0]]]


def test_a_rollout_video_shows_every_second_step(tmp_path):
    executed = np.linspace((-6.0, -6.0), (6.0, 7.0), 9)[None]
    plans.rollout_video(tmp_path / "a.gif", task(), DISC, executed, executed)
    frames = iio.imread(tmp_path / "a.gif")
    assert len(frames) == 5
    assert frames.shape[1] % 2 == frames.shape[2] % 2 == 0


def test_drawing_changes_no_setting_of_matplotlib(tmp_path):
    code = f"""
import pathlib, matplotlib, numpy as np
matplotlib.use("svg")
before = dict(matplotlib.rcParams)
from cdiff_cli.evaluation.figures import episodes, plans
path = pathlib.Path({str(tmp_path / "a.png")!r})
plans.convergence_picture(path, {{"a": np.ones((3, 2, 1))}})
assert dict(matplotlib.rcParams) == before
from matplotlib import pyplot
assert pyplot.get_backend() == "svg" and pyplot.get_fignums() == []
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "a.png").exists()
