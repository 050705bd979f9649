"""Run directories, their rows, and the comparison of many runs."""

import json
import math
import types

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cdiff_cli.commands.run_directory
from cdiff_cli.commands.run_directory import (
    find_rows,
    merge_kinds,
    new_run,
    read_rows,
    write_rows,
    write_yaml,
)
from cdiff_cli.errors import CdiffError
from cdiff_cli.evaluation.columns import COLUMNS, KEYS
from cdiff_cli.evaluation.comparison import Cell, compare
from cdiff_cli.evaluation.tables import render


def row(
    seed: int = 0, method: str = "alm", preset: str = "paper", task: str = "maze2d-umaze", **metrics
) -> dict:
    return {
        "task": task,
        "constraints": "corner",
        "method": method,
        "preset": preset,
        "seed": seed,
        **metrics,
    }


# directories ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def noon(monkeypatch) -> None:
    monkeypatch.setattr(
        cdiff_cli.commands.run_directory,
        "time",
        types.SimpleNamespace(strftime=lambda _: "20250102-120000"),
    )


@pytest.mark.usefixtures("noon")
def test_a_finished_run_stands_under_its_time_and_name(tmp_path):
    root = tmp_path / "runs"
    with new_run(root, "plan-umaze") as run:
        (run.path / "rows.csv").write_text("a")
        assert run.path.name.startswith(".")
    assert [path.name for path in root.iterdir()] == ["20250102-120000-plan-umaze"]
    assert run.path == root / "20250102-120000-plan-umaze"
    assert (run.path / "rows.csv").read_text() == "a"
    assert run.path.stat().st_mode & 0o777 == 0o755


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_run_that_fails_leaves_nothing_behind(error, tmp_path):
    def fail():
        with new_run(tmp_path, "plan") as run:
            (run.path / "rows.csv").write_text("a")
            raise error

    with pytest.raises(error):
        fail()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("noon")
def test_runs_of_the_same_second_get_a_number(tmp_path):
    paths = []
    for _ in range(3):
        with new_run(tmp_path, "plan") as run:
            pass
        paths.append(run.path.name)
    assert paths == ["20250102-120000-plan", "20250102-120000-plan-1", "20250102-120000-plan-2"]


def test_an_unfinished_run_is_not_found(tmp_path):
    with new_run(tmp_path, "plan") as run:
        write_rows(run.path / "rows.csv", [row()])
        assert find_rows(tmp_path) == []
    assert find_rows(tmp_path) == [run.path / "rows.csv"]


# rows -----------------------------------------------------------------------------------------------------------------


def test_rows_round_trip_with_metrics_as_numbers(tmp_path):
    path = tmp_path / "rows.csv"
    write_rows(path, [row(0, distance=1.5, jump=0.1), row(1, distance=-2.0, jump=1e-300)])
    assert read_rows(path) == [
        row("0", distance=1.5, jump=0.1),
        row("1", distance=-2.0, jump=1e-300),
    ]


def test_an_empty_metric_stays_empty(tmp_path):
    path = tmp_path / "rows.csv"
    write_rows(path, [row(0, distance="", jump=0.5)])
    assert read_rows(path) == [row("0", distance="", jump=0.5)]


def test_no_rows_round_trip(tmp_path):
    write_rows(tmp_path / "rows.csv", [])
    assert read_rows(tmp_path / "rows.csv") == []


