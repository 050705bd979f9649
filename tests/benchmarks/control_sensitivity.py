"""What alpha, disturbed inputs and longer execution of a plan do to a locomotion task under its constraint.

    python tests/benchmarks/control_sensitivity.py --task hopper [--episodes 10] [--seed 100] [--only execute] [--keep]
        [--picture docs/alpha-hopper.png]

Recommended alm throughout, each row with margins of its own: those shipped where they fit, else calibrated here as `cdiff rollout
--calibrate` does, on episodes 5000-5099 at level 0.99, and with --keep written beside the checkpoint. The picture shows
h = limit - |w| along the first episode for each alpha.
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

from cdiff_cli.calibrations import Chosen, write_calibration
from cdiff_cli.closed_loop import controller, fit_margins
from cdiff_cli.margins import tightened
from cdiff_cli.recipe import home
from cdiff_cli.request import Options, Resolved, resolve

ALPHAS = (0.1, 0.3, 0.5, 0.85, 1.0)
SHOWN = 120  # steps of the picture


def changed(task: str, alpha: float | None = None, **options: Any) -> Options:
    """The recommended alm with other options, its barriers at another alpha."""
    path = home() / "constraints" / f"{task}.yaml"
    if alpha is None:
        return Options(task=task, **options)
    content = yaml.safe_load(path.read_text())
    for barrier in content["constraints"]:
        barrier["alpha"] = alpha
    other = Path(tempfile.mkdtemp()) / path.name
    other.write_text(yaml.safe_dump(content))
    return Options(task=task, constraints=other, **options)


def fitted(options: Options, keep: bool) -> Resolved:
    """The problem with margins that were calibrated on it."""
    resolved = resolve(options)
    if resolved.margins.match == "exact":
        return resolved
    calibrating = resolve(replace(options, calibrate=True, n=100, seed=5000))
    found = fit_margins(calibrating, lambda *_: None, 0.99)
    if keep:
        write_calibration(calibrating.checkpoint.path, found)
    margins = {name: each.margin for name, each in found.margins.items()}
    problem = replace(resolved.problem, enforced=tightened(calibrating.problem.enforced, margins))
    return replace(resolved, problem=problem, margins=Chosen(margins, "exact", found))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="hopper")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--only", default="", help="rows whose name begins so")
    parser.add_argument("--keep", action="store_true")
    parser.add_argument("--picture", type=Path)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    seeds = range(asked.seed, asked.seed + asked.episodes)
    rows = [(f"alpha {alpha:g}", changed(asked.task, None if alpha == 0.85 else alpha)) for alpha in ALPHAS]
    rows += [(f"action noise {noise:g}", changed(asked.task, action_noise=noise)) for noise in (0.02, 0.1, 0.25)]
    rows += [(f"execute {k}", changed(asked.task, execute=k)) for k in (2, 4, 8)]
    rows += [("warm 0.3, ddim", changed(asked.task, warm=0.3, kernel="ddim")), ("warm 0.3", changed(asked.task, warm=0.3))]
    table = Table(title=f"{asked.task}, recommended alm, {asked.episodes} episodes from seed {asked.seed}")
    titles = ("change", "margins", "return", "violation rate / %", "sum / rad/s", "worst / rad/s", "largest fall of h", "fell")
    for title in titles:
        table.add_column(title, justify="left" if title == "change" else "right")
    figure, axis = plt.subplots(figsize=(8, 3.2))
    for name, options in rows:
        if not name.startswith(asked.only):
            continue
        resolved = fitted(options, asked.keep)
        acting = controller(resolved)
        found = act(acting, seeds, acting.g)
        h = -found.levels.max(-1)
        fall = np.nanmax((h[:, :-1] - h[:, 1:]) / np.maximum(h[:, :-1], 0.05))
        rate, total = f"{found.mean('violation_rate'):.3f}", f"{found.mean('executed_violation'):.3f}"
        margins = ", ".join(f"{margin:.2f}" for margin in resolved.margins.margins.values())
        table.add_row(name, margins, found.returned(), rate, total, found.worst(), f"{fall:.2f}", f"{found.done.fell.sum()}")
        if name.startswith("alpha"):
            axis.plot(np.arange(SHOWN) * acting.task.dt, h[0, 500 : 500 + SHOWN], label=name, lw=1.2)
        Console(stderr=True).print(name, margins, found.returned(), rate, found.worst())
    Console(width=130).print(table)
    axis.axhline(0, color="#d1495b", lw=1.2)
    axis.set(xlabel="time / s", ylabel="h / rad/s, unsafe below 0", title=f"{asked.task}: distance to the limit, by alpha")
    axis.set_ylim(bottom=-1.0)
    axis.legend(fontsize=8, frameon=False, ncols=5, loc="lower center")
    figure.tight_layout()
    if asked.picture:
        figure.savefig(asked.picture, dpi=110)


if __name__ == "__main__":
    main()
