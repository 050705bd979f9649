"""Which task has which ability."""

import numpy as np
import pytest

from cdiff_cli.tasks import TASKS, load_task
from cdiff_cli.tasks.protocol import (
    Brakes,
    ControlTask,
    Demonstrates,
    DrawsObservations,
    HasEnvOptions,
    HasExactScore,
    HasMap,
    HasRoutes,
    Observes,
    ReadsD4RL,
    Task,
    Tracks,
    observable_of,
    observed_in,
    walls_of,
)

MAZE = {Demonstrates, ReadsD4RL, Tracks, HasMap, HasRoutes}
BALL = {Demonstrates, ReadsD4RL, Observes, DrawsObservations, Brakes, HasEnvOptions}
EXPECTED = {
    "maze2d-umaze": ("open_loop", MAZE),
    "maze2d-large": ("open_loop", MAZE),
    "ball-run": ("receding_horizon", BALL),
    "hopper": ("receding_horizon", {Demonstrates}),
    "swimmer": ("receding_horizon", {Demonstrates}),
    "gaussian2d": ("open_loop", {HasExactScore}),
}
ABILITIES = MAZE | BALL | {HasExactScore}


@pytest.mark.parametrize("name", TASKS)
def test_shipped_task_has_exactly_its_abilities(name):
    task = load_task(name)
    control, abilities = EXPECTED[name]
    assert isinstance(task, Task)
    assert task.control == control
    assert isinstance(task, ControlTask) == (control == "receding_horizon")
    assert {ability for ability in ABILITIES if isinstance(task, ability)} == abilities


@pytest.mark.parametrize("ability", sorted(ABILITIES, key=lambda ability: ability.__name__))
def test_ability_has_one_to_three_members(ability):
    members = {name for name in vars(ability) if not name.startswith("_")}
    assert 1 <= len(members) <= 3


def test_missing_ability_gives_the_neutral_answer():
    hopper = load_task("hopper")
    assert walls_of(hopper).shape == (0, 4)
    assert observable_of(hopper) == ()
    assert observed_in(hopper, env=None) == {}
    assert len(walls_of(load_task("maze2d-umaze"))) == 18
    assert observable_of(load_task("ball-run"))[0] == "obstacle.x"


def test_relative_quantities_name_a_coordinate_of_the_state():
    task = load_task("ball-run")
    assert dict(task.relative_to) == {
        "obstacle.x": "x",
        "obstacle.y": "y",
        "obstacle.vx": "vx",
        "obstacle.vy": "vy",
    }
    drawn = task.observed_along(np.zeros((3, 4)), np.random.default_rng(0))
    assert set(task.relative_to) <= set(drawn)
    assert set(task.relative_to.values()) <= set(task.layout)
