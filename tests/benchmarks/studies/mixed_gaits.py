"""What does a planner do that was trained on all shipped gaits?

    python tests/benchmarks/studies/mixed_gaits.py FOLDER [--task hopper] [--episodes 30]
        [--seed 100]

The shipped Hopper planner knows the first gait alone. The script trains, calibrates and measures a
planner of all of them in FOLDER, with limits at the 95 and 90 % quantiles of its demonstrations. An
interrupted training is resumed. It takes about a quarter of an hour on one core.
"""

import argparse
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import yaml
from acting import act
from gaits import BOUNDED
from rich.console import Console
from rich.table import Table

from cdiff_cli.commands.calibrate import calibrate
from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.models.checkpoint import install
from cdiff_cli.models.recipe import Recipe, load_recipe
from cdiff_cli.paths import home
from cdiff_cli.tasks import load_task
from cdiff_cli.training import fit
from cdiff_cli.training.demonstrations import demonstrations


def move_to(folder: Path, task: str) -> None:
    """Copy the shipped files of the task to the folder, and work there."""
    if not (folder / "models").exists():
        shutil.copytree(home() / "models" / task, folder / "models" / task)
        shutil.copytree(home() / "constraints", folder / "constraints")
    (folder / "data").mkdir(exist_ok=True)
    os.environ["MINARI_DATASETS_PATH"] = str((folder / "data").resolve())
    os.chdir(folder)


def set_limits(task, recipe: Recipe) -> None:
    """Write the quantiles of the walks into the two constraint files."""
    at = task.layout.index(BOUNDED[task.name])
    episodes = demonstrations(task, recipe.demonstrations.steps, recipe.demonstrations.seed)
    walks = np.abs(np.concatenate([x[:, at] for x in episodes if len(x) >= recipe.horizon]))
    for stem, q in ((task.name, 0.95), (f"{task.name}-hard", 0.9)):
        path, limit = Path("constraints") / f"{stem}.yaml", round(float(np.quantile(walks, q)), 1)
        content = yaml.safe_load(path.read_text())
        for each in content["constraints"]:
            each["barrier"]["b"] = limit
        path.write_text(yaml.safe_dump(content))
        Console(stderr=True).print(f"{stem}: limit {limit:g}, the {q:.0%} quantile")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--task", default="hopper", choices=BOUNDED)
    parser.add_argument("--episodes", type=int, default=30)
    parser.add_argument("--seed", type=int, default=100)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    task = replace(load_task(arguments.task), gaits=None)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    move_to(arguments.folder, task.name)
    recipe = load_recipe(task.name)
    set_limits(task, recipe)
    work = Path("runs")
    resume = (work / "state.safetensors").exists()
    found = fit.train(
        task,
        recipe,
        "small",
        seed=0,
        device=torch.device("cpu"),
        work=work,
        resume=resume,
        save_every=2000,
    )
    install(found)
    table = Table(
        title=f"{task.name}, a planner of all gaits (R² {found.card.inverse}), {arguments.episodes} episodes from {arguments.seed}"
    )
    for title in (
        "constraint",
        "method",
        "return",
        "least",
        "largest",
        "fell",
        "violating",
        "violation rate / %",
        "worst / g",
    ):
        table.add_column(title, justify="left" if title in ("constraint", "method") else "right")
    for stem in (task.name, f"{task.name}-hard"):
        request = Request(
            task=task.name, constraints=Path("constraints") / f"{stem}.yaml", device="cpu"
        )
        calibrate(
            resolve(replace(request, n=100, seed=5000, calibrate=True)), lambda *_: None, 0.99
        )
        for method in ("diffuser", "alm"):
            experiment = resolve(replace(request, method=method))
            seeds = range(arguments.seed, arguments.seed + arguments.episodes)
            done = act(controller(experiment), experiment.task, seeds, experiment.declared)
            reward = np.array([row["reward"] for row in done.rows])
            least, largest = f"{reward.min():.0f}", f"{reward.max():.0f}"
            counts = (
                f"{done.done.fell.sum()}",
                done.violating(),
                f"{done.mean('violation_rate'):.3f}",
            )
            table.add_row(stem, method, done.returned(), least, largest, *counts, done.worst())
            Console(stderr=True).print(stem, method, done.returned(), *counts)
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
