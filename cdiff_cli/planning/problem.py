"""A planning problem with all that sampling needs, its pins, and whether it can be met at its ends."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import check_rates
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.errors import CdiffError, InfeasibleError
from cdiff_cli.models.denoiser import Denoiser
from cdiff_cli.models.normaliser import Normaliser
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.tasks.protocol import Task

MARGIN = (
    1e-6  # how far inside the polish puts a plan, environment units: above every solver's tolerance
)


@dataclass(frozen=True)
class Problem:
    """All that sampling needs, resolved.

    g            as declared, at the waypoints: what is scored                       environment units
    enforced     what sampling obeys: g, taken on the segments where that is asked   environment units
    start, goal  pinned states [dim], or one a plan [n, dim], or None
    """

    task: Task
    horizon: int
    denoiser: Denoiser
    schedule: Schedule
    normaliser: Normaliser
    g: Constraint
    enforced: Constraint
    start: Array | None
    goal: Array | None
    device: torch.device


def check_feasible(problem: Problem) -> None:
    """Refuse a start or goal inside a wall or outside the constraints, before anything is sampled."""
    columns = [problem.task.layout.index(name) for name in problem.task.positions]
    for name, states in (("start", problem.start), ("goal", problem.goal)):
        for state in () if states is None else np.atleast_2d(states):
            _check_pin(problem, name, state, columns)
    check_rates(problem.g)
    if problem.start is not None and problem.goal is not None:
        n = len(np.atleast_2d(problem.start))
        pins = make_pins(problem, n, torch.float64, torch.device("cpu"))
        for part in pull_back(problem.g, problem.normaliser.centre, problem.normaliser.scale).parts:
            part.check_pins(pins, MARGIN)


def _check_pin(problem: Problem, name: str, state: Array, columns: list[int]) -> None:
    point = ", ".join(
        f"{c} = {v:g}" for c, v in zip(problem.task.positions, state[columns], strict=True)
    )
    task: Any = problem.task
    if hasattr(task, "is_free") and not task.is_free(state[columns], task.footprint):
        raise CdiffError(
            f"the {name} ({point}) is inside a wall or touches one; choose a free point of {problem.task.name}"
        )
    for part in problem.g.parts:
        level = part.level
        value = float(level(torch.from_numpy(state))) if level is not None else 0.0
        if value > 0:
            raise InfeasibleError(
                f'the constraint "{part.name}" excludes the {name} ({point}): g = {value:.3g} there, must be <= 0; '
                f"move the {name} or relax the constraint"
            )


def make_pins(
    problem: Problem, n: int, dtype: torch.dtype = torch.float32, device: torch.device | None = None
) -> Pins:
    """The start as the first waypoint, the goal as the last, in normalised coordinates."""
    dim = len(problem.task.layout)
    mask = torch.zeros(problem.horizon, dim, dtype=torch.bool)
    values = torch.zeros(n, problem.horizon, dim, dtype=torch.float64)
    for index, state in ((0, problem.start), (-1, problem.goal)):
        if state is not None:
            mask[index] = True
            values[:, index] = problem.normaliser.encode(torch.from_numpy(state))
    device = problem.device if device is None else device
    return Pins(mask.to(device), values.to(device, dtype))
