"""`cdiff rollout` on the control tasks as typed, with the shipped checkpoints: what is on disk, what is refused, what diverges."""

import json
import shutil
from functools import partial
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
import yaml
from typer.testing import CliRunner

from cdiff_cli.cli import app
from cdiff_cli.commands import rollout
from cdiff_cli.commands.margins import read_calibrations
from cdiff_cli.commands.run_directory import read_rows
from cdiff_cli.models.checkpoint import (
    card_path,
    load_checkpoint,
    read_safetensors,
    save_checkpoint,
)
from cdiff_cli.models.denoiser import calls_a_step
from cdiff_cli.models.recipe import load_recipe
from cdiff_cli.paths import home
from cdiff_cli.planning.receding_horizon import rollout as act

ROOT = Path(__file__).parents[2]
BALL = ("rollout", "--task", "ball-run")
MAZE = ("rollout", "--task", "maze2d-umaze")
TIMES = ("latency_ms", "latency_p95", "overhead")


def cdiff(*words, code=0):
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == code, result.output + result.stderr + repr(result.exception)
    return result


def refused(*words, expected, tmp_path):
    """One line on stderr with these pieces, exit code 2, nothing written."""
    runs = tmp_path / "runs"
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    result = cdiff(*words, "--runs", runs, code=2)
    assert len(result.stderr.strip().splitlines()) == 1, result.stderr
    for piece in expected:
        assert piece in result.stderr
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def copied(folder, task="ball-run", spoil=False):
    """A copy of the shipped checkpoint, its margins left out; spoilt, with a weight that is not a number."""
    shipped, copy = home() / "models" / task / "small.safetensors", folder / "small.safetensors"
    if not spoil:
        shutil.copy(shipped, copy)
        shutil.copy(card_path(shipped), card_path(copy))
        return copy
    tensors, _ = read_safetensors(shipped, "")
    tensors["net.stem.weight"] = torch.full_like(tensors["net.stem.weight"], torch.nan)
    save_checkpoint(copy, tensors, load_checkpoint(shipped).card.model_dump(mode="json"))
    return copy


def without_times(path):
    return [
        {name: value for name, value in row.items() if name not in TIMES} for row in read_rows(path)
    ]


@pytest.fixture(scope="module")
def ball_run(tmp_path_factory):
    """Two episodes of `cdiff rollout --task ball-run --method alm`, with a video."""
    root = tmp_path_factory.mktemp("runs")
    result = cdiff(*BALL, "--method", "alm", "--episodes", 2, "--video", "gif", "--runs", root)
    (run,) = root.iterdir()
    return run, result.stdout


# a whole run ----------------------------------------------------------------------------------------------------------


def test_a_closed_loop_run_prints_its_table(ball_run):
    run, stdout = ball_run
    for word in (
        "ball-run",
        "alm",
        "recommended",
        "n = 2",
        "return",
        "violation rate / %",
        "latency / ms",
        "rollout.png",
    ):
        assert word in stdout
    assert str(run) in stdout
    assert "of 2 episodes safe at every step" in stdout


def test_a_closed_loop_run_holds_every_artifact(ball_run):
    run, _ = ball_run
    assert {path.name for path in run.iterdir()} == {
        "run.yaml",
        "rollout.npz",
        "rows.csv",
        "rollout.png",
        "rollout.gif",
    }
    with np.load(run / "rollout.npz", allow_pickle=False) as done:
        assert done["x"].shape == done["predicted"].shape == (2, 101, 4)
        assert done["u"].shape == (2, 100, 2)
        assert done["reward"].shape == (2, 100)
        assert list(done["layout"]) == ["x", "y", "vx", "vy"]
        assert list(done["seed"]) == [0, 1]
        for name in ("x", "y", "vx", "vy"):
            assert np.isfinite(done[f"obstacle.{name}"]).all()
        assert np.abs(done["u"]).max() <= 1
        rewards = done["reward"].sum(1)
    rows = read_rows(run / "rows.csv")
    np.testing.assert_allclose(
        [row["reward"] for row in rows], rewards, rtol=1e-12
    )  # the last digit of a float as text
    assert {(row["task"], row["method"], row["preset"], row["constraints"]) for row in rows} == {
        ("ball-run", "alm", "recommended", "ball-run")
    }
    config = yaml.safe_load((run / "run.yaml").read_text())
    assert config["preset"]["control"]["execute"] == 1
    assert config["command"][0] == "cdiff"
    assert len(config["checkpoint"]["weights_sha256"]) == 64


