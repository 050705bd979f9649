"""The frame of a control task: windows of states told relative to the present one, each waypoint on its own scale."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from cdiff_cli.data import Normaliser, Windows

SAMPLED = 100_000  # windows that the scales are measured on
LEAST = 1e-6


@dataclass(frozen=True)
class Frame:
    """x^0 = state.centre + state.scale z^0,  x^k = x^0 + mean^k + gain^k z^0 + scale^k z^k for k > 0.

    The first row of z is the present state, which the network is told and never has to guess; the others say how the window
    goes on from there, beyond what a linear regression on the present state foresees, all of them of size one.

    state         of the present state; coordinates that are not `seen` are told as 0   [dim]
    seen          False for coordinates that nothing depends on                          [dim]
    mean, gain    least squares of x^k - x^0 over the data's windows, environment units  [horizon, dim], [horizon, dim, dim]
    scale         standard deviation of what they leave                                  [horizon, dim]
    """

    state: Normaliser
    seen: Tensor
    mean: Tensor
    gain: Tensor
    scale: Tensor

    def at(self, present: Tensor) -> Normaliser:
        """The affine map between z and windows that begin at the states `present` [batch, dim]: centre [batch, horizon, dim],
        scale [horizon, dim].
        """
        seen = self.seen.to(present.device)
        told = torch.where(seen, self.state.encode(present), 0.0)
        centre = present[:, None] + self.mean.to(present) + torch.einsum("kij,nj->nki", self.gain.to(present), told)
        centre[:, 0] = torch.where(seen, self.state.centre.to(present), present)
        scale = self.scale.to(present).clone()
        scale[0] = self.state.scale.to(present)
        return Normaliser(centre, scale)

    def encode(self, x: Tensor) -> Tensor:
        """z of windows x [batch, horizon, dim]."""
        return self.at(x[:, 0]).encode(x)


def fit_frame(windows: Windows, layout: Sequence[str], shared: Sequence[Sequence[str]], invariant: Sequence[str]) -> Frame:
    """The frame of the windows (raw states); coordinates of a shared group share their scales."""
    every = torch.arange(len(windows.starts))
    x = windows[every[:: max(1, len(every) // SAMPLED)]].double()
    ahead, spread = x - x[:, :1], x[:, 0].std(0)
    for group in shared:
        columns = [layout.index(name) for name in group]
        spread[columns] = spread[columns].max()
    state, seen = Normaliser(x[:, 0].mean(0), spread.clamp_min(LEAST)), torch.tensor([name not in invariant for name in layout])
    told = torch.where(seen, state.encode(x[:, 0]), 0.0)
    known = torch.cat((told, torch.ones_like(told[:, :1])), 1)
    found = torch.linalg.lstsq(known, ahead.flatten(1), driver="gelsd").solution.unflatten(1, ahead.shape[1:])
    gain, mean = found[:-1].permute(1, 2, 0), found[-1]
    scale = (ahead - mean - torch.einsum("kij,nj->nki", gain, told)).std(0)
    for group in shared:
        columns = [layout.index(name) for name in group]
        scale[:, columns] = scale[:, columns].amax(1, keepdim=True)
    return Frame(state, seen, mean, gain, scale.clamp_min(LEAST))
