"""The comparison as text, in every format."""

import csv
import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from cdiff_cli.evaluation.columns import COLUMNS, CONTROL_TABLE, FORMATS, KEYS, PAPER_TABLE
from cdiff_cli.evaluation.comparison import compare
from cdiff_cli.evaluation.tables import notes, read_paper, render

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
    expected = {"latex": r"10.00 $\pm$ 0.58", "json": "0.577350269"}.get(style, OURS)
    assert expected in shown


@pytest.mark.parametrize("style", FORMATS)
def test_every_format_holds_the_papers_value(style):
    expected = (
        r"9.81 $\pm$ 1.65"
        if style == "latex"
        else "9.81 \\u00b1 1.65"
        if style == "json"
        else "9.81 ± 1.65"
    )
    assert expected in text(style, PAPER)
    assert expected not in text(style)


def test_header_names_units_and_leaves_out_metrics_nobody_has():
    header, lines = header_and_lines(GROUPS, METRICS, None)
    assert header == [*KEYS, "n", COLUMNS["distance_paper"].title, COLUMNS["violation_paper"].title]
    assert lines[1] == ["maze2d-umaze", "corner_cut", "alm", "paper", "3", OURS, "0.2500"]


def test_the_papers_column_stands_beside_ours_and_is_empty_where_it_is_silent():
    header, lines = header_and_lines(GROUPS, METRICS, PAPER)
    assert header[5:] == [
        COLUMNS["distance_paper"].title,
        "paper",
        COLUMNS["violation_paper"].title,
    ]
    assert lines[0][5:7] == [OURS, ""]
    assert lines[1][5:7] == [OURS, "9.81 ± 1.65"]


def test_csv_reads_back_as_header_and_lines():
    header, lines = header_and_lines(GROUPS, METRICS, PAPER)
    assert list(csv.reader(io.StringIO(text("csv", PAPER)))) == [header, *lines]


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


def test_rich_moves_what_all_rows_share_into_the_title():
    shown = text("rich", title="plans")
    assert "plans · maze2d-umaze, corner_cut, paper" in shown
    assert shown.count("maze2d-umaze") == 1


@pytest.mark.parametrize("style", FORMATS)
def test_no_groups_make_an_empty_table(style):
    assert render([], METRICS, style) is not None


def test_beside_the_papers_values_runs_of_one_seed_have_a_distance_too():
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
    header, (line,) = header_and_lines(groups, PAPER_TABLE, PAPER)
    assert (header[5:], line[5:]) == (["distance / m"], ["2.00"])
    assert [note for note in notes(groups, PAPER_TABLE) if note.startswith("distance / m: ")]


def test_the_shipped_paper_values_are_read():
    paper = read_paper(Path(__file__).parents[2] / "runs" / "reference" / "paper.csv")
    assert paper["maze2d-umaze", "alm"]["distance_paper"] == "9.81 ± 1.65"
    assert {name for values in paper.values() for name in values} <= set(COLUMNS) & {
        *PAPER_TABLE,
        *CONTROL_TABLE,
    }
