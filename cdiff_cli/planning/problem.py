"""A planning problem with all that sampling needs, its pins, and whether its ends are feasible."""

from dataclasses import dataclass

import numpy as np
import torch

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import check_rates
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.errors import CdiffError, InfeasibleError
from cdiff_cli.models.normaliser import Normaliser
from cdiff_cli.models.planner import Planner
from cdiff_cli.tasks.protocol import HasMap, Task, Tolerances

POLISH_MARGIN = 1e-6
"""Margin of the final projection, environment units; larger than every solver's tolerance."""


DEFAULT_TOLERANCES = Tolerances()


@dataclass(frozen=True)
class Problem:
    """Whole plans to be made.

    declared     g as declared, at the waypoints: what is scored        environment units
    enforced     what plans satisfy: g on segments, dynamics, margins   environment units
    start, goal  pinned states [dim], or one per plan [n, dim], or None
    """

    planner: Planner
    declared: Constraint
    enforced: Constraint
    start: Array | None = None
    goal: Array | None = None
    tolerances: Tolerances = DEFAULT_TOLERANCES

    @property
    def normaliser(self) -> Normaliser:
        """The planner's normaliser, the same for every plan.

        Raises CdiffError where windows are relative to a first state.
        """
        if not isinstance(self.planner.normaliser, Normaliser):
            raise CdiffError(
                "this planner sees windows relative to a first state; act with a controller"
            )
        return self.planner.normaliser

    def pins(
        self, n: int, dtype: torch.dtype = torch.float32, device: torch.device | None = None
    ) -> Pins:
        """The start as the first waypoint, the goal as the last, of n plans, normalised.

        device   None: the planner's
        """
        shape = (self.planner.horizon, self.planner.dim)
        mask = torch.zeros(shape, dtype=torch.bool)
        values = torch.zeros((n, *shape), dtype=torch.float64)
        for index, state in ((0, self.start), (-1, self.goal)):
            if state is not None:
                mask[index] = True
                values[:, index] = self.normaliser.encode(torch.from_numpy(state))
        where = self.planner.device if device is None else device
        return Pins(mask.to(where), values.to(where, dtype))


def check_feasible(problem: Problem, task: Task | None = None) -> None:
    """Refuse a start or goal inside a wall of the task or outside the constraints.

    Raises CdiffError, or InfeasibleError where a constraint is the reason.
    """
    for name, states in (("start", problem.start), ("goal", problem.goal)):
        for state in () if states is None else np.atleast_2d(states):
            _check_end(problem, task, name, state)
    check_rates(problem.declared)
    if problem.start is None or problem.goal is None:
        return
    pins = problem.pins(len(np.atleast_2d(problem.start)), torch.float64, torch.device("cpu"))
    normalised = pull_back(problem.declared, problem.normaliser.centre, problem.normaliser.scale)
    for part in normalised.parts:
        part.check_pins(pins, POLISH_MARGIN)


def _check_end(problem: Problem, task: Task | None, name: str, state: Array) -> None:
    columns = problem.planner.position_columns
    names = [problem.planner.coordinates[column] for column in columns]
    point = ", ".join(f"{c} = {v:g}" for c, v in zip(names, state[columns], strict=True))
    if (
        task is not None
        and isinstance(task, HasMap)
        and not task.is_free(state[columns], task.footprint)
    ):
        raise CdiffError(
            f"the {name} ({point}) is inside a wall or touches one; "
            f"choose a free point of {task.name}"
        )
    for part in problem.declared.parts:
        level = part.level
        value = float(level(torch.from_numpy(state))) if level is not None else 0.0
        if value > 0:
            raise InfeasibleError(
                f'the constraint "{part.name}" excludes the {name} ({point}): '
                f"g = {value:.3g} there, must be <= 0; move the {name} or relax the constraint"
            )
