"""The denoising loss."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from cdiff_cli.arrays import Traj
from cdiff_cli.models.schedule import Schedule


class Estimator(Protocol):
    """A network that estimates the clean trajectory at rising resolution.

    The last estimate is the output.
    """

    def estimates(self, x: Traj, t: Tensor, condition: Tensor | None = None) -> list[Traj]:
        """Estimates [batch, horizon / k, dim]."""
        ...


@dataclass(frozen=True)
class Weighing:
    """Weights of the terms of the training loss.

    smoothness   weight of the change of the error between neighbouring waypoints
    emphasis     largest weight w_t of a diffusion step before division by the mean. w_t is the
                 square root of the signal-to-noise ratio alpha_bar / (1 - alpha_bar), clipped to
                 [1, emphasis]. At 1 all steps weigh the same, and the noisiest ones, from which
                 little can be learnt, dominate the loss
    """

    smoothness: float = 100.0
    emphasis: float = 1.0

    def weights(self, schedule: Schedule) -> Tensor:
        """w_t for t = 0 ... n_steps."""
        a = torch.tensor(schedule.alpha_bar, dtype=torch.float64)
        w = (a / (1 - a).clamp_min(1e-12)).sqrt().clamp(1.0, self.emphasis)
        return w / w[1:].mean()


def training_loss(
    net: Estimator,
    schedule: Schedule,
    x0: Traj,
    pinned: Tensor,
    weighing: Weighing,
    generator: torch.Generator,
    bf16: bool,
    condition: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """(loss, mean squared error) of the clean estimate at random steps t, both scalars.

    loss = w_t (|e|^2 + smoothness |e^{tau+1} - e^tau|^2 + |coarse e|^2 / 2),  e = x0_hat - x_0

    At each t the loss is a quadratic form of e, so its minimiser is E[x_0 | x_t]. `coarse` are the
    estimates of lower resolution, if the network has any.

    x0          clean windows, normalised                               [batch, horizon, dim]
    pinned      coordinates that are clean, in training as in sampling  [horizon, dim]
    condition   labels of the windows, for conditional planners         [batch, k]
    """
    t = torch.randint(1, schedule.n_steps + 1, (len(x0),), generator=generator)
    z = torch.randn(x0.shape, generator=generator).to(x0)
    a = torch.tensor(schedule.alpha_bar, dtype=x0.dtype)[t].to(x0)[:, None, None]
    x_t = torch.where(pinned, x0, a.sqrt() * x0 + (1 - a).sqrt() * z)
    label = () if condition is None else (condition,)
    with torch.autocast(x0.device.type, torch.bfloat16, enabled=bf16):
        *coarse, estimate = net.estimates(x_t, t.to(x0), *label)
    w = weighing.weights(schedule).to(x0)[t][:, None, None]
    e = torch.where(pinned, 0.0, estimate.float() - x0)
    loss = (w * e.square()).mean() + weighing.smoothness * (w * e.diff(dim=1).square()).mean()
    for guess in coarse:
        mean = x0.reshape(len(x0), guess.shape[1], -1, x0.shape[2]).mean(2)
        loss = loss + 0.5 * (w * (guess.float() - mean).square()).mean()
    return loss, e.square().mean().detach()