def test_a_closed_loop_run_is_filmed(ball_run):
    frames = iio.imread(ball_run[0] / "rollout.gif")
    assert len(frames) == 100  # one per step: 25 per second at 30 steps per second
    assert (frames[0] != frames[-1]).any()


def test_equal_seeds_give_equal_rows_but_for_times(ball_run, tmp_path):
    result = cdiff(*BALL, "--method", "alm", "--episodes", 2, "--json", "--runs", tmp_path)
    (run,) = tmp_path.iterdir()
    assert without_times(run / "rows.csv") == without_times(ball_run[0] / "rows.csv")
    said = json.loads(result.stdout)
    assert said["run"] == str(run)
    assert (said["summary"][0]["n"], said["summary"][0]["reward"]["n"]) == (2, 2)
    assert said["certificate"]["episodes"] == 2


def test_compare_prints_closed_loop_runs(ball_run):
    stdout = cdiff("compare", ball_run[0].parent, "--wide", "--format", "markdown").stdout
    for title in ("return", "violation rate / %", "contacts", "latency / ms"):
        assert title in stdout
    assert "| ball-run | ball-run | alm | recommended | 2 |" in stdout


def test_verify_says_that_a_closed_loop_run_has_no_certificate(ball_run):
    said = cdiff("verify", ball_run[0], code=2).stderr
    assert "a closed-loop run" in said
    assert "cdiff compare" in said
    assert len(said.splitlines()) == 1


def test_options_of_the_environment_are_part_of_what_was_asked(tmp_path):
    words = (
        "--method",
        "diffuser",
        "--episodes",
        1,
        "--env",
        "pattern=leader",
        "--env",
        "collide=false",
        "--execute",
        8,
    )
    cdiff(*BALL, *words, "--runs", tmp_path)
    (run,) = tmp_path.iterdir()
    (row,) = read_rows(run / "rows.csv")
    assert (row["constraints"], row["preset"]) == (
        "ball-run pattern=leader collide=false",
        "recommended*",
    )
    with np.load(run / "rollout.npz") as done:
        assert np.isfinite(done["violation"]).sum() == 13  # 100 steps, a plan each 8


@pytest.mark.parametrize("task", ["ball-run", "hopper", "swimmer"])
@pytest.mark.parametrize("method", ["guidance", "terminal", "final-projection", "best-of-k"])
def test_the_baselines_act_too(task, method, tmp_path, monkeypatch):
    """Four steps: that each acts, and makes the network calls it says."""
    monkeypatch.setattr(rollout, "rollout", partial(act, steps=4))
    words = (
        "--method",
        method,
        "--episodes",
        1,
        *(("--set", "k=3") if method == "best-of-k" else ()),
    )
    cdiff("rollout", "--task", task, *words, "--runs", tmp_path)
    (run,) = tmp_path.iterdir()
    (row,) = read_rows(run / "rows.csv")
    assert row["steps"] == 4
    a_step = calls_a_step(load_recipe(task).returns)  # of the other tasks 0
    assert row["calls"] == load_recipe(task).n_steps * a_step * (3 if method == "best-of-k" else 1)
    if method in ("terminal", "final-projection"):
        assert row["safe_plans"] == 1


# margins --------------------------------------------------------------------------------------------------------------


def test_calibration_writes_margins_beside_the_checkpoint_and_rollouts_use_them(tmp_path):
    checkpoint = copied(tmp_path)
    words = (*BALL, "--checkpoint", checkpoint, "--episodes", 3, "--execute", 8)
    stdout = cdiff(*words, "--calibrate", "--level", 0.75, "--runs", tmp_path / "runs").stdout
    assert "margins at level 0.75 from 3 episodes, pass " in stdout
    (found,) = read_calibrations(checkpoint)
    assert (found.stem, found.level, found.episodes, found.seed) == ("ball-run", 0.75, 3, 0)
    assert (found.method, found.preset.control.execute) == ("alm", 8)
    assert found.preset.methods["alm"]["rho"] == 10.0
    margin = found.margins["moving-ball"]
    assert margin.margin >= max(
        margin.largest, 0.0
    )  # in the last pass: the third of three covers three in four
    assert not (tmp_path / "runs").exists()
    stdout = cdiff(*words, "--runs", tmp_path / "runs").stdout
    assert "note:" not in stdout
    (run,) = (tmp_path / "runs").iterdir()
    config = yaml.safe_load((run / "run.yaml").read_text())
    assert config["margins"] == {"moving-ball": margin.margin}
    source = config["margins_from"]
    assert source["match"] == "exact"
    assert source["calibrated"]["preset"]["control"]["execute"] == 8


