"""Margins: the errors that count, the conformal quantile, tightened constraints."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import CdiffError
from cdiff_cli.evaluation.conformal import (
    PASSES,
    conformal,
    errors,
    excess,
    require_enough,
    tightened,
    until_covered,
)
from tests.problems import vec


def test_the_margin_is_the_largest_of_19_at_95_percent_and_the_18th_at_90():
    scores = np.random.default_rng(0).permutation(np.arange(1.0, 20.0))
    assert conformal(scores, 0.95) == 19
    assert conformal(scores, 0.9) == 18
    assert conformal(scores, 0.5) == 10


@given(st.integers(1, 60), st.floats(0.01, 0.99))
def test_a_further_score_is_covered_as_often_as_promised(n, level):
    """The last of n + 1 exchangeable scores has every rank with equal probability.

    So a score of rank r covers it with probability r / (n + 1).
    """
    try:
        rank = conformal(np.arange(1.0, n + 1), level)
    except CdiffError as error:
        enough = int(str(error).split("it takes ")[1].split()[0])
        assert enough > n
        require_enough(enough, level)
        with pytest.raises(CdiffError):
            require_enough(enough - 1, level)
    else:
        assert level <= rank / (n + 1) * (1 + 1e-12)  # the quotient is rounded
        assert (rank - 1) / (n + 1) < level * (1 + 1e-12)


@pytest.mark.parametrize("level", [0.0, 1.0, -0.5, 2.0, math.nan])
def test_a_level_is_a_probability(level):
    with pytest.raises(
        CdiffError, match="--level: expected a share of episodes above 0 and below 1"
    ):
        require_enough(100, level)


def test_the_error_of_an_episode_is_the_worst_near_the_limit():
    """An error of 0.5 cannot make a state unsafe that is planned 2 from the limit.

    An error of 0.2 can at the limit.
    """
    predicted = np.array([[np.nan, -2.0, 0.0, -0.3], [np.nan, -5.0, -0.1, np.nan]])[..., None]
    executed = np.array([[0.0, -1.5, 0.2, -0.4], [0.0, -5.0, -0.2, np.nan]])[..., None]
    np.testing.assert_allclose(errors(predicted, executed)[:, 0], [0.2, 0.0])


def test_tightening_moves_the_limit_by_the_margin_of_that_name_alone():
    parts = [
        AtWaypoints(name, HalfSpace(vec(1.0), torch.tensor(3.0, dtype=torch.float64)))
        for name in ("near", "other")
    ]
    g = tightened(Constraint(tuple(parts)), {"near": 0.25})
    np.testing.assert_allclose(g(torch.full((1, 1, 1), 2.9, dtype=torch.float64))[0], [0.15, -0.1])


def test_margins_cover_the_errors_of_plans_that_keep_them():
    """The error is 0.1 plus half the margin, so 0.1 is not enough and 0.2 is the least margin."""
    tried = []

    def measured(margins, number):
        assert number == len(tried)
        tried.append(margins)
        return np.outer(np.linspace(0.5, 1.0, 20), 0.1 + 0.5 * margins)

    margins, scores, passes = until_covered(measured, 2, level=0.9)
    assert (scores <= margins).mean() >= 0.9
    assert np.allclose(margins, 0.2, atol=0.02)
    assert passes == len(tried) > 1
    assert np.array_equal(tried[0], np.zeros(2))
    assert np.array_equal(tried[-1], margins)


def test_margins_that_never_cover_what_they_cause_are_refused():
    with pytest.raises(
        CdiffError,
        match=f"no margin found in {PASSES} passes: the larger the margin, the larger the error",
    ):
        until_covered(lambda margins, _: np.full((20, 1), 1.0) + 3 * margins, 1, level=0.9)


def test_where_execution_follows_the_plan_the_margin_is_nothing():
    margins, _, passes = until_covered(lambda *_: np.full((20, 1), -1.0), 1, level=0.9)
    assert margins.tolist() == [0.0]
    assert passes == 1


def test_excess_counts_what_small_errors_add_up_to():
    """Each of three steps ends 0.01 less safe than planned, and the last is 0.02 past the limit."""
    executed = np.array([[[-0.2], [0.0], [0.01], [0.02]]])
    predicted = executed - 0.01
    assert errors(predicted, executed) == pytest.approx(0.01)
    assert excess(predicted, executed, np.array([0.1])) == pytest.approx(0.12)


def test_excess_of_a_safe_episode_is_its_error():
    executed = np.array([[[-0.2], [-0.05], [-0.02], [np.nan]]])
    predicted = np.array([[[-0.2], [-0.15], [-0.03], [np.nan]]])
    assert excess(predicted, executed, np.array([0.3])) == pytest.approx(
        errors(predicted, executed)
    )
