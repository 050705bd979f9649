"""Which kernel and which spacing of the steps lose least with few network calls?

    python tests/benchmarks/studies/solvers.py [--n-steps 64]
    python tests/benchmarks/studies/solvers.py --task maze2d-umaze [--n 20]

Without a task: laws in one dimension with exact scores. The error is the root mean square distance
of 1000 samples to the end of the probability flow from the same x_T, solved in 4000 steps even in
log-SNR; shown as root mean square over the laws, with the worst law in brackets. With a task: mean
distance per waypoint [m] of unconstrained plans between random points to the plans of all steps by
dpm++2m with the same noise.
"""

import argparse
import math

import numpy as np
import torch

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.models.preset import SamplerSettings
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.planning.open_loop import plan
from cdiff_cli.sampling import load_kernel
from cdiff_cli.sampling.baselines import Unconstrained
from cdiff_cli.sampling.kernels import half_log_snr
from cdiff_cli.sampling.sampler import sample

CALLS = (5, 8, 16, 32)
DETERMINISTIC = ("ddim", "dpm++2m")
LAWS = {  # weights, means, standard deviations of Gaussian mixtures; normalised data lie in [-1, 1]
    "narrow": ([1.0], [0.5], [0.1]),
    "middle": ([1.0], [0.0], [0.5]),
    "wide": ([1.0], [0.2], [0.9]),
    "two modes": ([0.5, 0.5], [-0.5, 0.5], [0.1, 0.1]),
    "three modes": ([0.3, 0.5, 0.2], [-0.7, 0.1, 0.8], [0.05, 0.15, 0.02]),
}


def mixture_denoiser(law, schedule):
    """E[x_0 | x_t] of a Gaussian mixture, exactly."""
    weights, means, stds = (torch.tensor(values, dtype=torch.float64) for values in law)
    level = dict(zip(schedule.t, schedule.alpha_bar, strict=True))

    def clean(x, t):
        a = level[t]
        variance = a * stds**2 + 1 - a
        gap = x[..., None] - math.sqrt(a) * means
        share = (weights.log() - variance.log() / 2 - gap**2 / (2 * variance)).softmax(-1)
        return (share * (means + stds**2 * math.sqrt(a) / variance * gap)).sum(-1)

    return clean


def end(law, schedule, kernel):
    """x_0 of 1000 chains from the same x_T."""
    x = torch.randn(1000, 1, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return sample(
        mixture_denoiser(law, schedule),
        schedule,
        Unconstrained(),
        Constraint(()),
        Pins.none(x),
        lambda: x,
        kernel=load_kernel(kernel),
    ).x


def kept(full, steps):
    """The schedule of these steps in order; equal steps move up, at most to the noisiest."""
    out = [0]
    for k, i in enumerate(steps):
        out.append(min(max(i, out[-1] + 1), full.n_steps - (len(steps) - 1 - k)))
    return Schedule(tuple(full.alpha_bar[i] for i in out), tuple(out))


def power(full, n, p):
    return kept(full, [round(full.n_steps * (k / n) ** p) for k in range(1, n + 1)])


def even_in_log_snr(full, n):
    levels = np.array([half_log_snr(a) for a in full.alpha_bar[1:]])
    wanted = np.linspace(levels[0], levels[-1], n)
    return kept(full, [1 + int(np.abs(levels - level).argmin()) for level in wanted])


SPACINGS = {
    "even": lambda full, n: power(full, n, 1.0),
    "power 1.5 (respaced)": lambda full, n: full.respaced(n),
    "power 2": lambda full, n: power(full, n, 2.0),
    "even in log-SNR": even_in_log_snr,
}


def exact_scores(n_steps):
    full = Schedule.cosine(n_steps)
    levels = np.linspace(9.5, half_log_snr(full.alpha_bar[-1]), 4000)
    flow = Schedule(
        (1.0, *(float(1 / (1 + math.exp(-2 * level))) for level in levels)), tuple(range(4001))
    )
    truth = {name: end(law, flow, "dpm++2m") for name, law in LAWS.items()}
    for name, spacing in SPACINGS.items():
        for kernel in DETERMINISTIC:
            cells = []
            for n in CALLS:
                gaps = [
                    end(law, spacing(full, n), kernel) - truth[key] for key, law in LAWS.items()
                ]
                errors = [float(gap.square().mean().sqrt()) for gap in gaps]
                cells.append(f"{float(np.mean(np.square(errors))) ** 0.5:.4f} ({max(errors):.3f})")
            print(f"{name:22}{kernel:9}" + "".join(f"{cell:>18}" for cell in cells))


def trained_model(task, n):
    def plans(kernel, steps):
        one = resolve(
            Request(task=task, method="diffuser", n=n, random=True, kernel=kernel, steps=steps)
        )
        sampler = SamplerSettings(kernel=kernel)
        x = plan(one.problem, one.method, one.seeds, sampler).x
        return x[..., one.planner.position_columns]

    truth = plans("dpm++2m", None)
    for kernel in DETERMINISTIC:
        gaps = [np.linalg.norm(plans(kernel, steps) - truth, axis=-1).mean() for steps in CALLS]
        print(f"{task:22}{kernel:9}" + "".join(f"{gap:18.4f}" for gap in gaps), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--n-steps", type=int, default=64)
    parser.add_argument("--task")
    parser.add_argument("--n", type=int, default=20)
    arguments = parser.parse_args()
    print(f"{'spacing or task':22}{'kernel':9}" + "".join(f"{f'{n} calls':>18}" for n in CALLS))
    if arguments.task:
        trained_model(arguments.task, arguments.n)
    else:
        exact_scores(arguments.n_steps)
