"""The comparison as text, in every format."""

import csv
import io
import json
import math
from pathlib import Path

import pytest
from rich.console import Console

from cdiff_cli.evaluation.columns import COLUMNS, CONTROL_TABLE, FORMATS, KEYS, PAPER_TABLE
from cdiff_cli.evaluation.comparison import compare, differences
from cdiff_cli.evaluation.layout import terminal
from cdiff_cli.evaluation.tables import (
    csv_table,
    notes,
    read_paper,
    render,
    render_differences,
    text_table,
)
from tests.evaluation.test_comparison import row, rows

METRICS = ("distance_paper", "violation_paper", "steps")
ROWS = [
    {
        "task": "maze2d-umaze",
        "constraints": "corner_cut",
        "method": method,
        "preset": "paper",
        "seed": str(seed),
    }
    | {"distance_paper": 9.0 + seed, "violation_paper": 0.25}
    for method in ("diffuser", "alm")
    for seed in range(3)
]
GROUPS = compare(ROWS)
PAPER = {("maze2d-umaze", "alm"): {"distance_paper": "9.81 ± 1.65"}}
OURS = "10.00 ± 0.58"  # of 9, 10, 11: standard error 1 / sqrt(3)


def text(style: str, paper=None, title: str = "") -> str:
    table = render(GROUPS, METRICS, style, paper, title)
    if isinstance(table, str):
        return table
    out = io.StringIO()
    Console(file=out, width=200).print(table)
    return out.getvalue()


@pytest.mark.parametrize("style", FORMATS)
def test_every_format_holds_methods_and_values(style):
    shown = text(style)
    assert "diffuser" in shown
    assert "alm" in shown
    digits = {"latex": r"10.00 $\pm$ 0.58", "json": "0.577350269", "csv": "10.0,0.577350269"}
    expected = digits.get(style, OURS)
    assert expected in shown


@pytest.mark.parametrize("style", FORMATS)
def test_every_format_holds_the_papers_value(style):
    printed = {"latex": r"9.81 $\pm$ 1.65", "json": r"9.81 \u00b1 1.65", "csv": "9.81,1.65"}
    expected = printed.get(style, "9.81 ± 1.65")
    assert expected in text(style, PAPER)
    assert expected not in text(style)


def test_header_names_units_and_leaves_out_metrics_without_values():
    table = text_table(GROUPS, METRICS)
    header, lines = table.header, table.lines
    assert header == [*KEYS, "n", COLUMNS["distance_paper"].title, COLUMNS["violation_paper"].title]
    assert lines[1] == ["maze2d-umaze", "corner_cut", "alm", "paper", "3", OURS, "0.2500"]


def test_column_of_the_paper_is_beside_ours_and_empty_where_it_has_no_value():
    table = text_table(GROUPS, METRICS, PAPER)
    header, lines = table.header, table.lines
    assert header[5:] == [
        COLUMNS["distance_paper"].title,
        "paper",
        COLUMNS["violation_paper"].title,
    ]
    assert lines[0][5:7] == [OURS, ""]
    assert lines[1][5:7] == [OURS, "9.81 ± 1.65"]


def read(text):
    return list(csv.DictReader(io.StringIO(text)))


def test_csv_has_one_line_per_group_and_metric_with_a_number_per_cell():
    lines = read(text("csv", title="plans"))
    assert list(lines[0]) == ["kind", *KEYS, "metric", "n", "mean", "standard_error"]
    assert [(line["method"], line["metric"]) for line in lines] == [
        ("diffuser", "distance_paper"),
        ("diffuser", "violation_paper"),
        ("alm", "distance_paper"),
        ("alm", "violation_paper"),
    ]
    assert (lines[2]["kind"], lines[2]["n"], lines[2]["mean"]) == ("plans", "3", "10.0")
    assert float(lines[2]["standard_error"]) == pytest.approx(3**-0.5, abs=1e-15)


