"""Margins from evidence: how far execution leaves the plan on the unsafe side, and the conformal quantile that covers it."""

import math
from collections.abc import Callable, Mapping

import numpy as np

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.errors import CdiffError

PASSES = 6  # of calibration at most
FINEST = 1e-4  # margins are multiples of it, in the units of the barrier


def tightened(g: Constraint, margins: Mapping[str, float]) -> Constraint:
    """g with the levels f <= 0 of the named parts tightened to f <= -margin; h >= margin of a barrier."""
    if not margins:
        return g
    return Constraint(
        tuple(
            part.tighten_level(margins.get(part.name, 0.0)) if part.name in margins else part
            for part in g.parts
        )
    )


def errors(foreseen: Array, executed: Array) -> Array:
    """Largest amount by which execution was less safe than the plan followed had foreseen, an episode and part [n, parts]: max over
    steps of f(x^tau) - f(planned x^tau), f > 0 unsafe, among the steps that such an error could make unsafe: those planned no
    further from the limit than the largest error of all. What happens further off needs no margin.

    foreseen, executed   f at the states, NaN after an episode's end   [n, steps + 1, parts]
    """
    gap = np.nan_to_num((executed - foreseen)[:, 1:], nan=-np.inf)
    largest = gap.max((0, 1))
    return np.asarray(np.where(-foreseen[:, 1:] <= largest, gap, 0.0).max(1))


def until_covered(
    measured: Callable[[Array, int], Array], parts: int, level: float
) -> tuple[Array, Array, int]:
    """Margins [parts] that cover the excess of plans that keep those same margins, that excess [n, parts], and the passes it took.
    Plans that stay clear of a limit are other plans than those that ride it, so what covers the errors of the one need not cover
    those of the other: each pass acts with the margins found so far, on episodes of its own, until they suffice. Where they do
    not, they are raised by twice what is missing. The last pass fits nothing: it confirms. CdiffError where none does.

    measured   margins and the number of the pass, from 0, to the excess() of new episodes
    """
    margins = np.zeros(parts)
    for k in range(1, PASSES + 1):
        scores = measured(margins, k - 1)
        needed = np.array([conformal(each, level) for each in scores.T])
        if (needed <= margins).all():
            return margins, scores, k
        short = np.maximum(needed - margins, 0.0) * (1 if k == 1 else 2)
        margins = np.ceil((margins + short) / FINEST) * FINEST
    raise CdiffError(
        f"no margin found in {PASSES} passes: execution leaves the plans the further, the more clear of the limit they keep "
        f"(the last margins tried: {', '.join(f'{margin:.3g}' for margin in margins)}); nothing was written"
    )


def excess(foreseen: Array, executed: Array, margins: Array) -> Array:
    """Largest amount by which an episode of plans that keep the margins was less safe than they allow [n, parts]: than its plan, as
    in errors(), or than the limit less the margin. The second is the larger where small errors of one step add up over many.
    """
    worst = np.nan_to_num(executed[:, 1:], nan=-np.inf).max(1)
    return np.maximum(errors(foreseen, executed), np.where(worst > 0, worst + margins, 0.0))


def conformal(scores: Array, level: float) -> float:
    """The smallest score that covers a further exchangeable one with probability `level`: the ceil((n + 1) level)-th of n
    (split conformal prediction; Vovk et al., 2005). CdiffError where n is too small for the level.
    """
    require_enough(len(scores), level)
    return float(np.sort(scores)[_rank(len(scores), level) - 1])


def require_enough(n: int, level: float) -> None:
    """Refuse a level that is no probability, or that n scores cannot vouch for; raises CdiffError."""
    if not 0 < level < 1:
        raise CdiffError(
            f"--level: expected a share of episodes above 0 and below 1, found {level:g}"
        )
    if _rank(n, level) > n:
        need = math.floor(level / (1 - level))
        while _rank(need, level) > need:  # the quotient is rounded
            need += 1
        raise CdiffError(
            f"{n} episodes cannot vouch for a level of {level:g}: it takes {need} or more; raise --episodes"
        )


def _rank(n: int, level: float) -> int:
    return math.ceil((n + 1) * level)
