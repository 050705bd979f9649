"""Trajectory laws with an exact score, their true constrained laws, and measures of the difference.

The law is a mixture of Gaussian-process bridges in the plane: component k is N(m_k, s_k^2 C) in x
and in y, with C = V diag(l) V^T the covariance of a smooth bridge, zero at the start and the goal.
With a = alpha_bar_t and v_k = a s_k^2 l + 1 - a

    E[x_0 | x_t] = sum_k w_k(x_t) (m_k + V diag(sqrt(a) s_k^2 l / v_k) V^T (x_t - sqrt(a) m_k))
    w_k  proportional to  p_k N(x_t; sqrt(a) m_k, V diag(v_k) V^T)

The constrained law is this law given g <= 0 at every waypoint; rejection samples it without any
diffusion.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.state_sets import Ellipsoid, HalfSpace
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.evaluation import metrics
from cdiff_cli.models.denoiser import Denoiser
from cdiff_cli.models.normaliser import Normaliser
from cdiff_cli.models.planner import Planner
from cdiff_cli.models.preset import SamplerSettings
from cdiff_cli.models.recipe import load_recipe
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.planning.open_loop import plan
from cdiff_cli.planning.polish import polish_plans
from cdiff_cli.planning.problem import Problem
from cdiff_cli.projection.project import project
from cdiff_cli.sampling import METHODS, make_method
from cdiff_cli.sampling.baselines import Unconstrained
from cdiff_cli.sampling.sampler import Method, PlannerKind, Step

Array = NDArray[np.float64]
F64 = torch.float64
SCALE = 1.4  # metres a normalised unit, as in the U-maze
SAFE = (
    1e-5  # [m] largest g that counts as safe: float32 rounding of a plan without final projection
)


@dataclass(frozen=True)
class Routes:
    """A mixture of smooth Gaussian bridges from a start to a goal, in environment units (metres).

    means     mean paths, equal at both ends      [K, horizon, 2]
    std       largest standard deviation of each  [K]
    weights   probability of each                 [K]
    length    correlation length of the deviations, as a share of the horizon
    """

    means: Tensor
    std: Tensor
    weights: Tensor
    length: float = 0.4

    @property
    def horizon(self) -> int:
        return self.means.shape[1]

    @cached_property
    def modes(self) -> tuple[Tensor, Tensor]:
        """Eigenvalues [horizon] and eigenvectors [horizon, horizon] of the bridge's covariance, its
        largest variance 1.
        """
        s = torch.linspace(0, 1, self.horizon, dtype=F64)
        r = math.sqrt(5) * (s[:, None] - s).abs() / self.length
        kernel = (1 + r + r * r / 3) * torch.exp(-r)  # Matern 5/2: two derivatives
        ends = kernel[:, [0, -1]]
        bridge = kernel - ends @ torch.linalg.solve(kernel[[0, -1]][:, [0, -1]], ends.T)
        values, vectors = torch.linalg.eigh(bridge / bridge.diagonal().max())
        return values.clamp_min(0), vectors

    def draw(self, n: int, generator: torch.Generator) -> Tensor:
        """Exact samples of the unconstrained law [n, horizon, 2]."""
        values, vectors = self.modes
        k = torch.multinomial(self.weights, n, replacement=True, generator=generator)
        z = torch.randn(n, self.horizon, 2, generator=generator, dtype=F64)
        return self.means[k] + self.std[k, None, None] * (vectors * values.sqrt()) @ z

    def truth(self, g: Constraint, n: int, generator: torch.Generator) -> tuple[Array, float]:
        """n exact samples of the law given g <= 0 at every waypoint, and the share of draws that
        were accepted.
        """
        kept, drawn = [], 0
        while sum(map(len, kept)) < n:
            x = self.draw(4 * n, generator)
            drawn += len(x)
            kept.append(x[(g(x) <= 0).all(1)])
        accepted = torch.cat(kept)
        return accepted[:n].numpy(), len(accepted) / drawn

    def denoiser(self, schedule: Schedule) -> Denoiser:
        """(x_t, t) -> E[x_0 | x_t] in normalised coordinates z = x / SCALE, in the dtype of x_t."""
        level = dict(zip(schedule.t, schedule.alpha_bar, strict=True))
        values, vectors = self.modes
        variance = self.std.square()[:, None] * values / SCALE**2  # [K, horizon]
        means = self.means / SCALE

        def clean(z: Traj, t: int) -> Traj:
            a = level[t]
            total = a * variance + 1 - a
            V, m = vectors.to(z), means.to(z)
            left = V.T @ (z[:, None] - math.sqrt(a) * m)  # [n, K, horizon, 2]
            # both ends are pinned to the means' own values: they add the same to every component
            log_weight = self.weights.log() - total.log().sum(-1)
            exponent = (left.square().sum(-1) / total.to(z)).sum(-1) / 2
            weight = torch.softmax(log_weight.to(z) - exponent, 1)
            gain = (math.sqrt(a) * variance / total).to(z)
            each = m + V @ (gain[..., None] * left)
            return (weight[..., None, None] * each).sum(1)

        return clean

    def route(self, x: Array) -> NDArray[np.int64]:
        """Which mean path is nearest [n]."""
        return np.linalg.norm(x[:, None] - self.means.numpy(), axis=(2, 3)).argmin(1)


def three_routes(horizon: int = 32) -> Routes:
    """Over, under and straight through, from (-1.2, 0) to (1.2, 0): 45, 35 and 20 % of the
    trajectories.
    """
    s = torch.linspace(0, 1, horizon, dtype=F64)
    x = -1.2 * torch.cos(math.pi * s)  # from rest to rest
    height = torch.tensor([0.9, -0.9, 0.0], dtype=F64)
    y = height[:, None] * torch.sin(math.pi * s) ** 2
    means = torch.stack((x.expand_as(y), y), -1)
    return Routes(
        means, torch.tensor([0.2, 0.2, 0.15], dtype=F64), torch.tensor([0.45, 0.35, 0.2], dtype=F64)
    )


# constraints, in metres ---------------------------------------------------------------------------


def _half_space(x: float, y: float, b: float) -> HalfSpace:
    return HalfSpace(torch.tensor([x, y], dtype=F64), torch.tensor(b, dtype=F64))


def _outside(x: float, y: float, radius: float) -> Ellipsoid:
    one = torch.ones(2, dtype=F64)
    return Ellipsoid(
        torch.eye(2, dtype=F64),
        torch.tensor([x, y], dtype=F64),
        radius * one,
        radius * one[0],
        "outside",
    )


CONSTRAINTS = {
    "corner": Constraint((AtWaypoints("corner", _half_space(0.5, 0.866, 0.75)),)),
    "disc": Constraint((AtWaypoints("disc", _outside(0.0, 0.9, 0.2)),)),
    "wide disc": Constraint((AtWaypoints("wide disc", _outside(0.0, 0.45, 0.4)),)),
    "slab": Constraint(
        (
            AtWaypoints("above", _half_space(0.0, 1.0, 0.8)),
            AtWaypoints("below", _half_space(0.0, -1.0, 0.8)),
        )
    ),
    "discs": Constraint(
        tuple(
            AtWaypoints(f"disc {k}", _outside(0.0, y, 0.25)) for k, y in enumerate((0.9, -0.9, 0.0))
        )
    ),
    "chain": Constraint((DiscreteBarrier("chain", _half_space(0.0, 1.0, 1.0), 0.12),)),
}


def problem(law: Routes, g: Constraint, n_steps: int = 64) -> Problem:
    """The law in place of a trained model: start and goal pinned, cosine schedule, g at the
    waypoints, where the truth has it.
    """
    schedule = Schedule.cosine(n_steps)
    scale = Normaliser(torch.zeros(2, dtype=F64), torch.full((2,), SCALE, dtype=F64))
    start, goal = law.means[0, [0, -1]].numpy()
    planner = Planner(law.denoiser(schedule), schedule, scale, law.horizon, ("x", "y"))
    return Problem(planner, declared=g, enforced=g, start=start, goal=goal)


# what separates samples from the truth ------------------------------------------------------------


def energy_distance(x: Array, y: Array) -> float:
    """2 E|x - y| - E|x - x'| - E|y - y'|, |.| the root mean square distance of waypoints, in
    metres.

    Unbiased (no pair of a sample with itself): zero on average where both have one law, and it can
    come out negative.
    """
    if min(len(x), len(y)) < 2:
        return math.nan
    a, b = (torch.from_numpy(v).flatten(1) / math.sqrt(v.shape[1]) for v in (x, y))
    within = [torch.cdist(v, v).sum() / (len(v) * (len(v) - 1)) for v in (a, b)]
    return float(2 * torch.cdist(a, b).mean() - within[0] - within[1])


def route_shares(law: Routes, x: Array) -> Array:
    """Share of the samples on each route [K]."""
    return np.bincount(law.route(x), minlength=len(law.means)) / len(x)


def energy_within_routes(law: Routes, x: Array, truth: Array) -> float:
    """Energy distance of the samples on one route to the true ones on it, mean over the truth's
    shares: what is left once the mass on each route is right. Routes of fewer than 20 samples on
    either side are left out.
    """
    mine, theirs = law.route(x), law.route(truth)
    pairs = [(x[mine == k], truth[theirs == k]) for k in range(len(law.means))]
    pairs = [(a, b) for a, b in pairs if min(len(a), len(b)) >= 20]
    each = [energy_distance(a, b) for a, b in pairs]
    return float(np.average(each, weights=[len(b) for _, b in pairs])) if pairs else math.nan


def jump_limit(truth: Array) -> float:
    """The 99.9 % quantile of the true samples' largest jump: a plan beyond it is torn."""
    return float(np.quantile(metrics.jump(truth, (0, 1)), 0.999))