def test_csv_has_interval_bounds_in_columns_where_requested_and_empty_cells_without_value():
    groups = compare([row(0, distance=2.0), row(1, distance=2.0, jump=1.0)], intervals=True)
    first, second = read(render(groups, ("distance", "jump"), "csv"))
    assert (first["mean"], first["standard_error"]) == ("2.0", "0.0")
    assert (first["low"], first["high"], first["n"]) == ("2.0", "2.0", "2")
    assert [second[name] for name in ("n", "mean", "standard_error", "low", "high")] == [
        *("1", "1.0", "", "", "")
    ]


def test_csv_has_the_papers_value_and_its_error_as_numbers():
    lines = read(text("csv", PAPER))
    assert [(line["paper"], line["paper_error"]) for line in lines] == [
        *[("", "")] * 2,
        ("9.81", "1.65"),
        ("", ""),
    ]


def test_csv_has_the_tests_against_a_method_in_the_lines_of_the_metric():
    results = [*rows("projected", 1.0), *rows("alm")]
    tested = [("plans", one) for one in differences(results, "alm", ["distance"])]
    lines = read(csv_table([("plans", compare(results), ["distance"])], None, tested))
    assert [line["method"] for line in lines] == ["projected", "alm"]
    names = ("pairs", "difference", "difference_low", "difference_high", "p", "p_holm")
    assert [lines[0][name] for name in names] == ["6", "1.0", "1.0", "1.0", "0.03125", "0.03125"]
    assert [lines[1][name] for name in names] == [""] * 6


def test_json_holds_full_precision_mean_error_and_n():
    records = json.loads(text("json", PAPER))
    assert [record["method"] for record in records] == ["diffuser", "alm"]
    cell = records[1]["distance_paper"]
    assert (cell["mean"], cell["n"]) == (10.0, 3)
    assert cell["standard_error"] == pytest.approx(3**-0.5)
    assert records[1]["paper"] == {"distance_paper": "9.81 ± 1.65"}
    assert "paper" not in records[0]


def test_json_of_a_single_row_has_no_standard_error():
    record = json.loads(render(compare(ROWS[:1]), METRICS, "json"))[0]
    assert record["distance_paper"] == {"mean": 9.0, "standard_error": None, "n": 1}


def test_markdown_has_as_many_cells_in_every_line():
    lines = text("markdown", PAPER).splitlines()
    assert len(lines) == 4
    assert len({line.count("|") for line in lines}) == 1
    assert lines[1].startswith("| --- |")
    assert lines[1].endswith("| ---: |")


def test_latex_is_one_tabular_with_its_special_characters_escaped():
    shown = text("latex", PAPER)
    assert shown.startswith(r"\begin{tabular}{llllrrrr}")
    assert shown.endswith(r"\end{tabular}")
    assert r"corner\_cut" in shown
    assert shown.count(" & ") == 3 * 7


def test_terminal_title_holds_the_keys_that_all_rows_share():
    shown = text("rich", title="plans")
    assert "plans · maze2d-umaze, corner_cut, paper, n = 3" in shown
    assert shown.count("maze2d-umaze") == 1


def matrix(constraints=("corner", "disc"), presets=("paper", "recommended")):
    """Comparison of two methods with long names, constraint files and presets."""
    return compare(
        [
            row(seed, method, preset, constraints=file, distance=seed + 0.5, jump=seed + 0.25)
            for file in constraints
            for preset in presets
            for method in ("final-projection", "projected")
            for seed in range(2)
        ]
    )


def drawn(groups, metrics, width, drop=False):
    shown, left_out = terminal(text_table(groups, metrics), "plans", width, drop)
    out = io.StringIO()
    Console(file=out, width=width).print(shown)
    lines = [line.rstrip() for line in out.getvalue().splitlines()]
    assert max(map(len, lines)) <= width
    return lines, left_out


def test_terminal_makes_constraint_files_headings_and_shows_what_differs_only():
    lines, left_out = drawn(matrix(), ("distance", "jump"), 100)
    assert lines[0] == "plans · maze2d-umaze, n = 2"
    assert [line for line in lines if line in ("corner", "disc")] == ["corner", "disc"]
    headings = [line.split() for line in lines if line.startswith("method")]
    assert headings == [["method", "preset", "distance", "/", "m", "jump", "/", "m"]] * 2
    assert left_out == []


