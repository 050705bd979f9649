"""What a diffusion model is asked for: the clean estimate of a noisy trajectory, with or without a condition."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.observed import ObservedValues

LEAST = 1e-6  # scale of a quantity that is the same throughout


@dataclass(frozen=True)
class ObservationEncoder:
    """How observed quantities are told to a network: those called after a coordinate (obstacle.x, after x) relative to it as it is
    at present, all of them in standard deviations.

    columns         the coordinate that each is relative to, -1: none   [k]
    centre, scale   of what is told, over the training data             [k]
    """

    columns: Tensor
    centre: Tensor
    scale: Tensor

    @classmethod
    def fit(
        cls, names: Sequence[str], layout: Sequence[str], seen: Sequence[Tensor], present: Tensor
    ) -> "ObservationEncoder":
        """The scales of the data: quantities, in order, each [n], and the states [n, dim] that they were seen from."""
        last = [name.rpartition(".")[2] for name in names]
        columns = torch.tensor([layout.index(name) if name in layout else -1 for name in last])
        plain = cls(columns, torch.zeros(len(names)), torch.ones(len(names)))(seen, present)
        return cls(columns, plain.mean(0), plain.std(0).clamp_min(LEAST))

    def __call__(self, seen: Sequence[Tensor], present: Tensor) -> Tensor:
        """What the network is told [n, k] of the quantities, in order, each [n], seen from the states [n, dim]."""
        origin = torch.where(self.columns >= 0, present[:, self.columns], 0.0)
        return ((torch.stack(tuple(seen), 1) - origin).float() - self.centre) / self.scale


def calls_a_step(weight: float) -> int:
    """Network calls that guided() takes for one estimate."""
    return 1 if weight in (0.0, 1.0) else 2


Denoiser = Callable[[Traj, int], Traj]
"""(x_t, t) -> clean estimate x0_hat, normalised coordinates."""
ObservingDenoiser = Callable[[ObservedValues, Tensor], Denoiser]
"""(what is observed now, the present states [n, dim]) -> the clean estimate of a planner that is told of it."""


def guided(
    net: nn.Module, weight: float = 0.0, limit: float = 1.0, told: Tensor | None = None
) -> Denoiser:
    """x0 = x0(no condition) + weight (x0(asked) - x0(no condition)) (Ho and Salimans, 2022, Eq. 6 for estimates of x0), clipped to
    the data's limits. Asked for is the label (1, 0): a window that obeys, or the highest return. Both estimates are made in one
    batch; weight 1 needs the conditioned one alone, weight 0 the other, which every network has.

    told   what is observed, beside the label [batch, k]
    """

    def clean(x: Traj, t: int) -> Traj:
        steps = torch.full((len(x),), float(t), device=x.device)
        if weight == 0.0:
            return net(x, steps).clamp(-limit, limit)
        asked = torch.tensor([1.0, 0.0], device=x.device).expand(len(x), -1)
        asked = asked if told is None else torch.cat((asked, told.to(asked)), 1)
        if weight == 1.0:
            return net(x, steps, asked).clamp(-limit, limit)
        both = net(
            torch.cat((x, x)),
            torch.cat((steps, steps)),
            torch.cat((asked, torch.zeros_like(asked))),
        )
        wanted, free = both.chunk(2)
        return (free + weight * (wanted - free)).clamp(-limit, limit)

    return clean
