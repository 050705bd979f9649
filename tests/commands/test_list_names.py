"""`cdiff list`: its names are those that exist, its facts those of the files."""

import json

import pytest

from cdiff_cli import sampling
from cdiff_cli.commands.list_names import entries
from cdiff_cli.commands.names import ABOUT_TASKS, KERNELS, LISTS, METHODS, PRESETS
from cdiff_cli.evaluation.columns import COLUMNS
from cdiff_cli.models.recipe import load_recipe
from cdiff_cli.paths import home
from cdiff_cli.tasks import TASKS
from tests.commands.test_cli import cdiff, without_torch


def test_names_are_those_of_the_tables_that_make_them():
    assert list(ABOUT_TASKS) == list(TASKS)
    assert list(METHODS) == list(sampling.METHODS)
    assert list(KERNELS) == list(sampling.KERNELS)
    assert set(PRESETS) == {name for task in TASKS for name in load_recipe(task).presets}
    assert [entry["name"] for entry in entries("columns")] == list(COLUMNS)


@pytest.mark.parametrize("kind", LISTS)
def test_every_list_is_one_line_per_name_without_torch(kind, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    lines = [line for line in without_torch("list", kind).splitlines() if line.strip()]
    names = [entry["name"] for entry in entries(kind)]
    assert [line.split()[0] for line in lines] == names
    assert all(len(line.split()) > 1 for line in lines)
    assert json.loads(cdiff("list", kind, "--json").stdout) == entries(kind)


def test_presets_name_the_tasks_that_have_them():
    (fast,) = [entry for entry in entries("presets") if entry["name"] == "fast"]
    assert fast["tasks"] == ["maze2d-umaze", "maze2d-large"]
    assert fast["about"] == "ours, in 16 network calls (maze2d-umaze, maze2d-large)"


def test_constraint_files_are_listed_with_task_names_and_kinds():
    listed = {entry["name"]: entry for entry in entries("constraints")}
    assert len(listed) == len(list((home() / "constraints").glob("*.yaml")))
    pillar = listed["constraints/maze2d-umaze-pillar.yaml"]
    assert pillar["about"] == "maze2d-umaze: pillar (quadratic), cut-corner (linear)"
    assert not pillar["default"]
    own = listed["constraints/maze2d-umaze.yaml"]
    assert own["about"] == "maze2d-umaze: cut-corner (linear); the task's own"


def test_models_are_listed_with_the_facts_of_their_cards():
    listed = {entry["name"]: entry for entry in entries("models")}
    small = listed["maze2d-umaze/small"]
    assert small["about"] == "horizon 128, 64 steps, 2.3 M parameters"
    assert (small["trained_steps"], small["task"], small["recipe"]) == (
        *(12000, "maze2d-umaze", "small"),
    )
    assert small["bytes"] > 1_000_000


def test_unknown_list_is_refused_with_a_suggestion():
    stderr = cdiff("list", "presests", code=2).stderr
    assert stderr == (
        'error: no list "presests" (did you mean "presets"?); choose from tasks, constraints, '
        "methods, presets, kernels, models, columns\n"
    )
