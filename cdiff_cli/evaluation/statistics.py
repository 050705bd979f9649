"""Statistical inference for comparisons: intervals of means and rates, paired tests, correction.

numpy and scipy are imported on first use, so that the command line starts without them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Interval = tuple[float, float]
Test = Literal["wilcoxon", "t"]
LEVEL = 0.95  # coverage of the intervals
DRAWS = 9999  # bootstrap resamples


def bootstrap(values: Sequence[float], level: float = LEVEL) -> Interval | None:
    """Interval of the mean by the bias-corrected and accelerated bootstrap (Efron, 1987).

    None for fewer than two values, or where one is infinite. The resampling is seeded, so equal
    values give equal intervals.
    """
    import numpy as np
    from scipy.special import ndtr, ndtri

    x = np.asarray(values, dtype=np.float64)
    n = len(x)
    if n < 2 or not np.isfinite(x).all():
        return None
    mean, means = x.mean(), x[_resamples(n)].mean(1)
    if x.min() == x.max() or means.min() == means.max():
        return float(mean), float(mean)
    below = ((means < mean).mean() + (means <= mean).mean()) / 2
    bias = ndtri(np.clip(below, 0.5 / DRAWS, 1 - 0.5 / DRAWS))
    shift = (x - mean) / (n - 1)  # jackknife: means without one value, minus their average
    acceleration = (shift**3).sum() / (6 * (shift**2).sum() ** 1.5)
    z = bias + ndtri(np.array([(1 - level) / 2, (1 + level) / 2]))
    low, high = np.quantile(means, ndtr(bias + z / (1 - acceleration * z)))
    return float(low), float(high)


@lru_cache(maxsize=8)
def _resamples(n: int) -> NDArray[np.int64]:
    import numpy as np

    return np.random.default_rng(0).integers(n, size=(DRAWS, n))


def clopper_pearson(successes: int, n: int, level: float = LEVEL) -> Interval:
    """Exact interval of a rate (Clopper and Pearson, 1934).

    It holds the rates that a two-sided binomial test does not reject.
    """
    from scipy.special import betaincinv

    tail = (1 - level) / 2
    low = 0.0 if successes == 0 else float(betaincinv(successes, n - successes + 1, tail))
    high = 1.0 if successes == n else float(betaincinv(successes + 1, n - successes, 1 - tail))
    return low, high


def interval(values: Sequence[float], share: bool) -> Interval | None:
    """The interval of a rate where share is set and the values are 0 and 1, else of a mean."""
    if share and set(values) <= {0.0, 1.0}:
        return clopper_pearson(round(sum(values)), len(values))
    return bootstrap(values)


def paired_p(differences: Sequence[float], test: Test, share: bool) -> float:
    """Two-sided p of no difference between paired values; NaN for fewer than two pairs.

    wilcoxon   signed ranks, exact up to 50 pairs without ties; equal pairs are left out
    t          Student's test
    share      differences of zeros and ones: McNemar's exact test, a binomial test on the pairs
               that differ, whichever test is named
    """
    import numpy as np
    from scipy import stats

    d = np.asarray(differences, dtype=np.float64)
    if len(d) < 2:
        return math.nan
    changed = d[d != 0]
    if len(changed) == 0:
        return 1.0
    if share:
        return float(stats.binomtest(int((changed > 0).sum()), len(changed)).pvalue)
    if test == "wilcoxon":
        return float(stats.wilcoxon(changed).pvalue)
    return 0.0 if d.min() == d.max() else float(stats.ttest_1samp(d, 0.0).pvalue)


def holm(p: Sequence[float]) -> list[float]:
    """Corrected p values of a family of m tests by Holm's (1979) step-down procedure.

    The i-th smallest (from 0) is multiplied by m - i, made monotone and cut at 1. NaN is not
    counted in m and stays NaN.
    """
    known = sorted((value, i) for i, value in enumerate(p) if not math.isnan(value))
    out, largest = [math.nan] * len(p), 0.0
    for rank, (value, i) in enumerate(known):
        largest = max(largest, min(1.0, (len(known) - rank) * value))
        out[i] = largest
    return out
