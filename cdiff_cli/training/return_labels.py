"""Labels of the return: what is earned from a window's first state on, for planners that are asked for the most of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError

QUANTILES = (
    0.02,
    0.98,
)  # of the returns of the demonstrations, at -1 and 1: what lies beyond is a burst, not a gait
SAME = 1e-6  # returns that differ by less, relative to their size, are all one


def mean_rewards(
    episodes: Sequence[Array], rewards: Sequence[Array], discount: float
) -> list[Array]:
    """sum_k discount^k r_{tau+k} / sum_k discount^k from each state to the end of its walk, an episode each [n]: a mean, for what
    is left of a walk must not tell. NaN where that is less than 1 / (1 - discount) steps, too few to know.

    An episode that begins with the very state that the one before it ends with goes on with its walk.

    episodes  states [n, dim];  rewards  of the steps between them [n - 1], or of one step more [n]
    """
    found: list[Array] = []
    total, weight, left = 0.0, 0.0, 0
    for i in reversed(range(len(episodes))):
        if i + 1 == len(episodes) or not np.array_equal(episodes[i][-1], episodes[i + 1][0]):
            total, weight, left = 0.0, 0.0, 0
        each = np.full(len(episodes[i]), np.nan)
        for tau in reversed(range(len(rewards[i]))):
            total, weight, left = (
                float(rewards[i][tau]) + discount * total,
                1.0 + discount * weight,
                left + 1,
            )
            if left >= round(1 / (1 - discount)):
                each[tau] = total / weight
        found.append(each)
    return found[::-1]


@dataclass(frozen=True)
class ReturnLabel:
    """What a network is told of the return from each state of the demonstrations on.

    label      (r, 1 - r), r the mean reward from `low` at -1 to `high` at 1; zeros, which mean no label, where it is not known,
               so that r = 0 is none of them. Asked for is r = 1 (conditioning.guided)   [n, 2]
    low, high  reward a step
    """

    label: Tensor
    low: float
    high: float

    @classmethod
    def from_episodes(
        cls, episodes: Sequence[Array], rewards: Sequence[Array], discount: float
    ) -> "ReturnLabel":
        """Labels of all states of the episodes, one after the other; CdiffError where none can be told from another."""
        mean = np.concatenate(mean_rewards(episodes, rewards, discount))
        if np.isnan(mean).all():
            raise CdiffError(
                f"no demonstration is {round(1 / (1 - discount))} steps long, as a return at discount {discount:g} needs; "
                "lower the discount in the recipe, or leave `returns` out"
            )
        low, high = (float(value) for value in np.nanquantile(mean, QUANTILES))
        if high - low <= SAME * max(abs(low), abs(high)):
            raise CdiffError(
                f"all demonstrations return the same, {low:.3g} a step: there is no better one to ask for; "
                "leave `returns` out of the recipe"
            )
        r = torch.from_numpy(2 * (mean - low) / (high - low) - 1).float().clamp(-1, 1)
        return cls(torch.stack((r, 1 - r), 1).nan_to_num(0.0), low, high)

    def told(self, discount: float) -> dict[str, float]:
        """For the card."""
        labelled = float((self.label != 0).any(1).float().mean())
        return {
            "discount": discount,
            "low": round(self.low, 5),
            "high": round(self.high, 5),
            "labelled": round(labelled, 4),
        }
