"""Intervals, paired tests and Holm's correction against hand-made and independent answers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from cdiff_cli.evaluation.statistics import bootstrap, clopper_pearson, holm, interval, paired_p


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [(0, 10, 0.0, 0.3085), (10, 10, 0.6915, 1.0), (8, 10, 0.4439, 0.9748)],
)
def test_clopper_pearson_of_tens(k, n, low, high):
    assert clopper_pearson(k, n) == pytest.approx(
        (low, high), abs=5e-5
    )  # as tabulated, four digits


@settings(max_examples=30, deadline=None)
@given(n=st.integers(1, 300), data=st.data())
def test_clopper_pearson_inverts_the_binomial_test(n, data):
    k = data.draw(st.integers(0, n))
    low, high = clopper_pearson(k, n)
    if k > 0:
        assert stats.binom.sf(k - 1, n, low) == pytest.approx(0.025, rel=1e-6)
    if k < n:
        assert stats.binom.cdf(k, n, high) == pytest.approx(0.025, rel=1e-6)


def test_bootstrap_interval_is_that_of_an_independent_implementation():
    x = np.random.default_rng(3).exponential(size=30)
    reference = stats.bootstrap(
        (x,), np.mean, n_resamples=20_000, method="BCa", rng=1
    ).confidence_interval
    assert bootstrap(x) == pytest.approx(
        tuple(reference), abs=0.02
    )  # ten Monte-Carlo errors of the 2.5 % quantiles


def test_bootstrap_interval_covers_the_mean_of_skewed_draws():
    """95 % intervals of 300 samples of 60 values: 285 expected to cover, standard deviation 4.

    The bootstrap covers slightly less than it claims.
    """
    rng = np.random.default_rng(0)
    bounds = [bootstrap(rng.exponential(size=60)) for _ in range(300)]
    assert 265 <= sum(low <= 1.0 <= high for low, high in bounds) <= 297


def test_bootstrap_of_equal_values_is_that_value_and_of_one_value_none():
    assert bootstrap([2.0, 2.0, 2.0]) == (2.0, 2.0)
    assert bootstrap([2.0]) is None


def test_bootstrap_repeats_to_the_last_bit():
    assert bootstrap([1.0, 5.0, 2.0, 9.0]) == bootstrap([1.0, 5.0, 2.0, 9.0])


def test_rate_gets_the_exact_interval_and_mean_the_bootstrap():
    values = [1.0, 0.0, 1.0, 1.0]
    assert interval(values, share=True) == clopper_pearson(3, 4)
    assert interval(values, share=False) == bootstrap(values)


@pytest.mark.parametrize(
    ("d", "test", "share", "p"),
    [
        (
            [1.0, 2.0, 3.0, 4.0, 5.0],
            "wilcoxon",
            False,
            2 / 2**5,
        ),  # all signs one way: one of 32 each way
        (
            [1.0, 2.0, 3.0, 4.0, 5.0, 0.0, 0.0],
            "wilcoxon",
            False,
            2 / 2**5,
        ),  # pairs without a difference say nothing
        ([-1.0, 2.0, 3.0, 4.0, 5.0], "wilcoxon", False, 4 / 2**5),  # rank sums 0 and 1
        ([1.0, 2.0, 3.0], "t", False, 0.0741799),  # t = 2 sqrt 3 with two degrees of freedom
        (
            [1.0] * 4 + [0.0] * 6,
            "wilcoxon",
            True,
            2 / 2**4,
        ),  # McNemar: four discordant pairs, all one way
        ([1.0, -1.0, 1.0, -1.0], "t", True, 1.0),
        ([0.0, 0.0, 0.0], "wilcoxon", False, 1.0),
        ([2.0, 2.0], "t", False, 0.0),
    ],
)
def test_paired_tests_by_hand(d, test, share, p):
    assert paired_p(d, test, share) == pytest.approx(p, abs=1e-6)


def test_one_pair_has_no_p_value():
    assert math.isnan(paired_p([1.0], "wilcoxon", False))


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx(
        [0.03, 0.06, 0.06]
    )  # 3 x .01, 2 x .03, then no less than that
    assert holm([0.5, 0.6]) == [1.0, 1.0]
    assert holm([]) == []


def test_holm_does_not_count_nan():
    corrected = holm([0.01, math.nan, 0.03])
    assert math.isnan(corrected[1])
    assert corrected[0] == pytest.approx(0.02)


@settings(max_examples=50, deadline=None)
@given(p=st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_holm_never_lowers_a_p_keeps_their_order_and_stays_below_bonferroni(p):
    corrected = holm(p)
    for before, after in zip(p, corrected, strict=True):
        assert before <= after <= min(1.0, len(p) * before) + 1e-12 or after == max(corrected)
    order = np.argsort(p, kind="stable")
    assert np.all(np.diff(np.array(corrected)[order]) >= 0)
