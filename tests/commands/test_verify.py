"""`cdiff verify`: what it certifies, what it finds altered, what it cannot read."""

import hashlib
import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from cdiff_cli.cli import app
from cdiff_cli.commands.run_directory import write_yaml
from cdiff_cli.commands.verify import verify_run
from cdiff_cli.constraints.spec.load import load_constraints
from cdiff_cli.evaluation.certificate import Saved, certificate
from cdiff_cli.tasks import load_task

DISC = {
    "name": "disc",
    "kind": "quadratic",
    "side": "outside",
    "centre": {"x": 0.0, "y": 0.0},
    "radius": 1.0,
}
CUT_CORNER = {"name": "cut", "kind": "linear", "a": {"x": 1.0, "y": -1.0}, "b": 5.0}
SLOW = {
    "name": "slow",
    "kind": "dcbf",
    "alpha": 0.5,
    "barrier": {"kind": "linear", "a": {"vx": 1.0}, "b": 1.0},
}
SADDLE = {
    "name": "saddle",
    "kind": "quadratic",
    "side": "inside",
    "P": {"x": {"x": 1.0}, "y": {"y": -1.0}},
    "r": 99.0,
}
ROUND = [(-2.0, 1.5, 0.0, 0.0), (0.0, 1.5, 0.0, 0.0), (2.0, 1.5, 0.0, 0.0)]
ACROSS = [
    (-2.0, 0.5, 0.0, 0.0),
    (2.0, 0.5, 0.0, 0.0),
    (2.0, 1.0, 0.0, 0.0),
]  # both ends outside the disc, 0.5 deep between


def make_run(folder, *plans, kinds=(DISC, CUT_CORNER), rollout=None):
    """A run directory of these plans as `cdiff plan` would leave it."""
    folder.mkdir(parents=True)
    task, file = load_task("maze2d-umaze"), folder / "constraints.yaml"
    write_yaml(file, {"task": task.name, "constraints": list(kinds)})
    specs, g = load_constraints(file, task.name, task.layout, dt=task.dt)
    content = [spec.model_dump(mode="json", exclude_none=True) for spec in specs]
    recorded = {
        "file": str(file),
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "content": content,
    }
    run = {
        "command": ["cdiff", "plan"],
        "options": {"task": task.name, "n": len(plans)},
        "constraints": recorded,
    }
    write_yaml(folder / "run.yaml", run)
    plan = save(folder / "plan.npz", plans)
    executed = None if rollout is None else save(folder / "rollout.npz", rollout)
    proof = certificate(task, recorded, g, plan, executed)
    (folder / "certificate.json").write_text(json.dumps(proof, allow_nan=False))
    return folder


def save(path, plans, layout=("x", "y", "vx", "vy"), **more):
    x, seeds = np.array(plans, dtype=np.float64), list(range(len(plans)))
    np.savez_compressed(
        path, **({"x": x, "layout": np.array(layout), "seed": np.array(seeds)} | more)
    )
    return Saved(x, seeds, hashlib.sha256(path.read_bytes()).hexdigest())


def verify(*words, code):
    result = CliRunner().invoke(app, ["verify", *map(str, words)])
    assert result.exit_code == code, result.output + result.stderr + repr(result.exception)
    return result


def refused(*words):
    """The one line on stderr of a run that cannot be read."""
    result = verify(*words, code=2)
    (line,) = result.stderr.strip().splitlines()
    assert line.startswith("error: ")
    return line


def edit(path, change):
    proof = json.loads(path.read_text())
    change(proof)
    path.write_text(json.dumps(proof))


def test_safe_run_is_certified(tmp_path):
    result = verify(make_run(tmp_path / "run", ROUND), code=0)
    assert "certified      " in result.stdout
    assert "1 of 1 plans safe at the waypoints, 1 of 1 between them" in result.stdout
    assert result.stderr == ""


def test_plan_across_a_disc_is_certified_at_its_waypoints_only(tmp_path):
    run = make_run(tmp_path / "run", ROUND, ACROSS)
    result = verify(run, code=1)
    assert "NOT certified" in result.stdout
    assert "2 of 2 plans safe at the waypoints, 1 of 2 between them" in result.stdout
    assert "0.5 at 0.005 s, seed 1" in result.stdout
    assert "certified      " in verify(run, "--waypoints", code=0).stdout


