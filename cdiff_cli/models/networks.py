"""The networks."""

import math
from itertools import pairwise
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class TemporalUnet(nn.Module):
    """A U-Net over the horizon predicts the clean trajectory from a noisy one with clean pins.

    The architecture is Diffuser's (Janner et al., 2022): residual blocks of two kernel-5
    convolutions with the diffusion step added in between, stride-2 down- and upsampling between
    levels, and skip connections. Two additions keep plans from jumping at their pinned ends. Every
    waypoint gets the pinned states as further channels. Within `ramp` waypoints of an end the
    output is blended into the pinned state. Two more, off by default, shorten the training:

    patch        waypoints per token. Above 1 the U-Net works on horizon / patch tokens, and its
                 output is a uniform cubic B-spline with one knot per token. There are fewer tokens
                 to convolve and no jitter to unlearn
    octaves      number of Fourier features sin, cos(2^k pi z), k < octaves. They are features of
                 the pinned states, and of an estimate of the clean trajectory that each level on
                 the way up makes and gets back. Walls are sharp functions of the position, which
                 convolutions of z alone learn slowly

    conditions   entries of a label that the estimate can be conditioned on (labels.py)
    dim          number of coordinates of a waypoint
    width        channels of the first level
    multipliers  channels of each level, in units of width; patch * 2^(levels - 1) divides the
                 horizon
    ends         pinned waypoints: 0 the first, -1 the last
    ramp         length of the blend, in waypoints
    """

    def __init__(
        self,
        dim: int,
        width: int = 32,
        multipliers: tuple[int, ...] = (1, 2, 4),
        *,
        patch: int = 1,
        octaves: int = 0,
        conditions: int = 0,
        ends: tuple[int, ...] = (0, -1),
        ramp: int = 16,
    ) -> None:
        nn.Module.__init__(self)
        self.ends, self.ramp, self.patch, self.octaves = ends, ramp, patch, octaves
        channels = [width * m for m in multipliers]
        inputs = dim * (1 + len(ends) * (1 + 2 * octaves))
        self.stride = patch * 2 ** (len(channels) - 1)
        self.embed = nn.Sequential(
            SinusoidalStep(width),
            nn.Linear(width, 4 * width),
            nn.Mish(),
            nn.Linear(4 * width, width),
        )
        self.stem = (
            nn.Conv1d(inputs, width, 2 * patch, stride=patch, padding=patch // 2)
            if patch > 1
            else nn.Identity()
        )
        self.down = nn.ModuleList(
            nn.ModuleList(
                (
                    ResidualBlock(c_in, c_out, width),
                    ResidualBlock(c_out, c_out, width),
                    nn.Conv1d(c_out, c_out, 3, stride=2, padding=1)
                    if i < len(channels) - 1
                    else nn.Identity(),
                )
            )
            for i, (c_in, c_out) in enumerate(pairwise([width if patch > 1 else inputs, *channels]))
        )
        top = channels[-1]
        self.middle = nn.ModuleList(
            (ResidualBlock(top, top, width), ResidualBlock(top, top, width))
        )
        self.up = nn.ModuleList(
            nn.ModuleList(
                (
                    ResidualBlock(2 * c_out, c_in, width),
                    ResidualBlock(c_in, c_in, width),
                    nn.ConvTranspose1d(c_in, c_in, 4, stride=2, padding=1),
                )
            )
            for c_in, c_out in reversed(list(pairwise(channels)))
        )
        if octaves:
            self.guess = nn.ModuleList(nn.Conv1d(c, dim, 1) for c in reversed(channels))
            self.recall = nn.ModuleList(
                nn.Conv1d(dim * (1 + 2 * octaves), c, 1) for c in reversed(channels)
            )
            self.last = ResidualBlock(channels[0], channels[0], width)
        self.head = nn.Sequential(
            ConvBlock(channels[0], channels[0]), nn.Conv1d(channels[0], dim, 1)
        )
        self.condition = _condition(conditions, width)

    def forward(self, x: Tensor, t: Tensor, condition: Tensor | None = None) -> Tensor:
        """Clean estimate [batch, horizon, dim] of noisy trajectories x at steps t [batch]."""
        return self.estimates(x, t, condition)[-1]

    def estimates(self, x: Tensor, t: Tensor, condition: Tensor | None = None) -> list[Tensor]:
        """Clean estimates at rising resolution [batch, horizon / k, dim].

        The last one is the output. The others estimate means over k waypoints and have a loss of
        their own; without octaves there are none.
        """
        pinned = [x[:, [end]] for end in self.ends]
        features = [
            torch.cat((state, *self._fourier(state)), -1).expand(-1, x.shape[1], -1)
            for state in pinned
        ]
        h = self.stem(torch.cat((x, *features), -1).transpose(1, 2))
        step = self.embed(t) if condition is None else self.embed(t) + self.condition(condition)
        skips, guesses = [], []

        def look(level: int, h: Tensor) -> Tensor:
            """h with the features of a clean estimate from h added."""
            if not self.octaves:
                return h
            guess = self.guess[level](h).float()
            guesses.append(guess.transpose(1, 2))
            place = guess.detach()
            return h + cast(
                Tensor, self.recall[level](torch.cat((place, *self._fourier(place)), 1).to(h))
            )

        for first, second, shrink in cast(Any, self.down):
            h = second(first(h, step), step)
            skips.append(h)
            h = shrink(h)
        for block in self.middle:
            h = block(h, step)
        h = look(0, h)
        for level, (first, second, grow) in enumerate(cast(Any, self.up), start=1):
            h = second(first(torch.cat((h, skips.pop()), 1), step), step)
            h = look(level, grow(h))
        if self.octaves:
            h = self.last(h, step)
        estimate = _spline(self.head(h).to(x), self.patch).transpose(1, 2)
        for end, state in zip(self.ends, pinned, strict=True):
            share = self._share(end, x)
            estimate = share * state + (1 - share) * estimate
        return [*guesses, estimate]

    def _fourier(self, z: Tensor) -> list[Tensor]:
        """Sines and cosines of z at each octave, all with the shape of z."""
        angles = [2**k * math.pi * z for k in range(self.octaves)]
        return [f(angle) for angle in angles for f in (torch.sin, torch.cos)]

    def _share(self, end: int, x: Tensor) -> Tensor:
        """Share of the pinned state in the output [horizon, 1]: 1 at the end, 0 after the ramp."""
        ramp = min(self.ramp, x.shape[1] // 2)
        tau = torch.arange(x.shape[1], device=x.device, dtype=x.dtype)
        share = (1 - tau / max(ramp, 1)).clamp_min(0.0)[:, None]
        return share if end == 0 else share.flip(0)


class ResidualMlp(nn.Module):
    """A residual network predicts a clean window from a noisy one with a clean first waypoint.

    It works on the whole window at once, for the short windows of receding-horizon control. Its
    blocks h + W2 silu(W1 norm(h) + step) have the same width.

    horizon, dim   size of a window
    width, depth   channels and number of the blocks
    """

    def __init__(
        self, dim: int, horizon: int, width: int = 256, depth: int = 3, conditions: int = 0
    ) -> None:
        nn.Module.__init__(self)
        self.embed = nn.Sequential(
            SinusoidalStep(64), nn.Linear(64, width), nn.SiLU(), nn.Linear(width, width)
        )
        self.stem = nn.Linear(horizon * dim, width)
        self.blocks = nn.ModuleList(
            nn.ModuleList((nn.LayerNorm(width), nn.Linear(width, width), nn.Linear(width, width)))
            for _ in range(depth)
        )
        self.head = nn.Sequential(
            nn.LayerNorm(width), nn.SiLU(), nn.Linear(width, (horizon - 1) * dim)
        )
        self.condition = _condition(conditions, width)

    def forward(self, x: Tensor, t: Tensor, condition: Tensor | None = None) -> Tensor:
        """Clean estimate [batch, horizon, dim] of noisy windows x at steps t [batch]."""
        return self.estimates(x, t, condition)[-1]

    def estimates(self, x: Tensor, t: Tensor, condition: Tensor | None = None) -> list[Tensor]:
        """The clean estimate, as the only element of a list."""
        h, step = self.stem(x.flatten(1)), self.embed(t)
        step = step if condition is None else step + self.condition(condition)
        for norm, inward, outward in cast(Any, self.blocks):
            h = h + outward(F.silu(inward(norm(h)) + step))
        ahead = self.head(h).to(x).unflatten(1, (x.shape[1] - 1, x.shape[2]))
        return [torch.cat((x[:, :1], ahead), 1)]


class InverseDynamics(nn.Module):
    """A network u = IDM(x, x') predicts the input that leads from a state to another.

    It gets the normalised state and the normalised change.

    centre, scale   of x and of x' - x, environment units   [2, dim]
    low, high       bounds to which u is clipped            [m]
    """

    def __init__(self, dim: int, inputs: int, width: int = 256) -> None:
        nn.Module.__init__(self)
        for name, shape in (
            ("centre", (2, dim)),
            ("scale", (2, dim)),
            ("low", (inputs,)),
            ("high", (inputs,)),
        ):
            self.register_buffer(name, torch.ones(shape) if name == "scale" else torch.zeros(shape))
        self.layers = nn.Sequential(
            nn.Linear(2 * dim, width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.SiLU(),
            nn.Linear(width, inputs),
        )

    def raw(self, x: Tensor, after: Tensor) -> Tensor:
        """Input before clipping [batch, m], for states and successors [batch, dim].

        States are in environment units.
        """
        centre, scale = cast(Tensor, self.centre), cast(Tensor, self.scale)
        features = torch.cat(((x - centre[0]) / scale[0], (after - x - centre[1]) / scale[1]), -1)
        return cast(Tensor, self.layers(features))

    def forward(self, x: Tensor, after: Tensor) -> Tensor:
        """Input [batch, m], for states and successors [batch, dim]."""
        return torch.minimum(
            torch.maximum(self.raw(x, after), cast(Tensor, self.low)), cast(Tensor, self.high)
        )


def _condition(conditions: int, width: int) -> nn.Module:
    """A map of labels [batch, conditions] into the embedding of the diffusion step.

    It is linear, so that zeros mean no label, and zero before training.
    """
    layer = nn.Linear(conditions, width, bias=False) if conditions else nn.Identity()
    if isinstance(layer, nn.Linear):
        nn.init.zeros_(layer.weight)
    return layer


def _spline(knots: Tensor, patch: int) -> Tensor:
    """Uniform cubic B-spline of knots [batch, dim, n], at `patch` points per knot.

    Its shape is [batch, dim, n * patch]. The end knots are repeated.
    """
    if patch == 1:
        return knots
    u = ((torch.arange(4 * patch, device=knots.device, dtype=knots.dtype) + 0.5) / patch - 2).abs()
    weight = torch.where(u < 1, 2 / 3 - u**2 + u**3 / 2, (2 - u) ** 3 / 6)
    dim, cut = knots.shape[1], 2 * patch + 3 * patch // 2
    padded = F.pad(knots, (2, 2), mode="replicate")
    with torch.autocast(knots.device.type, enabled=False):
        curve = F.conv_transpose1d(padded, weight.expand(dim, 1, -1), stride=patch, groups=dim)
    return curve[..., cut : cut + knots.shape[2] * patch]


class SinusoidalStep(nn.Module):
    """Sines and cosines of the diffusion step, [batch] -> [batch, width]."""

    def __init__(self, width: int) -> None:
        nn.Module.__init__(self)
        half = width // 2
        self.register_buffer(
            "frequency",
            torch.exp(torch.arange(half) * (-math.log(10000) / (half - 1))),
            persistent=False,
        )

    def forward(self, t: Tensor) -> Tensor:
        """Features [batch, width] of the steps t [batch]."""
        angle = t[:, None] * cast(Tensor, self.frequency)
        return torch.cat((angle.sin(), angle.cos()), -1)


class ConvBlock(nn.Sequential):
    """Kernel-5 convolution, group norm, Mish: [batch, c_in, horizon] -> [batch, c_out, horizon]."""

    def __init__(self, c_in: int, c_out: int) -> None:
        nn.Sequential.__init__(
            self, nn.Conv1d(c_in, c_out, 5, padding=2), nn.GroupNorm(8, c_out), nn.Mish()
        )


class ResidualBlock(nn.Module):
    """Two ConvBlocks, with the embedded diffusion step added in between, and a skip connection."""

    def __init__(self, c_in: int, c_out: int, width: int) -> None:
        nn.Module.__init__(self)
        self.first, self.second = ConvBlock(c_in, c_out), ConvBlock(c_out, c_out)
        self.step = nn.Linear(width, c_out)
        self.skip = nn.Conv1d(c_in, c_out, 1) if c_in != c_out else nn.Identity()

    def forward(self, x: Tensor, step: Tensor) -> Tensor:
        """Features [batch, c_out, horizon] of x [batch, c_in, horizon] at step [batch, width]."""
        h = self.first(x) + self.step(F.mish(step))[:, :, None]
        return self.second(h) + self.skip(x)
