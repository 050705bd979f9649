"""Split-conformal margins: how far execution is less safe than the plan, and a quantile of that.

f is the value of a constraint, positive where unsafe. A margin tightens f <= 0 to f <= -margin.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.errors import CdiffError

PASSES = 6  # most passes of a calibration
MARGIN_STEP = 1e-4  # [units of f] margins are multiples of it


def tightened(g: Constraint, margins: Mapping[str, float]) -> Constraint:
    """g with f <= -margin in the place of f <= 0 for the named constraints: h >= margin."""
    if not margins:
        return g
    return Constraint(
        tuple(
            part.tighten_level(margins[part.name]) if part.name in margins else part
            for part in g.parts
        )
    )


def errors(predicted: Array, executed: Array) -> Array:
    """Largest amount by which execution was less safe than predicted [n, parts].

    That is the largest f(executed state) - f(predicted state) over the steps of an episode. Only
    steps near the limit count, where such an error could make the state unsafe: those with a
    predicted -f of at most the largest error of all episodes.

    predicted, executed   f per step, NaN after the end of an episode   [n, steps + 1, parts]
    """
    gap = np.nan_to_num((executed - predicted)[:, 1:], nan=-np.inf)
    largest = gap.max((0, 1))
    return np.asarray(np.where(-predicted[:, 1:] <= largest, gap, 0.0).max(1))


def excess(predicted: Array, executed: Array, margins: Array) -> Array:
    """Largest amount by which execution was less safe than planned with margins [n, parts].

    That is the larger of errors() and, for an unsafe episode, its largest f plus the margin. The
    second is larger if small errors of single steps add up.

    predicted, executed   f per step, as in errors()   [n, steps + 1, parts]
    margins               that the plans kept          [parts]
    """
    worst = np.nan_to_num(executed[:, 1:], nan=-np.inf).max(1)
    return np.maximum(errors(predicted, executed), np.where(worst > 0, worst + margins, 0.0))


def until_covered(
    measured: Callable[[Array, int], Array], parts: int, level: float
) -> tuple[Array, Array, int]:
    """Margins that cover the excess of plans with these margins.

    Plans with a margin differ from plans at the limit, and so do their errors. Each pass therefore
    runs new episodes with the present margins. If they do not cover the excess, the first pass
    adds the shortfall and every later pass adds twice the shortfall. The last pass only confirms.

    measured   (margins, number of the pass from 0) -> excess() of new episodes   [n, parts]
    parts      number of constraints
    level      share of episodes to cover, in (0, 1)

    Returns the margins [parts], the excess of the last pass [n, parts] and the number of passes.
    Raises CdiffError if no pass confirms.
    """
    margins = np.zeros(parts)
    for number in range(PASSES):
        scores = measured(margins, number)
        needed = np.array([conformal(column, level) for column in scores.T])
        if (needed <= margins).all():
            return margins, scores, number + 1
        shortfall = np.maximum(needed - margins, 0.0) * (2 if number else 1)
        margins = np.ceil((margins + shortfall) / MARGIN_STEP) * MARGIN_STEP
    last = ", ".join(f"{margin:.3g}" for margin in margins)
    raise CdiffError(
        f"no margin found in {PASSES} passes: the larger the margin, the larger the error of "
        f"execution (last margins {last}); nothing was written"
    )


def conformal(scores: Array, level: float) -> float:
    """The smallest score that covers one further exchangeable score with probability `level`.

    It is the ceil((n + 1) level)-th of n sorted scores (split conformal prediction; Vovk et al.,
    2005). Raises CdiffError if n is too small for the level.
    """
    require_enough(len(scores), level)
    return float(np.sort(scores)[_rank(len(scores), level) - 1])


def require_enough(n: int, level: float) -> None:
    """Check that the level is a probability for which n scores suffice; raises CdiffError."""
    if not 0 < level < 1:
        raise CdiffError(
            f"--level: expected a share of episodes above 0 and below 1, found {level:g}"
        )
    if _rank(n, level) > n:
        enough = math.floor(level / (1 - level))
        while _rank(enough, level) > enough:  # the quotient is rounded
            enough += 1
        raise CdiffError(
            f"{n} episodes are too few for a level of {level:g}: it takes {enough} or more; "
            "raise --episodes"
        )


def _rank(n: int, level: float) -> int:
    return math.ceil((n + 1) * level)
