"""Fitting the inverse dynamics model u = IDM(x^0, x^1) to the transitions of the demonstrations."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError
from cdiff_cli.models.networks import InverseDynamics
from cdiff_cli.models.recipe import InverseSpec

HELD_OUT = 20  # one episode in so many is kept for the R^2


def fit_inverse(
    episodes: Sequence[Array],
    inputs: Sequence[Array],
    horizon: int,
    spec: InverseSpec,
    seed: int,
    on_step: Callable[[int, int, float], None] | None = None,
) -> tuple[InverseDynamics, dict[str, float]]:
    """The model, and its R^2 (share of the inputs' variance explained) on episodes that it was not trained on: `windows` on those
    at least a horizon long, `branches` on the shorter ones, which hold random and strongly perturbed inputs.
    """
    if not inputs:
        raise CdiffError(
            "this dataset has no inputs to fit the inverse dynamics to; choose one with actions, a Minari dataset"
        )
    lengths = np.array([len(x) for x in episodes])
    every = [_transitions(x, u, spec.ahead) for x, u in zip(episodes, inputs, strict=True)]
    long = np.flatnonzero(lengths >= horizon)
    short = np.flatnonzero(lengths < horizon)
    kept = {
        name: of[::HELD_OUT][: len(of) // 2]
        for name, of in (("windows", long), ("branches", short))
    }  # a single one is used
    held = set(np.concatenate(list(kept.values())).tolist())
    x, after, u = (
        torch.cat(parts)
        for parts in zip(*(t for i, t in enumerate(every) if i not in held), strict=True)
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(
            seed
        )  # weight initialisation draws from the global generator; fork_rng restores it
        net = InverseDynamics(x.shape[1], u.shape[1], spec.width)
    net.load_state_dict(net.state_dict() | _scales(x, after, u))
    generator, optimiser = (
        torch.Generator().manual_seed(seed),
        torch.optim.Adam(net.parameters(), spec.learning_rate),
    )
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, spec.steps)
    for step in range(spec.steps):
        some = torch.randint(len(x), (spec.batch,), generator=generator)
        loss = nn.functional.mse_loss(net.raw(x[some], after[some]), u[some])
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        rate.step()
        if on_step:
            on_step(step + 1, spec.steps, loss.item())
    net.eval().requires_grad_(False)
    return net, {
        name: _explained(net, [every[i] for i in which])
        for name, which in kept.items()
        if len(which)
    }


def _transitions(x: Array, u: Array, ahead: int) -> tuple[Tensor, Tensor, Tensor]:
    """States, the states `ahead` steps later, and the inputs, of one episode."""
    states, n = torch.from_numpy(x).float(), max(len(x) - ahead, 0)
    return states[:n], states[ahead : ahead + n], torch.from_numpy(u[:n]).float()


def _scales(x: Tensor, after: Tensor, u: Tensor) -> dict[str, Tensor]:
    """The model's buffers."""
    change = after - x
    scale = torch.stack((x.std(0), change.std(0))).clamp_min(1e-6)
    return {
        "centre": torch.stack((x.mean(0), change.mean(0))),
        "scale": scale,
        "low": u.amin(0),
        "high": u.amax(0),
    }


def _explained(net: InverseDynamics, parts: Sequence[tuple[Tensor, Tensor, Tensor]]) -> float:
    x, after, u = (torch.cat(part) for part in zip(*parts, strict=True))
    missed = (net(x, after) - u).square().sum()
    return round(float(1 - missed / (u - u.mean(0)).square().sum()), 5)