def measure(
    law: Routes, g: Constraint, x: Array, x_free: Array, truth: Array, limit: float
) -> dict[str, float]:
    """Every measure of samples x [n, horizon, 2]; x_free are the unconstrained ones of the same
    noise.
    """
    return {
        "energy": energy_distance(x, truth),
        "within": energy_within_routes(law, x, truth),
        "unsafe": float((metrics.worst_waypoint(g, x) > SAFE).mean()),
        "unsafe_segments": float((metrics.worst_segment(g, x) > SAFE).mean()),
        "torn": float((metrics.jump(x, (0, 1)) > limit).mean()),
        "distance": float(metrics.distance(x, x_free, (0, 1)).mean()),
        **{f"route_{k}": float(share) for k, share in enumerate(route_shares(law, x))},
    }


# variants of a method -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Latent:
    """A method on the clean estimate that shifts the sample x_t along with it.

    The estimated noise therefore stays as it is. With a = alpha_bar_t and b = alpha_bar_{t-1}:

        x_{t-1} = kernel(x_t + sqrt(a) (x0' - x0), x0') = reverse(x0) + sqrt(b) (x0' - x0)

    With DDPM, reverse(x0') - reverse(x0) is only the share beta_t / (1 - a) of that shift: its
    coefficient of x0 over sqrt(b). With DDIM the share is 1 - sqrt(a (1 - b) / (b (1 - a))). The
    whole shift is made at each step, so more steps push harder, where the kernel correction
    approaches a limit.
    """

    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    inner: Method
    schedule: Schedule

    def init(self, x: Traj, g: Constraint) -> Any:
        return self.inner.init(x, g), self.schedule.n_steps

    def step(self, step: Step, g: Constraint, state: Any) -> tuple[Traj, Any]:
        inner, i = state
        level = math.sqrt(self.schedule.alpha_bar[i - 1])
        plain = step.reverse(step.x0)
        x, inner = self.inner.step(
            replace(step, reverse=lambda clean: plain + level * (clean - step.x0)), g, inner
        )
        return x, (inner, max(i - 1, 1))


