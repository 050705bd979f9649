"""`cdiff compare`: its columns, its formats, its widths, its refusals."""

import csv
import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from cdiff_cli.commands.run_directory import write_rows
from tests.commands.test_cli import cdiff
from tests.evaluation.test_comparison import rows


@pytest.fixture
def folder(tmp_path):
    for name, methods in (("a", ("alm",)), ("b", ("projected", "diffuser"))):
        (tmp_path / name).mkdir()
        content = [
            line
            for i, method in enumerate(methods)
            for line in rows(method, 1.0 + i, smooth=1.0, violation_paper=0.5, jump=0.125)
        ]
        write_rows(tmp_path / name / "rows.csv", content)
    return tmp_path


@pytest.fixture
def three_kinds(tmp_path):
    """A folder with runs of all kinds: plans, a rollout of plans, a closed loop."""
    for kind, more in (
        ("plan", {"violation": 0.5}),
        ("rollout", {"violation_rate": 1.0, "safe_executed": 0.0}),
        ("control", {"violation_rate": 2.0, "plan_violation": 0.25, "reward": 9.0}),
    ):
        (tmp_path / kind).mkdir()
        write_rows(tmp_path / kind / "rows.csv", rows(kind, **more))
    return tmp_path


def headings(shown):
    """The columns of the first table of a markdown output, keys and n left out."""
    return [cell.strip() for cell in shown.splitlines()[0].strip("| ").split("|")][5:]


def test_few_columns_are_shown_unless_wide_or_named(folder):
    words = ("compare", folder, "--format", "markdown")
    assert headings(cdiff(*words).stdout) == ["torn", "distance / m"]
    wide = headings(cdiff(*words, "--wide").stdout)
    assert wide == ["distance / m", "torn", "jump / m"]
    assert headings(cdiff(*words, "--columns", "jump, torn").stdout) == ["jump / m", "torn"]


def test_json_and_csv_hold_every_column(folder):
    record = json.loads(cdiff("compare", folder, "--format", "json").stdout)["plans"][0]
    assert {"distance", "torn", "jump"} <= set(record)
    lines = list(csv.DictReader(io.StringIO(cdiff("compare", folder, "--format", "csv").stdout)))
    assert {line["metric"] for line in lines} == {"distance", "torn", "jump"}


def test_csv_of_all_kinds_of_runs_has_one_header(three_kinds):
    text = cdiff("compare", three_kinds, "--format", "csv").stdout
    lines = list(csv.DictReader(io.StringIO(text)))
    assert {line["kind"] for line in lines} == {"plans", "rollouts", "closed loop"}
    assert text.count("kind,task,constraints") == 1
    for line in lines:
        float(line["mean"]), int(line["n"]), float(line["standard_error"])


@pytest.mark.parametrize("width", [80, 100])
@pytest.mark.parametrize(
    "more", [(), ("--wide",), ("--paper",), ("--against", "alm"), ("--intervals",)]
)
def test_no_heading_is_wrapped_and_no_line_too_long(width, more, tmp_path, monkeypatch):
    """On the shipped rows of the U-maze: ten methods, three presets."""
    shipped = Path(__file__).parents[2] / "runs" / "reference" / "table1-umaze"
    (tmp_path / "run").symlink_to(shipped)
    screen = io.StringIO()
    monkeypatch.setattr("cdiff_cli.cli.out", Console(file=screen, width=width))
    cdiff("compare", tmp_path, *more)
    printed = screen.getvalue().splitlines()
    assert max(map(len, printed)) <= width
    rules = [i for i, line in enumerate(printed) if line and set(line) == {"─"}]
    assert rules
    for i in rules:
        assert printed[i - 1].startswith(("method", "preset"))


def test_compare_against_a_method_prints_its_tests(folder):
    shown = cdiff(
        "compare", folder, "--against", "alm", "--intervals", "--format", "markdown"
    ).stdout
    assert "| p (Holm) |" in shown
    assert "| projected |" in shown
    assert "[" in shown
    found = json.loads(
        cdiff("compare", folder, "--against", "alm", "--test", "t", "--format", "json").stdout
    )
    assert {each["method"] for each in found["plans against alm"]} == {"projected", "diffuser"}


def test_compare_with_the_paper_has_its_notes(folder):
    assert (
        "±: ours is the standard error"
        in cdiff("compare", folder, "--paper", "--format", "markdown").stdout
    )
    csv = cdiff("compare", folder, "--paper", "--format", "csv")
    assert "note: ±" in csv.stderr
    assert "note:" not in csv.stdout
    assert json.loads(cdiff("compare", folder, "--paper", "--format", "json").stdout)["notes"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--against", "almm"], '--against: no runs of "almm"'),
        (["--against", "alm", "--test", "u"], "--test: expected wilcoxon or t, found u"),
        (["--format", "xml"], 'no format "xml"'),
        (["--columns", "jumps"], '--columns: no column "jumps" (did you mean "jump"?)'),
        (["--columns", ","], "--columns: expected names such as violation,torn, found none"),
        (["--columns", "reward"], "--columns: no run here has reward"),
        (["--columns", "jump", "--wide"], "--columns and --wide: choose one of them"),
    ],
)
def test_bad_option_of_compare_is_refused_in_one_line(words, message, folder):
    stderr = cdiff("compare", folder, *words, code=2).stderr
    assert message in stderr
    assert len(stderr.strip().splitlines()) == 1
