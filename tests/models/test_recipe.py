"""Presets of a recipe: kernel and steps, their checks, and their effect on a command."""

from dataclasses import replace
from typing import get_args

import pytest

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.errors import CdiffError
from cdiff_cli.models.preset import SamplerSettings
from cdiff_cli.models.recipe import Recipe, load_recipe
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.paths import home
from cdiff_cli.planning.open_loop import plan
from cdiff_cli.sampling import KERNELS
from cdiff_cli.yaml_files import load

PRESETS = "presets:\n  fast:\n    sampler: {kernel: dpm++2m, steps: 6, polish: true}\n"


def recipe(path, presets, n_steps=64):
    """The recipe of the U-maze with these presets, read from a file."""
    text = (home() / "models" / "maze2d-umaze" / "recipe.yaml").read_text()
    path /= "recipe.yaml"
    path.write_text(
        text[: text.index("presets:")].replace("n_steps: 64", f"n_steps: {n_steps}") + presets
    )
    return load(path, Recipe)


@pytest.fixture
def fast(tmp_path, monkeypatch):
    read = recipe(tmp_path, PRESETS)
    monkeypatch.setattr("cdiff_cli.commands.resolve.load_recipe", lambda _: read)


def test_a_preset_may_name_every_kernel():
    assert set(get_args(SamplerSettings.model_fields["kernel"].annotation)) == set(KERNELS)


@pytest.mark.usefixtures("fast")
def test_preset_with_steps_plans_in_that_many_calls():
    resolved = resolve(Request(preset="fast", n=1))
    sampler = resolved.preset.sampler
    assert (sampler.kernel, resolved.problem.planner.schedule) == (
        "dpm++2m",
        Schedule.cosine(64).respaced(6),
    )
    assert resolved.row()["preset"] == "fast"
    plans = plan(resolved.problem, resolved.method, [0], sampler)
    assert plans.calls == 6
    assert float((plans.x[..., 0] - plans.x[..., 1]).max()) <= 1.82


@pytest.mark.usefixtures("fast")
def test_steps_option_overrides_the_preset():
    resolved = resolve(Request(preset="fast", steps=9))
    assert resolved.problem.planner.schedule == Schedule.cosine(64).respaced(9)
    assert resolved.row()["preset"] == "fast*"


def test_a_preset_without_steps_takes_all_as_trained():
    assert resolve(Request()).problem.planner.schedule == Schedule.cosine(64)


def test_preset_with_more_steps_than_trained_is_refused(tmp_path, monkeypatch):
    longer = recipe(
        tmp_path, PRESETS.replace("6", "100"), n_steps=128
    )  # the shipped checkpoint has 64
    monkeypatch.setattr("cdiff_cli.commands.resolve.load_recipe", lambda _: longer)
    with pytest.raises(
        CdiffError, match=r'^preset "fast", steps: expected 1 to 64 \(as trained\), found 100$'
    ):
        resolve(Request(preset="fast"))


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        (
            ("dpm++2m", "dpm2m"),
            "presets.fast.sampler.kernel: "
            "expected 'ddpm', 'ddim', 'dpm++2m' or 'langevin', found 'dpm2m'",
        ),
        (("6", "0"), "presets.fast.sampler.steps: expected greater than or equal to 1, found 0"),
        (("6", "-3"), "presets.fast.sampler.steps: expected greater than or equal to 1, found -3"),
        (
            ("6", "2.5"),
            "presets.fast.sampler.steps: "
            "expected a valid integer, got a number with a fractional part, found 2.5",
        ),
        (
            ("6", "many"),
            "presets.fast.sampler.steps: "
            "expected a valid integer, unable to parse string as an integer, found 'many'",
        ),
        (("6", "65"), "presets.fast.sampler.steps: expected 1 to 64 (n_steps), found 65"),
    ],
)
def test_bad_kernel_or_steps_in_a_preset_is_refused_in_one_line(wrong, complaint, tmp_path):
    with pytest.raises(CdiffError) as error:
        recipe(tmp_path, PRESETS.replace(*wrong))
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)


def test_what_a_preset_says_of_control_is_used_and_options_win_over_it(monkeypatch):
    shipped = load_recipe("ball-run")
    said = {"control.action_noise": 0.1, "control.env": ["pattern=leader"], "control.execute": 2}
    noisy = shipped.model_copy(
        update={"presets": {"noisy": shipped.presets["recommended"].updated(said)}}
    )
    monkeypatch.setattr("cdiff_cli.commands.resolve.load_recipe", lambda _: noisy)
    asked = Request(task="ball-run", preset="noisy")
    one = resolve(asked)
    control = one.preset.control
    assert (control.action_noise, control.env, control.execute) == (0.1, ("pattern=leader",), 2)
    assert not one.changed
    other = resolve(replace(asked, action_noise=0.2, env=("pattern=chaser",), execute=1))
    control = other.preset.control
    assert (control.action_noise, control.env, control.execute) == (0.2, ("pattern=chaser",), 1)
    assert other.changed
