"""Reverse kernels: the step from one noise level to the next, given a clean estimate."""

import math
from collections.abc import Callable

from cdiff_cli.arrays import Traj

Previous = tuple[Traj, float]
"""Clean estimate that the previous step used, changed by the method, and its alpha_bar_{t+1}."""
Kernel = Callable[[Traj, Traj, Traj, float, float, Previous | None], Traj]
"""(x_t, x0, z, a, b, previous) -> x_{t-1}, with noise z, a = alpha_bar_t and b = alpha_bar_{t-1}.

previous is None in the first step.
"""


def ddpm(x: Traj, x0: Traj, z: Traj, a: float, b: float, previous: Previous | None = None) -> Traj:  # noqa: ARG001
    """Draw from the posterior q(x_{t-1} | x_t, x_0) (Ho et al., 2020, Eq. 7).

    This is the paper's Eq. 4 with the variance of the posterior.
    """
    beta = 1 - a / b
    mean = math.sqrt(b) * beta / (1 - a) * x0 + math.sqrt(1 - beta) * (1 - b) / (1 - a) * x
    return mean + math.sqrt(beta * (1 - b) / (1 - a)) * z


def ddim(x: Traj, x0: Traj, z: Traj, a: float, b: float, previous: Previous | None = None) -> Traj:  # noqa: ARG001
    """Take the deterministic step of DDIM (Song et al., 2021, Eq. 12 with sigma = 0)."""
    noise = (x - math.sqrt(a) * x0) / math.sqrt(1 - a)
    return math.sqrt(b) * x0 + math.sqrt(1 - b) * noise


def dpmpp_2m(
    x: Traj, x0: Traj, z: Traj, a: float, b: float, previous: Previous | None = None
) -> Traj:
    """Take the second-order multistep step of DPM-Solver++ (Lu et al., 2022, Algorithm 2).

    It is the DDIM step from the clean estimate D, extrapolated linearly in lambda from the previous
    and the present one:

    D = x0 + h_t / (2 h_{t+1}) (x0 - x0_{t+1}),   h_t = lambda_{t-1} - lambda_t

    D = x0 in the first step, which has no previous one, and in the last, where lambda_{t-1} is
    infinite. The plan is therefore a clean estimate, while D may violate g <= 0 in the steps
    between.
    """
    if previous is None or b == 1:
        return ddim(x, x0, z, a, b)
    x0_before, a_before = previous
    ratio = (half_log_snr(b) - half_log_snr(a)) / (half_log_snr(a) - half_log_snr(a_before)) / 2
    return ddim(x, x0 + ratio * (x0 - x0_before), z, a, b)


def half_log_snr(alpha_bar: float) -> float:
    """Half the log signal-to-noise ratio, lambda = log(alpha_bar / (1 - alpha_bar)) / 2."""
    return math.log(alpha_bar / (1 - alpha_bar)) / 2


def langevin(
    x: Traj,
    x0: Traj,
    z: Traj,
    a: float,
    b: float,
    previous: Previous | None = None,  # noqa: ARG001
) -> Traj:
    """Take the Langevin step x_{t-1} = x_t + (beta_t / 2) score + sqrt(beta_t) z (paper, Eq. 8),
    the score by Eq. 7.

    This step does not sample the law of a trained model: see its known answer in
    tests/sampling/test_sampler.py.
    """
    beta = 1 - a / b
    score = -(x - math.sqrt(a) * x0) / (1 - a)
    return x + beta / 2 * score + math.sqrt(beta) * z
