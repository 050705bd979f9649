"""Which inverse dynamics model drives the ball best?

    python tests/benchmarks/studies/inverse_dynamics.py [--episodes 60] [--seed 0]

Candidates: networks between states 1, 2, 4 or 8 waypoints apart, and the linear fit solved for u.
The obstacle is a ghost in all patterns; the methods are diffuser and recommended alm. Missing
demonstrations are generated.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from acting import act
from rich.console import Console
from rich.table import Table
from torch import Tensor

from cdiff_cli.arrays import Array
from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.models.recipe import InverseSpec
from cdiff_cli.planning.receding_horizon import Controller
from cdiff_cli.training.demonstrations import demonstrations, load_inputs
from cdiff_cli.training.inverse_dynamics import fit_inverse
from cdiff_cli.training.system_identification import fit_dynamics

NAME = "ball-run"


def linear(episodes: list, inputs: list):
    """The model u = B^+ (x' - A x - c), clipped to the inputs of the data, and its residual.

    The residual is the root mean square error of x' per coordinate.
    """
    found = fit_dynamics(episodes, inputs)
    assert found is not None
    dynamics = found[0]
    A, B, c = (getattr(dynamics, name).float() for name in ("A", "B", "c"))
    back = torch.linalg.pinv(B)

    def inverse(x: Tensor, following: Tensor) -> Tensor:
        u = (following - x @ A.T - c) @ back.T
        return torch.clamp(u, dynamics.low.float(), dynamics.high.float())

    x, u, after = (
        np.concatenate(p)
        for p in zip(
            *((e[:-1], i[: len(e) - 1], e[1:]) for e, i in zip(episodes, inputs, strict=True)),
            strict=True,
        )
    )
    left = after - x @ dynamics.A.numpy().T - u @ dynamics.B.numpy().T - dynamics.c.numpy()
    return inverse, np.sqrt((left**2).mean(0))


def driven(acting: Controller, inverse: Callable[[Tensor, Tensor], Tensor], ahead: int = 1):
    """The controller with another inverse dynamics model."""

    def input_between(x: Array, following: Array) -> Array:
        with torch.inference_mode():
            u = inverse(torch.from_numpy(x).float(), torch.from_numpy(following).float())
        return u.double().numpy()

    planner = replace(acting.planner, inverse_dynamics=input_between)
    return replace(acting, planner=planner, ahead=ahead)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    both = {m: controller(resolve(Request(task=NAME, method=m))) for m in ("diffuser", "alm")}
    ball_run = resolve(Request(task=NAME))
    recipe, task = ball_run.recipe, ball_run.task
    episodes = demonstrations(task, recipe.demonstrations.steps, recipe.demonstrations.seed)
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    inputs = load_inputs(task, f"cdiff/{NAME}-v0")
    table = Table(
        title=f"ball run, ghost obstacle, {arguments.episodes} episodes from seed {arguments.seed}"
    )
    for title in (
        "inverse dynamics",
        "R² windows",
        "R² random",
        "method",
        "return",
        "violation rate / %",
        "violating",
    ):
        table.add_column(title, justify="right" if title[0] in "Rrv" else "left")

    def add(name: str, fits: tuple[str, str], changed: dict[str, Controller]) -> None:
        for method, acting in changed.items():
            acted = act(acting, task, seeds, ball_run.declared, {"collide": False})
            table.add_row(
                name,
                *fits,
                method,
                acted.returned(),
                f"{acted.mean('violation_rate'):.3f}",
                acted.violating(),
            )

    for ahead in (1, 2, 4, 8):
        spec = InverseSpec(steps=8000, ahead=ahead)
        net, fits = fit_inverse(episodes, inputs, recipe.horizon, spec, 0)
        explained = f"{fits['windows']:.4f}", f"{fits['branches']:.4f}"
        add(
            f"network, {ahead} ahead",
            explained,
            {m: driven(c, net, ahead) for m, c in both.items()},
        )
    inverse, left = linear(episodes, inputs)
    add("linear fit, 1 ahead", ("", ""), {m: driven(c, inverse) for m, c in both.items()})
    Console(width=120).print(table)
    Console(width=120).print(
        f"the linear fit leaves {', '.join(f'{v:.1e}' for v in left)} of x, y (m), vx, vy (m/s), root mean square"
    )


if __name__ == "__main__":
    main()