@dataclass(frozen=True)
class Over:
    """Over-projection of the clean estimate: x0' = x0 + fold (P(x0) - x0); fold 1 at the end."""

    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    fold: float

    def init(self, x: Traj, g: Constraint) -> None:
        return None

    def step(self, step: Step, g: Constraint, state: None) -> tuple[Traj, None]:
        fold = 1.0 if step.last else self.fold
        return step.reverse(step.x0 + fold * (project(g, step.x0, step.pins) - step.x0)), state


@dataclass(frozen=True)
class CalledTwice:
    """Latent projection that evaluates the network again at the shifted x_t: two calls per step."""

    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    schedule: Schedule
    denoiser: Denoiser

    def init(self, x: Traj, g: Constraint) -> int:
        return self.schedule.n_steps

    def step(self, step: Step, g: Constraint, i: int) -> tuple[Traj, int]:
        a, b = self.schedule.alpha_bar[i], self.schedule.alpha_bar[i - 1]
        shift = project(g, step.x0, step.pins) - step.x0
        x0 = step.pins.paint(self.denoiser(step.x + math.sqrt(a) * shift, self.schedule.t[i]))
        carried = math.sqrt(b) * (1 - step.beta / (1 - a))  # of the shift of x_t, by DDPM
        return step.reverse(project(g, x0, step.pins)) + carried * shift, max(i - 1, 1)


@dataclass(frozen=True)
class Late:
    """A method that acts in the last `steps` of n_steps only; before them the sampler is left
    alone.
    """

    enforces: ClassVar[bool] = True
    polished: ClassVar[bool] = True
    candidates: ClassVar[int] = 1
    planner: ClassVar[PlannerKind] = "unconditional"

    inner: Method
    steps: int
    n_steps: int

    def init(self, x: Traj, g: Constraint) -> Any:
        return self.inner.init(x, g), self.n_steps

    def step(self, step: Step, g: Constraint, state: Any) -> tuple[Traj, Any]:
        inner, i = state
        if i > self.steps:
            return step.reverse(step.x0), (inner, i - 1)
        x, inner = self.inner.step(step, g, inner)
        return x, (inner, max(i - 1, 1))


