"""Normalisers: affine maps between environment units and those of a network.

Normaliser maps each coordinate by itself. ResidualNormaliser maps a window relative to a linear
prediction from its first state.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from cdiff_cli.arrays import Array

LEAST = 1e-6  # scale of a coordinate that is constant


@dataclass(frozen=True)
class Normaliser:
    """x = centre + scale * z, coordinate by coordinate.

    Coordinates of one group share a scale, so that a ball stays a ball.

    centre, scale   environment units   [dim]
    """

    centre: Tensor
    scale: Tensor

    @classmethod
    def fit(
        cls, states: Array, layout: Sequence[str], shared: Sequence[Sequence[str]]
    ) -> "Normaliser":
        """Maps the limits of the data [n, dim] to [-1, 1].

        The widest coordinate of a shared group sets the scale of the group.
        """
        low, high = states.min(0), states.max(0)
        half = np.maximum((high - low) / 2, LEAST)
        for group in shared:
            columns = [layout.index(name) for name in group]
            half[columns] = half[columns].max()
        return cls(torch.from_numpy((low + high) / 2), torch.from_numpy(half))

    @classmethod
    def identity(cls, dim: int) -> "Normaliser":
        """x = z."""
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
        """z of x [..., dim]."""
        return (x - self.centre.to(x)) / self.scale.to(x)

    def decode(self, z: Tensor) -> Tensor:
        """x of z [..., dim]."""
        return self.centre.to(z) + self.scale.to(z) * z


@dataclass(frozen=True)
class ResidualNormaliser:
    """A map of windows relative to a linear prediction from their first state.

    x^0 = state.centre + state.scale z^0
    x^k = x^0 + mean^k + gain^k z^0 + scale^k z^k   for k > 0

    The first row of z is the present state, which the network gets as input. The other rows are
    what a linear regression on the present state leaves, scaled to standard deviation 1.

    state        map of the present state; the network gets 0 for unused coordinates  [dim]
    used         False for coordinates that the dynamics do not depend on             [dim]
    mean, gain   least squares of x^k - x^0 over the windows of the data, in environment units
                 [horizon, dim], [horizon, dim, dim]
    scale        standard deviation of the residual                                   [horizon, dim]
    """

    state: Normaliser
    used: Tensor
    mean: Tensor
    gain: Tensor
    scale: Tensor

    @classmethod
    def from_record(cls, state: Normaliser, record: dict[str, Tensor]) -> "ResidualNormaliser":
        """The normaliser that record() describes."""
        return cls(state, record["seen"], record["mean"], record["gain"], record["scale"])

    def record(self) -> dict[str, Tensor]:
        """Tensors by their names in a checkpoint, which calls the used coordinates `seen`."""
        return {"seen": self.used, "mean": self.mean, "gain": self.gain, "scale": self.scale}

    def at(self, present: Tensor) -> Normaliser:
        """The affine map between z and windows that start in the states `present` [batch, dim].

        Its centre is [batch, horizon, dim], its scale [horizon, dim].
        """
        used = self.used.to(present.device)
        first = torch.where(used, self.state.encode(present), 0.0)
        centre = (
            present[:, None]
            + self.mean.to(present)
            + torch.einsum("kij,nj->nki", self.gain.to(present), first)
        )
        centre[:, 0] = torch.where(used, self.state.centre.to(present), present)
        scale = self.scale.to(present).clone()
        scale[0] = self.state.scale.to(present)
        return Normaliser(centre, scale)

    def encode(self, x: Tensor) -> Tensor:
        """z of windows x [batch, horizon, dim]."""
        return self.at(x[:, 0]).encode(x)
