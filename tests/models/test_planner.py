"""Planners as values: what they derive, and those of the shipped checkpoints."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from cdiff_cli.models.checkpoint import load_checkpoint
from cdiff_cli.models.denoiser import guided
from cdiff_cli.models.normaliser import Normaliser, ResidualNormaliser
from cdiff_cli.models.planner import Planner
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.paths import home
from cdiff_cli.tasks import load_task
from tests.problems import normal

PLANNER = Planner(
    denoiser=lambda x, _: 0.9 * x,
    schedule=Schedule.cosine(20),
    normaliser=Normaliser.identity(4),
    horizon=8,
    coordinates=("x", "y", "vx", "vy"),
    positions=("y", "x"),
)


def shipped(task, weight=0.0, name="small"):
    """The checkpoint and its planner."""
    loaded = load_task(task)
    checkpoint = load_checkpoint(home() / "models" / task / f"{name}.safetensors", task)
    coordinates, positions = loaded.layout, loaded.positions
    return checkpoint, Planner.from_checkpoint(
        checkpoint, coordinates, loaded.dt, positions, weight
    )


def test_a_planner_counts_its_coordinates_and_finds_its_positions():
    assert PLANNER.dim == 4
    assert PLANNER.position_columns == [1, 0]
    assert replace(PLANNER, positions=()).position_columns == [0, 1, 2, 3]


def test_respacing_changes_the_schedule_alone():
    assert PLANNER.respaced(None) is PLANNER
    fewer = PLANNER.respaced(5)
    assert fewer.schedule == Schedule.cosine(20).respaced(5)
    assert replace(fewer, schedule=PLANNER.schedule) == PLANNER
    assert PLANNER.respaced(20).schedule == PLANNER.schedule


def test_the_planner_of_a_maze_is_its_checkpoint():
    checkpoint, planner = shipped("maze2d-umaze")
    x = normal(0, 2, 128, 4).float()
    assert torch.equal(planner.denoiser(x, 5), guided(checkpoint.net, 0.0, 1.0)(x, 5))
    assert planner.schedule == Schedule.cosine(64)
    assert planner.normaliser is checkpoint.normaliser
    assert planner.dynamics is checkpoint.dynamics is not None
    assert (planner.horizon, planner.dim, planner.calls_per_step) == (128, 4, 1)
    assert planner.inverse_dynamics is None
    assert planner.conditioned_denoiser is None
    assert planner.device == torch.device("cpu")


def test_the_planner_of_a_control_task_has_relative_windows_and_inverse_dynamics():
    checkpoint, planner = shipped("ball-run")
    assert isinstance(planner.normaliser, ResidualNormaliser)
    assert planner.normaliser is checkpoint.frame
    present, following = (normal(seed, 3, 4, scale=0.1).numpy() for seed in (0, 1))
    u = planner.inverse_dynamics(present, following)
    assert (u.shape, u.dtype) == ((3, 2), np.float64)
    states = (torch.from_numpy(x).float() for x in (present, following))
    np.testing.assert_array_equal(u, checkpoint.inverse(*states).double().numpy())


@pytest.mark.parametrize(("weight", "calls"), [(0.0, 1), (1.0, 1), (2.0, 2)])
def test_the_guidance_weight_is_that_of_the_denoiser_and_counts_its_calls(weight, calls):
    checkpoint, planner = shipped("swimmer", weight)
    x = normal(0, 2, planner.horizon, planner.dim).float()
    wanted = guided(checkpoint.net, weight, checkpoint.limit)(x, 3)
    assert torch.equal(planner.denoiser(x, 3), wanted)
    assert planner.calls_per_step == calls


def test_a_planner_conditioned_on_observations_encodes_them_from_the_present_states():
    checkpoint, planner = shipped("ball-run", 2.0, "conditional-ball-run")
    x, present = normal(0, 2, 16, 4).float(), normal(1, 2, 4)
    values = [normal(seed, 2) for seed in range(4)]
    observed = dict(zip(checkpoint.card.observed, values, strict=True))
    told = checkpoint.telling(values, present)
    wanted = guided(checkpoint.net, 2.0, checkpoint.limit, told)(x, 3)
    shuffled = dict(reversed(observed.items()))
    assert torch.equal(planner.conditioned_denoiser(shuffled, present)(x, 3), wanted)
    moved = observed | {checkpoint.card.observed[0]: values[0] + 1}
    assert not torch.equal(planner.conditioned_denoiser(moved, present)(x, 3), wanted)