# runs ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """One way to sample the constrained law.

    sampler  kernel, extra steps and polish; its own `steps` are not used
    k        candidates per plan; the first safe one is kept, else the one that violates
             least
    steps    steps of the respaced schedule, None for all
    repair   method that samples again where no candidate is safe, with the same noise; None: the
             polish alone
    """

    name: str
    method: Method
    sampler: SamplerSettings
    k: int = 1
    steps: int | None = None
    repair: Method | None = None


def recipe_runs(task: str = "maze2d-umaze") -> list[Run]:
    """Every method under every preset of a task's recipe; the unconstrained one, alike in all,
    once.
    """
    runs = [Run("diffuser", Unconstrained(), SamplerSettings())]
    for label, preset in load_recipe(task).presets.items():
        for name in METHODS:
            if name not in (
                "diffuser",
                "conditional",
            ):  # the one is there, the other needs training
                own = preset.of_method(name)
                method = make_method(name, own.methods[name])
                runs.append(Run(f"{name} {label}", method, own.sampler))
    return runs


def variant_runs(at: Problem, task: str = "maze2d-umaze") -> list[Run]:
    """What `recommended` could be instead, all with its final polish."""
    preset, schedule = load_recipe(task).presets["recommended"], at.planner.schedule
    sampler, n_steps = preset.sampler, schedule.n_steps
    few = schedule.respaced(n_steps // 4)
    clean = {
        name: make_method(name, preset.methods[name])
        for name in ("projected", "primal-dual", "alm")
    }
    projected = clean["projected"]
    half = Late(projected, n_steps // 2, n_steps)
    plain = Unconstrained()
    return [
        *(
            Run(f"latent {name}", Latent(method, schedule), sampler)
            for name, method in clean.items()
        ),
        Run("latent projected, 1.5-fold", Latent(Over(1.5), schedule), sampler),
        Run("latent projected, 2 calls", CalledTwice(schedule, at.planner.denoiser), sampler),
        Run("latent projected, last half", Latent(half, schedule), sampler),
        Run("projected, last half", half, sampler),
        Run("projected, final only", Late(projected, 1, n_steps), sampler),
        Run(f"best of 4, {few.n_steps} steps", plain, sampler, k=4, steps=few.n_steps),
        Run(
            f"best of 4, {few.n_steps} steps, else latent",
            plain,
            sampler,
            k=4,
            steps=few.n_steps,
            repair=Latent(projected, few),
        ),
        Run(f"best of 4, {n_steps} steps", plain, sampler, k=4),
        Run(
            f"best of 4, {n_steps} steps, else latent",
            plain,
            sampler,
            k=4,
            repair=Latent(projected, schedule),
        ),
    ]


def execute(run: Run, at: Problem, seeds: Sequence[int]) -> tuple[Array, float]:
    """Samples [n, horizon, 2], one per seed, and the network calls per plan."""
    calls = 0

    def counted(z: Traj, t: int) -> Traj:
        nonlocal calls
        calls += len(z)
        return at.planner.denoiser(z, t)

    planner = replace(at.planner, denoiser=counted).respaced(run.steps)
    respaced = replace(at, planner=planner)

    def plans(method: Method, draws: Sequence[int]) -> Array:
        return plan(respaced, method, draws, run.sampler).x

    if run.k == 1:
        x = plans(
            replace(run.method, denoiser=counted)
            if isinstance(run.method, CalledTwice)
            else run.method,
            seeds,
        )
        return x, calls / len(seeds)
    draws = (
        np.array(seeds) + 10_000_000 * np.arange(run.k)[:, None]
    )  # [k, n], the first those of every other run
    candidates = plans(run.method, draws.ravel().tolist()).reshape(
        run.k, len(seeds), at.planner.horizon, 2
    )
    worst = np.stack([metrics.worst_waypoint(at.declared, x) for x in candidates]).clip(min=0)
    best, each = worst.argmin(0), np.arange(len(seeds))
    x, bad = candidates[best, each], worst[best, each] > 0
    if bad.any() and run.repair is not None:
        x[bad] = plans(run.repair, draws[best, each][bad].tolist())
    elif bad.any():
        z = at.normaliser.encode(torch.from_numpy(x[bad]))
        x[bad] = at.normaliser.decode(polish_plans(at, z)[0]).numpy()
    return x, calls / len(seeds)
