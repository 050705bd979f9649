"""What alpha, disturbed inputs and longer execution of a plan do to a locomotion task under its constraint.

    python tests/benchmarks/control_sensitivity.py --task hopper [--episodes 10] [--seed 100] [--picture docs/alpha-hopper.png]

Recommended alm throughout, with its calibrated margin. The picture shows h = limit - |w| along the first episode for each alpha.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import numpy as np
import torch
import yaml
from acting import act
from matplotlib import pyplot as plt
from rich.console import Console
from rich.table import Table

from cdiff_cli.closed_loop import controller
from cdiff_cli.control import Controller
from cdiff_cli.recipe import home
from cdiff_cli.request import Options, resolve

ALPHAS = (0.1, 0.3, 0.5, 0.85, 1.0)
SHOWN = 120  # steps of the picture


def acting(task: str, alpha: float | None = None) -> Controller:
    """The recommended alm, its barriers at another alpha."""
    path = home() / "constraints" / f"{task}.yaml"
    if alpha is None:
        return controller(resolve(Options(task=task)))
    content = yaml.safe_load(path.read_text())
    for barrier in content["constraints"]:
        barrier["alpha"] = alpha
    with tempfile.TemporaryDirectory() as folder:
        changed = Path(folder) / path.name  # the same name: the margins are found by it
        changed.write_text(yaml.safe_dump(content))
        return controller(resolve(Options(task=task, constraints=changed)))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="hopper")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--picture", type=Path)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    seeds = range(asked.seed, asked.seed + asked.episodes)
    own = acting(asked.task)
    rows = [(f"alpha {alpha:g}", acting(asked.task, alpha)) for alpha in ALPHAS]
    rows += [(f"action noise {noise:g}", replace(own, action_noise=noise)) for noise in (0.02, 0.1, 0.25)]
    rows += [(f"execute {k}", replace(own, execute=k)) for k in (1, 2, 4, 8)]
    rows += [("warm 0.3, ddim", replace(own, warm=0.3, kernel="ddim")), ("warm 0.3", replace(own, warm=0.3))]
    table = Table(title=f"{asked.task}, recommended alm, {asked.episodes} episodes from seed {asked.seed}")
    for title in ("change", "return", "violation rate / %", "sum / rad/s", "worst / rad/s", "largest fall of h", "fell"):
        table.add_column(title, justify="left" if title == "change" else "right")
    figure, axis = plt.subplots(figsize=(8, 3.2))
    for name, changed in rows:
        found = act(changed, seeds, own.g)
        h = -found.levels.max(-1)
        fall = np.nanmax((h[:, :-1] - h[:, 1:]) / np.maximum(h[:, :-1], 0.05))
        rate, total = f"{found.mean('violation_rate'):.3f}", f"{found.mean('executed_violation'):.3f}"
        table.add_row(name, found.returned(), rate, total, found.worst(), f"{fall:.2f}", f"{found.done.fell.sum()}")
        if name.startswith("alpha"):
            axis.plot(np.arange(SHOWN) * own.task.dt, h[0, 500 : 500 + SHOWN], label=name, lw=1.2)
        Console(stderr=True).print(name, found.returned())
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
