"""Step and Method, and sample(): the only loop over the diffusion steps t."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

import torch

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.models.denoiser import Denoiser
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.sampling.kernels import Kernel, Previous, ddpm


@dataclass(frozen=True)
class Step:
    """One reverse step as a method gets it.

    x, x0     x_t and its clean estimate, normalised, pinned states set   [batch, horizon, dim]
    beta      beta_t
    level     sqrt(alpha_bar_{t-1}), the share of the clean trajectory in x_{t-1}
    reverse   clean estimate -> x_{t-1}, with noise and pins bound; the kernel's next step gets the
              last estimate passed to it
    pins      fixed coordinates
    last      whether no noise is added: x_{t-1} is the plan, or a frozen step refines it
    left      remaining denoising steps; 0 in the last step and in the frozen ones
    """

    x: Traj
    x0: Traj
    beta: float
    level: float
    reverse: Callable[[Traj], Traj]
    pins: Pins
    last: bool
    left: int = 0


PlannerKind = Literal["unconditional", "conditional"]


class Method(Protocol):
    """A method acts on g <= 0 in every reverse step.

    It holds hyper-parameters only; its state is passed in and returned. Its attributes say how
    plans are treated:

    enforces     The sampled plans depend on g, so margins that tighten g change them. False for
                 `diffuser` and `conditional`.
    polished     The final projection applies to the plans, and a warm plan that violates g is made
                 anew from noise. False for `diffuser` and `best-of-k`, whose plans stay as the
                 network made them.
    candidates   Plans sampled per seed, of which the one with the least sum of [g]_+ is kept: k of
                 `best-of-k`, else 1.
    planner      The checkpoint that it samples from: the task's, or the one trained with constraint
                 labels.

    Only `diffuser` is neither enforcing nor polished: its plans are the unconstrained plans that
    others are compared with.
    """

    @property
    def enforces(self) -> bool: ...
    @property
    def polished(self) -> bool: ...
    @property
    def candidates(self) -> int: ...
    @property
    def planner(self) -> PlannerKind: ...
    def init(self, x: Traj, g: Constraint) -> Any: ...
    def step(self, step: Step, g: Constraint, state: Any) -> tuple[Traj, Any]: ...


class Sample(NamedTuple):
    """Plans x_0, normalised [batch, horizon, dim], and the method's state after its last step."""

    x: Traj
    state: Any


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
    state: Any = None,
    on_step: Callable[[int, Step, Traj], None] | None = None,
) -> Sample:
    """Sample plans x_0 from noise, with the method acting in every reverse step.

    denoiser      (x_t, t) -> clean estimate, normalised
    noise         draws standard normal noise [batch, horizon, dim]
    extra_steps   further steps with t frozen at 1 and no noise, in which the multipliers still
                  move; as in the released code
    first         x_T; None: drawn
    state         the method's state before its first step; None: method.init()
    on_step       called with the number of network calls so far, the step and x_{t-1}
    """
    x = pins.paint(noise() if first is None else first)
    state = method.init(x, g) if state is None else state
    used: Previous | None = None
    for call, i in enumerate([*range(schedule.n_steps, 0, -1), *[1] * extra_steps], start=1):
        x0 = pins.paint(denoiser(x, schedule.t[i]))
        last = i == 1
        z = torch.zeros_like(x) if last else noise()
        a, b = schedule.alpha_bar[i], schedule.alpha_bar[i - 1]
        x_t = x

        def reverse(
            clean: Traj,
            x: Traj = x_t,
            z: Traj = z,
            a: float = a,
            b: float = b,
            previous: Previous | None = used,
        ) -> Traj:
            nonlocal used
            used = clean, a
            return pins.paint(kernel(x, clean, z, a, b, previous))

        step = Step(x_t, x0, schedule.beta(i), math.sqrt(b), reverse, pins, last, i - 1)
        x, state = method.step(step, g, state)
        if on_step:
            on_step(call, step, x)
    return Sample(x, state)
