"""What do alpha, disturbed inputs and longer execution do to a constrained locomotion task?

    python tests/benchmarks/studies/control_sensitivity.py --task hopper [--episodes 10]
        [--seed 100] [--only execute] [--keep] [--picture docs/alpha-hopper.png]

All rows are recommended alm with margins of their own: the shipped ones if they fit, else margins
that are calibrated as by `cdiff rollout --calibrate`, with 100 episodes per pass from seed 5000 at
level 0.99. --keep writes them beside the checkpoint.

The picture shows h = limit - |w| for each alpha. Left: along the first episode. Right: the approach
to the limit, from the last step above 2.2 rad/s to the nearest point of a stride, as a median over
all strides and episodes; dotted, the fastest fall that the barrier allows, to its margin.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import numpy as np
import torch
import yaml
from acting import act
from matplotlib import pyplot as plt
from rich.console import Console
from rich.table import Table

from cdiff_cli.commands.calibrate import fit_margins
from cdiff_cli.commands.experiment import Experiment, Request
from cdiff_cli.commands.margins import ChosenMargins, write_calibration
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.evaluation.conformal import tightened
from cdiff_cli.paths import home

ALPHAS = (0.1, 0.3, 0.5, 0.85, 1.0)
FROM = 2.2  # rad/s: where an approach begins
STRIDE, APPROACH = 36, 14  # steps: half a stride of Hopper, at most; of an approach
SETTLED = 500  # step after which every stride is like the last


def changed(task: str, alpha: float | None = None, **options: Any) -> Request:
    """The recommended alm with other options, its barriers at another alpha."""
    path = home() / "constraints" / f"{task}.yaml"
    if alpha is None:
        return Request(task=task, **options)
    content = yaml.safe_load(path.read_text())
    for barrier in content["constraints"]:
        barrier["alpha"] = alpha
    other = Path(tempfile.mkdtemp()) / path.name
    other.write_text(yaml.safe_dump(content))
    return Request(task=task, constraints=other, **options)


def fitted(options: Request, keep: bool) -> Experiment:
    """The experiment with margins that were calibrated on it."""
    experiment = resolve(options)
    if experiment.margins.match in ("exact", "unused"):
        return experiment
    calibrating = resolve(replace(options, calibrate=True, n=100, seed=5000))
    calibration = fit_margins(calibrating, lambda *_: None, 0.99)
    if keep:
        write_calibration(calibrating.checkpoint.path, calibration)
    margins = {name: one.margin for name, one in calibration.margins.items()}
    enforced = tightened(calibrating.problem.enforced, margins)
    return replace(
        experiment,
        problem=replace(experiment.problem, enforced=enforced),
        margins=ChosenMargins(margins, "exact", calibration),
    )


def approaches(h: Any) -> list[tuple[int, int]]:
    """(episode, last step with h >= FROM) before the smallest h of each stride.

    h   [n, steps + 1]
    """
    found = []
    for i, row in enumerate(h):
        for k in range(3 * STRIDE, len(row) - 3 * STRIDE):
            if row[k] == row[k - STRIDE : k + STRIDE + 1].min():
                above = np.flatnonzero(row[k - STRIDE : k] >= FROM)
                found += [(i, k - STRIDE + int(above[-1]))] if len(above) else []
    return found


def draw(
    axes: Any, name: str, h: Any, alpha: float | None, margin: float, dt: float, colour: Any
) -> None:
    """Draw h for one alpha; None is no constraint."""
    found = approaches(h)
    if not found:
        return
    episode, begin = next((each for each in found if each[1] >= SETTLED), found[-1])
    shown = np.arange(-2 * STRIDE, STRIDE)
    axes[0].plot(dt * shown, h[episode, begin + shown], label=name, lw=1.2, color=colour)
    steps = np.arange(APPROACH + 1)
    together = np.array([h[i, k + steps] for i, k in found])
    middle = np.median(together, 0)
    axes[1].plot(dt * steps, middle, lw=1.6, color=colour)
    axes[1].fill_between(
        dt * steps, *np.quantile(together, (0.1, 0.9), axis=0), color=colour, alpha=0.15, lw=0
    )
    if alpha is not None and alpha < 1:
        axes[1].plot(
            dt * steps,
            margin + (middle[0] - margin) * (1 - alpha) ** steps,
            ":",
            lw=1,
            color=colour,
        )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="hopper")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--only", default="", help="rows whose name begins so")
    parser.add_argument("--keep", action="store_true")
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    rows = [("alpha: no constraint", changed(arguments.task, method="diffuser"))]
    rows += [
        (f"alpha {alpha:g}", changed(arguments.task, None if alpha == 0.85 else alpha))
        for alpha in ALPHAS
    ]
    rows += [
        (f"action noise {noise:g}", changed(arguments.task, action_noise=noise))
        for noise in (0.02, 0.1, 0.25)
    ]
    rows += [(f"execute {k}", changed(arguments.task, execute=k)) for k in (2, 4, 8)]
    rows += [
        ("warm 0.3, ddim", changed(arguments.task, warm=0.3, kernel="ddim")),
        ("warm 0.3", changed(arguments.task, warm=0.3)),
    ]
    table = Table(
        title=f"{arguments.task}, recommended alm, {arguments.episodes} episodes from seed {arguments.seed}"
    )
    titles = (
        "change",
        "margins",
        "return",
        "violation rate / %",
        "sum / rad/s",
        "worst / rad/s",
        "largest fall of h",
        "fell",
    )
    for title in titles:
        table.add_column(title, justify="left" if title == "change" else "right")
    figure, axes = plt.subplots(
        1, 2, figsize=(10, 3.7), sharey=True, width_ratios=(3, 2), layout="constrained"
    )
    colours = iter(["0.6", *plt.get_cmap("viridis")(np.linspace(0, 0.9, len(ALPHAS)))])
    for name, options in rows:
        if not name.startswith(arguments.only):
            continue
        experiment = fitted(options, arguments.keep)
        episodes = act(controller(experiment), experiment.task, seeds, experiment.declared)
        h = -episodes.levels.max(-1)
        fall = np.nanmax((h[:, :-1] - h[:, 1:]) / np.maximum(h[:, :-1], 0.05))
        rate, total = (
            f"{episodes.mean('violation_rate'):.3f}",
            f"{episodes.mean('executed_violation'):.3f}",
        )
        margins = ", ".join(f"{margin:.2f}" for margin in experiment.margins.margins.values())
        table.add_row(
            name,
            margins,
            episodes.returned(),
            rate,
            total,
            episodes.worst(),
            f"{fall:.2f}",
            f"{episodes.done.fell.sum()}",
        )
        if name.startswith("alpha"):
            alpha = None if experiment.request.method == "diffuser" else float(name.split()[1])
            margin = max(experiment.margins.margins.values(), default=0.0)
            draw(
                axes,
                name.removeprefix("alpha: "),
                h,
                alpha,
                margin,
                experiment.task.dt,
                next(colours),
            )
        Console(stderr=True).print(name, margins, episodes.returned(), rate, episodes.worst())
    Console(width=130).print(table)
    if arguments.picture:
        for axis in axes:
            axis.axhline(0, color="#d1495b", lw=1.2)
            axis.set(xlabel="time / s")
        axes[0].set(
            ylabel="h / rad/s, unsafe below 0", title=f"{arguments.task}: distance to the limit"
        )
        axes[1].set(title="approaches: median, 80 %; dotted: bound")
        figure.legend(fontsize=8, frameon=False, ncols=6, loc="outside upper center")
        figure.savefig(arguments.picture, dpi=110)


if __name__ == "__main__":
    main()
