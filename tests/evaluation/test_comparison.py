"""Groups of rows: means, standard errors, intervals, paired differences; known answers by hand."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cdiff_cli.evaluation.columns
from cdiff_cli.evaluation.columns import COLUMNS, KEYS
from cdiff_cli.evaluation.comparison import Cell, compare, differences
from cdiff_cli.evaluation.statistics import clopper_pearson


def row(seed=0, method="alm", preset="paper", task="maze2d-umaze", constraints="corner", **more):
    """One row of rows.csv with these metrics."""
    keys = {"task": task, "constraints": constraints, "method": method, "preset": preset}
    return keys | {"seed": seed} | more


def rows(method="alm", base=0.0, n=6, **more):
    """Rows of n seeds whose distance is base + seed^2."""
    return [row(seed, method, distance=base + seed**2, **more) for seed in range(n)]


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


def test_newest_row_of_a_seed_wins():
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


def test_groups_are_in_order_of_task_constraints_preset_method():
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


def test_metric_counts_only_the_rows_that_have_it():
    (group,) = compare([row(0, distance=1.0, jump=""), row(1, distance=2.0, jump=3.0)])
    assert group.cells["jump"].n == 1
    assert group.cells["distance"].n == 2


def test_only_requested_metrics_are_compared():
    (group,) = compare([row(0, distance=1.0, jump=2.0)], ["jump", "reward"])
    assert list(group.cells) == ["jump"]


@settings(max_examples=30, deadline=None)
@given(values=st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=8), data=st.data())
def test_order_of_rows_of_different_seeds_does_not_matter(values, data):
    rows = [row(seed, distance=value) for seed, value in enumerate(values)]
    (straight,), (shuffled,) = compare(rows), compare(data.draw(st.permutations(rows)))
    assert shuffled.cells["distance"].mean == pytest.approx(
        straight.cells["distance"].mean, abs=1e-6
    )
    assert shuffled.cells["distance"].error == pytest.approx(
        straight.cells["distance"].error, abs=1e-6
    )


def test_tables_name_only_known_columns():
    tables = [
        value
        for name, value in vars(cdiff_cli.evaluation.columns).items()
        if name.endswith("_TABLE")
    ]
    assert tables
    assert {name for table in tables for name in table} <= set(COLUMNS)
    assert set(KEYS).isdisjoint(COLUMNS)


def test_metric_without_a_value_is_left_out_and_an_infinite_one_has_no_error():
    rows = [
        row(0, reward=1.0, effort=math.inf),
        row(1, reward=math.nan, effort=1.0),
        row(2, reward=3.0, effort=1.0),
    ]
    (group,) = compare(rows, intervals=True)
    assert (group.cells["reward"].mean, group.cells["reward"].n) == (2.0, 2)
    assert (group.cells["effort"].text(2), group.cells["effort"].interval) == ("inf", None)
    assert compare([row(0, reward=math.nan)])[0].cells == {}


def test_torn_is_one_minus_smooth():
    (group,) = compare([row(0, smooth=1.0), row(1, smooth=0.0), row(2, smooth=0.0)])
    assert group.cells["torn"].mean == pytest.approx(2 / 3)


def test_metrics_of_zeros_and_ones_are_shares():
    assert {name for name, column in COLUMNS.items() if column.share} >= {
        "torn",
        "smooth",
        "success",
        "safe_executed",
        "wall",
    }
    assert not COLUMNS["violation_rate"].share  # percent of the states of one episode


def test_intervals_are_given_of_means_and_rates_but_not_of_costs():
    (group,) = compare(
        [row(i, success=float(i > 1), calls=64.0, distance=float(i)) for i in range(10)],
        intervals=True,
    )
    assert group.cells["success"].interval == clopper_pearson(8, 10)
    assert group.cells["success"].text(2) == "0.80 ± 0.13 [0.44, 0.97]"
    assert group.cells["calls"].text(0) == "64"
    assert Cell(1.0, 0.0, 5, (0.48, 1.0)).text(2) == "1.00 [0.48, 1.00]"


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


def test_metric_without_any_difference_is_left_out():
    assert (
        differences(
            [*rows("projected", steps=5.0), *rows("alm", 1.0, steps=5.0)],
            "alm",
            ["steps", "distance"],
        )[0].metric
        == "distance"
    )