def test_a_rollout_says_where_its_margins_were_calibrated_on_something_else(tmp_path):
    checkpoint = copied(tmp_path)
    words = (*BALL, "--checkpoint", checkpoint, "--execute", 15)
    told = "note: no margin was calibrated on"
    assert told in cdiff(*words, "--episodes", 1, "--runs", tmp_path / "before").stdout
    cdiff(*words, "--episodes", 1, "--calibrate", "--level", 0.5)
    said = json.loads(
        cdiff(
            *words, "--episodes", 1, "--method", "projected", "--json", "--runs", tmp_path / "runs"
        ).stdout
    )
    (note,) = said["notes"]
    assert note.startswith(
        "note: the margins were calibrated with method alm (now projected), settings "
    )
    command = f"--task ball-run --method projected --checkpoint {checkpoint} --execute 15"
    assert f"cdiff rollout --calibrate --level 0.99 --episodes 100 --seed 5000 {command}`" in note
    (run,) = (tmp_path / "runs").iterdir()
    told = yaml.safe_load((run / "run.yaml").read_text())["margins_from"]
    assert (told["match"], told["unlike"]) == ("other", ["method", "settings"])


def test_what_ignores_the_constraints_needs_no_margin(tmp_path):
    assert (
        "note:"
        not in cdiff(
            *BALL, "--method", "diffuser", "--episodes", 1, "--execute", 15, "--runs", tmp_path
        ).stdout
    )


def test_calibration_as_json_names_its_file(tmp_path):
    checkpoint = copied(tmp_path)
    words = (
        "--method",
        "diffuser",
        "--episodes",
        1,
        "--execute",
        15,
        "--calibrate",
        "--level",
        0.5,
        "--json",
    )
    said = json.loads(cdiff(*BALL, "--checkpoint", checkpoint, *words).stdout)
    assert said["file"] == str(tmp_path / "small.margins.yaml")
    assert said["margins"]["moving-ball"]["margin"] >= max(
        said["margins"]["moving-ball"]["largest"], 0
    )


@pytest.mark.parametrize(("level", "need"), [(0.95, 19), (0.99, 99), (0.9, 9), (0.75, 3)])
def test_too_few_episodes_for_a_level_are_told_how_many_it_takes(level, need, tmp_path):
    checkpoint = copied(tmp_path)
    words = (
        *BALL,
        "--checkpoint",
        checkpoint,
        "--calibrate",
        "--level",
        level,
        "--episodes",
        need - 1,
    )
    refused(
        *words,
        expected=[f"{need - 1} episodes are too few", f"it takes {need} or more"],
        tmp_path=tmp_path,
    )


# what is refused ------------------------------------------------------------------------------------------------------

