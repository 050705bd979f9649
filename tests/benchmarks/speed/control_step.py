"""How long does one control step take, by method, against the bare network calls?

    python tests/benchmarks/speed/control_step.py [--task hopper swimmer ball-run] [--methods alm]
        [--warm 0.3] [--steps 150] [--repeats 3] [--threads 2] [--paper-size 16 100]

Plans are made at batch 1. Times are medians over the steps of an episode, after 10 to warm up. The
methods take turns, so that a slow moment of the machine meets all of them. The constraint's share
of a step is the time outside the network, less that of the first method, over the whole step. The
last rows show the projection of one plan onto the first barrier of the task, ours and ProxQP's
through qpsolvers.

--paper-size   use a network of the paper's size with these horizons in the place of the shipped
               one: Decision Diffuser's U-Net of width 128, multipliers 1, 4, 8; the paper's horizon
               is 100. It is not trained. Only its time counts; the estimates are those of the
               shipped network, repeated along the longer horizon.
"""

import argparse
from dataclasses import replace
from typing import Any, cast

import numpy as np
import qpsolvers
import torch
from rich.console import Console
from rich.table import Table
from scipy import sparse
from timing import milliseconds

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.models.networks import TemporalUnet
from cdiff_cli.models.normaliser import ResidualNormaliser
from cdiff_cli.planning.episodes import Episodes
from cdiff_cli.planning.receding_horizon import Controller, rollout
from cdiff_cli.projection.project import project
from cdiff_cli.tasks import load_task
from cdiff_cli.tasks.protocol import ControlTask, observable_of

WARM_UP = 10  # control steps that are not timed
PROJECTIONS = 200  # timed calls of one projection, after 20 to warm up
METHODS = ("diffuser", "projected", "primal-dual", "alm")
SEED = 100
TITLES = (
    "task",
    "preset",
    "method",
    "calls",
    "network",
    "step",
    "95 %",
    "over the calls / %",
    "constraint / %",
    "ProxQP",
)


def paper_sized(acting: Controller, net: TemporalUnet, horizon: int) -> Controller:
    """The controller with a longer horizon, and the time of a call of `net` per estimate."""
    shipped = acting.planner
    normaliser = cast(ResidualNormaliser, shipped.normaliser)
    tau = torch.tensor([0, *(1 + k % (shipped.horizon - 1) for k in range(horizon - 1))])

    def denoiser(x: torch.Tensor, t: int) -> torch.Tensor:
        net(x, x.new_full((len(x),), t))
        return shipped.denoiser(x[:, : shipped.horizon], t)[:, tau]

    longer = replace(
        normaliser,
        mean=normaliser.mean[tau],
        gain=normaliser.gain[tau],
        scale=normaliser.scale[tau],
    )
    planner = replace(shipped, normaliser=longer, denoiser=denoiser, horizon=horizon)
    return replace(acting, planner=planner)


def projections(acting: Controller, task: ControlTask) -> tuple[float, float, float]:
    """One projection of a random plan near the data onto the first barrier.

    Returns the times of ours and of ProxQP [ms], and the largest difference of the results.
    """
    planner, dim = acting.planner, acting.planner.dim
    normaliser = cast(ResidualNormaliser, planner.normaliser)
    observed = {name: torch.ones(1, dtype=torch.float64) for name in observable_of(task)}
    generator = torch.Generator().manual_seed(0)
    present = normaliser.state.decode(torch.randn(1, dim, generator=generator, dtype=torch.float64))
    window = normaliser.at(present)
    bound = acting.declared.bind(observed, task.dt, planner.horizon)
    g = Constraint(pull_back(bound, window.centre, torch.ones_like(window.scale)).parts[:1])
    shape = (1, planner.horizon, dim)
    y = window.scale * torch.randn(shape, generator=generator, dtype=torch.float64)
    y[:, 0] = 0
    mask = torch.zeros(planner.horizon, dim, dtype=torch.bool)
    mask[0] = True
    pins = Pins(mask, y)
    nearest = project(g, y, pins, strict=False)
    solution = nearest.flatten()[dim:].numpy()
    matrices = quadratic_program(g, nearest, y)

    def proxqp() -> Any:
        return qpsolvers.solve_qp(*matrices, solver="proxqp", eps_abs=1e-9)

    gap = float(np.abs(proxqp() - solution).max())
    ours = milliseconds(lambda: project(g, y, pins, strict=False), PROJECTIONS, 20)
    return ours, milliseconds(proxqp, PROJECTIONS, 20), gap