def test_json_holds_the_same_results(tmp_path):
    run = make_run(tmp_path / "run", ROUND, ACROSS)
    (report,) = json.loads(verify(run, "--json", code=1).stdout)["runs"]
    assert (report["run"], report["certified"], report["matches"], report["notes"]) == (
        str(run),
        False,
        True,
        [],
    )
    disc, cut = report["constraints"]
    assert disc["segments"] == {
        "seed": 1,
        "worst": pytest.approx(0.5),
        "time": pytest.approx(0.005),
    }
    assert (disc["safe"], disc["plans"], disc["exact"], disc["executed"]) == (1, 2, True, None)
    assert (cut["constraint"], cut["safe"]) == ("cut", 2)


def test_barrier_and_general_quadric_are_compiled_from_run_yaml(tmp_path):
    verify(make_run(tmp_path / "run", ROUND, kinds=(SLOW, SADDLE)), code=0)


@pytest.mark.parametrize("name", ["1e3", "on", "[/bold]", "pillar@3-4", "säule"])
def test_constraint_may_have_any_name(name, tmp_path):
    run = make_run(tmp_path / "run", ROUND, kinds=(DISC | {"name": name}, CUT_CORNER))
    assert name in verify(run, code=0).stdout


def test_plan_that_violates_a_barrier_is_not_certified(tmp_path):
    rush = [(0.0, 2.0, 0.0, 0.0), (0.0, 2.0, 0.75, 0.0), (0.0, 2.0, 0.75, 0.0)]
    result = verify(make_run(tmp_path / "run", rush, kinds=(SLOW,)), code=1)
    assert "0.25 at 0.01 s, seed 0" in result.stdout
    assert "0 of 1 plans safe at the waypoints, 1 of 1 between them" in result.stdout


def test_executed_violation_is_shown_and_leaves_the_plans_certified(tmp_path):
    path = [[*ROUND, (0.0, 0.25, 0.0, 0.0), (np.nan,) * 4]]
    result = verify(make_run(tmp_path / "run", ROUND, rollout=path), code=0)
    assert "0.75 at 0.03 s, seed 0" in result.stdout
    assert "1 of 1 between them, 0 of 1 as executed" in result.stdout


def test_folder_of_runs_is_verified_run_by_run(tmp_path):
    make_run(tmp_path / "a", ROUND)
    make_run(tmp_path / "b", ACROSS)
    make_run(tmp_path / ".partial", ACROSS)
    (tmp_path / "no-run").mkdir()
    result = verify(tmp_path, tmp_path / "a", code=1)
    assert [line.split("  ")[0] for line in result.stdout.splitlines() if "certified" in line] == [
        "certified",
        "NOT certified",
    ]


def test_unreadable_run_hides_none_of_the_others(tmp_path):
    make_run(tmp_path / "a", ROUND)
    (make_run(tmp_path / "b", ROUND) / "run.yaml").unlink()
    result = verify(tmp_path, code=2)
    assert "certified      " in result.stdout
    assert "run.yaml is missing" in result.stderr


def test_altered_plan_is_detected_even_where_it_is_safe(tmp_path):
    run = make_run(tmp_path / "run", ROUND)
    save(run / "plan.npz", [[(x, y + 0.1, vx, vy) for x, y, vx, vy in ROUND]])
    assert "plan.npz was altered after its certificate was written" in verify(run, code=1).stdout


def test_removed_plan_is_detected(tmp_path):
    run = make_run(tmp_path / "run", ROUND, ACROSS)
    save(run / "plan.npz", [ROUND])
    assert "plan.npz was altered" in verify(run, code=1).stdout


def test_altered_rollout_is_detected(tmp_path):
    run = make_run(tmp_path / "run", ROUND, rollout=[[*ROUND, (0.0, 0.25, 0.0, 0.0)]])
    save(run / "rollout.npz", [ROUND])
    assert "rollout.npz was altered" in verify(run, code=1).stdout


EDITS = {
    "a status": (lambda p: p["entries"][2].update(status="safe"), 'entries[2].status says "safe"'),
    "a value": (
        lambda p: p["entries"][2]["segments"].update(worst=-0.5),
        "entries[2].segments.worst says -0.5, recomputed 0.5",
    ),
    "a place": (
        lambda p: p["entries"][0]["waypoints"].update(tau=2),
        "entries[0].waypoints.tau says 2, recomputed 1",
    ),
    "a state": (
        lambda p: p["entries"][0]["segments"]["state"].update(x=1.0),
        "entries[0].segments.state.x says 1.0",
    ),
    "a count": (
        lambda p: p["counts"].update(safe_on_segments=2),
        "counts.safe_on_segments says 2, recomputed 1",
    ),
    "a count as true": (
        lambda p: p["counts"].update(safe_on_segments=True),
        "counts.safe_on_segments says true, recomputed 1",
    ),
    "a value beyond floats": (
        lambda p: p["entries"][0]["waypoints"].update(worst=10**400),
        "entries[0].waypoints.worst says 1000",
    ),
    "an entry taken away": (lambda p: p["entries"].pop(2), "entries has 3, recomputed 4"),
    "a tolerance": (lambda p: p.update(tolerance=0.6), "tolerance says 0.6, recomputed 0"),
    "a field taken away": (
        lambda p: p["entries"][2]["segments"].pop("safe"),
        "entries[2].segments.safe is missing",
    ),
    "a field added": (lambda p: p.update(approved=True), "approved is not of a certificate"),
    "the task": (lambda p: p.update(task="maze2d-large"), 'task says "maze2d-large"'),
    "the constraints": (
        lambda p: p["constraints"].update(sha256="0" * 64),
        "constraints in run.yaml are not those",
    ),
}


