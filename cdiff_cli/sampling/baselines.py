"""What the paper's methods are compared with, besides SafeDiffuser: each a few lines on the seams of methods.py."""

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
    """x_{t-1} = reverse(x0) - weight sum dg(x_t): a push of constant weight along every row's gradient, violated or not.

    The released maze code calls it conditional; the paper's text means `conditional`, trained.

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
        return step.reverse(step.x0) - self.weight * step.pins.free(
            pull(torch.ones_like(rows))
        ), None


@dataclass(frozen=True)
class Conditional:
    """The paper's Conditional: a planner trained with labels that say whether a window obeys the constraints, asked for one that
    does (labels.py); its step is the plain one.

    weight   of classifier-free guidance: 1 is the conditioned estimate itself, above it two network calls a step
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
    """The unconstrained plan, projected once when it is done."""

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
    """k unconstrained plans a seed, of which open_loop.py keeps the safest: the least sum of [g]_+, the first among equals.

    k   plans a seed; the network calls are k-fold
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
