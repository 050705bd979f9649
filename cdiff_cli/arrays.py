"""The array types and products that every folder shares."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Traj = Float[Tensor, "batch horizon dim"]
Rows = Float[Tensor, "batch n"]
Pull = Callable[[Rows], Traj]


def dot(x: Tensor, a: Tensor) -> Tensor:
    """a.x over the last dimension."""
    return x @ a if a.ndim == 1 else (x * a).sum(-1)


def times(x: Tensor, P: Tensor) -> Tensor:
    """x.P for states [..., dim] and one matrix, or one for each of them."""
    return x @ P if P.ndim == 2 else (x[..., None, :] @ P)[..., 0, :]


def each_end(p: Tensor, trailing: int) -> tuple[Tensor, Tensor]:
    """A number of the level at the first and at the last waypoint of each segment."""
    axis = p.ndim - 1 - trailing
    if axis < 0 or p.shape[axis] == 1:
        return p, p
    n = p.shape[axis] - 1
    return p.narrow(axis, 0, n), p.narrow(axis, 1, n)
