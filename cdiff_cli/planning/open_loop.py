"""Whole plans: a batch sampled from noise, then projected once more in float64."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from cdiff_cli.arrays import Array, Traj
from cdiff_cli.constraints.dynamics import dynamics_of, split
from cdiff_cli.constraints.observed import require_bound
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.errors import CdiffError
from cdiff_cli.models.preset import SamplerSettings
from cdiff_cli.planning.polish import polish_plans
from cdiff_cli.planning.problem import Problem
from cdiff_cli.planning.timing import Timed, candidate_seed, synchronise
from cdiff_cli.sampling import load_kernel
from cdiff_cli.sampling.baselines import Unconstrained
from cdiff_cli.sampling.noise import Noise
from cdiff_cli.sampling.sampler import Method, Step, sample

CHAIN_NUMBERS = 4_000_000
"""Largest count of numbers of a chain that is kept: 32 MB in float64."""


@dataclass(frozen=True)
class Plans:
    """Plans of one batch, and what it took to make them.

    x              [n, horizon, dim] float64, environment units
    trace          total violation of the declared g per plan and diffusion step: of x_t, and of its
                   clean estimate   [steps, 2, n]
    chain          every x_t, where that is small   [steps + 1, n, horizon, dim] or None
    polish         largest displacement by the final projection, environment units   [n]
    u              inputs that produce x, where dynamics are enforced   [n, horizon - 1, m] or None
    calls          network calls per plan
    total_s, network_s   wall time of the batch, and the network's part of it
    """

    x: Array
    trace: Array
    chain: Array | None
    polish: Array
    calls: int
    total_s: float
    network_s: float
    u: Array | None = None


def plan(
    problem: Problem,
    method: Method,
    seeds: Sequence[int],
    sampler: SamplerSettings | None = None,
    on_step: Callable[[int], None] | None = None,
) -> Plans:
    """One plan per seed.

    Equal seeds meet equal noise whatever the method, so differences between methods are paired.
    The method sees the constraints without the dynamics. The dynamics are satisfied once, exactly,
    when the plan is finished: plans of the large maze that satisfied them in the last sixteenth of
    the steps as well moved two to three times as far and were no safer.

    sampler   None: SamplerSettings(); the schedule is respaced by the caller (Planner.respaced).
              `polish` projects finished plans onto all constraints, which dynamics always ask for
    on_step   called with the number of diffusion steps so far
    Raises CdiffError where plans diverge, InfeasibleError where none satisfies the constraints.
    """
    settings = sampler or SamplerSettings()
    require_bound(problem.declared)
    if method.candidates > 1:
        return _best_of(problem, method.candidates, seeds, settings, on_step)
    planner, watch = problem.planner, _Watch(problem, len(seeds), settings, on_step)
    timed = Timed(planner.denoiser, planner.device)
    noise = Noise(seeds, (planner.horizon, planner.dim), planner.device)
    g, pins = _seen_by_the_method(problem), problem.pins(len(seeds))
    synchronise(planner.device)
    began = time.perf_counter()
    with torch.inference_mode():
        z = sample(
            timed,
            planner.schedule,
            method,
            g,
            pins,
            lambda: settings.temperature * noise(),
            kernel=load_kernel(settings.kernel),
            extra_steps=settings.extra_steps,
            on_step=watch,
        ).x
        _refuse_divergence(z, seeds)
        z64 = z.double().cpu()
        moved, u = np.zeros(len(seeds)), None
        if method.polished and (settings.polish or dynamics_of(problem.enforced)):
            z64, moved, u = polish_plans(problem, z64)
        x = problem.normaliser.decode(z64).numpy()
    synchronise(planner.device)
    return Plans(
        x=x,
        trace=watch.violations(),
        chain=watch.trajectories(),
        polish=moved,
        calls=watch.total * planner.calls_per_step,
        total_s=time.perf_counter() - began - watch.seconds,
        network_s=timed.seconds,
        u=u,
    )


def _seen_by_the_method(problem: Problem) -> Constraint:
    """What the method satisfies, normalised: all but the dynamics; with dynamics, a clearance."""
    others, dynamics = split(problem.enforced)
    inside = others.tighten(problem.tolerances.clearance) if dynamics.parts else others
    return _normalised(problem, inside)


def _normalised(problem: Problem, g: Constraint) -> Constraint:
    """g in the planner's coordinates, dtype and device."""
    like = torch.empty(0, device=problem.planner.device)
    return pull_back(g, problem.normaliser.centre, problem.normaliser.scale).to(like)


