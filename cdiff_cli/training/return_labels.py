"""Labels of the return that follows the first state of a window.

A planner that is conditioned on them can be asked for the highest return.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError

QUANTILES = (0.02, 0.98)  # of the mean rewards, labelled -1 and 1; beyond them lie random bursts
SAME = 1e-6  # relative difference below which two returns are equal


def mean_rewards(
    episodes: Sequence[Array], rewards: Sequence[Array], discount: float
) -> list[Array]:
    """sum_k discount^k r_{tau+k} / sum_k discount^k from each state tau to the end of its walk.

    The result is a mean, so that the length of the rest of a walk does not matter. It is NaN where
    fewer than 1 / (1 - discount) steps are left, which are too few to estimate it. An episode that
    starts in the last state of the previous one continues its walk.

    episodes   states [n, dim] of each
    rewards    rewards of the steps between them [n - 1], or of one step more [n]
    returns    one array [n] per episode
    """
    means: list[Array] = []
    total, weight, steps = 0.0, 0.0, 0
    for i in reversed(range(len(episodes))):
        if i + 1 == len(episodes) or not np.array_equal(episodes[i][-1], episodes[i + 1][0]):
            total, weight, steps = 0.0, 0.0, 0
        mean = np.full(len(episodes[i]), np.nan)
        for tau in reversed(range(len(rewards[i]))):
            total = float(rewards[i][tau]) + discount * total
            weight = 1.0 + discount * weight
            steps += 1
            if steps >= round(1 / (1 - discount)):
                mean[tau] = total / weight
        means.append(mean)
    return means[::-1]


@dataclass(frozen=True)
class ReturnLabel:
    """What a network gets of the return that follows each state of the demonstrations.

    label       (r, 1 - r), with r = -1 at the mean reward `low` and 1 at `high`; zeros, which mean
                no label, where the return is unknown. The second entry tells r = 0 from no label.
                Planning uses r = 1 (denoiser.guided)   [n, 2]
    low, high   reward per step
    """

    label: Tensor
    low: float
    high: float

    @classmethod
    def from_episodes(
        cls, episodes: Sequence[Array], rewards: Sequence[Array], discount: float
    ) -> "ReturnLabel":
        """Labels of the states of all episodes; CdiffError if the returns do not differ."""
        mean = np.concatenate(mean_rewards(episodes, rewards, discount))
        if np.isnan(mean).all():
            raise CdiffError(
                f"no demonstration is {round(1 / (1 - discount))} steps long, as a return at "
                f"discount {discount:g} needs; lower the discount in the recipe, or leave "
                "`returns` out"
            )
        low, high = (float(value) for value in np.nanquantile(mean, QUANTILES))
        if high - low <= SAME * max(abs(low), abs(high)):
            raise CdiffError(
                f"all demonstrations return the same, {low:.3g} per step, so that none is better; "
                "leave `returns` out of the recipe"
            )
        r = torch.from_numpy(2 * (mean - low) / (high - low) - 1).float().clamp(-1, 1)
        return cls(torch.stack((r, 1 - r), 1).nan_to_num(0.0), low, high)

    def record(self, discount: float) -> dict[str, float]:
        """The entries of the card: discount, limits and the share of states with a label."""
        labelled = float((self.label != 0).any(1).float().mean())
        return {
            "discount": discount,
            "low": round(self.low, 5),
            "high": round(self.high, 5),
            "labelled": round(labelled, 4),
        }
