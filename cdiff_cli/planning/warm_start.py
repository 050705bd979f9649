"""What a plan of receding-horizon control takes over from the last one: the plan itself, moved on, and the multipliers."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cdiff_cli.arrays import Rows, Traj
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.models.normaliser import Normaliser
from cdiff_cli.projection.segments import row_blocks
from cdiff_cli.sampling.methods import AlmState, AugmentedLagrangian, PrimalDual
from cdiff_cli.sampling.sampler import Method, PlannerKind, Step


def shift_plan(to: Normaliser, last: NDArray[np.float64], steps: int) -> Tensor:
    """The last plans, environment units, moved on by the steps executed, from the centre of the present frame. What they do not
    reach goes on as the frame foresees, at 0: a last waypoint repeated is a robot that stops, which few steps of denoising believe.
    """
    y = torch.from_numpy(np.concatenate((last[:, steps:], last[:, :steps]), 1)) - to.centre
    y[:, -steps:] = 0.0
    return y


@dataclass
class CarriedMultipliers:
    """The method, begun with the multipliers that the last plan ended with, moved on by `tighten` waypoints: reset, they would have
    to be found again in the few steps of a warm plan.

    state   of the method after its last step; None to begin anew
    """

    method: Method
    shift: int
    state: Any = None

    @property
    def enforces(self) -> bool:
        return self.method.enforces

    @property
    def polished(self) -> bool:
        return self.method.polished

    @property
    def candidates(self) -> int:
        return self.method.candidates

    @property
    def planner(self) -> PlannerKind:
        return self.method.planner

    def init(self, x: Traj, g: Constraint) -> Any:
        fresh, last = self.method.init(x, g), self.state
        if isinstance(fresh, AlmState) and isinstance(last, AlmState):
            return fresh._replace(lam=self._moved(fresh.lam, last.lam, g, x.shape[1]))
        return self._moved(fresh, last, g, x.shape[1]) if isinstance(fresh, torch.Tensor) else fresh

    def step(self, step: Step, g: Constraint, state: Any) -> tuple[Traj, Any]:
        x, self.state = self.method.step(step, g, state)
        return x, self.state

    def _moved(self, fresh: Rows, last: Any, g: Constraint, horizon: int) -> Rows:
        """The last rows moved on block by block, the new ones at the end as they begin."""
        if not isinstance(last, torch.Tensor) or last.shape != fresh.shape:
            return fresh
        out, planes = (
            fresh.clone(),
            isinstance(self.method, PrimalDual | AugmentedLagrangian) and self.method.on != "noisy",
        )
        for block in row_blocks(g, horizon, planes):
            kept = max(block.stop - block.start - self.shift, 0)
            out[:, block.start : block.start + kept] = last[:, block.stop - kept : block.stop]
        return out


def select_multipliers(multipliers: Any, episodes: NDArray[np.bool_]) -> Any:
    """A method's multipliers of some episodes; those that all episodes share are theirs too."""
    some = torch.from_numpy(episodes)
    if isinstance(multipliers, AlmState):
        return multipliers._replace(lam=select_multipliers(multipliers.lam, episodes))
    if isinstance(multipliers, torch.Tensor) and len(multipliers) == len(some):
        return multipliers[some]
    return multipliers
