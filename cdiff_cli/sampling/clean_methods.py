"""The paper's three methods on the clean estimate x0 instead of the noisy sample x_t.

They are ours, not the paper's: see docs/paper.md, Deviations.

clean      the clean estimate is changed before the reverse step: x_{t-1} = reverse(x0')
estimate   g is evaluated at the clean estimate, and the sample is changed after the reverse step;
           meant for control, dual methods only

Where g keeps segments outside a ball, the dual methods use the rows of tangent half-spaces at x0
(projection/segments.py) in place of g's own. Their normals rotate evenly along the path, and each
row keeps its place from step to step. The gradient of g itself pushes each segment straight away
from the centre, and so tears the plan.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

from cdiff_cli.arrays import Rows, Traj
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.projection.project import project
from cdiff_cli.projection.segments import with_tangent_planes
from cdiff_cli.sampling.methods import AlmState
from cdiff_cli.sampling.multipliers import (
    Coefficient,
    Expectation,
    Positive,
    expect,
    idle,
    linearise,
    multiplier,
    spread,
    weight,
    zeros,
)
from cdiff_cli.sampling.sampler import PlannerKind, Step

Correction = Literal["kernel", "latent"]
SMALLEST_SIZE = 1e-12  # [units of g squared] lower bound of |dg|^2 where a row is divided by it


@dataclass(frozen=True)
class CleanProjected:
    """The clean estimate is projected: x0' = P_C(x0).

    correction   how the projection reaches x_{t-1}.
                 kernel: x_{t-1} = reverse(x0'), weighed as the reverse step weighs a clean estimate
                 latent: x_{t-1} = reverse(x0) + sqrt(alpha_bar_{t-1}) (x0' - x0), whole, with the
                 estimated noise kept
    """

    on: ClassVar[str] = "clean"
    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    correction: Correction = "kernel"

    def init(self, x: Traj, g: Constraint) -> None:
        return None

    def step(self, step: Step, g: Constraint, state: None) -> tuple[Traj, None]:
        x0 = project(g, step.x0, step.pins, strict=False)
        if self.correction == "kernel":
            return step.reverse(x0), None
        return step.reverse(step.x0) + step.level * (x0 - step.x0), None


@dataclass(frozen=True)
class CleanPrimalDual:
    """Primal-dual on the clean estimate; its dual step is scaled by the size of each row.

    x0' = x0 - lam_t^T dg(x0),  x_{t-1} = reverse(x0')
    lam_{t-1} = [lam_t + eta E g(x0') / |dg|^2]_+

    eta           dual step size; 1 solves one half-space in one step
    expectation   E g of each plan, or of the batch
    positive      g itself, or its smooth positive part
    """

    on: ClassVar[str] = "clean"
    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    eta: float = 1.0
    expectation: Expectation = "per_sample"
    positive: Positive = "none"

    def init(self, x: Traj, g: Constraint) -> Rows:
        return zeros(x, g, self.expectation, tangent_planes=True)

    def step(self, step: Step, g: Constraint, state: Rows) -> tuple[Traj, Rows]:
        lam = state
        if idle(g, step, lam):
            return step.reverse(step.x0), lam
        planes = with_tangent_planes(g, step.x0, step.pins)
        rows, pull, _ = linearise(planes, step.x0, self.positive)
        x0 = step.x0 - step.pins.free(pull(spread(lam, rows)))
        rows, _, size = linearise(planes, x0, self.positive)
        scaled = expect(rows / size.clamp_min(SMALLEST_SIZE), self.expectation)
        return step.reverse(x0), (lam + self.eta * scaled).clamp_min(0)


@dataclass(frozen=True)
class EstimatePrimalDual:
    """Primal-dual as printed, but with g and its gradient at the clean estimate.

    x_{t-1} = reverse(x0) - c_t lam_t^T dg(x0)
    lam_{t-1} = [lam_t + eta E g(x0)]_+

    Settings are those of methods.PrimalDual.
    """

    on: ClassVar[str] = "estimate"
    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    eta: float = 1.0
    coefficient: Coefficient = "beta/2"
    expectation: Expectation = "per_sample"
    positive: Positive = "none"

    def init(self, x: Traj, g: Constraint) -> Rows:
        return zeros(x, g, self.expectation, tangent_planes=True)

    def step(self, step: Step, g: Constraint, state: Rows) -> tuple[Traj, Rows]:
        lam = state
        if idle(g, step, lam):
            return step.reverse(step.x0), lam
        planes = with_tangent_planes(g, step.x0, step.pins)
        rows, pull, _ = linearise(planes, step.x0, self.positive)
        push = step.pins.free(pull(spread(lam, rows)))
        x = step.reverse(step.x0) - weight(self.coefficient, step) * push
        return x, (lam + self.eta * expect(rows, self.expectation)).clamp_min(0)


@dataclass(frozen=True)
class CleanAugmentedLagrangian:
    """Augmented Lagrangian on the clean estimate; its penalty is scaled by the size of each row.

    y = x0 - lam_t^T dg(x0), the estimate as the known multipliers push it
    lam_{t-1} = [lam_t + rho_t E g(y) / |dg|^2]_+
    x0' = x0 - lam_{t-1}^T dg(y),  x_{t-1} = reverse(x0')
    rho_{t-1} = c rho_t, at most 1 (or the first rho where that is larger)

    rho           first penalty weight; 1 solves one half-space in one step
    c             growth of the penalty weight per step
    expectation   E g of each plan, or of the batch
    positive      g itself, or its smooth positive part
    """

    on: ClassVar[str] = "clean"
    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    rho: float = 0.5
    c: float = 1.02
    expectation: Expectation = "per_sample"
    positive: Positive = "none"

    def init(self, x: Traj, g: Constraint) -> AlmState:
        return AlmState(zeros(x, g, self.expectation, tangent_planes=True), self.rho)

    def step(self, step: Step, g: Constraint, state: AlmState) -> tuple[Traj, AlmState]:
        lam, rho = state
        grown = min(self.c * rho, max(self.rho, 1.0))
        if idle(g, step, lam):
            return step.reverse(step.x0), AlmState(lam, grown)
        planes = with_tangent_planes(g, step.x0, step.pins)
        rows, pull, _ = linearise(planes, step.x0, self.positive)
        pushed = step.x0 - step.pins.free(pull(spread(lam, rows)))
        rows, pull, size = linearise(planes, pushed, self.positive)
        scaled = expect(rows / size.clamp_min(SMALLEST_SIZE), self.expectation)
        lam = multiplier(scaled, lam, rho)
        x0 = step.x0 - step.pins.free(pull(spread(lam, rows)))
        return step.reverse(x0), AlmState(lam, grown)


@dataclass(frozen=True)
class EstimateAugmentedLagrangian:
    """Augmented Lagrangian as printed, but with g and its gradient at the clean estimate.

    lam_{t-1} = [lam_t + rho_t E g(x0)]_+
    x_{t-1} = reverse(x0) - c_t lam_{t-1}^T dg(x0)
    rho_{t-1} = c rho_t

    Settings are those of methods.AugmentedLagrangian.
    """

    on: ClassVar[str] = "estimate"
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
        return AlmState(zeros(x, g, self.expectation, tangent_planes=True), self.rho)

    def step(self, step: Step, g: Constraint, state: AlmState) -> tuple[Traj, AlmState]:
        lam, rho = state
        if idle(g, step, lam):
            return step.reverse(step.x0), AlmState(lam, self.c * rho)
        planes = with_tangent_planes(g, step.x0, step.pins)
        rows, pull, _ = linearise(planes, step.x0, self.positive)
        lam = multiplier(expect(rows, self.expectation), lam, rho)
        push = step.pins.free(pull(spread(lam, rows)))
        x = step.reverse(step.x0) - weight(self.coefficient, step) * push
        return x, AlmState(lam, self.c * rho)