@settings(max_examples=30, deadline=None)
@given(values=st.lists(st.floats(allow_nan=False), min_size=1, max_size=5))
def test_every_number_survives_the_file_to_the_last_bit(values, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "numbers.csv"
    write_rows(path, [row(i, violation=value) for i, value in enumerate(values)])
    assert [line["violation"] for line in read_rows(path)] == values


GOOD = "task,constraints,method,preset,seed,distance\nt,c,alm,paper,0,1.0\n"
MALFORMED = {
    "text for a metric": (GOOD + "t,c,alm,paper,1,far\n", "3: distance is not a number: 'far'"),
    "a short row": (GOOD + "t,c\n", "3: not a row of a run: it lacks method, preset"),
    "a missing column": (GOOD.replace("method,", ""), "2: not a row of a run: it lacks method"),
    "another kind of file": (
        "hello\nworld\n",
        "2: not a row of a run: it lacks task, constraints, method, preset",
    ),
    "an empty line above": (
        GOOD + "\n\nt,c,alm,paper,1,far\n",
        "5: distance is not a number: 'far'",
    ),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_rows_name_file_and_line(case, tmp_path):
    text, said = MALFORMED[case]
    path = tmp_path / "rows.csv"
    path.write_text(text)
    with pytest.raises(CdiffError) as caught:
        read_rows(path)
    assert str(caught.value) == f"{path}:{said}"


def test_missing_and_binary_files_cannot_be_read(tmp_path):
    binary = tmp_path / "rows.csv"
    binary.write_bytes(b"\xff\xfe\x80\x81")
    for path in (tmp_path / "none.csv", binary):
        with pytest.raises(CdiffError, match=r"csv: cannot be read"):
            read_rows(path)


def test_written_yaml_keeps_its_order_and_letters(tmp_path):
    write_yaml(tmp_path / "run.yaml", {"b": 1, "a": "é"})
    assert (tmp_path / "run.yaml").read_text(encoding="utf-8") == "b: 1\na: é\n"


# comparison -----------------------------------------------------------------------------------------------------------


def test_mean_and_standard_error_by_hand():
    (group,) = compare([row(seed, distance=value) for seed, value in enumerate((1.0, 2.0, 3.0))])
    assert group.n == 3
    assert group.cells["distance"].mean == 2.0
    assert group.cells["distance"].error == pytest.approx(
        1 / math.sqrt(3)
    )  # the sample's standard deviation is 1


def test_one_row_has_no_standard_error():
    cell = Cell.from_values([4.0])
    assert (cell.mean, cell.n) == (4.0, 1)
    assert math.isnan(cell.error)
    assert cell.text(2) == "4.00"


@pytest.mark.parametrize(
    ("cell", "digits", "text"),
    [
        (Cell(1.234, 0.056, 3), 2, "1.23 ± 0.06"),
        (Cell(-0.0001, 0.0, 3), 2, "0.00"),
        (Cell(64.0, 0.0, 3), 0, "64"),
        (Cell(64.0, 2.0, 3), 0, "64 ± 2"),
    ],
)
def test_cell_text(cell, digits, text):
    assert cell.text(digits) == text


def test_the_newest_row_of_a_seed_wins():
    (group,) = compare([row(0, distance=1.0), row(1, distance=5.0), row(0, distance=3.0)])
    assert group.n == 2
    assert group.cells["distance"].mean == 4.0


def test_groups_differ_by_task_constraints_method_and_preset():
    rows = [
        row(),
        row(method="diffuser"),
        row(preset="released"),
        row(task="maze2d-large"),
        row() | {"constraints": "pillar"},
    ]
    assert len(compare(rows)) == 5


def test_groups_come_by_task_constraints_preset_then_method():
    rows = [
        row(method="zeta"),
        row(method="alm"),
        row(method="diffuser", preset="recommended"),
        row(method="diffuser"),
        row(method="projected", task="maze2d-large"),
    ]
    keys = [(group.key[0], group.key[3], group.key[2]) for group in compare(rows)]
    assert keys == [
        ("maze2d-large", "paper", "projected"),
        ("maze2d-umaze", "paper", "diffuser"),
        ("maze2d-umaze", "paper", "alm"),
        ("maze2d-umaze", "paper", "zeta"),
        ("maze2d-umaze", "recommended", "diffuser"),
    ]


def test_a_metric_counts_only_the_rows_that_have_it():
    (group,) = compare([row(0, distance=1.0, jump=""), row(1, distance=2.0, jump=3.0)])
    assert group.cells["jump"].n == 1
    assert group.cells["distance"].n == 2


def test_only_the_metrics_asked_for_are_compared():
    (group,) = compare([row(0, distance=1.0, jump=2.0)], ["jump", "reward"])
    assert list(group.cells) == ["jump"]


@settings(max_examples=30, deadline=None)
@given(values=st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=8), data=st.data())
def test_the_order_of_rows_of_different_seeds_does_not_matter(values, data):
    rows = [row(seed, distance=value) for seed, value in enumerate(values)]
    (straight,), (shuffled,) = compare(rows), compare(data.draw(st.permutations(rows)))
    assert shuffled.cells["distance"].mean == pytest.approx(
        straight.cells["distance"].mean, abs=1e-6
    )
    assert shuffled.cells["distance"].error == pytest.approx(
        straight.cells["distance"].error, abs=1e-6
    )


def test_plans_and_rollouts_are_told_apart_oldest_first(tmp_path):
    for name, content in (
        ("20250103-000000-plan", row(0, distance=2.0)),
        ("20250101-000000-plan", row(0, distance=1.0)),
        ("20250102-000000-rollout", row(0, violation_rate=0.5)),
    ):
        (tmp_path / name).mkdir()
        write_rows(tmp_path / name / "rows.csv", [content])
    plans, rollouts = merge_kinds(tmp_path)
    assert [line["distance"] for line in plans] == [1.0, 2.0]
    assert [line["violation_rate"] for line in rollouts] == [0.5]


def test_tables_name_only_known_columns():
    tables = [
        value
        for name, value in vars(cdiff_cli.evaluation.columns).items()
        if name.endswith("_TABLE")
    ]
    assert tables
    assert {name for table in tables for name in table} <= set(COLUMNS)
    assert set(KEYS).isdisjoint(COLUMNS)


def test_a_metric_without_a_value_is_left_out_and_an_infinite_one_has_no_error():
    rows = [
        row(0, reward=1.0, effort=math.inf),
        row(1, reward=math.nan, effort=1.0),
        row(2, reward=3.0, effort=1.0),
    ]
    (group,) = compare(rows, intervals=True)
    assert (group.cells["reward"].mean, group.cells["reward"].n) == (2.0, 2)
    assert (group.cells["effort"].text(2), group.cells["effort"].interval) == ("inf", None)
    assert compare([row(0, reward=math.nan)])[0].cells == {}


def test_json_of_an_infinite_metric_is_json():
    said = render(compare([row(0, effort=math.inf), row(1, effort=1.0)]), ["effort"], "json")
    assert json.loads(said, parse_constant=pytest.fail)[0]["effort"] == {
        "mean": None,
        "standard_error": None,
        "n": 2,
    }
