"""`cdiff rerun`: equal arrays, notes of what changed, refusals."""

import shutil

import numpy as np
import pytest
import yaml

from cdiff_cli.commands.rerun import changes
from cdiff_cli.paths import home
from tests.commands.test_cli import cdiff


def only(folder):
    (run,) = folder.iterdir()
    return run


def edit(run, change):
    """Change a parsed run.yaml in place."""
    record = yaml.safe_load((run / "run.yaml").read_text())
    change(record)
    (run / "run.yaml").write_text(yaml.safe_dump(record, sort_keys=False))


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """A plan of two seeds with options of several types, on a constraint file of its own."""
    root = tmp_path_factory.mktemp("planned")
    file = root / "mine.yaml"
    shutil.copy(home() / "constraints" / "maze2d-umaze-slalom.yaml", file)
    words = ("--method", "projected", "--steps", 6, "--set", "on=noisy", "--n", 2, "--seed", 3)
    cdiff("plan", *words, "--constraints", file, "--runs", root / "runs")
    return only(root / "runs")


@pytest.fixture
def run(planned, tmp_path):
    """A copy of the plan, and of its constraint file, that a test may change."""
    copied = tmp_path / "run"
    shutil.copytree(planned, copied)
    file = tmp_path / "mine.yaml"
    shutil.copy(planned.parents[1] / "mine.yaml", file)
    edit(copied, lambda record: record["options"].update(constraints=str(file)))
    return copied


def test_rerun_of_a_plan_gives_equal_arrays_and_options(run, tmp_path):
    result = cdiff("rerun", run, "--runs", tmp_path / "again")
    again = only(tmp_path / "again")
    assert str(again) in result.stdout
    assert result.stderr == ""
    with np.load(run / "plan.npz") as one, np.load(again / "plan.npz") as two:
        assert set(one.files) == set(two.files)
        for name in one.files:
            np.testing.assert_array_equal(one[name], two[name])
    before, after = (yaml.safe_load((r / "run.yaml").read_text()) for r in (run, again))
    assert before["options"] == after["options"]
    assert after["command"][1:2] != ["plan"]


def test_rerun_of_a_rollout_gives_equal_arrays(tmp_path):
    words = ("--method", "projected", "--steps", 4, "--n", 1, "--runs", tmp_path / "one")
    cdiff("rollout", *words)
    cdiff("rerun", only(tmp_path / "one"), "--runs", tmp_path / "two")
    for name in ("plan.npz", "rollout.npz"):
        one, two = (np.load(only(tmp_path / folder) / name) for folder in ("one", "two"))
        for key in one.files:
            np.testing.assert_array_equal(one[key], two[key])


def test_rerun_notes_in_one_line_each_what_is_not_as_it_was(run, tmp_path):
    def change(record):
        record["versions"]["numpy"] = "0.1"
        record["commit"] = "none of this"
        record["checkpoint"]["weights_sha256"] = "f" * 64
        record["preset"]["methods"]["projected"]["on"] = "clean"

    edit(run, change)
    lines = cdiff("rerun", run, "--runs", tmp_path / "again").stderr.splitlines()
    assert [line.split(" was ")[0] for line in lines] == [
        *("note: numpy", "note: commit", "note: checkpoint", "note: preset.methods.projected.on"),
    ]
    assert f"note: numpy was 0.1, is {np.__version__}" in lines
    assert "note: preset.methods.projected.on was clean, is noisy" in lines


def test_changed_constraint_file_is_refused_unless_allowed(run, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(file.read_text() + "# a comment\n")
    words = ("rerun", run, "--runs", tmp_path / "again")
    (line,) = cdiff(*words, code=2).stderr.splitlines()
    assert f"{file} has changed: sha256 was" in line
    assert line.endswith("restore the file, or add --allow-changed")
    assert not (tmp_path / "again").exists()
    (line,) = cdiff(*words, "--allow-changed").stderr.splitlines()
    assert line.startswith(f"note: {file} has changed")
    assert only(tmp_path / "again")


def remove(name):
    return lambda run: (run / name).unlink()


def rewrite(text):
    return lambda run: (run / "run.yaml").write_text(text)


def options(**more):
    return lambda run: edit(run, lambda record: record["options"].update(more))


REFUSED = {
    "run.yaml is missing": (remove("run.yaml"), "run.yaml: no such file"),
    "not YAML": (rewrite("a: [b"), "run.yaml:1: not valid YAML"),
    "no mapping": (rewrite("- 1"), "not the run.yaml of a run: it lacks options.task"),
    "no hash": (
        lambda run: edit(run, lambda record: record["constraints"].pop("sha256")),
        "it lacks constraints.sha256",
    ),
    "a number that is none": (options(n="two"), "options.n: "),
    "an option of another version": (options(speed=3), 'no option "speed" in this version'),
    "a method of another version": (options(method="almm"), 'no method "almm"'),
    "a constraint file that is gone": (options(constraints="gone.yaml"), "gone.yaml"),
    "a checkpoint that is gone": (options(checkpoint="gone.safetensors"), "no such checkpoint"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_run_that_cannot_be_made_again_is_refused_in_one_line(case, run, tmp_path):
    spoil, message = REFUSED[case]
    spoil(run)
    (line,) = cdiff("rerun", run, "--runs", tmp_path / "again", code=2).stderr.splitlines()
    assert line.startswith("error: ")
    assert message in line
    assert not (tmp_path / "again").exists()


def test_run_that_does_not_exist_is_refused(tmp_path):
    assert "no such run directory" in cdiff("rerun", tmp_path / "none", code=2).stderr


def test_margins_that_were_calibrated_anew_are_a_change():
    class Planner:
        device = type("Device", (), {"type": "cpu"})

    class Experiment:
        planner = Planner

        @staticmethod
        def record():
            return {"margins": {"thigh-up": 0.5}, "checkpoint": None}

    record = {"margins": {"thigh-up": 0.25}, "checkpoint": None}
    assert "margins.thigh-up was 0.25, is 0.5" in list(changes(record, Experiment))
