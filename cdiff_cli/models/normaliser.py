"""Normalisers: environment units to the network's, and back.

A plain one is affine by coordinate. A residual one sees a window relative to a linear prediction from its first state.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from cdiff_cli.arrays import Array

LEAST = 1e-6


@dataclass(frozen=True)
class Normaliser:
    """x = centre + scale * z, coordinate by coordinate; coordinates of one group share a scale, so a ball stays a ball.

    centre, scale   environment units   [dim]
    """

    centre: Tensor
    scale: Tensor

    @classmethod
    def fit(
        cls, states: Array, layout: Sequence[str], shared: Sequence[Sequence[str]]
    ) -> "Normaliser":
        """Limits of the data [n, dim] to [-1, 1]; the widest coordinate of a shared group sets the group's scale."""
        low, high = states.min(0), states.max(0)
        half = np.maximum((high - low) / 2, 1e-6)
        for group in shared:
            columns = [layout.index(name) for name in group]
            half[columns] = half[columns].max()
        return cls(torch.from_numpy((low + high) / 2), torch.from_numpy(half))

    @classmethod
    def identity(cls, dim: int) -> "Normaliser":
        return cls(torch.zeros(dim, dtype=torch.float64), torch.ones(dim, dtype=torch.float64))

    @classmethod
    def from_limits(cls, low: ArrayLike, high: ArrayLike) -> "Normaliser":
        """[low, high] of each coordinate to [-1, 1]   [dim], environment units

        Raises ValueError where a coordinate has no width, or an infinite one.
        """
        bottom, top = (torch.as_tensor(np.asarray(v, dtype=np.float64)) for v in (low, high))
        vectors = bottom.shape == top.shape and bottom.ndim == 1
        if not vectors or not bool(((bottom < top) & (top - bottom).isfinite()).all()):
            raise ValueError(
                f"expected low < high for every coordinate, both finite, found {low!r} and {high!r}"
            )
        return cls((bottom + top) / 2, (top - bottom) / 2)

    def at(self, present: Tensor) -> "Normaliser":
        """The same map for windows from any present state, as ResidualNormaliser.at."""
        return Normaliser(self.centre[None, None], self.scale[None])

    def encode(self, x: Tensor) -> Tensor:
        return (x - self.centre.to(x)) / self.scale.to(x)

    def decode(self, z: Tensor) -> Tensor:
        return self.centre.to(z) + self.scale.to(z) * z


@dataclass(frozen=True)
class ResidualNormaliser:
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
        centre = (
            present[:, None]
            + self.mean.to(present)
            + torch.einsum("kij,nj->nki", self.gain.to(present), told)
        )
        centre[:, 0] = torch.where(seen, self.state.centre.to(present), present)
        scale = self.scale.to(present).clone()
        scale[0] = self.state.scale.to(present)
        return Normaliser(centre, scale)

    def encode(self, x: Tensor) -> Tensor:
        """z of windows x [batch, horizon, dim]."""
        return self.at(x[:, 0]).encode(x)
