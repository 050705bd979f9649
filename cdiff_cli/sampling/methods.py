"""The paper's three methods as printed: projected, primal-dual, augmented Lagrangian.

Read beside the paper's section 4, in its order. `reverse(x0)` is the unconstrained reverse step:
with the kernel `langevin` the paper's x_t + (beta_t / 2) score + sqrt(beta_t) z (Eq. 8). Other
kernels go on from the same clean estimate. dg is the gradient of g. The sample is changed after the
reverse step, and pinned states do not move. clean_methods.py changes the clean estimate instead.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from cdiff_cli.arrays import Rows, Traj
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.projection.project import project
from cdiff_cli.sampling.multipliers import (
    Coefficient,
    Expectation,
    Positive,
    expect,
    linearise,
    multiplier,
    spread,
    weight,
    zeros,
)
from cdiff_cli.sampling.sampler import PlannerKind, Step


@dataclass(frozen=True)
class Projected:
    """Projected diffusion projects every sample onto C = {g <= 0}   (paper, section 4.1).

    x_{t-1} = Pi_C(reverse(x0))
    """

    on: ClassVar[str] = "noisy"
    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    def init(self, x: Traj, g: Constraint) -> None:
        return None

    def step(self, step: Step, g: Constraint, state: None) -> tuple[Traj, None]:
        x = step.reverse(step.x0)
        return project(g, x, step.pins, strict=False), None  # Eq. qp


@dataclass(frozen=True)
class PrimalDual:
    """Primal-dual: multipliers lam rise with the violation, x descends lam^T g   (section 4.2).

    x_{t-1} = reverse(x0) - c_t lam_t^T dg(x_t)     (Eq. pri)
    lam_{t-1} = [lam_t + eta E g(x_t)]_+            (Eq. dual)

    eta           dual step size
    coefficient   factor c_t of the push
    expectation   E g of each plan, or of the batch
    positive      g itself, or its smooth positive part
    """

    on: ClassVar[str] = "noisy"
    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    eta: float = 1.0
    coefficient: Coefficient = "beta/2"
    expectation: Expectation = "per_sample"
    positive: Positive = "none"

    def init(self, x: Traj, g: Constraint) -> Rows:
        return zeros(x, g, self.expectation, tangent_planes=False)

    def step(self, step: Step, g: Constraint, state: Rows) -> tuple[Traj, Rows]:
        lam, c_t = state, weight(self.coefficient, step)
        rows, pull, _ = linearise(g, step.x, self.positive)  # g(x_t), w -> w^T dg(x_t)
        push = step.pins.free(pull(spread(lam, rows)))  # lam_t^T dg(x_t)
        x = step.reverse(step.x0) - c_t * push  # Eq. pri
        lam = (lam + self.eta * expect(rows, self.expectation)).clamp_min(0)  # Eq. dual
        return x, lam


class AlmState(NamedTuple):
    """Multipliers lam [batch or 1, n] and the penalty weight rho."""

    lam: Rows
    rho: float


@dataclass(frozen=True)
class AugmentedLagrangian:
    """Augmented Lagrangian: primal-dual with a growing quadratic penalty   (paper, section 4.3).

    s_t = [-E g(x_t) - lam_t / rho_t]_+                                     (Eq. alm_slack)
    x_{t-1} = reverse(x0) - c_t (lam_t + rho_t (E g(x_t) + s_t))^T dg(x_t)  (Eq. alm_ineq_pri_x_fo)
    lam_{t-1} = lam_t + rho_t (E g(x_t) + s_t)                              (Eq. alm_ineq_dual)
    rho_{t-1} = c rho_t

    Both use lam_t + rho_t (E g + s_t), which equals [lam_t + rho_t E g]_+ and is computed so.

    rho           first penalty weight
    c             growth of the penalty weight per step
    coefficient   factor c_t of the push
    expectation   E g of each plan, or of the batch
    positive      g itself, or its smooth positive part
    """

    on: ClassVar[str] = "noisy"
    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    rho: float = 0.5
    c: float = 1.02
    coefficient: Coefficient = "beta/2"
    expectation: Expectation = "per_sample"
    positive: Positive = "none"

    def init(self, x: Traj, g: Constraint) -> AlmState:
        return AlmState(zeros(x, g, self.expectation, tangent_planes=False), self.rho)

    def step(self, step: Step, g: Constraint, state: AlmState) -> tuple[Traj, AlmState]:
        (lam, rho), c_t = state, weight(self.coefficient, step)
        rows, pull, _ = linearise(g, step.x, self.positive)  # g(x_t), w -> w^T dg(x_t)
        lam = multiplier(expect(rows, self.expectation), lam, rho)  # Eqs. alm_slack, alm_ineq_dual
        push = step.pins.free(pull(spread(lam, rows)))  # lam_{t-1}^T dg(x_t)
        x = step.reverse(step.x0) - c_t * push  # Eq. alm_ineq_pri_x_fo
        return x, AlmState(lam, self.c * rho)
