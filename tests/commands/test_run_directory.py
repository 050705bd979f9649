"""Run directories and the rows in them."""

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
from tests.evaluation.test_comparison import row


@pytest.fixture
def noon(monkeypatch) -> None:
    monkeypatch.setattr(
        cdiff_cli.commands.run_directory,
        "time",
        types.SimpleNamespace(strftime=lambda _: "20250102-120000"),
    )


@pytest.mark.usefixtures("noon")
def test_finished_run_is_named_by_its_time_and_name(tmp_path):
    root = tmp_path / "runs"
    with new_run(root, "plan-umaze") as run:
        (run.path / "rows.csv").write_text("a")
        assert run.path.name.startswith(".")
    assert [path.name for path in root.iterdir()] == ["20250102-120000-plan-umaze"]
    assert run.path == root / "20250102-120000-plan-umaze"
    assert (run.path / "rows.csv").read_text() == "a"
    assert run.path.stat().st_mode & 0o777 == 0o755


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_failed_run_leaves_nothing_behind(error, tmp_path):
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


def test_unfinished_run_is_not_listed(tmp_path):
    with new_run(tmp_path, "plan") as run:
        write_rows(run.path / "rows.csv", [row()])
        assert find_rows(tmp_path) == []
    assert find_rows(tmp_path) == [run.path / "rows.csv"]


def test_rows_round_trip_with_metrics_as_numbers(tmp_path):
    path = tmp_path / "rows.csv"
    write_rows(path, [row(0, distance=1.5, jump=0.1), row(1, distance=-2.0, jump=1e-300)])
    assert read_rows(path) == [
        row("0", distance=1.5, jump=0.1),
        row("1", distance=-2.0, jump=1e-300),
    ]


def test_empty_metric_stays_empty(tmp_path):
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


def test_run_yaml_keeps_the_order_of_keys_and_non_ascii_letters(tmp_path):
    write_yaml(tmp_path / "run.yaml", {"b": 1, "a": "é"})
    assert (tmp_path / "run.yaml").read_text(encoding="utf-8") == "b: 1\na: é\n"


def test_plans_and_rollouts_are_separated_oldest_run_first(tmp_path):
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
