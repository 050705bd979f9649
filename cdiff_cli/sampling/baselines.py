"""Methods that the paper's three are compared with, besides SafeDiffuser (safediffuser.py)."""

from dataclasses import dataclass
from typing import ClassVar

import torch

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.projection.project import project
from cdiff_cli.sampling.sampler import PlannerKind, Step


@dataclass(frozen=True)
class Unconstrained:
    """Diffuser: x_{t-1} = reverse(x0), g is ignored."""

    enforces: ClassVar[bool] = False
    polished: ClassVar[bool] = False
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    def init(self, x: Traj, g: Constraint) -> None:
        return None

    def step(self, step: Step, g: Constraint, state: None) -> tuple[Traj, None]:
        return step.reverse(step.x0), None


@dataclass(frozen=True)
class Guidance:
    """Guidance pushes with constant weight along the gradient of every row, violated or not.

    x_{t-1} = reverse(x0) - weight sum_i dg_i(x_t)

    The released maze code calls this "conditional". The paper's text means a trained planner: the
    class Conditional.

    weight   5.5e-3 as released
    """

    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    weight: float = 5.5e-3

    def init(self, x: Traj, g: Constraint) -> None:
        return None

    def step(self, step: Step, g: Constraint, state: None) -> tuple[Traj, None]:
        rows, pull, _ = g.linearise(step.x)
        push = step.pins.free(pull(torch.ones_like(rows)))
        return step.reverse(step.x0) - self.weight * push, None


@dataclass(frozen=True)
class Conditional:
    """The paper's Conditional uses a planner that is trained with constraint labels.

    The planner is conditioned on the label "satisfied" (training/labels.py). The step itself is the
    unconstrained one.

    weight   weight of classifier-free guidance; 1 is the conditioned estimate itself, other values
             take two network calls per step
    """

    enforces: ClassVar[bool] = False
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "conditional"

    weight: float = 2.0

    def init(self, x: Traj, g: Constraint) -> None:
        return None

    def step(self, step: Step, g: Constraint, state: None) -> tuple[Traj, None]:
        return step.reverse(step.x0), None


@dataclass(frozen=True)
class FinalProjection:
    """The unconstrained plan is projected once, after the last step."""

    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    def init(self, x: Traj, g: Constraint) -> None:
        return None

    def step(self, step: Step, g: Constraint, state: None) -> tuple[Traj, None]:
        x = step.reverse(step.x0)
        return (project(g, x, step.pins, strict=False) if step.last else x), None


@dataclass(frozen=True)
class BestOf:
    """Best of k samples k unconstrained plans per seed, and planning keeps one of them.

    It is the plan with the least sum of [g]_+, the first among equals.

    k   plans per seed; network calls are k-fold
    """

    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = False
    planner: ClassVar[PlannerKind] = "unconditional"

    k: int = 8

    @property
    def candidates(self) -> int:
        return self.k

    def init(self, x: Traj, g: Constraint) -> None:
        return None

    def step(self, step: Step, g: Constraint, state: None) -> tuple[Traj, None]:
        return step.reverse(step.x0), None
