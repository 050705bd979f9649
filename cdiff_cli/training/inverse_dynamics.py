"""Fitting the inverse dynamics model u = IDM(x, x') to transitions of the demonstrations."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError
from cdiff_cli.models.networks import InverseDynamics
from cdiff_cli.models.recipe import InverseSpec

HELD_OUT = 20  # one episode in so many is kept for the R^2
LEAST = 1e-6  # scale of a coordinate that is constant
Transitions = tuple[Tensor, Tensor, Tensor]
"""States [k, dim], their successors [k, dim], and the inputs between them [k, m]."""


def fit_inverse(
    episodes: Sequence[Array],
    inputs: Sequence[Array],
    horizon: int,
    spec: InverseSpec,
    seed: int,
    on_step: Callable[[int, int, float], None] | None = None,
) -> tuple[InverseDynamics, dict[str, float]]:
    """The model, and its R^2 on episodes that it was not trained on.

    R^2 is the share of the variance of the inputs that the model explains: `windows` on episodes
    of at least one horizon, `branches` on shorter ones, which hold random and strongly perturbed
    inputs.
    """
    if not inputs:
        raise CdiffError(
            "this dataset has no inputs to fit the inverse dynamics to; "
            "choose one with actions, a Minari dataset"
        )
    parts = [_transitions(x, u, spec.ahead) for x, u in zip(episodes, inputs, strict=True)]
    held_out = _held_out([len(x) for x in episodes], horizon)
    unused = {number for numbers in held_out.values() for number in numbers}
    training = _joined([part for number, part in enumerate(parts) if number not in unused])
    net = _initial(training, spec.width, seed)
    _minimise(net, training, spec, torch.Generator().manual_seed(seed), on_step)
    net.eval().requires_grad_(False)
    explained = {
        name: _explained(net, _joined([parts[number] for number in numbers]))
        for name, numbers in held_out.items()
        if numbers
    }
    return net, explained


def _held_out(lengths: Sequence[int], horizon: int) -> dict[str, list[int]]:
    """Numbers of the episodes that are kept for the R^2; a single one is trained on."""
    kinds = {
        "windows": [i for i, n in enumerate(lengths) if n >= horizon],
        "branches": [i for i, n in enumerate(lengths) if n < horizon],
    }
    return {name: which[::HELD_OUT][: len(which) // 2] for name, which in kinds.items()}


def _initial(training: Transitions, width: int, seed: int) -> InverseDynamics:
    """The model before training, its buffers set to the scales of the data."""
    x, after, u = training
    with torch.random.fork_rng(devices=[]):
        # weight initialisation draws from the global generator; fork_rng restores it
        torch.manual_seed(seed)
        net = InverseDynamics(x.shape[1], u.shape[1], width)
    change = after - x
    buffers = {
        "centre": torch.stack((x.mean(0), change.mean(0))),
        "scale": torch.stack((x.std(0), change.std(0))).clamp_min(LEAST),
        "low": u.amin(0),
        "high": u.amax(0),
    }
    net.load_state_dict(net.state_dict() | buffers)
    return net


def _minimise(
    net: InverseDynamics,
    training: Transitions,
    spec: InverseSpec,
    generator: torch.Generator,
    on_step: Callable[[int, int, float], None] | None,
) -> None:
    """Adam on the mean squared error of the inputs, with a cosine learning rate."""
    x, after, u = training
    optimiser = torch.optim.Adam(net.parameters(), spec.learning_rate)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, spec.steps)
    for step in range(spec.steps):
        batch = torch.randint(len(x), (spec.batch,), generator=generator)
        loss = nn.functional.mse_loss(net.raw(x[batch], after[batch]), u[batch])
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        rate.step()
        if on_step:
            on_step(step + 1, spec.steps, loss.item())


def _transitions(x: Array, u: Array, ahead: int) -> Transitions:
    """States of one episode, the states `ahead` steps later, and the inputs."""
    states, n = torch.from_numpy(x).float(), max(len(x) - ahead, 0)
    return states[:n], states[ahead : ahead + n], torch.from_numpy(u[:n]).float()


def _joined(parts: Sequence[Transitions]) -> Transitions:
    x, after, u = (torch.cat(part) for part in zip(*parts, strict=True))
    return x, after, u


def _explained(net: InverseDynamics, held_out: Transitions) -> float:
    x, after, u = held_out
    error = (net(x, after) - u).square().sum()
    return round(float(1 - error / (u - u.mean(0)).square().sum()), 5)