def quadratic_program(g: Constraint, x: torch.Tensor, y: torch.Tensor) -> tuple[Any, ...]:
    """P, q, G, h of the nearest point to y under g linearised at x, without the first waypoint."""
    dim = x.shape[-1]
    rows, pull, _ = g.linearise(x)
    unit = torch.eye(rows.shape[1], dtype=torch.float64)
    jacobian = torch.stack([pull(w[None])[0] for w in unit]).flatten(1).numpy()[:, dim:]
    h = jacobian @ x.flatten()[dim:].numpy() - rows[0].numpy()
    eye = sparse.eye(jacobian.shape[1], format="csc")
    return eye, -y.flatten()[dim:].numpy(), sparse.csc_matrix(jacobian), h


def report(table: Table, task: str, preset: str, episodes: dict[str, list[Episodes]]) -> None:
    """Add one row per method; the first is what the others are compared with."""
    bare = None
    for method, runs in episodes.items():
        step = 1e3 * np.concatenate([run.latency_s[WARM_UP:] for run in runs])
        network = 1e3 * np.concatenate([run.network_s[WARM_UP:] for run in runs])
        calls = np.concatenate([run.calls[0, WARM_UP:] for run in runs])
        median, outside = np.median(step), np.median(step - network)
        bare = outside if bare is None else bare
        times = (f"{np.median(network):.2f}", f"{median:.2f}", f"{np.quantile(step, 0.95):.2f}")
        shares = (
            f"{100 * outside / np.median(network):.1f}",
            f"{100 * (outside - bare) / median:.1f}",
        )
        table.add_row(task, preset, method, f"{np.nanmean(calls):.3g}", *times, *shares, "")


def measure(table: Table, name: str, arguments: argparse.Namespace) -> None:
    """Add all rows of one task."""
    task = cast(ControlTask, load_task(name))
    net = None
    if arguments.paper_size:
        net = TemporalUnet(len(task.layout), 128, (1, 4, 8), ends=(0,)).eval().requires_grad_(False)
    presets = {"recommended": None} | {f"recommended, warm {w:g}": w for w in arguments.warm}
    for preset, warm in presets.items():
        controllers = {
            method: controller(resolve(Request(task=name, method=method, warm=warm)))
            for method in arguments.methods
        }
        for horizon in arguments.paper_size or [None]:
            sized = controllers
            if net is not None:
                sized = {m: paper_sized(c, net, horizon) for m, c in controllers.items()}
            episodes: dict[str, list[Episodes]] = {method: [] for method in sized}
            for _ in range(arguments.repeats):
                for method, acting in sized.items():
                    episodes[method].append(rollout(acting, task, [SEED], steps=arguments.steps))
            title = f"{preset}, U-Net, horizon {horizon}" if horizon else preset
            report(table, name, title, episodes)
    if not arguments.paper_size:
        ours, theirs, gap = projections(next(iter(controllers.values())), task)
        method = f"one projection (differ by {gap:.0e})"
        table.add_row(name, "", method, "", "", f"{ours:.3f}", "", "", "", f"{theirs:.3f}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", nargs="+", default=["hopper", "swimmer", "ball-run"])
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument(
        "--warm", type=float, nargs="*", default=[0.3], help="warm starts, besides the cold one"
    )
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--paper-size", type=int, nargs="+", metavar="HORIZON")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    threads = f"{arguments.threads} threads"
    table = Table(title=f"one control step at batch 1, {threads}, milliseconds")
    for title in TITLES:
        left = title in ("task", "preset", "method")
        table.add_column(title, justify="left" if left else "right")
    for name in arguments.task:
        measure(table, name, arguments)
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