OBSERVED = """task: ball-run
constraints:
  - name: ball
    kind: dcbf
    alpha: 0.5
    barrier: {kind: quadratic, side: outside, centre: {x: obstacle.x, y: obstacle.z}, radius: 1.2}
"""
REFUSED = {
    "unknown option of the environment": (
        BALL,
        ["--env", "patern=leader"],
        ['no option "patern"', 'did you mean "pattern"'],
    ),
    "unknown value": (
        BALL,
        ["--env", "pattern=chasr"],
        ["--env pattern: expected one of oncoming", 'did you mean "chaser"'],
    ),
    "option without a value": (
        BALL,
        ["--env", "pattern"],
        ["expected name=value such as pattern=oncoming"],
    ),
    "option given twice": (
        BALL,
        ["--env", "collide=true", "--env", "collide=false"],
        ["--env collide: given twice"],
    ),
    "environment without options": (
        ("rollout", "--task", "hopper"),
        ["--env", "wind=1"],
        ["its options are: none"],
    ),
    "execute nothing": (
        BALL,
        ["--execute", 0],
        ["--execute: expected 1 to 15 steps of a plan of 16, found 0"],
    ),
    "execute beyond the plan": (BALL, ["--execute", 16], ["expected 1 to 15", "found 16"]),
    "warm by nothing": (BALL, ["--warm", 0], ["--warm: expected a share", "found 0"]),
    "warm beyond all": (BALL, ["--warm", 1.5], ["--warm: expected a share", "found 1.5"]),
    "negative noise": (
        BALL,
        ["--action-noise", -1],
        ["--action-noise: expected 0 or more, found -1"],
    ),
    "noise that is no number": (
        BALL,
        ["--action-noise", "nan"],
        ["--action-noise: expected 0 or more, found nan"],
    ),
    "negative margin": (
        BALL,
        ["--margin", -0.1],
        ["--margin: expected 0 or more, in the units of h, found -0.1"],
    ),
    "margin that is no number": (
        BALL,
        ["--margin", "nan"],
        ["--margin: expected 0 or more", "found nan"],
    ),
    "level of a run": (BALL, ["--level", 0.9], ["--level: belongs to --calibrate"]),
    "level that is no probability": (
        BALL,
        ["--calibrate", "--level", 1],
        ["--level: expected a share", "found 1"],
    ),
    "calibrate with a margin": (
        BALL,
        ["--calibrate", "--margin", 0.1],
        ["--margin: --calibrate acts without"],
    ),
    "calibrate with a video": (
        BALL,
        ["--calibrate", "--video", "gif"],
        ["--video: --calibrate writes margins"],
    ),
    "plan": (
        ("plan", "--task", "ball-run"),
        [],
        ["plans anew at every step", "`cdiff rollout --task ball-run`"],
    ),
    "plan a walk": (
        ("plan", "--task", "hopper"),
        [],
        ["plans anew at every step", "`cdiff rollout --task hopper`"],
    ),
    "random": (
        BALL,
        ["--random"],
        ["--random is for whole plans, and ball-run plans anew at every step"],
    ),
    "start": (BALL, ["--start", "0,0"], ["--start is for whole plans"]),
    "goal of a walk": (
        ("rollout", "--task", "hopper"),
        ["--goal", "1,0"],
        ["--goal is for whole plans, and hopper"],
    ),
    "dynamics": (BALL, ["--no-dynamics"], ["--no-dynamics is for whole plans"]),
    "calibrate a maze": (
        MAZE,
        ["--calibrate"],
        ["--calibrate is for control tasks, and maze2d-umaze is planned once"],
    ),
    "environment of a maze": (MAZE, ["--env", "pattern=leader"], ["--env is for control tasks"]),
    "execute in a maze": (MAZE, ["--execute", 2], ["--execute is for control tasks"]),
    "warm in a maze": (MAZE, ["--warm", 0.3], ["--warm is for control tasks"]),
    "margin in a maze": (MAZE, ["--margin", 0.1], ["--margin is for control tasks"]),
    "noise in a maze": (MAZE, ["--action-noise", 0.1], ["--action-noise is for control tasks"]),
    "constraints of another task": (
        BALL,
        ["--constraints", ROOT / "constraints/hopper.yaml"],
        [":3 task", "change one of them"],
    ),
    "checkpoint of another task": (
        BALL,
        ["--checkpoint", home() / "models/hopper/small.safetensors"],
        ["a checkpoint of hopper, asked for was ball-run"],
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_acted_on_gets_one_line_exit_2_and_writes_nothing(case, tmp_path):
    command, words, expected = REFUSED[case]
    refused(*command, *words, expected=expected, tmp_path=tmp_path)


def test_an_unknown_observed_quantity_is_met_with_those_there_are(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(OBSERVED)
    expected = [
        f"{file}:6 ",
        'found "obstacle.z"',
        "ball-run offers obstacle.x, obstacle.y, obstacle.vx, obstacle.vy",
    ]
    refused(*BALL, "--constraints", file, expected=expected, tmp_path=tmp_path)


def test_without_a_planner_trained_for_the_constraints_conditional_says_how_to_get_one(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(OBSERVED.replace("obstacle.z", "obstacle.y"))
    expected = [
        "no conditional planner for these constraints",
        f"`cdiff train --task ball-run --conditional {file}`",
    ]
    refused(
        *BALL,
        "--method",
        "conditional",
        "--constraints",
        file,
        expected=expected,
        tmp_path=tmp_path,
    )


def dataset(path, **columns):
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[name] = values
    return path


def test_a_dataset_of_another_layout_is_refused_before_training(tmp_path):
    source = dataset(
        tmp_path / "other.hdf5", observations=np.zeros((40, 4)), actions=np.zeros((40, 3))
    )
    expected = [
        "other.hdf5: observations of shape (40, 4), but hopper has 11 coordinates (height",
        "choose a dataset of this",
    ]
    refused("train", "--task", "hopper", "--dataset", source, expected=expected, tmp_path=tmp_path)


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({}, ["it needs actions and timeouts"]),
        (
            {"actions": np.zeros((40, 2))},
            ["actions of shape (40, 2), but hopper has 3 inputs (thigh"],
        ),
        ({"actions": np.full((40, 3), np.nan)}, ["actions hold NaN or inf"]),
    ],
    ids=["none", "too few", "nan"],
)
def test_a_dataset_without_usable_inputs_is_refused_before_training(columns, expected, tmp_path):
    source = dataset(tmp_path / "mine.hdf5", observations=np.zeros((40, 11)), **columns)
    refused("train", "--task", "hopper", "--dataset", source, expected=expected, tmp_path=tmp_path)


# check ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("ball-run", ["moving-ball", "obstacle.x", "observed only while acting"]),
        (
            "hopper",
            [
                "thigh-up",
                "thigh-down",
                "thigh_velocity",
                "[rad/s]",
                "exact",
                "no place in the plane",
            ],
        ),
        ("swimmer", ["rotor2-up", "rotor2_velocity", "[rad/s]", "no place in the plane"]),
    ],
)
def test_check_says_what_a_constraint_means_where_no_picture_can(name, words, tmp_path):
    picture = tmp_path / "c.png"
    stdout = cdiff("check", ROOT / "constraints" / f"{name}.yaml", "--picture", picture).stdout
    for word in words:
        assert word in stdout
    assert not picture.exists()


