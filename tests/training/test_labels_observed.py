"""Planners conditioned on constraints with observed quantities: simulation, labels, training."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from gymnasium.utils import seeding
from typer.testing import CliRunner

from cdiff_cli.cli import app
from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.commands.run_directory import read_rows
from cdiff_cli.errors import CdiffError
from cdiff_cli.models.checkpoint import load_checkpoint
from cdiff_cli.models.denoiser import ObservationEncoder, guided
from cdiff_cli.models.recipe import load_recipe
from cdiff_cli.planning.receding_horizon import rollout
from cdiff_cli.tasks.ball_run.env import DT, BallRunEnv
from cdiff_cli.tasks.ball_run.obstacles import PATTERNS, beside
from cdiff_cli.tasks.ball_run.task import BALL_RUN
from cdiff_cli.training.demonstrations import demonstrations
from cdiff_cli.training.labels import ConstraintLabel
from cdiff_cli.training.windows import SampledObservations, TrainingSet
from tests.problems import generator

ROOT = Path(__file__).parents[2]
FILE = ROOT / "constraints" / "ball-run.yaml"


@pytest.fixture(scope="module")
def condition():
    return ConstraintLabel.read(FILE, BALL_RUN)


@pytest.fixture(scope="module", autouse=True)
def own_minari(tmp_path_factory):
    """A Minari folder for this file, so that the user's datasets do not change."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        yield


def straight(speed=3.0, horizon=16):
    """A window along x from the origin."""
    x = torch.zeros(1, horizon, 4)
    x[0, :, 0], x[0, :, 2] = speed * DT * torch.arange(horizon), speed
    return x


def seen(*values):
    return {
        name: torch.tensor([value], dtype=torch.float64)
        for name, value in zip(BALL_RUN.observable, values, strict=True)
    }


# simulated observations ---------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", PATTERNS)
def test_simulated_observations_equal_those_of_the_environment_with_a_ghost(pattern):
    env = BallRunEnv(pattern, collide=False)
    obs, _ = env.reset(seed=5)
    run, there, rng = (
        [BALL_RUN.observe(obs)],
        [list(BALL_RUN.observed(env).values())],
        np.random.default_rng(0),
    )
    for _ in range(100):
        run.append(BALL_RUN.observe(env.step(rng.uniform((0.0, -1.0), 1.0))[0]))
        there.append(list(BALL_RUN.observed(env).values()))
    env.close()
    drawn, _ = seeding.np_random(5)
    (
        drawn.integers(len(PATTERNS)),
        drawn.uniform(-0.01, 0.01, 2),
    )  # draws of a reset before the pattern
    np.testing.assert_allclose(
        beside(PATTERNS[pattern](drawn), np.array(run)[:, :2], DT), there, atol=1e-9
    )  # rounding, summed


def test_simulated_observations_include_patterns_from_behind_and_ahead():
    run, rng = np.zeros((3, 4)), np.random.default_rng(0)
    begun = {
        tuple(np.sign(values[0]) for values in BALL_RUN.observed_along(run, rng).values())
        for _ in range(60)
    }
    assert any(signs[0] < 0 < signs[2] for signs in begun)  # from behind, faster: the chaser
    assert any(signs[2] < 0 < signs[0] for signs in begun)  # from ahead towards the ball


# labels -------------------------------------------------------------------------------------------


def test_condition_lists_the_observed_quantities_of_its_constraints(condition):
    assert condition.observed == BALL_RUN.observable
    assert condition.entries == 6


def test_window_is_labelled_by_the_constraint_bound_to_its_obstacle(condition):
    """The window runs straight at 3 m/s towards a ball at rest at distance D.

    psi_k = D - 0.1 k - 1.2 - 0.2 * 3 and g_k = psi_k / 2 - psi_{k+1}. The largest g is the last
    one, 0.1 - psi_14 / 2.
    """
    for distance, label in (
        (3.0, (-1.0, 0.2)),
        (3.3, (-1.0, 0.05)),
        (3.6, (1.0, 0.0)),
        (50.0, (1.0, 0.0)),
    ):
        found = condition.label(straight(), seen(distance, 0.0, 0.0, 0.0), DT)
        torch.testing.assert_close(found, torch.tensor([label]), atol=1e-5, rtol=0)  # float32


def test_label_extrapolates_the_obstacle_at_its_observed_velocity(condition):
    assert condition.label(straight(), seen(3.0, 0.0, 3.0, 0.0), DT).tolist() == [
        [1.0, 0.0]
    ]  # at equal speed the distance stays
    assert condition.label(straight(), seen(5.0, 0.0, -3.0, 0.0), DT)[0, 0] == -1.0


def test_network_gets_quantities_relative_to_the_coordinate_they_are_mapped_to():
    names, layout = ("obstacle.x", "obstacle.vy", "wind"), ("x", "y", "vx", "vy")
    telling = ObservationEncoder(
        torch.tensor([0, 3, -1]), torch.zeros(3), torch.tensor([2.0, 1.0, 1.0])
    )
    told = telling(
        [torch.tensor([5.0]), torch.tensor([1.0]), torch.tensor([7.0])],
        torch.tensor([[1.0, 0.0, 0.0, 0.25]]),
    )
    assert told.tolist() == [[2.0, 0.75, 7.0]]
    values, states = (
        torch.randn(3, 500, generator=generator(0)).double(),
        torch.randn(500, 4, generator=generator(1)).double(),
    )
    fitted = ObservationEncoder.fit(
        names, layout, {"obstacle.x": "x", "obstacle.vy": "vy"}, list(values), states
    )
    assert fitted.columns.tolist() == [0, 3, -1]
    told = fitted(list(values), states)
    torch.testing.assert_close(told.mean(0), torch.zeros(3), atol=1e-5, rtol=0)  # float32
    torch.testing.assert_close(told.std(0), torch.ones(3), atol=1e-5, rtol=0)


