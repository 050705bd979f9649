"""Planners trained elsewhere: their networks made denoisers, (x_t, t) -> clean estimate.

With x_t = sqrt(a) x_0 + sqrt(1 - a) noise, a = alpha_bar_t, a network may predict the noise, the
velocity v = sqrt(a) noise - sqrt(1 - a) x_0 (Salimans and Ho, 2022), or, with a noise level
sigma = sqrt((1 - a) / a) in the place of a step, the clean x_0 of x_0 + sigma noise (Karras et
al., 2022).
All of them hold the same information; the clean estimate is the form that constraints act on.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from cdiff_cli.models.denoiser import Denoiser
from cdiff_cli.models.schedule import Schedule

StepNetwork = Callable[[Tensor, Tensor], Tensor]
"""(x_t [batch, horizon, dim], t [batch], 0 for the least noise) -> a prediction of x_t's shape."""

SigmaNetwork = Callable[[Tensor, Tensor], Tensor]
"""(x_0 + sigma noise [batch, horizon, dim], sigma [batch]) -> x_0."""


def from_clean(network: StepNetwork) -> Denoiser:
    """The denoiser of a network that predicts x_0."""
    return lambda x, t: network(x, _steps(x, t))


def from_epsilon(network: StepNetwork, alphas_cumprod: Sequence[float] | Tensor) -> Denoiser:
    """The denoiser of a network that predicts the noise: x_0 = (x_t - sqrt(1 - a) noise) / sqrt(a).

    alphas_cumprod   alpha_bar of the steps 1 to n, falling [n]
    """
    a = _levels(alphas_cumprod)

    def clean(x: Tensor, t: int) -> Tensor:
        noise = network(x, _steps(x, t))
        return (x - math.sqrt(1 - a[t]) * noise) / math.sqrt(a[t])

    return clean


def from_velocity(network: StepNetwork, alphas_cumprod: Sequence[float] | Tensor) -> Denoiser:
    """The denoiser of a network that predicts v: x_0 = sqrt(a) x_t - sqrt(1 - a) v.

    alphas_cumprod   alpha_bar of the steps 1 to n, falling [n]
    """
    a = _levels(alphas_cumprod)
    return lambda x, t: math.sqrt(a[t]) * x - math.sqrt(1 - a[t]) * network(x, _steps(x, t))


def from_sigma(network: SigmaNetwork, alphas_cumprod: Sequence[float] | Tensor) -> Denoiser:
    """The denoiser of a network that takes a noise level: x_0 = network(x_t / sqrt(a), sigma).

    alphas_cumprod   alpha_bar of the steps 1 to n, falling [n]: the levels at which it is asked
    """
    a = _levels(alphas_cumprod)

    def clean(x: Tensor, t: int) -> Tensor:
        sigma = math.sqrt((1 - a[t]) / a[t])
        return network(
            x / math.sqrt(a[t]), torch.full((len(x),), sigma, dtype=x.dtype, device=x.device)
        )

    return clean


def from_diffusers(unet: Any, scheduler: Any) -> tuple[Denoiser, Schedule]:
    """Denoiser and schedule of a 1-D U-Net and a scheduler with the interface of `diffusers`.

    unet        (x [batch, dim, horizon], t [batch]) -> a prediction, or an object with `.sample`
    scheduler   alphas_cumprod [n] and config.prediction_type: epsilon, sample or v_prediction;
                where config.clip_sample is true the estimate is clipped to config.clip_sample_range
    Raises ValueError for another prediction type.
    """
    config = scheduler.config
    kind = config.prediction_type
    if kind not in ("epsilon", "sample", "v_prediction"):
        raise ValueError(
            f"prediction_type: expected epsilon, sample or v_prediction, found {kind!r}"
        )

    def network(x: Tensor, t: Tensor) -> Tensor:
        out = unet(x.transpose(1, 2), t)
        return getattr(out, "sample", out).transpose(1, 2)

    a = [float(level) for level in scheduler.alphas_cumprod]
    if kind == "epsilon":
        denoiser = from_epsilon(network, a)
    elif kind == "v_prediction":
        denoiser = from_velocity(network, a)
    else:
        denoiser = from_clean(network)
    if getattr(config, "clip_sample", False):
        denoiser = clipped(denoiser, float(getattr(config, "clip_sample_range", 1.0)))
    return denoiser, Schedule.from_alphas_cumprod(a)


def clipped(denoiser: Denoiser, limit: float = 1.0) -> Denoiser:
    """The denoiser with its estimate clipped to [-limit, limit], normalised coordinates."""
    return lambda x, t: denoiser(x, t).clamp(-limit, limit)


def batched(denoiser: Denoiser, size: int) -> Denoiser:
    """The denoiser called with at most `size` plans at a time, for bounded memory."""
    return lambda x, t: torch.cat([denoiser(part, t) for part in torch.split(x, size)])


def _levels(alphas_cumprod: Sequence[float] | Tensor) -> list[float]:
    """alpha_bar by step: 1 at step 0, then as given."""
    return [1.0, *(float(level) for level in alphas_cumprod)]


def _steps(x: Tensor, t: int) -> Tensor:
    """The step of every plan, counted from 0 as these networks count."""
    return torch.full((len(x),), t - 1, dtype=torch.long, device=x.device)
