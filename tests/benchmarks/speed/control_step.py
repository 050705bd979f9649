"""What a control step costs: planning at batch 1, method by method, against the bare network calls of the same run.

    python tests/benchmarks/speed/control_step.py [--task hopper swimmer ball-run] [--methods alm] [--warm 0.3] [--steps 150]
        [--repeats 3] [--threads 2] [--paper-size 16 100]

Medians over the steps of an episode, after 10 to warm up; the methods take turns, so that a slow moment meets all of them. The
constraint's share of a step: what the method takes outside the network beyond the first method's, over the whole step. The
last rows: the projection of one plan onto the task's barrier chain, ours and ProxQP's through qpsolvers.

--paper-size    steps with a network of the paper's size, at these horizons, in the place of the shipped one (Decision Diffuser's:
                a U-Net of width 128, multipliers 1, 4, 8; the paper's horizon is 100). It is not trained, and only its time
                counts: the estimates are the shipped network's, repeated along the longer horizon
"""

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import qpsolvers
import torch
from rich.console import Console
from rich.table import Table
from scipy import sparse

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import pull_back
from cdiff_cli.models.networks import TemporalUnet
from cdiff_cli.models.normaliser import ResidualNormaliser
from cdiff_cli.planning.receding_horizon import Controller, rollout
from cdiff_cli.projection.project import project
from cdiff_cli.tasks import load_task
from cdiff_cli.tasks.protocol import ControlTask, observable_of

WARM_UP = 10
METHODS = ("diffuser", "projected", "primal-dual", "alm")


def median_ms(call: Callable[[], Any], repeats: int = 200) -> float:
    times = []
    for k in range(repeats + 20):
        began = time.perf_counter()
        call()
        if k >= 20:
            times.append(time.perf_counter() - began)
    return 1e3 * statistics.median(times)


def paper_sized(acting: Controller, net: TemporalUnet, horizon: int) -> Controller:
    """The same with plans of that length, each estimate at the cost of a call of `net`."""
    planner = acting.planner
    own, frame, shipped = planner.horizon, planner.normaliser, planner.denoiser
    tau = torch.tensor([0, *(1 + k % (own - 1) for k in range(horizon - 1))])

    def denoiser(x: torch.Tensor, t: int) -> torch.Tensor:
        net(x, x.new_full((len(x),), t))
        return shipped(x[:, :own], t)[:, tau]

    longer = ResidualNormaliser(
        frame.state, frame.used, frame.mean[tau], frame.gain[tau], frame.scale[tau]
    )
    planner = replace(planner, normaliser=longer, denoiser=denoiser, horizon=horizon)
    return replace(acting, planner=planner)


def projections(acting: Controller, task: ControlTask) -> tuple[float, float, float]:
    """Milliseconds of one projection of a random plan near the data onto the first chain: ours, ProxQP's; their distance."""
    frame, dim, horizon = acting.planner.normaliser, len(task.layout), acting.planner.horizon
    seen = {name: torch.ones(1, dtype=torch.float64) for name in observable_of(task)}
    generator = torch.Generator().manual_seed(0)
    present = frame.state.decode(torch.randn(1, dim, generator=generator, dtype=torch.float64))
    to = frame.at(present)
    g = pull_back(
        acting.declared.bind(seen, task.dt, horizon), to.centre, torch.ones_like(to.scale)
    )
    g = type(g)(g.parts[:1])
    y = to.scale * torch.randn(1, horizon, dim, generator=generator, dtype=torch.float64)
    y[:, 0] = 0
    mask = torch.zeros(horizon, dim, dtype=torch.bool)
    mask[0] = True
    pins = Pins(mask, y)
    ours = project(g, y, pins, strict=False)
    rows, pull, _ = g.linearise(ours)
    jacobian = (
        torch.stack([pull(w[None])[0] for w in torch.eye(rows.shape[1], dtype=torch.float64)])
        .flatten(1)
        .numpy()[:, dim:]
    )
    bound = jacobian @ ours.flatten()[dim:].numpy() - rows[0].numpy()
    eye, target, J = (
        sparse.eye(len(bound) * dim, format="csc"),
        -y.flatten()[dim:].numpy(),
        sparse.csc_matrix(jacobian),
    )

    def proxqp() -> Any:
        return qpsolvers.solve_qp(eye, target, J, bound, solver="proxqp", eps_abs=1e-9)

    gap = float(np.abs(proxqp() - ours.flatten()[dim:].numpy()).max())
    return median_ms(lambda: project(g, y, pins, strict=False)), median_ms(proxqp), gap


def report(table: Table, task: str, preset: str, found: dict[str, list[Any]]) -> None:
    """A row a method; the first is what the others are measured against."""
    bare = None
    for method, runs in found.items():
        step = 1e3 * np.concatenate([done.latency_s[WARM_UP:] for done in runs])
        network = 1e3 * np.concatenate([done.network_s[WARM_UP:] for done in runs])
        calls = np.concatenate([done.calls[0, WARM_UP:] for done in runs])
        middle, outside = np.median(step), np.median(step - network)
        bare = outside if bare is None else bare
        numbers = (f"{np.median(network):.2f}", f"{middle:.2f}", f"{np.quantile(step, 0.95):.2f}")
        shares = (
            f"{100 * outside / np.median(network):.1f}",
            f"{100 * (outside - bare) / middle:.1f}",
        )
        table.add_row(task, preset, method, f"{np.nanmean(calls):.3g}", *numbers, *shares, "")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", nargs="+", default=["hopper", "swimmer", "ball-run"])
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument(
        "--warm", type=float, nargs="*", default=[0.3], help="warm starts beside the cold one"
    )
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--paper-size", type=int, nargs="+", metavar="HORIZON")
    asked = parser.parse_args()
    torch.set_num_threads(asked.threads)
    table = Table(title=f"a control step at batch 1, {asked.threads} threads, milliseconds")
    for title in (
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
    ):
        table.add_column(
            title, justify="left" if title in ("task", "preset", "method") else "right"
        )
    for task in asked.task:
        loaded = load_task(task)
        dim = len(loaded.layout)
        net = (
            TemporalUnet(dim, 128, (1, 4, 8), ends=(0,)).eval().requires_grad_(False)
            if asked.paper_size
            else None
        )
        for preset, warm in (
            ("recommended", None),
            *((f"recommended, warm {wa:g}", wa) for wa in asked.warm),
        ):
            each = {
                m: controller(resolve(Request(task=task, method=m, warm=warm)))
                for m in asked.methods
            }
            for horizon in asked.paper_size or [None]:
                sized = {
                    m: paper_sized(acting, net, horizon) if net and horizon else acting
                    for m, acting in each.items()
                }
                found: dict[str, list[Any]] = {m: [] for m in asked.methods}
                for _ in range(asked.repeats):
                    for method, acting in sized.items():
                        found[method].append(rollout(acting, loaded, [100], steps=asked.steps))
                name = f"{preset}, U-Net, horizon {horizon}" if horizon else preset
                report(table, task, name, found)
        if not asked.paper_size:
            ours, theirs, gap = projections(next(iter(each.values())), loaded)
            table.add_row(
                task,
                "",
                f"one projection (apart {gap:.0e})",
                "",
                "",
                f"{ours:.3f}",
                "",
                "",
                "",
                f"{theirs:.3f}",
            )
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
