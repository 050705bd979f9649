"""The networks: nn.Modules and nothing else."""

import math
from itertools import pairwise
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class TemporalUnet(nn.Module):
    """U-Net over the horizon that predicts the clean trajectory from a noisy one whose pinned waypoints are clean.

    Diffuser's architecture (Janner et al., 2022): residual blocks of two kernel-5 convolutions, the diffusion step added
    between them, stride-2 down- and upsampling between levels, skip connections. Two additions, for plans that do not jump
    at their pinned ends: every waypoint sees the pinned states as further channels, and within `ramp` waypoints of an end
    the output is blended into the pinned state.

    dim         number of coordinates of a waypoint
    width       channels of the first level
    multipliers channels of each level, in units of width; the horizon must divide by 2^(levels - 1)
    ends        the pinned waypoints: 0 the first, -1 the last
    ramp        length of the blend, waypoints
    """

    def __init__(
        self,
        dim: int,
        width: int = 32,
        multipliers: tuple[int, ...] = (1, 2, 4),
        ends: tuple[int, ...] = (0, -1),
        ramp: int = 16,
    ) -> None:
        nn.Module.__init__(self)
        self.ends, self.ramp = ends, ramp
        channels = [dim * (1 + len(ends)), *(width * m for m in multipliers)]
        levels = list(pairwise(channels))
        self.stride = 2 ** (len(levels) - 1)
        self.embed = nn.Sequential(SinusoidalStep(width), nn.Linear(width, 4 * width), nn.Mish(), nn.Linear(4 * width, width))
        self.down = nn.ModuleList(
            nn.ModuleList(
                (
                    ResidualBlock(c_in, c_out, width),
                    ResidualBlock(c_out, c_out, width),
                    nn.Conv1d(c_out, c_out, 3, stride=2, padding=1) if i < len(levels) - 1 else nn.Identity(),
                )
            )
            for i, (c_in, c_out) in enumerate(levels)
        )
        top = channels[-1]
        self.middle = nn.ModuleList((ResidualBlock(top, top, width), ResidualBlock(top, top, width)))
        self.up = nn.ModuleList(
            nn.ModuleList(
                (
                    ResidualBlock(2 * c_out, c_in, width),
                    ResidualBlock(c_in, c_in, width),
                    nn.ConvTranspose1d(c_in, c_in, 4, stride=2, padding=1),
                )
            )
            for c_in, c_out in reversed(levels[1:])
        )
        self.head = nn.Sequential(ConvBlock(channels[1], channels[1]), nn.Conv1d(channels[1], dim, 1))

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        """The clean estimate [batch, horizon, dim] of the noisy trajectories x at the diffusion steps t [batch]."""
        pinned = [x[:, [end]] for end in self.ends]
        h = torch.cat((x, *(state.expand_as(x) for state in pinned)), -1).transpose(1, 2)
        step = self.embed(t)
        skips = []
        for first, second, shrink in cast(Any, self.down):
            h = second(first(h, step), step)
            skips.append(h)
            h = shrink(h)
        for block in self.middle:
            h = block(h, step)
        for first, second, grow in cast(Any, self.up):
            h = second(first(torch.cat((h, skips.pop()), 1), step), step)
            h = grow(h)
        estimate = self.head(h).transpose(1, 2).to(x)
        for end, state in zip(self.ends, pinned, strict=True):
            share = self._share(end, x)
            estimate = share * state + (1 - share) * estimate
        return estimate

    def _share(self, end: int, x: Tensor) -> Tensor:
        """Share of the pinned state in the output [horizon, 1]: 1 at the end, falling to 0 within the ramp."""
        ramp = min(self.ramp, x.shape[1] // 2)
        tau = torch.arange(x.shape[1], device=x.device, dtype=x.dtype)
        share = (1 - tau / max(ramp, 1)).clamp_min(0.0)[:, None]
        return share if end == 0 else share.flip(0)


class SinusoidalStep(nn.Module):
    """Sines and cosines of the diffusion step, [batch] -> [batch, width]."""

    def __init__(self, width: int) -> None:
        nn.Module.__init__(self)
        half = width // 2
        self.register_buffer("frequency", torch.exp(torch.arange(half) * (-math.log(10000) / (half - 1))), persistent=False)

    def forward(self, t: Tensor) -> Tensor:
        angle = t[:, None] * cast(Tensor, self.frequency)
        return torch.cat((angle.sin(), angle.cos()), -1)


class ConvBlock(nn.Sequential):
    """Convolution of kernel 5, group normalisation, Mish: [batch, c_in, horizon] -> [batch, c_out, horizon]."""

    def __init__(self, c_in: int, c_out: int) -> None:
        nn.Sequential.__init__(self, nn.Conv1d(c_in, c_out, 5, padding=2), nn.GroupNorm(8, c_out), nn.Mish())


class ResidualBlock(nn.Module):
    """Two ConvBlocks with the embedded diffusion step added in between, and a skip connection."""

    def __init__(self, c_in: int, c_out: int, width: int) -> None:
        nn.Module.__init__(self)
        self.first, self.second = ConvBlock(c_in, c_out), ConvBlock(c_out, c_out)
        self.step = nn.Linear(width, c_out)
        self.skip = nn.Conv1d(c_in, c_out, 1) if c_in != c_out else nn.Identity()

    def forward(self, x: Tensor, step: Tensor) -> Tensor:
        h = self.first(x) + self.step(F.mish(step))[:, :, None]
        return self.second(h) + self.skip(x)
