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
    """The product a.x over the last dimension."""
    return x @ a if a.ndim == 1 else (x * a).sum(-1)


def times(x: Tensor, P: Tensor) -> Tensor:
    """The product x.P for states x [..., dim] and one matrix P, or one matrix per state."""
    return x @ P if P.ndim == 2 else (x[..., None, :] @ P)[..., 0, :]


def each_end(p: Tensor, trailing: int) -> tuple[Tensor, Tensor]:
    """A parameter of a state set at the first and at the last waypoint of each segment.

    p          [...], or with the horizon in front of its last `trailing` dimensions
    trailing   number of dimensions that the parameter has at one waypoint
    """
    axis = p.ndim - 1 - trailing
    if axis < 0 or p.shape[axis] == 1:
        return p, p
    n = p.shape[axis] - 1
    return p.narrow(axis, 0, n), p.narrow(axis, 1, n)
