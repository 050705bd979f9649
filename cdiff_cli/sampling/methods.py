"""The methods: how each reverse step obeys g(x) <= 0. Read beside the paper, section 4.

Every method is the plain step x_{t-1} = reverse(x0) with two holes: the clean estimate x0 may be changed before it, the
sample after it. `on` says where g is evaluated and where the change is made:

noisy     at x_t, the change made to x_{t-1}: the paper's
estimate  at the clean estimate x0, the change made to x_{t-1}: ours for control; multipliers alone
clean     at the clean estimate x0, which is changed before the reverse step: ours, see README, Deviations

Of the dual methods on the last two, the rows of segments round a ball are those of tangent planes at x0 that turn evenly along the
path (segments.py), which keep their places from step to step: g's own push each segment straight out, and so tear the plan.

What the paper compares with stands in safediffuser.py and baselines.py; METHODS names them all.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple, cast, get_args, get_type_hints

import torch
from torch.nn import functional as F

from cdiff_cli.arrays import Pull, Rows, Traj
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.errors import CdiffError, suggestion
from cdiff_cli.projection.project import project
from cdiff_cli.projection.segments import (
    TangentPlanes,
    crossed,
    row_blocks,
    split_excluded,
    with_tangent_planes,
)
from cdiff_cli.sampling.baselines import BestOf, Conditional, FinalProjection, Guidance
from cdiff_cli.sampling.safediffuser import SafeDiffuser
from cdiff_cli.sampling.sampler import Method, PlannerKind, Step

On = Literal["noisy", "clean"]
DualOn = Literal["noisy", "estimate", "clean"]
Expectation = Literal["per_sample", "batch_mean"]
Positive = Literal["none", "silu"]
Correction = Literal["kernel", "latent"]
Coefficient = Literal["beta/2", "one"]


@dataclass(frozen=True)
class Unconstrained:
    """Diffuser: x_{t-1} = reverse(x0), constraints ignored."""

    enforces: ClassVar[bool] = False
    polished: ClassVar[bool] = False
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    def init(self, x: Traj, g: Constraint) -> None:
        return None

    def step(self, step: Step, g: Constraint, state: None) -> tuple[Traj, None]:
        return step.reverse(step.x0), state


@dataclass(frozen=True)
class Projected:
    """x_{t-1} = P_C(reverse(x0)) on noisy (paper, section 4.1); reverse(P_C(x0)) on clean.

    correction   on clean, how the projection reaches x_{t-1}. kernel: as the reverse step weighs a clean estimate. latent: whole,
                 x_{t-1} = reverse(x0) + sqrt(alpha_bar_{t-1}) (P_C(x0) - x0), which keeps the noise that was estimated
    """

    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    on: On = "clean"
    correction: Correction = "kernel"

    def init(self, x: Traj, g: Constraint) -> None:
        return None

    def step(self, step: Step, g: Constraint, state: None) -> tuple[Traj, None]:
        if self.on == "noisy":
            return project(g, step.reverse(step.x0), step.pins, strict=False), None
        x0 = project(g, step.x0, step.pins, strict=False)
        if self.correction == "kernel":
            return step.reverse(x0), None
        return step.reverse(step.x0) + step.level * (x0 - step.x0), None


@dataclass(frozen=True)
class PrimalDual:
    """Multipliers lam climb with the violation; the sample descends lam^T g.

    noisy:  x_{t-1} = reverse(x0) - c_t lam_t^T dg(x_t)               (paper, Eq. pri)
            lam_{t-1} = [lam_t + eta E g(x_t)]_+                      (paper, Eq. dual)
    estimate:  the same with g and dg at x0
    clean:  x0' = x0 - lam_t^T dg(x0),  x_{t-1} = reverse(x0'),  lam_{t-1} = [lam_t + eta E g(x0') / |dg|^2]_+

    eta          dual step; on clean in units of the exact one (1 solves one half-space in a step)
    coefficient  c_t on noisy: beta_t / 2 (the paper) or one (its released code)
    expectation  E g: each plan its own multipliers, or one set for the batch mean (the paper's formula)
    positive     none: E g <= 0;  silu: E g / (1 + e^-g) <= 0, the smooth positive part (paper, Remark 1)
    """

    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    on: DualOn = "clean"
    eta: float = 1.0
    coefficient: Coefficient = "beta/2"
    expectation: Expectation = "per_sample"
    positive: Positive = "none"

    def init(self, x: Traj, g: Constraint) -> Rows:
        return zeros(x, g, self.expectation, self.on != "noisy")

    def step(self, step: Step, g: Constraint, state: Rows) -> tuple[Traj, Rows]:
        lam = state
        if self.on != "noisy" and idle(g, step, lam):
            return step.reverse(step.x0), lam
        if self.on != "clean":
            at = step.x if self.on == "noisy" else step.x0
            rows, pull, _ = linearise(
                g if self.on == "noisy" else with_tangent_planes(g, at, step.pins),
                at,
                self.positive,
            )
            push = step.pins.free(pull(spread(lam, rows)))
            x = step.reverse(step.x0) - weight(self.coefficient, step) * push
            return x, (lam + self.eta * expect(rows, self.expectation)).clamp_min(0)
        flat = with_tangent_planes(g, step.x0, step.pins)
        rows, pull, _ = linearise(flat, step.x0, self.positive)
        x0 = step.x0 - step.pins.free(pull(spread(lam, rows)))
        rows, _, size = linearise(flat, x0, self.positive)
        lam = (lam + self.eta * expect(rows / size.clamp_min(1e-12), self.expectation)).clamp_min(0)
        return step.reverse(x0), lam


class AlmState(NamedTuple):
    """Multipliers [batch or 1, n] and the penalty weight."""

    lam: Rows
    rho: float


@dataclass(frozen=True)
class AugmentedLagrangian:
    """Primal-dual that descends the fresh multiplier and lets the penalty grow (paper, section 4.3).

    s_t = [-E g - lam_t / rho_t]_+,  m = lam_t + rho_t (E g + s_t) = [lam_t + rho_t E g]_+
    noisy:  g at x_t,  x_{t-1} = reverse(x0) - c_t m^T dg(x_t)
    estimate:  the same with g and dg at x0
    clean:  g at x0 - lam_t^T dg(x0), the estimate as the multipliers known so far push it;
            x0' = x0 - m^T dg,  x_{t-1} = reverse(x0')
    lam_{t-1} = m,  rho_{t-1} = c rho_t

    rho          first penalty weight; on clean in units of the exact one, kept at most 1, where one half-space is met at once
    c            its growth a step
    coefficient, expectation, positive   as in PrimalDual
    """

    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    on: DualOn = "clean"
    rho: float = 0.5
    c: float = 1.02
    coefficient: Coefficient = "beta/2"
    expectation: Expectation = "per_sample"
    positive: Positive = "none"

    def init(self, x: Traj, g: Constraint) -> AlmState:
        return AlmState(zeros(x, g, self.expectation, self.on != "noisy"), self.rho)

    def step(self, step: Step, g: Constraint, state: AlmState) -> tuple[Traj, AlmState]:
        lam, rho = state
        if self.on != "noisy" and idle(g, step, lam):
            return step.reverse(step.x0), state._replace(rho=self._grown(rho))
        if self.on != "clean":
            at = step.x if self.on == "noisy" else step.x0
            rows, pull, _ = linearise(
                g if self.on == "noisy" else with_tangent_planes(g, at, step.pins),
                at,
                self.positive,
            )
            m = multiplier(expect(rows, self.expectation), lam, rho)
            push = step.pins.free(pull(spread(m, rows)))
            return step.reverse(step.x0) - weight(self.coefficient, step) * push, AlmState(
                m, self._grown(rho)
            )
        flat = with_tangent_planes(g, step.x0, step.pins)
        rows, pull, _ = linearise(flat, step.x0, self.positive)
        x0 = step.x0 - step.pins.free(pull(spread(lam, rows)))
        rows, pull, size = linearise(flat, x0, self.positive)
        lam = multiplier(expect(rows / size.clamp_min(1e-12), self.expectation), lam, rho)
        x0 = step.x0 - step.pins.free(pull(spread(lam, rows)))
        return step.reverse(x0), AlmState(lam, self._grown(rho))

    def _grown(self, rho: float) -> float:
        """The next penalty weight."""
        return min(self.c * rho, max(self.rho, 1.0)) if self.on == "clean" else self.c * rho


METHODS: dict[str, Callable[..., Method]] = {
    "diffuser": Unconstrained,
    "guidance": Guidance,
    "conditional": Conditional,
    "best-of-k": BestOf,
    "final-projection": FinalProjection,
    "terminal": partial(Projected, on="clean", correction="latent"),
    "safediffuser": SafeDiffuser,
    "projected": Projected,
    "primal-dual": PrimalDual,
    "alm": AugmentedLagrangian,
}
"""A partial holds what its method fixes. `terminal`: only the trajectory that sampling ends at is asked to obey, as DiRecT does
(Giaretta et al., 2026).
"""


def make_method(name: str, settings: Mapping[str, Any]) -> Method:
    """The method of that name with those hyper-parameters; CdiffError where either does not exist or is out of range."""
    if name not in METHODS:
        raise CdiffError(
            f'no method "{name}"{suggestion(name, METHODS)}; choose from {", ".join(METHODS)}'
        )
    hints, known = get_type_hints(_kind(name)), _open(name)
    values = {}
    for key, value in settings.items():
        if key not in known:
            has = ", ".join(known) or "none"
            raise CdiffError(
                f'{name} has no setting "{key}"{suggestion(key, known)}; its settings are: {has}'
            )
        values[key] = _typed(f"{name}.{key}", value, hints[key])
    return METHODS[name](**values)


def settings_of(name: str, method: Method) -> dict[str, Any]:
    """The values of the settings that the method of that name leaves open."""
    return {key: getattr(method, key) for key in _open(name)}


def _kind(name: str) -> type[Method]:
    """The class behind the name."""
    made = METHODS[name]
    return cast(type[Method], made.func if isinstance(made, partial) else made)


def _open(name: str) -> list[str]:
    """The settings that can be asked for: those of the class that the name does not fix."""
    made = METHODS[name]
    fixed = made.keywords if isinstance(made, partial) else {}
    return [f.name for f in fields(_kind(name)) if f.name not in fixed]  # type: ignore[arg-type]


def slack(g: Rows, lam: Rows, rho: float) -> Rows:
    """Slack that closes g + s = 0 for the rows already satisfied.

    Paper, slack update:  s_t = [-E g(x_t) - lam_t / rho_t]_+

    g    E g(x_t), environment units, negative where satisfied   [batch, n]
    lam  multipliers, 1 / units of g, never negative             [batch, n]
    rho  penalty weight, > 0
    """
    return (-g - lam / rho).clamp_min(0)


def multiplier(g: Rows, lam: Rows, rho: float) -> Rows:
    """lam + rho (g + s) with the slack above, which is [lam + rho g]_+ (tests/test_methods.py shows they are equal)."""
    return (lam + rho * g).clamp_min(0)


def idle(g: Constraint, step: Step, lam: Rows) -> bool:
    """Whether a dual step on the clean estimate would change nothing: it obeys g, and no multiplier stands."""
    if _positive(lam):
        return False
    round_, others = split_excluded(g)
    if round_ and bool(crossed(round_, step.x0).any()):
        return False
    return not _positive(others(step.x0))


def _positive(rows: Rows) -> bool:
    """Whether one of them is, or is no number."""
    return rows.numel() > 0 and not float(rows.amax()) <= 0


def linearise(
    g: Constraint | TangentPlanes, x: Traj, positive: Positive
) -> tuple[Rows, Pull, Rows]:
    """g(x), its pull w -> w^T dg/dx and row sizes |dg/dx|^2, of g itself or of its smooth positive part g / (1 + e^-g)."""
    rows, pull, size = g.linearise(x)
    if positive == "none":
        return rows, pull, size
    gate = torch.sigmoid(rows)
    slope = gate * (1 + rows * (1 - gate))
    return F.silu(rows), lambda w: pull(w * slope), size


def zeros(x: Traj, g: Constraint, expectation: Expectation, planes: bool) -> Rows:
    """Multipliers of the rows of g, or where segments go round balls of those of their tangent planes."""
    blocks = row_blocks(g, x.shape[1], planes)  # counted, not evaluated
    return x.new_zeros(
        1 if expectation == "batch_mean" else len(x), blocks[-1].stop if blocks else 0
    )


def expect(rows: Rows, expectation: Expectation) -> Rows:
    """E g: the rows themselves, one multiplier vector a plan, or their mean over the batch [1, n]."""
    return rows if expectation == "per_sample" else rows.mean(0, keepdim=True)


def spread(lam: Rows, rows: Rows) -> Rows:
    """Shared multipliers handed to every plan."""
    return lam.expand_as(rows)


def weight(coefficient: Coefficient, step: Step) -> float:
    return step.beta / 2 if coefficient == "beta/2" else 1.0


def _typed(where: str, value: Any, hint: Any) -> Any:
    """The value as the field's type wants it, from YAML or from a --set string."""
    if choices := get_args(hint):
        if value not in choices:
            raise CdiffError(f"{where}: expected one of {', '.join(choices)}, found {value!r}")
        return value
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise CdiffError(f"{where}: expected a number, found {value!r}") from None
    if not 0 < number < float("inf") or (hint is int and number != int(number)):
        raise CdiffError(
            f"{where}: expected a positive {'whole ' if hint is int else ''}number, found {value}"
        )
    return hint(number)
