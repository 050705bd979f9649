"""What a plan takes over from the previous one: the plan itself, shifted, and the multipliers."""

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
from cdiff_cli.sampling.sampler import Method


def shift_plan(window: Normaliser, last: NDArray[np.float64], steps: int) -> Tensor:
    """The previous plans shifted by the executed steps, relative to the present window's centre.

    The waypoints that they do not reach are at the centre, 0. Repeating the last waypoint there
    would show a robot that stops, which a few denoising steps do not correct.

    last   environment units [n, horizon, dim]
    """
    y = torch.from_numpy(np.concatenate((last[:, steps:], last[:, :steps]), 1)) - window.centre
    y[:, -steps:] = 0.0
    return y


def carry(method: Method, last: Any, g: Constraint, x: Traj, executed: int) -> Any:
    """State that the method begins the next plan with, holding the previous plan's multipliers.

    The multipliers move forward by the executed waypoints, block by block, and those of the new
    waypoints begin at zero. With all at zero, they would have to be found again in the few steps of
    a warm-started plan. A penalty weight begins anew. Multipliers for another number of rows or
    plans are dropped.

    last       state after the last step of the previous plans, in the same order; None: begin anew
    g          the constraint that sample() is given
    x          any tensor of the plans' shape [batch, horizon, dim], type and device
    executed   waypoints by which the present plan begins later than the previous one
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
    """The previous multipliers moved forward block by block; new rows stay as in `fresh`."""
    if not isinstance(last, torch.Tensor) or last.shape != fresh.shape:
        return fresh
    out = fresh.clone()
    on_clean_estimate = getattr(method, "on", "noisy") != "noisy"
    for block in row_blocks(g, horizon, planes=on_clean_estimate):
        kept = max(block.stop - block.start - executed, 0)
        out[:, block.start : block.start + kept] = last[:, block.stop - kept : block.stop]
    return out
