"""The command line as typed: exit codes, content, what is on disk afterwards."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from cdiff_cli.cli import app
from cdiff_cli.commands.run_directory import read_rows
from cdiff_cli.models.recipe import Recipe, load_recipe
from cdiff_cli.paths import home
from cdiff_cli.sampling import METHOD_ORDER
from cdiff_cli.tasks import TASKS

ROOT = Path(__file__).parents[2]


def cdiff(*words, code=0):
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == code, result.output + result.stderr + repr(result.exception)
    return result


@pytest.fixture(scope="module")
def alm_run(tmp_path_factory):
    """One `cdiff plan --method alm` of two plans, shared by the tests that look at what it left."""
    root = tmp_path_factory.mktemp("runs")
    result = cdiff("plan", "--method", "alm", "--n", 2, "--runs", root)
    (run,) = root.iterdir()
    return run, result.stdout


def test_plan_with_alm_prints_its_table_and_picture(alm_run):
    run, stdout = alm_run
    for word in (
        "alm",
        "recommended",
        "n = 2",
        "distance / m",
        "worst segment / g",
        "network calls per plan",
        "plan.png",
    ):
        assert word in stdout
    assert str(run) in stdout


def test_run_directory_of_a_plan_holds_every_file(alm_run):
    run, _ = alm_run
    names = {
        "run.yaml",
        "plan.npz",
        "trace.npz",
        "rows.csv",
        "certificate.json",
        "plan.png",
        "convergence.png",
    }
    assert names == {path.name for path in run.iterdir()}
    with np.load(run / "plan.npz") as plan:
        assert plan["x"].shape == plan["x_free"].shape == (2, 128, 4)
        assert plan["x"].dtype == np.float64
        assert list(plan["layout"]) == ["x", "y", "vx", "vy"]
    config = yaml.safe_load((run / "run.yaml").read_text())
    assert config["preset"]["methods"]["alm"]["on"] == "clean"
    assert len(config["checkpoint"]["weights_sha256"]) == 64


def test_recommended_alm_has_zero_violation_at_waypoints_in_float64(alm_run):
    run, _ = alm_run
    assert [row["violation"] for row in read_rows(run / "rows.csv")] == [0.0, 0.0]
    with np.load(run / "plan.npz") as plan:
        assert (plan["x"][..., 0] - plan["x"][..., 1]).max() <= 1.82


def test_half_space_safe_at_waypoints_is_safe_on_segments(alm_run):
    run, stdout = alm_run
    proof = json.loads((run / "certificate.json").read_text())
    assert [entry["status"] for entry in proof["entries"]] == ["safe", "safe"]
    assert proof["counts"] == {
        "plans": 2,
        "safe_at_waypoints": 2,
        "safe_on_segments": 2,
        "safe_executed": None,
    }
    assert "certificate  2 of 2 plans safe at the waypoints, 2 of 2 between them\n" in stdout


def test_plans_begin_at_the_start_and_end_at_the_goal(alm_run):
    run, _ = alm_run
    recipe = load_recipe("maze2d-umaze")
    with np.load(run / "plan.npz") as plan:
        np.testing.assert_allclose(
            plan["x"][:, 0], [[recipe.start["x"], recipe.start["y"], 0, 0]] * 2, atol=1e-6
        )  # float32 pins
        np.testing.assert_allclose(
            plan["x"][:, -1], [[recipe.goal["x"], recipe.goal["y"], 0, 0]] * 2, atol=1e-3
        )  # what the dynamics make


def test_no_dynamics_plans_no_inputs_and_marks_the_preset_as_changed(alm_run, tmp_path):
    with np.load(alm_run[0] / "plan.npz") as plan:
        assert plan["u"].shape == (2, 127, 2)
    cdiff("plan", "--method", "alm", "--n", 1, "--no-dynamics", "--runs", tmp_path)
    (run,) = tmp_path.iterdir()
    with np.load(run / "plan.npz") as plan:
        assert "u" not in plan
    assert ",recommended*," in (run / "rows.csv").read_text()


def test_equal_seeds_give_equal_plans(alm_run, tmp_path):
    run, _ = alm_run
    cdiff("plan", "--method", "alm", "--n", 2, "--runs", tmp_path)
    (again,) = tmp_path.iterdir()
    with np.load(run / "plan.npz") as one, np.load(again / "plan.npz") as two:
        np.testing.assert_array_equal(one["x"], two["x"])


def test_json_is_one_object(tmp_path):
    result = cdiff("plan", "--method", "diffuser", "--n", 1, "--json", "--runs", tmp_path)
    summary = json.loads(result.stdout)["summary"]
    assert summary[0]["method"] == "diffuser"
    assert summary[0]["distance"]["mean"] == 0.0


@pytest.mark.parametrize("method", sorted(set(METHOD_ORDER) - {"alm", "diffuser"}))
@pytest.mark.parametrize("preset", ["paper", "released", "recommended"])
def test_every_method_and_preset_plans(method, preset, tmp_path):
    steps = () if method in ("projected", "primal-dual") else ("--steps", 8)
    result = cdiff(
        "plan",
        "--method",
        method,
        "--preset",
        preset,
        *steps,
        "--n",
        1,
        "--json",
        "--runs",
        tmp_path,
    )
    assert json.loads(result.stdout)["summary"][0]["violation"]["mean"] < 20


def test_extra_steps_option_adds_calls_and_marks_the_preset_as_changed(tmp_path):
    words = (
        "--method",
        "safediffuser",
        "--preset",
        "paper",
        "--extra-steps",
        5,
        "--n",
        1,
        "--json",
        "--runs",
        tmp_path,
    )
    summary = json.loads(cdiff("plan", *words).stdout)["summary"][0]
    assert (summary["calls"]["mean"], summary["preset"]) == (69, "paper*")


def test_each_method_of_the_released_preset_takes_its_own_extra_steps():
    preset = load_recipe("maze2d-umaze").presets["released"]
    methods = ("alm", "safediffuser", "diffuser")
    taken = [preset.of_method(name).sampler.extra_steps for name in methods]
    assert taken == [100, 50, 0]


@pytest.mark.parametrize("kernel", ["ddim", "dpm++2m"])
def test_few_steps_make_few_calls_and_satisfy_the_constraints(kernel, tmp_path):
    result = cdiff("plan", "--kernel", kernel, "--steps", 8, "--n", 1, "--json", "--runs", tmp_path)
    summary = json.loads(result.stdout)["summary"][0]
    assert summary["calls"]["mean"] == 8
    assert summary["violation"]["mean"] == 0
    assert summary["preset"] == "recommended*"


def test_barrier_and_two_constraints_at_once_are_satisfied(tmp_path):
    for name in ("pillar", "speed"):
        file = ROOT / "constraints" / f"maze2d-umaze-{name}.yaml"
        result = cdiff(
            "plan",
            "--method",
            "projected",
            "--constraints",
            file,
            "--n",
            1,
            "--json",
            "--runs",
            tmp_path,
        )
        assert json.loads(result.stdout)["summary"][0]["worst_waypoint"]["mean"] <= 0


def test_gaussian2d_draws_figure_1_and_its_boundary_mass(tmp_path):
    result = cdiff(
        "plan",
        "--task",
        "gaussian2d",
        "--method",
        "alm",
        "--preset",
        "paper",
        "--n",
        20,
        "--runs",
        tmp_path,
    )
    assert "boundary mass" in result.stdout
    (run,) = tmp_path.iterdir()
    assert (run / "chain.png").stat().st_size > 10_000


def test_rollout_executes_and_scores(tmp_path):
    result = cdiff(
        "rollout", "--method", "projected", "--n", 1, "--video", "gif", "--runs", tmp_path
    )
    assert "executed violation" in result.stdout
    assert (
        "1 of 1 plans safe at the waypoints, 1 of 1 between them, 1 of 1 as executed"
        in result.stdout
    )
    (run,) = tmp_path.iterdir()
    with np.load(run / "rollout.npz") as rollout:
        assert rollout["x"].shape == (1, 228, 4)
        assert np.abs(rollout["u"]).max() <= 1
    assert (run / "rollout.gif").stat().st_size > 10_000
    row = read_rows(run / "rows.csv")[0]
    assert row["steps"] == 227
    assert row["success"] in (0.0, 1.0)
    (entry,) = json.loads((run / "certificate.json").read_text())["entries"]
    assert entry["executed"]["worst"] == row["executed_worst"]
    assert "1 of 1 as executed" in cdiff("verify", run).stdout


def test_verify_certifies_a_run_of_alm(alm_run):
    run, _ = alm_run
    stdout = cdiff("verify", run).stdout
    assert "cut-corner" in stdout
    assert "2 of 2" in stdout
    assert (
        f"certified      {run}: 2 of 2 plans safe at the waypoints, 2 of 2 between them" in stdout
    )


def test_verify_does_not_certify_plans_that_ignore_an_active_constraint(tmp_path):
    slalom = ROOT / "constraints" / "maze2d-umaze-slalom.yaml"
    cdiff("plan", "--method", "diffuser", "--constraints", slalom, "--n", 4, "--runs", tmp_path)
    assert "NOT certified" in cdiff("verify", tmp_path, code=1).stdout


@pytest.mark.parametrize("name", ["pillar", "speed"])
def test_verify_certifies_a_disc_and_a_barrier(name, tmp_path):
    file = ROOT / "constraints" / f"maze2d-umaze-{name}.yaml"
    cdiff("plan", "--method", "alm", "--constraints", file, "--n", 1, "--runs", tmp_path)
    assert (
        "1 of 1 plans safe at the waypoints, 1 of 1 between them"
        in cdiff("verify", tmp_path).stdout
    )


def test_compare_prints_groups_and_the_papers_values(alm_run):
    run, _ = alm_run
    stdout = cdiff("compare", run.parent).stdout
    assert "alm" in stdout
    assert "n" in stdout
    assert "9.81 ± 1.65" in cdiff("compare", run.parent, "--paper", "--format", "markdown").stdout
    assert json.loads(cdiff("compare", run.parent, "--format", "json").stdout)["plans"][0]["n"] == 2
    assert cdiff("compare", run.parent, "--format", "latex").stdout.startswith(r"\begin{tabular}")


def test_check_prints_the_meaning_and_draws_a_picture(tmp_path):
    picture = tmp_path / "c.png"
    result = cdiff("check", ROOT / "constraints" / "maze2d-large.yaml", "--picture", picture)
    for word in ("disc", "quadratic", "outside the ball", "384", "exact"):
        assert word in result.stdout
    assert picture.stat().st_size > 10_000


def test_check_exports_a_json_schema():
    schema = json.loads(cdiff("check", "--schema").stdout)
    assert {"Linear", "Quadratic", "Dcbf"} <= set(schema["$defs"])


HEAD = "task: maze2d-umaze\nconstraints:\n"
GOOD = HEAD + "  - {name: cut, kind: linear, a: {x: 1.0, y: -1.0}, b: 1.82}\n"
BAD = {
    "unknown coordinate": (
        GOOD.replace("y: -1.0", "yy: -1.0"),
        ':3 constraints[0].a.yy: no coordinate "yy"',
        "x, y, vx, vy",
    ),
    "wrong type": (GOOD.replace("1.82", "[1]"), ":3 constraints[0].b", "found [1]"),
    "malformed": ("task: maze2d-umaze\nconstraints:\n  - {name: [cut\n", ":", "not valid YAML"),
    "nan": (GOOD.replace("1.82", ".nan"), ":3 constraints[0].b", "finite"),
    "inf": (GOOD.replace("1.82", ".inf"), ":3 constraints[0].b", "finite"),
    "excludes the start": (
        GOOD.replace("1.82", "1.0"),
        'the constraint "cut" excludes the start',
        "g = 0.54",
    ),
    "excludes the goal": (
        GOOD.replace("x: 1.0, y: -1.0", "y: 1.0").replace("1.82", "0.5"),
        "excludes the goal",
        "relax",
    ),
    "negative radius": (
        HEAD + "  - {kind: quadratic, side: outside, centre: {x: 1, y: 0}, radius: -1}\n",
        ":3 constraints[0].radius",
        "greater than 0",
    ),
    "alpha": (
        HEAD + "  - {kind: dcbf, alpha: 1.5, barrier: {kind: linear, a: {vx: 1}, b: 4}}\n",
        ":3 constraints[0].alpha",
        "less than or equal to 1",
    ),
    "other task": (GOOD.replace("umaze", "large"), ":1 task", "change one of them"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_constraint_file_gets_one_line_exit_2_and_writes_nothing(case, tmp_path):
    text, *expected = BAD[case]
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    refused("plan", "--constraints", file, expected=expected, tmp_path=tmp_path)


OPTIONS = {
    "unknown method": (["--method", "almm"], ['no method "almm"', 'did you mean "alm"']),
    "unknown preset": (["--preset", "papr"], ['no preset "papr"', 'did you mean "paper"']),
    "unknown task": (
        ["--task", "maze2d-umase"],
        ['no task "maze2d-umase"', 'did you mean "maze2d-umaze"'],
    ),
    "unknown setting": (["--set", "roh=1"], ['alm has no setting "roh"', 'did you mean "rho"']),
    "setting of the wrong type": (["--set", "rho=big"], ["alm.rho", "expected a number"]),
    "setting without a value": (["--set", "rho"], ["expected name=value"]),
    "missing constraint file": (["--constraints", "constraints/none.yaml"], ["no such file"]),
    "start in a wall": (["--start", "0,0"], ["the start (x = 0, y = 0) is inside a wall"]),
    "goal outside the maze": (["--goal", "9,9"], ["the goal (x = 9, y = 9) is inside a wall"]),
    "start not numbers": (["--start", "a,b"], ["expected a number for x"]),
    "start too short": (["--start", "1"], ["--start: y missing"]),
    "no plans": (["--n", "0"], ["at least 1"]),
    "negative extra steps": (
        ["--extra-steps", "-1"],
        ["--extra-steps: expected 0 or more, found -1"],
    ),
    "no planner for the constraints": (
        ["--method", "conditional", "--constraints", "constraints/maze2d-umaze-disc.yaml"],
        [
            "no conditional planner for these constraints",
            "cdiff train --task maze2d-umaze --conditional constraints/",
        ],
    ),
    "unknown variant": (
        ["--method", "safediffuser", "--set", "variant=rose"],
        ["safediffuser.variant: expected one of ros, res, tvs"],
    ),
    "unknown kernel": (["--kernel", "dpm+2m"], ['no kernel "dpm+2m"', 'did you mean "dpm++2m"']),
    "too many steps": (["--steps", "65"], ["expected 1 to 64"]),
    "missing checkpoint": (
        ["--checkpoint", "none.safetensors"],
        ["no such checkpoint", "cdiff train"],
    ),
    "unknown device": (["--device", "gpu9"], ['device "gpu9" cannot be used here']),
}


@pytest.mark.parametrize("case", OPTIONS)
def test_bad_option_gets_one_line_exit_2_and_writes_nothing(case, tmp_path):
    words, expected = OPTIONS[case]
    refused("plan", *words, expected=expected, tmp_path=tmp_path)


def test_checkpoint_of_another_task_is_refused(tmp_path):
    other = home() / "models" / "maze2d-large" / "small.safetensors"
    refused(
        "plan",
        "--checkpoint",
        other,
        expected=["a checkpoint of maze2d-large, asked for was maze2d-umaze"],
        tmp_path=tmp_path,
    )


def test_truncated_checkpoint_is_refused(tmp_path):
    source = home() / "models" / "maze2d-umaze"
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes((source / "small.safetensors").read_bytes()[:100_000])
    (tmp_path / "broken.card.yaml").write_bytes((source / "small.card.yaml").read_bytes())
    refused("plan", "--checkpoint", broken, expected=["truncated or altered"], tmp_path=tmp_path)


def refused(*words, expected, tmp_path):
    runs = tmp_path / "runs"
    result = cdiff(*words, "--runs", runs, code=2)
    assert len(result.stderr.strip().splitlines()) == 1
    for piece in expected:
        assert piece in result.stderr
    assert not runs.exists()


def test_compare_without_runs_says_what_to_do(tmp_path):
    assert "cdiff plan --method alm" in cdiff("compare", tmp_path, code=2).stderr
    assert "no such folder" in cdiff("compare", tmp_path / "none", code=2).stderr


def test_gaussian2d_cannot_be_trained_or_rolled_out(tmp_path):
    assert (
        "needs no training"
        in cdiff("train", "--task", "gaussian2d", "--runs", tmp_path, code=2).stderr
    )
    assert (
        "no environment"
        in cdiff("rollout", "--task", "gaussian2d", "--runs", tmp_path, code=2).stderr
    )


def test_help_names_every_method():
    shown = " ".join(cdiff("plan", "--help").stdout.replace("│", " ").split())
    assert ", ".join(METHOD_ORDER) in shown


def test_help_names_every_task_and_the_defaults_that_are_not_literal():
    shown = " ".join(cdiff("rollout", "--help").stdout.replace("│", " ").split())
    assert ", ".join(TASKS) in shown
    assert "YAML file of constraints [default: the task's own]" in shown


COMMANDS = {*("plan", "rollout", "verify", "compare", "sweep", "rerun", "check", "list", "train")}
WITHOUT_TORCH = """
import sys
from typer.testing import CliRunner
from cdiff_cli.cli import app
result = CliRunner().invoke(app, sys.argv[2:])
assert result.exit_code == int(sys.argv[1]), result.output + result.stderr
assert "torch" not in sys.modules
print(result.output)
"""


def without_torch(*words, code=0):
    """What a new process prints, which must not have imported torch."""
    program = [sys.executable, "-c", WITHOUT_TORCH, str(code), *map(str, words)]
    run = subprocess.run(program, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return run.stdout


def test_help_names_every_command_and_imports_no_torch():
    shown = without_torch("--help")
    assert [name for name in COMMANDS if f"│ {name} " not in shown] == []


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_help_of_each_command_has_an_example_with_options_that_exist(command):
    shown = cdiff(command, "-h").stdout
    assert shown == cdiff(command, "--help").stdout
    (example,) = [line.strip() for line in shown.splitlines() if "Example: cdiff" in line]
    cdiff(*example.removeprefix("Example: cdiff ").split(), "--help")


def test_options_stand_in_panels():
    shown = cdiff("rollout", "-h").stdout
    panels = [line.split("─ ")[1].split(" ─")[0] for line in shown.splitlines() if "╭─" in line]
    assert panels == ["Options", "Task", "Constraint", "Sampling", "Execution", "Output"]


def test_version_is_that_of_the_package():
    import cdiff_cli

    assert cdiff("--version").stdout == f"cdiff {cdiff_cli.__version__}\n"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("cdiff plan --method pri", ["primal-dual"]),
        ("cdiff plan --task maze", ["maze2d-umaze", "maze2d-large"]),
        ("cdiff list m", ["methods", "models"]),
        ("cdiff re", ["rerun"]),
    ],
)
def test_shell_completes_commands_and_names(line, expected):
    words = line.split()
    variables = {"COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    completed = subprocess.run(
        [sys.executable, "-c", "from cdiff_cli.cli import app; app(prog_name='cdiff')"],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | variables | {"_CDIFF_COMPLETE": "complete_bash"},
    )
    assert completed.stdout.split() == expected


MISSPELT = {
    "task": (["plan", "--task", "maze2d-umase"], 'no task "maze2d-umase" (did you mean'),
    "method": (["plan", "--method", "almm"], 'no method "almm" (did you mean "alm"?)'),
    "preset": (["rollout", "--preset", "papr"], 'no preset "papr" (did you mean "paper"?)'),
    "kernel": (["rollout", "--kernel", "dim"], 'no kernel "dim" (did you mean "ddim"?)'),
    "format": (["compare", "--format", "cvs"], 'no format "cvs" (did you mean "csv"?)'),
    "sweep": (["sweep", "--methods", "alm,almm"], '--methods: no method "almm"'),
    "train": (["train", "--recipe", "smal"], 'no recipe "smal" (did you mean "small"?)'),
    "list": (["list", "taks"], 'no list "taks" (did you mean "tasks"?)'),
}


@pytest.mark.parametrize("name", MISSPELT)
def test_misspelt_name_is_refused_before_torch_is_imported(name):
    words, message = MISSPELT[name]
    assert message in without_torch(*words, code=2)


@pytest.mark.parametrize("task", ["maze2d-umaze", "maze2d-large", "gaussian2d"])
def test_every_recipe_is_valid_and_every_preset_makes_its_methods(task):
    from cdiff_cli.sampling import make_method

    recipe = load_recipe(task)
    assert isinstance(recipe, Recipe)
    for preset in recipe.presets.values():
        for name, settings in preset.methods.items():
            make_method(name, settings)
