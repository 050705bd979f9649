"""Warm start of receding-horizon control: the last plan and its multipliers, moved forward."""

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
from cdiff_cli.sampling.methods import AlmState
from cdiff_cli.sampling.sampler import Method, PlannerKind, Step


def shift_plan(to: Normaliser, last: NDArray[np.float64], steps: int) -> Tensor:
    """Move the last plans forward by the executed steps.

    The result is relative to the centre of the present normaliser. The waypoints beyond the end of
    the last plans are 0, which is the normaliser's linear prediction. A repeated last waypoint
    would be a robot that stops, and the few denoising steps of a warm start do not undo that.

    to      normaliser at the present states
    last    last plans, environment units   [batch, horizon, dim]
    steps   executed steps
    """
    y = torch.from_numpy(np.concatenate((last[:, steps:], last[:, :steps]), 1)) - to.centre
    y[:, -steps:] = 0.0
    return y


def carry(method: Method, last: Any, g: Constraint, x: Traj, executed: int) -> Any:
    """State that the method begins the next plan with: fresh but for the last plan's multipliers.

    The multipliers move forward by the executed waypoints, block by block, and those of the new
    waypoints begin at zero. Begun at zero altogether, they would have to be found again in the few
    steps of a warm-started plan. A penalty weight begins anew. Multipliers of another number of
    rows or plans are dropped.

    last       state after the last step of the last plan, of the same plans in the same order;
               None: begin afresh
    g          the constraint that sample() is given
    x          any tensor of the plans' shape [batch, horizon, dim], type and device
    executed   waypoints by which the present plan begins later than the last
    """
    fresh = method.init(x, g)
    if isinstance(fresh, AlmState):
        lam = last.lam if isinstance(last, AlmState) else None
        return fresh._replace(lam=_moved(method, fresh.lam, lam, g, x.shape[1], executed))
    return (
        _moved(method, fresh, last, g, x.shape[1], executed)
        if isinstance(fresh, torch.Tensor)
        else fresh
    )


def select(state: Any, plans: NDArray[np.bool_]) -> Any:
    """State of some of the plans; multipliers shared by all plans stay as they are.

    plans   which of them   [batch]
    """
    if isinstance(state, AlmState):
        return state._replace(lam=select(state.lam, plans))
    if isinstance(state, torch.Tensor) and len(state) == len(plans):
        return state[torch.from_numpy(plans)]
    return state


def _moved(
    method: Method, fresh: Rows, last: Any, g: Constraint, horizon: int, executed: int
) -> Rows:
    """The last multipliers moved forward block by block; rows new to a block are as in `fresh`."""
    if not isinstance(last, torch.Tensor) or last.shape != fresh.shape:
        return fresh
    out = fresh.clone()
    on_clean_estimate = getattr(method, "on", "noisy") != "noisy"
    for block in row_blocks(g, horizon, planes=on_clean_estimate):
        kept = max(block.stop - block.start - executed, 0)
        out[:, block.start : block.start + kept] = last[:, block.stop - kept : block.stop]
    return out


@dataclass
class CarriedMultipliers:
    """A method that begins with carry() and keeps its last state itself, until the controller does.

    shift   executed waypoints
    state   state after the last step; None: begin afresh
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
        return carry(self.method, self.state, g, x, self.shift)

    def step(self, step: Step, g: Constraint, state: Any) -> tuple[Traj, Any]:
        x, self.state = self.method.step(step, g, state)
        return x, self.state

    def select(self, which: NDArray[np.bool_]) -> Any:
        return select(self.state, which)
