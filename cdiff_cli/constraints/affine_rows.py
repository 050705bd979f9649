"""Rows that are affine in the whole trajectory, as one matrix."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class AffineRows:
    """g(x) = A x + b, with each trajectory x [batch, horizon, dim] written as one vector.

    A      [n, horizon dim]
    b      [batch | 1, n]
    size   the bound per row that Constraint.linearise returns   [1, n]
    """

    A: Tensor
    b: Tensor
    size: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        return torch.addmm(self.b, x.flatten(1), self.A.T)

    def linearise(self, x: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor], Tensor]:
        """The values, the pull and the bounds, as Constraint.linearise returns them."""
        return self(x), lambda w: (w @ self.A).view(-1, *x.shape[1:]), self.size

    def about(self, centre: Tensor, like: Tensor) -> "AffineRows":
        """The rows as a function of y, x = centre + y, in the dtype and on the device of `like`.

        centre   [batch, horizon, dim]
        """
        return AffineRows(self.A.to(like), self(centre).to(like), self.size.to(like))
