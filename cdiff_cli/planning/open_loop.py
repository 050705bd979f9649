"""From a request to plans, and from plans to executed episodes."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from cdiff_cli.arrays import Array, Traj
from cdiff_cli.constraints.dynamics import dynamics_of, split
from cdiff_cli.constraints.observed import require_bound
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.errors import CdiffError
from cdiff_cli.planning.problem import MARGIN, Problem, make_pins
from cdiff_cli.planning.timing import Timed, candidate_seed, synchronise
from cdiff_cli.projection.project import project, project_reachable
from cdiff_cli.sampling import load_kernel
from cdiff_cli.sampling.baselines import BestOf, Unconstrained
from cdiff_cli.sampling.noise import Noise
from cdiff_cli.sampling.sampler import Method, Step, sample

TOUCHING = 1e-5  # what remains of the task's clearance where that leaves no plan


@dataclass(frozen=True)
class Plans:
    """Plans of one batch and what making them took.

    x              [n, horizon, dim] float64, environment units
    trace          total violation of the scored g a plan by network call: of x_t, of its clean estimate   [calls, 2, n]
    chain          every x_t, kept where small   [calls + 1, n, horizon, dim] or None
    polish         largest displacement by the final polish, environment units   [n]
    u              inputs that produce x, where dynamics were obeyed   [n, horizon - 1, m] or None
    calls          network calls a plan
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
    *,
    kernel: str = "ddpm",
    extra_steps: int = 0,
    polish: bool = False,
    on_step: Callable[[int], None] | None = None,
) -> Plans:
    """One plan a seed. Equal seeds meet equal noise whatever the method, so differences between methods are paired.

    The method sees the constraints without the dynamics. Those are met once, when the plan is done, and exactly: met in the last
    sixteenth of the steps as well, plans of the large maze moved two to three times as far and were no safer.

    polish   project the finished plans onto all constraints; always where there are dynamics
    """
    require_bound(problem.g)
    if isinstance(method, BestOf):
        return _best_of(problem, method.k, seeds, kernel, extra_steps, on_step)
    device, dim = problem.device, len(problem.task.layout)
    scale, centre = problem.normaliser.scale, problem.normaliser.centre
    like = torch.empty(0, device=device)
    others, dynamics = split(problem.enforced)
    inside = others.tighten(problem.task.tolerances.clearance) if dynamics.parts else others
    g, scored = (
        pull_back(constraint, centre, scale).to(like) for constraint in (inside, problem.g)
    )
    pins = make_pins(problem, len(seeds))
    shape = (problem.horizon, dim)
    total = problem.schedule.n_steps + extra_steps
    keep_chain = total * len(seeds) * problem.horizon * dim <= 4_000_000
    trace, chain, watching_s, timed = [], [], 0.0, Timed(problem.denoiser, device)

    def record(call: int, step: Step, x: Traj) -> None:
        nonlocal watching_s
        began = time.perf_counter()
        trace.append(
            torch.stack([scored(x_t).clamp_min(0).sum(1) for x_t in (step.x, step.x0)]).cpu()
        )
        if keep_chain:
            chain.append(step.x.cpu())
            if call == total:
                chain.append(x.cpu())
        if on_step:
            on_step(call)
        watching_s += time.perf_counter() - began

    synchronise(device)
    began = time.perf_counter()
    with torch.inference_mode():
        noise = Noise(seeds, shape, device)
        z = sample(
            timed,
            problem.schedule,
            method,
            g,
            pins,
            noise,
            kernel=load_kernel(kernel),
            extra_steps=extra_steps,
            on_step=record,
        ).x
        if not bool(torch.isfinite(z).all()):
            bad = [
                seed for seed, x in zip(seeds, z, strict=True) if not bool(torch.isfinite(x).all())
            ]
            raise CdiffError(
                f"the plans of seeds {bad[:5]} diverged to NaN or inf: the steps are too large for this kernel; "
                "lower eta, rho or c with --set, or use --preset recommended"
            )
        z64 = z.double().cpu()
        moved, u = np.zeros(len(seeds)), None
        if (polish or dynamics.parts) and not isinstance(method, Unconstrained):
            z64, moved, u = polish_plans(problem, z64)
        x = problem.normaliser.decode(z64).numpy()
    synchronise(device)
    total_s = time.perf_counter() - began - watching_s
    whole = torch.stack(chain) if chain else None
    return Plans(
        x=x,
        trace=torch.stack(trace).double().numpy() if trace else np.empty((0, 2, len(seeds))),
        chain=None if whole is None else problem.normaliser.decode(whole.double()).numpy(),
        polish=moved,
        calls=total,
        total_s=total_s,
        network_s=timed.seconds,
        u=u,
    )