@pytest.mark.parametrize("case", EDITS)
def test_edited_certificate_is_detected(case, tmp_path):
    change, said = EDITS[case]
    run = make_run(tmp_path / "run", ROUND, ACROSS)
    edit(run / "certificate.json", change)
    assert said in verify(run, "--waypoints", code=1).stdout


def test_relaxed_constraints_in_run_yaml_are_detected(tmp_path):
    run = make_run(tmp_path / "run", ACROSS)
    text = (run / "run.yaml").read_text()
    (run / "run.yaml").write_text(text.replace("radius: 1.0", "radius: 0.1"))
    assert (
        "the constraints in run.yaml are not those of the certificate" in verify(run, code=1).stdout
    )


def test_rounding_in_the_last_bit_is_no_mismatch(tmp_path):
    run = make_run(tmp_path / "run", ROUND, ACROSS)
    edit(
        run / "certificate.json",
        lambda p: p["entries"][2]["segments"].update(worst=np.nextafter(0.5, 1)),
    )
    assert verify_run(run).mismatch == ()


def test_constraint_file_edited_since_is_noted_and_not_used(tmp_path):
    run = make_run(tmp_path / "run", ACROSS)
    file = run / "constraints.yaml"
    file.write_text(file.read_text().replace("radius: 1.0", "radius: 0.1"))
    result = verify(run, code=1)
    assert "constraints.yaml has changed since" in result.stderr
    assert "0.5 at 0.005 s" in result.stdout
    file.unlink()
    assert "cannot be read from here" in verify(run, code=1).stderr


def test_no_such_run_says_what_to_do(tmp_path):
    assert "no such run; make one first: cdiff plan" in refused(tmp_path / "none")
    assert "no run here" in refused(tmp_path)
    (tmp_path / "file").touch()
    assert "name the run directory" in refused(tmp_path / "file")


@pytest.mark.parametrize("name", ["run.yaml", "plan.npz", "certificate.json", "rollout.npz"])
def test_missing_file_is_named(name, tmp_path):
    run = make_run(tmp_path / "run", ROUND, rollout=[ROUND])
    (run / name).unlink()
    assert f"{name} is missing" in refused(run)


