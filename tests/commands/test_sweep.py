"""`cdiff sweep`: its matrix, the runs it makes and skips, failures, interruptions."""

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from cdiff_cli.commands import resolve, rollout, sweep
from cdiff_cli.commands.run_directory import merge_kinds
from cdiff_cli.commands.sweep import Matrix, Outcome, plan_sweep, progress_table, run_job
from cdiff_cli.errors import CdiffError
from cdiff_cli.evaluation.columns import COSTS
from cdiff_cli.evaluation.comparison import newest
from cdiff_cli.planning.receding_horizon import rollout as act
from tests.commands.test_cli import cdiff

ROOT = Path(__file__).parents[2]
GAUSSIAN = (
    "sweep",
    "--task",
    "gaussian2d",
    "--presets",
    "recommended",
    "--methods",
    "diffuser,projected",
    "--seeds",
    "3",
)


def matrix(methods=("projected",), seeds=(0, 1), **more):
    return Matrix(["gaussian2d"], methods, ["recommended"], [None], seeds, **more)


def table(root):
    """What `compare` averages, without times: the newest row per seed.

    A worker may end its run after its sweep was killed, and leave a second row of a seed.
    """
    plans, _ = merge_kinds(root)
    rows = [row for by_seed in newest(plans).values() for _, row in sorted(by_seed.items())]
    return [{name: value for name, value in row.items() if name not in COSTS} for row in rows]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted sweep in one process."""
    root = tmp_path_factory.mktemp("whole")
    cdiff(*GAUSSIAN, "--runs", root)
    return root


def test_sweep_makes_one_run_per_seed_and_a_second_sweep_none(whole):
    assert len(table(whole)) == 6
    before = sorted(whole.iterdir())
    result = cdiff(*GAUSSIAN, "--runs", whole)
    assert "made" not in result.stderr
    assert sorted(whole.iterdir()) == before


def test_killed_and_continued_sweep_ends_as_an_uninterrupted_one(whole, tmp_path):
    program = [
        sys.executable,
        "-c",
        "from cdiff_cli.cli import app; app()",
        *GAUSSIAN,
        "--runs",
        str(tmp_path),
        "--jobs",
        "2",
    ]
    with subprocess.Popen(program, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        assert "of 6: made" in process.stderr.readline()
        assert "of 6: made" in process.stderr.readline()
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert len(list(tmp_path.glob("[!.]*/rows.csv"))) >= 2
    assert cdiff(*GAUSSIAN, "--runs", tmp_path).stderr.count("made") <= 4
    assert table(tmp_path) == table(whole)


def test_changed_constants_of_a_method_make_other_runs(whole, monkeypatch):
    assert len(plan_sweep(matrix(), whole).done) == 2
    load = resolve.resolve

    def other(options):
        resolved = load(options)
        resolved.settings["on"] = "clean"
        return resolved

    monkeypatch.setattr(sweep, "resolve", other)
    assert len(plan_sweep(matrix(), whole).todo) == 2


def test_half_written_run_is_not_done(whole, tmp_path):
    (job,) = plan_sweep(matrix(seeds=[0]), tmp_path).todo
    partial = tmp_path / f".20260101-000000-{job.name}-abc"
    partial.mkdir()
    (partial / "rows.csv").write_text("")
    assert plan_sweep(matrix(seeds=[0]), tmp_path).todo == [job]


def test_failing_run_is_reported_and_does_not_stop_the_others(tmp_path, monkeypatch):
    def broken(*arguments, **more):
        raise ZeroDivisionError("a\nb")

    real = run_job

    def sometimes(job, root, folder):
        if job.options.seed == 0:
            monkeypatch.setattr("cdiff_cli.commands.plan.plan_run", broken)
            outcome = real(job, root, folder)
            monkeypatch.undo()
            return outcome
        return real(job, root, folder)

    monkeypatch.setattr(sweep, "run_job", sometimes)
    result = cdiff(
        "sweep",
        "--task",
        "gaussian2d",
        "--methods",
        "projected",
        "--seeds",
        "2",
        "--runs",
        tmp_path,
        code=1,
    )
    assert "ZeroDivisionError: a b" in result.stderr
    assert len(table(tmp_path)) == 1


def test_refused_job_is_reported_and_does_not_stop_the_others(tmp_path):
    words = ("--methods", "conditional,diffuser", "--seeds", "1", "--runs", tmp_path)
    result = cdiff("sweep", "--task", "gaussian2d", *words, code=1)
    assert "conditional: this task's score is exact" in result.stderr
    assert [row["method"] for row in table(tmp_path)] == ["diffuser"]


def test_job_runs_on_one_thread_and_restores_their_number(tmp_path, monkeypatch):
    seen = []

    def plan_run(*_, **__):
        seen.append(torch.get_num_threads())
        return SimpleNamespace(rows=())

    monkeypatch.setattr("cdiff_cli.commands.plan.plan_run", plan_run)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    (job,) = plan_sweep(matrix(seeds=[0]), tmp_path).todo
    assert run_job(job, tmp_path, Path.cwd()).error is None
    assert (seen, torch.get_num_threads()) == ([1], 2)
    torch.set_num_threads(before)


def test_progress_table_counts_done_failed_and_all_runs(tmp_path):
    plan = plan_sweep(matrix(("projected", "conditional")), tmp_path)
    assert (len(plan.todo), len(plan.refused)) == (2, 2)
    shown = progress_table([*plan.refused, Outcome(plan.todo[0], 2.0)], plan, 0.0)
    assert "0 were there, 1 made, 1 to do" in shown.title
    assert [list(column.cells) for column in shown.columns][4:] == [
        ["1", "0"],
        ["0", "0"],
        ["0", "2"],
        ["2", "2"],
        ["2.0", ""],
    ]


def test_diverged_episode_is_reported_when_made_and_when_it_was_there(tmp_path, monkeypatch):
    def spoilt(controller, task, seeds, *rest, **more):
        """The plans of seed 1 are not finite after its first steps."""
        done = act(controller, task, seeds, *rest, steps=3, **more)
        return replace(done, diverged=np.array([seed == 1 for seed in seeds]))

    monkeypatch.setattr(rollout, "rollout", spoilt)
    words = (
        "sweep",
        "--task",
        "ball-run",
        "--rollout",
        "--methods",
        "diffuser",
        "--seeds",
        2,
        "--runs",
        tmp_path,
    )
    first = cdiff(*words, code=1).stderr
    assert "made, diverged: rollout-ball-run-ball-run-diffuser-recommended-seed1" in first
    for said in (first, cdiff(*words, code=1).stderr):
        (line,) = [line for line in said.splitlines() if line.startswith("diverged: ")]
        assert "seed1" in line
        assert "no longer finite" in line
    plan = plan_sweep(
        Matrix(["ball-run"], ["diffuser"], ["recommended"], [None], [0, 1, 2], rollout=True),
        tmp_path,
    )
    shown = progress_table([], plan, 0.0)
    assert [list(column.cells) for column in shown.columns][4:] == [
        ["2"],
        ["1"],
        ["0"],
        ["3"],
        [""],
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--methods", "almm"], '--methods: no method "almm" (did you mean "alm"?)'),
        (["--presets", "papr"], '--presets: no preset "papr"'),
        (["--task", "maze"], 'no task "maze"'),
        (["--constraints", "none.yaml"], "--constraints: none.yaml: no such file"),
        (["--jobs", "0"], "--jobs: expected at least 1"),
        (["--seeds", "0"], "--seeds: expected at least 1"),
        (["--backend", "rai"], '--backend: no backend "rai"'),
        (["--address", "localhost:1"], "--address: the runs are local"),
    ],
)
def test_bad_option_is_refused_in_one_line_and_writes_nothing(words, message, tmp_path):
    stderr = cdiff("sweep", *words, "--runs", tmp_path / "runs", code=2).stderr
    assert message in stderr
    assert len(stderr.strip().splitlines()) == 1
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("backend", ["ray", "dask"])
def test_backend_that_is_not_installed_names_its_extra(backend, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, backend, None)
    words = ("--task", "gaussian2d", "--methods", "diffuser", "--seeds", "1", "--backend", backend)
    assert (
        f"pip install 'cdiff-cli[{backend}]'"
        in cdiff("sweep", *words, "--runs", tmp_path, code=2).stderr
    )


def cluster(monkeypatch, cpus=None):
    """A Ray of that many CPUs, which no address reaches where None."""

    def init(**_):
        if cpus is None:
            raise ConnectionError("nobody\nthere")

    ray = SimpleNamespace(init=init, shutdown=lambda: None, cluster_resources=lambda: {"CPU": cpus})
    for name, module in (
        ("ray", ray),
        ("ray.util", None),
        ("ray.util.joblib", SimpleNamespace(register_ray=lambda: None)),
    ):
        monkeypatch.setitem(sys.modules, name, module)


RAY = (
    "sweep",
    "--task",
    "gaussian2d",
    "--methods",
    "diffuser",
    "--seeds",
    1,
    "--backend",
    "ray",
    "--address",
    "head:1",
)


def test_address_where_no_cluster_answers_is_refused_in_one_line(tmp_path, monkeypatch):
    cluster(monkeypatch)
    stderr = cdiff(*RAY, "--runs", tmp_path, code=2).stderr
    assert stderr == "error: --address head:1: no ray cluster answers there: nobody there\n"


def test_more_jobs_than_a_ray_cluster_has_cpus_are_refused(tmp_path, monkeypatch):
    cluster(monkeypatch, cpus=2)
    stderr = cdiff(*RAY, "--jobs", 3, "--runs", tmp_path, code=2).stderr
    assert "--jobs: the Ray cluster has 2 CPUs, one for each job; found 3" in stderr


def test_names_of_a_sweep_are_checked_before_anything_is_resolved(monkeypatch, tmp_path):
    monkeypatch.setattr(sweep, "resolve", None)
    with pytest.raises(CdiffError, match="no method"):
        plan_sweep(matrix(("none",)), tmp_path)