def _best_of(
    problem: Problem,
    k: int,
    seeds: Sequence[int],
    kernel: str,
    extra_steps: int,
    on_step: Callable[[int], None] | None,
) -> Plans:
    """Of k unconstrained plans a seed the one with the least sum of [g]_+, g as enforced but for the dynamics; the first, of the
    seed's own noise, among equals. Nothing is polished.
    """
    g = split(problem.enforced)[0]
    tries: list[Plans] = []
    for j in range(k):
        made = tries[0].calls * j if tries else 0
        tell = None if on_step is None else lambda call, made=made: on_step(made + call)
        noise = [candidate_seed(seed, j) for seed in seeds]
        tries.append(
            plan(
                problem,
                Unconstrained(),
                noise,
                kernel=kernel,
                extra_steps=extra_steps,
                on_step=tell,
            )
        )
    unsafe = np.stack([g(torch.from_numpy(one.x)).clamp_min(0).sum(1).numpy() for one in tries])
    best, each = unsafe.argmin(0), np.arange(len(seeds))
    chains = [one.chain for one in tries if one.chain is not None]
    return replace(
        tries[0],
        x=np.stack([one.x for one in tries])[best, each],
        trace=np.stack([one.trace for one in tries])[best, :, :, each].transpose(1, 2, 0),
        chain=np.stack(chains)[best, :, each].swapaxes(0, 1) if chains else None,
        calls=sum(one.calls for one in tries),
        total_s=sum(one.total_s for one in tries),
        network_s=sum(one.network_s for one in tries),
    )


def polish_plans(problem: Problem, z: Traj) -> tuple[Traj, Array, Array | None]:
    """Project finished plans in float64 onto the constraints tightened a little; also the largest displacement [n] and, where
    dynamics were to be obeyed, the inputs: the plan is then what they produce, to rounding.
    """
    pins = make_pins(problem, len(z), torch.float64, torch.device("cpu"))
    inputs = None
    if dynamics_of(problem.enforced):
        out, inputs = _follow_dynamics(problem, z, pins)
    else:
        g = pull_back(
            problem.enforced.tighten(MARGIN), problem.normaliser.centre, problem.normaliser.scale
        )
        out = project(g, z, pins)
    columns = [problem.task.layout.index(name) for name in problem.task.positions]
    shift = (problem.normaliser.scale * (out - z))[..., columns].norm(dim=-1).amax(1)
    return out, shift.numpy(), inputs


def _follow_dynamics(problem: Problem, z: Traj, pins: Pins) -> tuple[Traj, Array]:
    """Plans near z that the dynamics make, and their inputs: solved as finely as it takes for the rollout of the inputs to be safe
    and to end where it is pinned, to the task's tolerance. Where no plan keeps the task's clearance, as from a start that does not,
    one that keeps TOUCHING is taken if that is safe and ends there.
    """
    (reachable,) = dynamics_of(problem.enforced)
    near_enough, most = problem.task.tolerances.position, problem.task.tolerances.clearance
    scale, dynamics, others = problem.normaliser, reachable.dynamics, split(problem.enforced)[0]
    todo, warm = torch.arange(len(z)), None
    x, u = z.clone(), torch.zeros(len(z), z.shape[1] - 1, dynamics.B.shape[1], dtype=z.dtype)
    for clearance, tolerance in ((most, 5e-4), (most, 5e-5), (most, 5e-6), (TOUCHING, 5e-6)):
        inside = Constraint((reachable, *others.tighten(clearance).parts))
        g = pull_back(inside, scale.centre, scale.scale).select(todo)
        pinned = pins.values[todo]
        warm = warm if clearance == most else None
        near, warm = project_reachable(g, z[todo], Pins(pins.mask, pinned), warm, tolerance)
        made = torch.clamp(warm.u, dynamics.low, dynamics.high)
        path = scale.encode(dynamics.rollout(scale.decode(near[:, 0]), made))
        missed = (scale.scale * torch.where(pins.mask, path - pinned, 0.0)).abs().amax(
            (1, 2)
        ) > near_enough
        wrong = missed | (others(scale.decode(path)) > 0).any(1)
        kept = ~wrong | (clearance == most)
        x[todo[kept]], u[todo[kept]] = path[kept], made[kept]
        if not bool(wrong.any()):
            break
        warm, todo = warm.select(wrong), todo[wrong]
    return x, u.numpy()