@pytest.mark.parametrize("name", ["run.yaml", "plan.npz", "certificate.json", "rollout.npz"])
@pytest.mark.parametrize("how", ["truncated", "empty", "noise", "a folder"])
def test_damaged_file_is_refused_in_one_line(name, how, tmp_path):
    run = make_run(tmp_path / "run", ROUND, rollout=[ROUND])
    content = (run / name).read_bytes()
    (run / name).unlink()
    if how == "a folder":
        (run / name).mkdir()
    else:
        damaged = {
            "truncated": content[: len(content) // 2],
            "empty": b"",
            "noise": np.random.default_rng(0).bytes(2000),
        }
        (run / name).write_bytes(damaged[how])
    assert name in refused(run)


def test_every_flipped_byte_of_a_plan_is_detected(tmp_path):
    run = make_run(tmp_path / "run", ROUND)
    content = (run / "plan.npz").read_bytes()
    for at in range(0, len(content), 17):
        (run / "plan.npz").write_bytes(
            content[:at] + bytes([content[at] ^ 0x55]) + content[at + 1 :]
        )
        result = CliRunner().invoke(app, ["verify", str(run)])
        assert result.exit_code in (1, 2), (at, result.exception)
        assert "plan.npz" in result.stdout + result.stderr


def bare(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


ARRAYS = {
    "another layout": (
        {"layout": ("x", "y", "vy", "vx")},
        "expected the coordinates x, y, vx, vy of maze2d-umaze, found x, y, vy",
    ),
    "too few dimensions": (
        {"x": np.zeros((1, 3))},
        "expected x as numbers [plans, steps, 4], found float64 [1, 3]",
    ),
    "no plans": ({"x": np.zeros((0, 3, 4)), "seed": np.zeros(0, int)}, "expected x as numbers"),
    "text": ({"x": np.full((1, 3, 4), "a")}, "expected x as numbers"),
    "too many seeds": ({"seed": np.arange(2)}, "a whole-numbered seed for each of 1 plans"),
    "nan": ({"x": np.full((1, 3, 4), np.nan)}, "the state of seed 0 is not finite"),
    "inf": ({"x": np.full((1, 3, 4), np.inf)}, "the state of seed 0 is not finite"),
    "objects": ({"x": np.array([[[None] * 4] * 3])}, "damaged"),
}


@pytest.mark.parametrize("case", ARRAYS)
def test_arrays_that_are_not_of_a_plan_are_refused(case, tmp_path):
    arrays, said = ARRAYS[case]
    run = make_run(tmp_path / "run", ROUND)
    save(run / "plan.npz", [ROUND], **arrays)
    assert said in refused(run)


def test_arrays_under_other_names_are_refused_as_another_version(tmp_path):
    run = make_run(tmp_path / "run", ROUND)
    np.savez_compressed(run / "plan.npz", plans=np.zeros((1, 3, 4)), seed=np.zeros(1, int))
    assert "plan.npz: lacks x, layout" in refused(run)


def test_bare_array_is_refused(tmp_path):
    run = make_run(tmp_path / "run", ROUND)
    (run / "plan.npz").write_bytes(bare(np.zeros((1, 3, 4))))
    assert "plan.npz" in refused(run)


def test_states_that_are_not_finite_before_the_end_of_an_episode_are_refused(tmp_path):
    run = make_run(tmp_path / "run", ROUND, rollout=[ROUND])
    save(run / "rollout.npz", [[ROUND[0], (np.nan,) * 4, ROUND[2]]])
    assert "rollout.npz: the state of seed 0 is not finite" in refused(run)
    save(run / "rollout.npz", [[ROUND[0], (0.0, 1.5, np.nan, 0.0)]])
    assert "rollout.npz: the state of seed 0 is not finite" in refused(run)


def test_rollout_of_other_seeds_is_refused(tmp_path):
    run = make_run(tmp_path / "run", ROUND, rollout=[ROUND])
    save(run / "rollout.npz", [ROUND], seed=np.array([7]))
    assert "its seeds are not those of plan.npz" in refused(run)


RECORDS = {
    "an unknown kind": (
        "kind: linear",
        "kind: lineer",
        'no kind "lineer" (did you mean "linear"?)',
    ),
    "an unknown coordinate": ("  x: 1.0", "  z: 1.0", 'no coordinate "z" in maze2d-umaze'),
    "an unknown task": ("task: maze2d-umaze", "task: maze3d", 'options.task: no task "maze3d"'),
    "an unknown field": ("radius: 1.0", "radius: 1.0\n    colour: red", "no such field here"),
    "no content": ("content:", "contents:", "constraints.content: this field is missing"),
    "no options": ("options:", "settings:", "options: this field is missing"),
    "nan": ("radius: 1.0", "radius: .nan", "finite"),
}


@pytest.mark.parametrize("case", RECORDS)
def test_bad_run_yaml_is_refused_with_line_and_field(case, tmp_path):
    before, after, said = RECORDS[case]
    run = make_run(tmp_path / "run", ROUND)
    text = (run / "run.yaml").read_text()
    assert before in text
    (run / "run.yaml").write_text(text.replace(before, after))
    line = refused(run)
    assert "run.yaml:" in line
    assert said in line


def test_certificate_of_another_format_is_refused(tmp_path):
    run = make_run(tmp_path / "run", ROUND)
    for other in ("[]", "{}", '{"format": 2}', "null", '{"format": 1}'):
        (run / "certificate.json").write_text(other)
        assert "expected a certificate of format 1" in refused(run)
    (run / "certificate.json").write_text('{"format": NaN}')
    assert "damaged" in refused(run)


HEAVY = (
    *("cdiff_cli.models.networks", "cdiff_cli.training.fit", "cdiff_cli.planning.open_loop"),
    *("safetensors", "gymnasium", "mujoco", "matplotlib", "scipy", "qpsolvers"),
)


def test_verify_loads_no_network_no_simulator_and_no_plotting(tmp_path):
    run = make_run(tmp_path / "run", ROUND)
    code = f"""
import sys
from typer.testing import CliRunner
from cdiff_cli.cli import app
result = CliRunner().invoke(app, ["verify", {str(run)!r}])
assert result.exit_code == 0, result.output
assert [name for name in {HEAVY!r} if name in sys.modules] == []
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
