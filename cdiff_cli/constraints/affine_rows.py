"""Rows that are affine in the whole trajectory, as one matrix."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class AffineRows:
    """g(x) = A x + b of trajectories x [batch, horizon, dim], each written as one vector.

    A      [n, horizon dim]
    b      [batch | 1, n]
    size   what Constraint.linearise gives for step sizes   [1, n]
    """

    A: Tensor
    b: Tensor
    size: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        return torch.addmm(self.b, x.flatten(1), self.A.T)

    def linearise(self, x: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor], Tensor]:
        """As Constraint.linearise."""
        return self(x), lambda w: (w @ self.A).view(-1, *x.shape[1:]), self.size

    def about(self, centre: Tensor, like: Tensor) -> "AffineRows":
        """The same rows of y, x = centre + y, in the dtype and on the device of `like`   centre [batch, horizon, dim]"""
        return AffineRows(self.A.to(like), self(centre).to(like), self.size.to(like))