@pytest.fixture(scope="module")
def drawn(condition):
    """Labels and observations of 4000 windows of a few demonstrations."""
    episodes, recipe = demonstrations(BALL_RUN, 2000, 0), load_recipe("ball-run")
    data = TrainingSet.from_episodes(
        BALL_RUN, recipe, recipe.train["conditional"], episodes, condition, 0
    )
    return data.draw(4000, generator(0))[1]


def test_label_and_observation_are_dropped_together(drawn):
    told = drawn[:, 0] != 0
    assert float(told.float().mean()) == pytest.approx(0.75, abs=0.03)  # four standard errors
    assert not drawn[~told].any()
    assert drawn[told][:, 2:].any(1).all()


def test_both_labels_are_frequent(drawn):
    """31.7 % of the windows of all demonstrations violate; these are 19 runs with 8 obstacles."""
    told = drawn[drawn[:, 0] != 0]
    assert 0.15 < float((told[:, 0] < 0).float().mean()) < 0.5


def test_task_without_simulated_observations_is_refused_in_one_line(condition):
    task = SimpleNamespace(name="drone", layout=BALL_RUN.layout)
    with pytest.raises(
        CdiffError,
        match=r"^drone: the constraints observe obstacle\.x, .* demonstrations do not hold.*$",
    ):
        SampledObservations.from_task(task, [np.zeros((20, 4))], condition.observed, 0)


class _Told(torch.nn.Module):
    """An estimate equal to the third entry of the label."""

    def forward(self, x, t, condition):
        return torch.zeros_like(x) + condition[:, 2, None, None]


def test_observation_is_an_input_of_the_conditional_estimate_alone():
    told = torch.tensor([[0.25], [0.5]])
    for weight in (1.0, 2.0):
        out = guided(_Told(), weight, 1.0, told)(torch.zeros(2, 3, 4), 5)
        torch.testing.assert_close(out[:, 0, 0], weight * told[:, 0])


# training and acting ------------------------------------------------------------------------------

TINY = {
    "network": {"kind": "mlp", "width": 16, "depth": 1},
    "steps": 3,
    "batch": 8,
    "smoothness": 0,
    "bf16": False,
}


def cdiff(*words):
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output + result.stderr + repr(result.exception)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A home with a plain and a conditional planner of the ball run, trained by commands."""
    root = tmp_path_factory.mktemp("home")
    (root / "models" / "ball-run").mkdir(parents=True)
    (root / "constraints").mkdir()
    (root / "constraints" / FILE.name).write_text(FILE.read_text())
    recipe = load_recipe("ball-run").model_dump(mode="json")
    labelled = TINY | {"network": TINY["network"] | {"conditions": 6}, "begin": "small"}
    recipe["train"] = {
        "small": TINY | {"inverse": {"width": 8, "steps": 2}},
        "conditional": labelled,
    }
    recipe["demonstrations"] = {"steps": 660, "seed": 0}
    (root / "models" / "ball-run" / "recipe.yaml").write_text(yaml.safe_dump(recipe))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        cdiff("train", "--task", "ball-run")
        cdiff("train", "--task", "ball-run", "--conditional", "constraints/ball-run.yaml")
        yield root


def test_conditional_planner_is_trained_and_acts_from_the_command_line(place, tmp_path):
    made = load_checkpoint(
        place / "models" / "ball-run" / "conditional-ball-run.safetensors", "ball-run"
    )
    assert made.card.observed == BALL_RUN.observable
    assert made.card.network.conditions == 6
    assert made.telling.columns.tolist() == [0, 1, 2, 3]
    cdiff(
        "rollout",
        "--task",
        "ball-run",
        "--method",
        "conditional",
        "--preset",
        "paper",
        "--episodes",
        1,
        "--runs",
        tmp_path,
    )
    (run,) = tmp_path.iterdir()
    (row,) = read_rows(run / "rows.csv")
    assert (row["method"], row["calls"], row["steps"]) == ("conditional", 40.0, 100.0)


@pytest.mark.usefixtures("place")
def test_every_plan_gets_the_observation_of_its_own_step():
    acting, told = (
        controller(resolve(Request(task="ball-run", method="conditional", preset="paper", n=2))),
        [],
    )

    def spy(observed, present):
        told.append((present.clone(), torch.stack(tuple(observed.values()), 1)))
        return acting.planner.conditioned_denoiser(observed, present)

    spied = replace(acting, planner=replace(acting.planner, conditioned_denoiser=spy))
    done = rollout(spied, BALL_RUN, [0, 1], steps=3)
    assert len(told) == 3
    for step, (present, observed) in enumerate(told):
        np.testing.assert_array_equal(present.numpy(), done.x[:, step])
        np.testing.assert_array_equal(
            observed.numpy(),
            np.stack([done.observed[name][:, step] for name in BALL_RUN.observable], 1),
        )