def test_check_draws_what_stands_still_beside_what_moves(tmp_path):
    file, picture = tmp_path / "both.yaml", tmp_path / "c.png"
    file.write_text(
        OBSERVED.replace("obstacle.z", "obstacle.y")
        + "  - {name: lane, kind: linear, a: {y: 1.0}, b: 2.0}\n"
    )
    assert f"picture  {picture}" in cdiff("check", file, "--picture", picture).stdout
    assert picture.stat().st_size > 5_000


# what diverges --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("ball-run", ["--method", "alm", "--video", "gif"]),
        ("ball-run", ["--json"]),
        ("hopper", ["--method", "projected"]),
    ],
    ids=str,
)
def test_a_plan_that_is_not_finite_is_told_exits_1_and_the_run_is_kept(task, words, tmp_path):
    checkpoint, runs = copied(tmp_path, task, spoil=True), tmp_path / "runs"
    result = cdiff(
        "rollout",
        "--task",
        task,
        "--checkpoint",
        checkpoint,
        "--n",
        2,
        *words,
        "--runs",
        runs,
        code=1,
    )
    assert "warning: 2 of 2 episodes diverged" in result.stderr
    (run,) = runs.iterdir()
    rows = read_rows(run / "rows.csv")
    assert [(row["diverged"], row["safe_executed"], row["steps"]) for row in rows] == [
        (1.0, 0.0, 0.0)
    ] * 2
    with np.load(run / "rollout.npz") as done:
        assert done["diverged"].all()
        assert np.isfinite(done["x"][:, 0]).all()
    if "--json" in words:
        assert (
            json.loads(result.stdout, parse_constant=pytest.fail)["certificate"]["safe_executed"]
            == 0
        )
    else:
        assert "0 of 2 episodes safe at every step" in result.stdout
    for style in ("rich", "json"):
        cdiff("compare", runs, "--intervals", "--format", style)


def test_no_margins_are_written_of_episodes_that_diverged(tmp_path):
    checkpoint = copied(tmp_path, spoil=True)
    words = ("--checkpoint", checkpoint, "--calibrate", "--level", 0.5, "--n", 2)
    refused(
        *BALL,
        *words,
        expected=["2 of 2 episodes diverged", "nothing was written"],
        tmp_path=tmp_path,
    )
