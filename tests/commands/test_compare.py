"""Derived columns, intervals and paired differences of a comparison, and the command that prints them."""

import json

import pytest

from cdiff_cli.commands.run_directory import write_rows
from cdiff_cli.evaluation.columns import COLUMNS
from cdiff_cli.evaluation.comparison import Cell, compare, differences
from cdiff_cli.evaluation.statistics import clopper_pearson
from cdiff_cli.evaluation.tables import FORMATS, header_and_lines, notes, render_differences
from tests.commands.test_cli import cdiff
from tests.commands.test_run_directory import row


def rows(method="alm", base=0.0, n=6, **more):
    return [row(seed, method, distance=base + seed**2, **more) for seed in range(n)]


def test_torn_is_one_minus_smooth():
    (group,) = compare([row(0, smooth=1.0), row(1, smooth=0.0), row(2, smooth=0.0)])
    assert group.cells["torn"].mean == pytest.approx(2 / 3)


def test_shares_are_known_by_their_meaning():
    assert {name for name, column in COLUMNS.items() if column.share} >= {
        "torn",
        "smooth",
        "success",
        "safe_executed",
        "wall",
    }
    assert not COLUMNS["violation_rate"].share  # percent of the states of one episode


def test_intervals_stand_beside_the_mean_and_not_at_costs():
    (group,) = compare(
        [row(i, success=float(i > 1), calls=64.0, distance=float(i)) for i in range(10)],
        intervals=True,
    )
    assert group.cells["success"].interval == clopper_pearson(8, 10)
    assert group.cells["success"].text(2) == "0.80 ± 0.13 [0.44, 0.97]"
    assert group.cells["calls"].text(0) == "64"
    assert Cell(1.0, 0.0, 5, (0.48, 1.0)).text(2) == "1.00 [0.48, 1.00]"


def test_a_cell_of_fewer_values_than_rows_says_so():
    groups = compare([row(0, distance=1.0, jump=2.0), row(1, distance=3.0), row(2, distance=3.0)])
    _, lines = header_and_lines(groups, ("distance", "jump"), None)
    assert lines[0][-1] == "2.0000 (n = 1)"


def test_differences_are_paired_by_seed_within_task_constraints_and_preset():
    mine, theirs = rows("projected", 1.0), rows("alm", 0.0)[:5]
    other = [row(seed, "projected", "paper", "maze2d-large", distance=99.0) for seed in range(6)]
    (found,) = differences([*mine, *theirs, *other], "alm", ["distance"])
    assert found.key == ("maze2d-umaze", "corner", "projected", "paper")
    assert (found.n, found.mean, found.interval) == (5, 1.0, (1.0, 1.0))
    assert found.p == found.holm == pytest.approx(2 / 2**5)


def test_holm_corrects_all_tests_of_one_metric():
    many = [
        r
        for i, name in enumerate(("diffuser", "projected", "primal-dual"))
        for r in rows(name, 1.0 + i)
    ]
    found = differences([*many, *rows("alm")], "alm", ["distance", "calls"])
    assert [each.holm for each in found] == pytest.approx([3 * 2 / 2**6] * 3)


def test_a_metric_that_nowhere_differs_is_left_out():
    assert (
        differences(
            [*rows("projected", steps=5.0), *rows("alm", 1.0, steps=5.0)],
            "alm",
            ["steps", "distance"],
        )[0].metric
        == "distance"
    )


@pytest.mark.parametrize("style", FORMATS)
def test_every_format_holds_the_differences(style):
    found = differences([*rows("projected", 1.0), *rows("alm")], "alm", ["distance"])
    table = render_differences(found, style, "plans against alm")
    if style != "rich":
        assert "projected" in table
        assert ("0.03125" if style == "json" else "0.031") in table


def test_notes_name_what_is_shown_alone():
    groups = compare([row(0, "guidance", "released*", violation_paper=1.0)])
    said = " ".join(notes(groups, ("violation_paper", "step_ms")))
    assert "guidance: what the released maze code calls Conditional" in said
    assert "violation (paper)" in said
    assert "released: frozen steps" in said
    assert "step / ms" not in said


@pytest.fixture
def folder(tmp_path):
    for name, methods in (("a", ("alm",)), ("b", ("projected", "diffuser"))):
        (tmp_path / name).mkdir()
        made = [
            r
            for i, m in enumerate(methods)
            for r in rows(m, 1.0 + i, smooth=1.0, violation_paper=0.5)
        ]
        write_rows(tmp_path / name / "rows.csv", made)
    return tmp_path


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
    ],
)
def test_a_bad_option_of_compare_is_one_clear_line(words, message, folder):
    stderr = cdiff("compare", folder, *words, code=2).stderr
    assert message in stderr
    assert len(stderr.strip().splitlines()) == 1
