"""Constraint rows that are known only as a function."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.protocol import selected
from cdiff_cli.constraints.trajectory import TrajectoryConstraint


@dataclass(frozen=True)
class BlackBox:
    """Rows that are known only as a function.

    They are differentiated by autograd and projected by sequential quadratic programming.

    fn             trajectory in environment units -> rows, differentiable
    count          horizon -> number of rows
    margin         added to the rows, their units
    centre, scale  the trajectories that fn takes are centre + scale * x; None: x itself   [dim]
    """

    name: str
    fn: Callable[[Traj], Rows]
    count: Callable[[int], int]
    margin: float = 0.0
    centre: Tensor | None = None
    scale: Tensor | None = None

    trailing: ClassVar = {"centre": 1, "scale": 1}
    level = None
    support = 0
    spans = True
    affine = False
    exact_on_segments = False

    def labels(self, horizon: int) -> list[str]:
        return [f"{self.name}@{i}" for i in range(self.count(horizon))]

    def __call__(self, x: Traj) -> Rows:
        if self.centre is not None and self.scale is not None:
            x = self.centre.to(x) + self.scale.to(x) * x
        return self.fn(x) + self.margin

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        with torch.enable_grad():
            leaf = x.detach().clone().requires_grad_()
            rows = self(leaf)

            def pull(w: Rows) -> Traj:
                return torch.autograd.grad(rows, leaf, w, retain_graph=True)[0]

        size = pull(torch.ones_like(rows)).square().sum((1, 2))
        return rows.detach(), pull, size[:, None].expand_as(rows)

    def pull_back(self, centre: Tensor, scale: Tensor) -> "BlackBox":
        if self.centre is None or self.scale is None:
            return replace(self, centre=centre, scale=scale)
        return replace(self, centre=self.centre + self.scale * centre, scale=self.scale * scale)

    def select(self, which: Tensor) -> "BlackBox":
        return selected(self, which)

    def to(self, like: Tensor) -> "BlackBox":
        return self

    def tighten(self, margin: float) -> "BlackBox":
        return replace(self, margin=self.margin + margin)

    tighten_level = tighten

    def segment_max(self, x: Traj) -> Rows:
        return self(x)

    def segment_argmax(self, x: Traj) -> None:
        return None

    def state_values(self, x: Traj) -> Rows:
        return self(x).amax(1, keepdim=True).expand(x.shape[:2])

    def on_segments(self) -> "tuple[TrajectoryConstraint, ...]":
        """The part itself: nothing is known of its rows between waypoints."""
        return (self,)

    def coordinates(self, dim: int) -> list[int]:
        return list(range(dim))

    def restrict(self, columns: Sequence[int]) -> "BlackBox":
        """The part itself, because `columns` are all coordinates."""
        return self

    def check_pins(self, pins: Pins, tolerance: float) -> None:
        """Pins are not checked: no row is known to depend on pinned waypoints alone."""
