"""The clean estimate of a noisy trajectory, with or without a condition."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.observed import ObservedValues

LEAST = 1e-6  # scale of a quantity that is constant

Denoiser = Callable[[Traj, int], Traj]
"""(x_t, t) -> clean estimate x0_hat, normalised coordinates."""
ObservingDenoiser = Callable[[ObservedValues, Tensor], Denoiser]
"""(observed values, present states [n, dim]) -> denoiser of a planner that observes."""


@dataclass(frozen=True)
class ObservationEncoder:
    """How a network gets observed quantities: relative to the present state, and scaled.

    columns         coordinate that each quantity is relative to, -1 for none        [k]
    centre, scale   mean and standard deviation of the relative quantity in the data [k]
    """

    columns: Tensor
    centre: Tensor
    scale: Tensor

    @classmethod
    def fit(
        cls,
        names: Sequence[str],
        layout: Sequence[str],
        relative_to: Mapping[str, str],
        values: Sequence[Tensor],
        states: Tensor,
    ) -> "ObservationEncoder":
        """The encoder of the data: values of each quantity [n], observed from states [n, dim].

        relative_to   coordinate that a quantity is relative to, by quantity
        """
        columns = torch.tensor(
            [layout.index(relative_to[name]) if name in relative_to else -1 for name in names]
        )
        plain = cls(columns, torch.zeros(len(names)), torch.ones(len(names)))(values, states)
        return cls(columns, plain.mean(0), plain.std(0).clamp_min(LEAST))

    def __call__(self, values: Sequence[Tensor], states: Tensor) -> Tensor:
        """Inputs of the network [n, k]: values of each quantity [n], from states [n, dim]."""
        origin = torch.where(self.columns >= 0, states[:, self.columns], 0.0)
        return ((torch.stack(tuple(values), 1) - origin).float() - self.centre) / self.scale


def calls_a_step(weight: float) -> int:
    """Network calls per estimate of guided()."""
    return 1 if weight in (0.0, 1.0) else 2


def guided(
    net: nn.Module, weight: float = 0.0, limit: float = 1.0, observation: Tensor | None = None
) -> Denoiser:
    """Classifier-free guidance: x0 = x0(none) + weight (x0(label) - x0(none)).

    This is Ho and Salimans (2022), Eq. 6, for estimates of x0, clipped to +-limit. The label is
    (1, 0): a window that satisfies the constraints, or the highest return. Both estimates are made
    in one batch. Weight 1 needs only the conditional one, weight 0 only the other, which every
    network has.

    observation   encoded observed quantities beside the label [batch, k]
    """

    def clean(x: Traj, t: int) -> Traj:
        steps = torch.full((len(x),), float(t), device=x.device)
        if weight == 0.0:
            return net(x, steps).clamp(-limit, limit)
        label = torch.tensor([1.0, 0.0], device=x.device).expand(len(x), -1)
        if observation is not None:
            label = torch.cat((label, observation.to(label)), 1)
        if weight == 1.0:
            return net(x, steps, label).clamp(-limit, limit)
        labels = torch.cat((label, torch.zeros_like(label)))
        both = net(torch.cat((x, x)), torch.cat((steps, steps)), labels)
        conditional, free = both.chunk(2)
        return (free + weight * (conditional - free)).clamp(-limit, limit)

    return clean
