"""Diffusion: schedule, reverse kernels, training loss, and the only loop over the diffusion steps t."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any, Protocol

import torch
from torch import Tensor

from cdiff_cli.constraint import Constraint, Pins, Traj

Denoiser = Callable[[Traj, int], Traj]
"""(x_t, t) -> clean estimate x0_hat, normalised coordinates."""

Previous = tuple[Traj, float]
"""(clean estimate the step before went on from, after the method's change; its alpha_bar_{t+1})."""

Kernel = Callable[[Traj, Traj, Traj, float, float, Previous | None], Traj]
"""(x_t, x0, z, alpha_bar_t, alpha_bar_{t-1}, previous) -> x_{t-1}; previous is None in the first step."""


class Estimator(Protocol):
    """A network to be trained: estimates of the clean trajectory [batch, horizon / k, dim] from coarse to the output."""

    def estimates(self, x: Traj, t: Tensor, condition: Tensor | None = None) -> list[Traj]: ...


@dataclass(frozen=True)
class Schedule:
    """Noise levels alpha_bar[i] for i = 0 (clean) ... n_steps, and the trained step t[i] each one belongs to.

    q(x_t | x_0) = N(sqrt(alpha_bar_t) x_0, (1 - alpha_bar_t) I)
    """

    alpha_bar: tuple[float, ...]
    t: tuple[int, ...]

    @classmethod
    def cosine(cls, n_steps: int) -> "Schedule":
        """Cosine schedule with offset s = 0.008 and beta at most 0.999 (Nichol and Dhariwal, 2021)."""
        level = [math.cos((i / n_steps + 0.008) / 1.008 * math.pi / 2) ** 2 for i in range(n_steps + 1)]
        alpha_bar = [1.0]
        for now, before in zip(level[1:], level[:-1], strict=True):
            alpha_bar.append(alpha_bar[-1] * (1 - min(1 - now / before, 0.999)))
        return cls(tuple(alpha_bar), tuple(range(n_steps + 1)))

    @property
    def n_steps(self) -> int:
        return len(self.t) - 1

    def beta(self, i: int) -> float:
        """beta_t = 1 - alpha_bar_t / alpha_bar_{t-1}."""
        return 1 - self.alpha_bar[i] / self.alpha_bar[i - 1]

    def respaced(self, n_steps: int) -> "Schedule":
        """The same noise range in fewer steps, the noisiest always among them: i_k = n (k / n_steps)^1.5 of n.

        The last step ends at a clean estimate, a mean that has lost the detail below its noise level, so the steps are shorter
        near the data. 1.5 is ours, by tests/benchmarks/solvers.py: powers 1 (even) and 2 and steps even in log-SNR are worse.
        """
        wanted = (round(self.n_steps * (k / n_steps) ** 1.5) for k in range(1, n_steps + 1))
        keep = list(accumulate(wanted, lambda before, i: max(before + 1, i), initial=0))  # each step once; convex, so it ends at n
        return Schedule(tuple(self.alpha_bar[i] for i in keep), tuple(self.t[i] for i in keep))

    def until(self, n_steps: int) -> "Schedule":
        """The last steps alone, those nearest the data."""
        return Schedule(self.alpha_bar[: n_steps + 1], self.t[: n_steps + 1])


def ddpm(x: Traj, x0: Traj, z: Traj, a: float, b: float, previous: Previous | None = None) -> Traj:  # noqa: ARG001
    """Posterior q(x_{t-1} | x_t, x_0) (Ho et al., 2020, Eq. 7): Eq. 4 of the paper with the posterior's variance."""
    beta = 1 - a / b
    mean = math.sqrt(b) * beta / (1 - a) * x0 + math.sqrt(1 - beta) * (1 - b) / (1 - a) * x
    return mean + math.sqrt(beta * (1 - b) / (1 - a)) * z


def ddim(x: Traj, x0: Traj, z: Traj, a: float, b: float, previous: Previous | None = None) -> Traj:  # noqa: ARG001
    """Deterministic step (Song et al., 2021, Eq. 12 with sigma = 0)."""
    noise = (x - math.sqrt(a) * x0) / math.sqrt(1 - a)
    return math.sqrt(b) * x0 + math.sqrt(1 - b) * noise


def dpmpp_2m(x: Traj, x0: Traj, z: Traj, a: float, b: float, previous: Previous | None = None) -> Traj:
    """Second-order multistep DPM-Solver++ (Lu et al., 2022, Algorithm 2): the DDIM step from the clean estimate carried on
    along the straight line, in lambda = log(sqrt(alpha_bar) / sqrt(1 - alpha_bar)), through this estimate and the previous.

    D = x0 + h_t / (2 h_{t+1}) (x0 - x0_{t+1}),  h_t = lambda_{t-1} - lambda_t;  D = x0 in the first step, which has no
    previous, and in the last, where lambda_{t-1} is infinite: so the plan is a clean estimate, though D may leave g <= 0.
    """
    if previous is None or b == 1:
        return ddim(x, x0, z, a, b)
    x0_before, a_before = previous
    ahead = (half_log_snr(b) - half_log_snr(a)) / (half_log_snr(a) - half_log_snr(a_before)) / 2
    return ddim(x, x0 + ahead * (x0 - x0_before), z, a, b)


def half_log_snr(alpha_bar: float) -> float:
    """lambda = log(alpha_bar / (1 - alpha_bar)) / 2."""
    return math.log(alpha_bar / (1 - alpha_bar)) / 2


def langevin(x: Traj, x0: Traj, z: Traj, a: float, b: float, previous: Previous | None = None) -> Traj:  # noqa: ARG001
    """x_{t-1} = x_t + (beta_t / 2) score + sqrt(beta_t) z (paper, Eq. 8), score by Eq. 7. It is not the step that samples
    a trained model: see the known-answer tests.
    """
    beta = 1 - a / b
    score = -(x - math.sqrt(a) * x0) / (1 - a)
    return x + beta / 2 * score + math.sqrt(beta) * z


KERNELS: dict[str, Kernel] = {"ddpm": ddpm, "ddim": ddim, "dpm++2m": dpmpp_2m, "langevin": langevin}


@dataclass(frozen=True)
class Step:
    """One reverse step as a method sees it: what is known, and the one way on.

    x, x0     x_t and its clean estimate, pins painted, normalised   [batch, horizon, dim]
    beta      beta_t
    level     sqrt(alpha_bar_{t-1}), the share of the clean trajectory in x_{t-1}
    reverse   clean estimate -> x_{t-1}; noise z and pins already bound; the next step's kernel knows the last estimate given
    last      no noise follows: x_{t-1} is the plan, or a frozen step refines it
    left      denoising steps still to come: 0 in the last and in the frozen ones
    """

    x: Traj
    x0: Traj
    beta: float
    level: float
    reverse: Callable[[Traj], Traj]
    pins: Pins
    last: bool
    left: int = 0


class Method(Protocol):
    """A way to obey g <= 0 while sampling: hyper-parameters only, its state is passed in and returned."""

    def init(self, x: Traj, g: Constraint) -> Any: ...
    def step(self, step: Step, g: Constraint, state: Any) -> tuple[Traj, Any]: ...


@dataclass
class Noise:
    """Standard normal draws of one shape for a batch, one generator a seed, so that a seed's plan does not depend on its
    neighbours in the batch and every method meets the same x_T and z.
    """

    seeds: Sequence[int]
    shape: tuple[int, int]
    device: torch.device | str = "cpu"
    _generators: list[torch.Generator] = field(init=False)

    def __post_init__(self) -> None:
        self._generators = [torch.Generator().manual_seed(seed) for seed in self.seeds]

    def __call__(self) -> Traj:
        """The next draw [batch, horizon, dim]."""
        draws = [torch.randn(self.shape, generator=generator) for generator in self._generators]
        return torch.stack(draws).to(self.device) if draws else torch.empty(0, *self.shape, device=self.device)


def sample(
    denoiser: Denoiser,
    schedule: Schedule,
    method: Method,
    g: Constraint,
    pins: Pins,
    noise: Callable[[], Traj],
    *,
    kernel: Kernel = ddpm,
    extra_steps: int = 0,
    first: Traj | None = None,
    on_step: Callable[[int, Step, Traj], None] | None = None,
) -> Traj:
    """Plans x_0 in normalised coordinates [batch, horizon, dim].

    first        x_T, the schedule's noisiest; drawn where None
    extra_steps  further steps with t frozen at 1 and no noise, the multipliers still moving (the released code's)
    on_step      called with the number of network calls so far, the step and x_{t-1}
    """
    x = pins.paint(noise() if first is None else first)
    state = method.init(x, g)
    used: Previous | None = None
    for call, i in enumerate([*range(schedule.n_steps, 0, -1), *[1] * extra_steps], start=1):
        x0 = pins.paint(denoiser(x, schedule.t[i]))
        last = i == 1
        z = torch.zeros_like(x) if last else noise()
        a, b = schedule.alpha_bar[i], schedule.alpha_bar[i - 1]
        here = x

        def reverse(clean: Traj, x: Traj = here, z: Traj = z, a: float = a, b: float = b, previous: Previous | None = used) -> Traj:
            nonlocal used
            used = clean, a
            return pins.paint(kernel(x, clean, z, a, b, previous))

        step = Step(here, x0, schedule.beta(i), math.sqrt(b), reverse, pins, last, i - 1)
        x, state = method.step(step, g, state)
        if on_step:
            on_step(call, step, x)
    return x


def training_loss(
    net: Estimator,
    schedule: Schedule,
    x0: Traj,
    pinned: Tensor,
    weighing: "Weighing",
    generator: torch.Generator,
    bf16: bool,
    condition: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """(loss, mean squared error) of the clean estimate at random steps t, both scalars.

    loss = w_t (|e|^2 + smoothness |e^{tau+1} - e^tau|^2 + |coarse e|^2 / 2) with e = x0_hat - x_0: at each t a quadratic form
    of e, so its minimiser is still E[x_0 | x_t]; `coarse` are the network's estimates of lower resolution, if it has any.

    x0      clean windows, normalised                          [batch, horizon, dim]
    pinned  coordinates given clean, as they are in sampling   [horizon, dim]
    condition   labels of the windows, of conditional planners [batch, k]
    """
    t = torch.randint(1, schedule.n_steps + 1, (len(x0),), generator=generator)
    z = torch.randn(x0.shape, generator=generator).to(x0)
    a = torch.tensor(schedule.alpha_bar, dtype=x0.dtype)[t].to(x0)[:, None, None]
    x_t = torch.where(pinned, x0, a.sqrt() * x0 + (1 - a).sqrt() * z)
    with torch.autocast(x0.device.type, torch.bfloat16, enabled=bf16):
        *coarse, estimate = net.estimates(x_t, t.to(x0), *(() if condition is None else (condition,)))
    w = weighing.of(schedule).to(x0)[t][:, None, None]
    e = torch.where(pinned, 0.0, estimate.float() - x0)
    loss = (w * e.square()).mean() + weighing.smoothness * (w * e.diff(dim=1).square()).mean()
    for guess in coarse:
        mean = x0.reshape(len(x0), guess.shape[1], -1, x0.shape[2]).mean(2)
        loss = loss + 0.5 * (w * (guess.float() - mean).square()).mean()
    return loss, e.square().mean().detach()


@dataclass(frozen=True)
class Weighing:
    """How the training loss weighs its terms.

    smoothness  weight of the jitter between neighbouring waypoints
    emphasis    w_t rises with the signal-to-noise ratio alpha_bar / (1 - alpha_bar): its square root within [1, emphasis], over
                the mean. At 1 all steps weigh the same, and the noisiest, of which little can be learnt, dominate the loss
    """

    smoothness: float = 100.0
    emphasis: float = 1.0

    def of(self, schedule: Schedule) -> Tensor:
        """w_t for t = 0 ... n_steps."""
        a = torch.tensor(schedule.alpha_bar, dtype=torch.float64)
        w = (a / (1 - a).clamp_min(1e-12)).sqrt().clamp(1.0, self.emphasis)
        return w / w[1:].mean()
