"""Coordinates of a trajectory that are fixed, such as the start and the goal."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool
from torch import Tensor

from cdiff_cli.arrays import Array, Traj


@dataclass(frozen=True)
class Pins:
    """Coordinates of a trajectory that are fixed.

    mask     True where fixed                                  [horizon, dim]
    values   the fixed values; ignored where mask is False     [batch, horizon, dim]
    """

    mask: Bool[Tensor, "horizon dim"]
    values: Traj

    @cached_property
    def whole(self) -> bool:
        """Whether every waypoint is fixed as a whole or not at all."""
        return bool((self.mask.all(1) == self.held).all())

    @cached_property
    def held(self) -> Bool[Tensor, "horizon"]:  # noqa: F821
        """Waypoints with a fixed coordinate."""
        return self.mask.any(1)

    @cached_property
    def loose(self) -> tuple[int, int]:
        """The first waypoint without a fixed coordinate, and the index after the last one."""
        free = [tau for tau, held in enumerate(self.held.tolist()) if not held]
        return (free[0], free[-1] + 1) if free else (0, 0)

    @classmethod
    def none(cls, like: Traj) -> "Pins":
        """Nothing is fixed."""
        return cls(torch.zeros(like.shape[1:], dtype=torch.bool, device=like.device), like)

    @classmethod
    def ends(cls, x: Traj | Array) -> "Pins":
        """The first and the last state of each trajectory are fixed at their values in x.

        x   [batch, horizon, dim], numpy or torch
        """
        x = torch.as_tensor(x)
        mask = torch.zeros(x.shape[1:], dtype=torch.bool, device=x.device)
        mask[[0, -1]] = True
        return cls(mask, x)

    def paint(self, x: Traj) -> Traj:
        """x with the pinned coordinates at their values."""
        return torch.where(self.mask, self.values.to(x), x)

    def free(self, direction: Traj) -> Traj:
        """The direction with 0 at the pinned coordinates."""
        return torch.where(self.mask, 0.0, direction)