def _refuse_divergence(z: Traj, seeds: Sequence[int]) -> None:
    finite = torch.isfinite(z).all(2).all(1).tolist()
    bad = [seed for seed, fine in zip(seeds, finite, strict=True) if not fine]
    if bad:
        raise CdiffError(
            f"the plans of seeds {bad[:5]} diverged to NaN or inf: the steps are too large for "
            "this kernel; lower eta, rho or c with --set, or use --preset recommended"
        )


@dataclass
class _Watch:
    """What is recorded of each diffusion step; its own time is kept apart."""

    problem: Problem
    n: int
    settings: SamplerSettings
    on_step: Callable[[int], None] | None
    seconds: float = 0.0
    trace: list[torch.Tensor] = field(default_factory=list)
    chain: list[torch.Tensor] = field(default_factory=list)

    def __post_init__(self) -> None:
        planner = self.problem.planner
        self.declared = _normalised(self.problem, self.problem.declared)
        self.total = planner.schedule.n_steps + self.settings.extra_steps
        self.keeps = self.total * self.n * planner.horizon * planner.dim <= CHAIN_NUMBERS

    def __call__(self, step_number: int, step: Step, x: Traj) -> None:
        began = time.perf_counter()
        levels = [self.declared(x_t).clamp_min(0).sum(1) for x_t in (step.x, step.x0)]
        self.trace.append(torch.stack(levels).cpu())
        if self.keeps:
            self.chain.append(step.x.cpu())
            if step_number == self.total:
                self.chain.append(x.cpu())
        if self.on_step:
            self.on_step(step_number)
        self.seconds += time.perf_counter() - began

    def violations(self) -> Array:
        """Plans.trace."""
        if not self.trace:
            return np.empty((0, 2, self.n))
        return torch.stack(self.trace).double().numpy()

    def trajectories(self) -> Array | None:
        """Plans.chain."""
        if not self.chain:
            return None
        return self.problem.normaliser.decode(torch.stack(self.chain).double()).numpy()


def _best_of(
    problem: Problem,
    k: int,
    seeds: Sequence[int],
    settings: SamplerSettings,
    on_step: Callable[[int], None] | None,
) -> Plans:
    """The safest of k unconstrained plans per seed: the least sum of [g]_+ without the dynamics.

    The first among equals, candidate 0 having the seed's own noise. Nothing is projected.
    """
    g = split(problem.enforced)[0]
    candidates: list[Plans] = []
    steps = problem.planner.schedule.n_steps + settings.extra_steps
    for j in range(k):
        report = None if on_step is None else lambda step, j=j: on_step(steps * j + step)
        noise = [candidate_seed(seed, j) for seed in seeds]
        candidates.append(plan(problem, Unconstrained(), noise, settings, report))
    unsafe = [g(torch.from_numpy(one.x)).clamp_min(0).sum(1).numpy() for one in candidates]
    best, plans = np.stack(unsafe).argmin(0), np.arange(len(seeds))
    chains = [one.chain for one in candidates if one.chain is not None]
    return replace(
        candidates[0],
        x=np.stack([one.x for one in candidates])[best, plans],
        trace=np.stack([one.trace for one in candidates])[best, :, :, plans].transpose(1, 2, 0),
        chain=np.stack(chains)[best, :, plans].swapaxes(0, 1) if chains else None,
        calls=sum(one.calls for one in candidates),
        total_s=sum(one.total_s for one in candidates),
        network_s=sum(one.network_s for one in candidates),
    )