def test_narrow_terminal_makes_presets_headings_too():
    lines, left_out = drawn(matrix(), ("distance", "jump"), 50)
    assert [line for line in lines if "," in line][1:] == [
        *("corner, paper", "corner, recommended", "disc, paper", "disc, recommended")
    ]
    assert left_out == []


def test_terminal_leaves_out_columns_that_do_not_fit_or_puts_them_below():
    groups = matrix(presets=("paper",))
    lines, left_out = drawn(groups, ("distance", "jump"), 32, drop=True)
    assert left_out == ["jump / m"]
    assert not any("jump" in line for line in lines)
    lines, left_out = drawn(groups, ("distance", "jump"), 36)
    assert left_out == []
    assert sum("distance / m" in line for line in lines) == 2
    assert sum("jump / m" in line for line in lines) == 2
    assert not any("distance" in line and "jump" in line for line in lines)


def test_column_of_the_paper_stays_in_the_table_of_ours():
    table = text_table(GROUPS, METRICS, PAPER)
    shown, _ = terminal(table, "", 40)
    out = io.StringIO()
    Console(file=out, width=40).print(shown)
    (line,) = [line for line in out.getvalue().splitlines() if " paper" in line and "dist" in line]
    assert line.split() == ["method", "distance", "(paper)", "paper"]


@pytest.mark.parametrize("style", FORMATS)
def test_no_groups_make_an_empty_table(style):
    assert render([], METRICS, style) is not None


def test_runs_of_one_seed_have_a_distance_beside_the_papers_values():
    """Of one plan there is no mean unconstrained one: a sweep's runs have no distance (paper)."""
    groups = compare(
        [
            {
                **dict(zip(KEYS, ("maze2d-umaze", "maze2d-umaze", "alm", "paper"), strict=True)),
                "seed": "0",
                "distance": 2.0,
            }
        ]
    )
    table = text_table(groups, PAPER_TABLE, PAPER)
    header, (line,) = table.header, table.lines
    assert (header[5:], line[5:]) == (["distance / m"], ["2.00"])
    assert [note for note in notes(groups, PAPER_TABLE) if note.startswith("distance / m: ")]


def test_the_shipped_paper_values_are_read():
    paper = read_paper(Path(__file__).parents[2] / "runs" / "reference" / "paper.csv")
    assert paper["maze2d-umaze", "alm"]["distance_paper"] == "9.81 ± 1.65"
    assert {name for values in paper.values() for name in values} <= set(COLUMNS) & {
        *PAPER_TABLE,
        *CONTROL_TABLE,
    }


def test_cell_of_fewer_values_than_rows_shows_its_n():
    groups = compare([row(0, distance=1.0, jump=2.0), row(1, distance=3.0), row(2, distance=3.0)])
    lines = text_table(groups, ("distance", "jump")).lines
    assert lines[0][-1] == "2.0000 (n = 1)"


@pytest.mark.parametrize("style", FORMATS)
def test_every_format_holds_the_differences(style):
    found = differences([*rows("projected", 1.0), *rows("alm")], "alm", ["distance"])
    table = render_differences(found, style, "plans against alm")
    if style != "rich":
        assert "projected" in table
        assert ("0.03125" if style == "json" else "0.031") in table


def test_notes_are_about_shown_metrics_and_methods_only():
    groups = compare([row(0, "guidance", "released*", violation_paper=1.0)])
    said = " ".join(notes(groups, ("violation_paper", "step_ms")))
    assert "guidance: what the released maze code calls Conditional" in said
    assert "violation (paper)" in said
    assert "released: frozen steps" in said
    assert "step / ms" not in said


def test_json_of_an_infinite_metric_is_json():
    said = render(compare([row(0, effort=math.inf), row(1, effort=1.0)]), ["effort"], "json")
    assert json.loads(said, parse_constant=pytest.fail)[0]["effort"] == {
        "mean": None,
        "standard_error": None,
        "n": 2,
    }
