"""What is each choice of the recommended preset of the ball run worth?

    python tests/benchmarks/studies/control_ablation.py [--episodes 60] [--seed 0]

One row per change, with the same episodes and noise. The obstacle is a ghost in all six patterns. A
violation is an executed state within 1.2 m of its centre.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
import yaml
from acting import act
from rich.console import Console
from rich.table import Table

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.paths import home

RATE = {"time": 0.2, "velocity": {"x": "vx", "y": "vy"}}
PLACE = RATE | {"form": "place"}
ROWS = [
    ("diffuser, no constraint", "diffuser", {}, ()),
    ("recommended alm", "alm", {}, ()),
    ("g at the noisy sample", "alm", {}, ("on=noisy",)),
    ("clean estimate changed", "alm", {}, ("on=clean", "rho=0.5", "c=1.2")),
    ("projected", "projected", {}, ()),
    ("primal-dual", "primal-dual", {}, ()),
    ("obstacle held in place", "alm", {"hold": True}, ()),
    ("plain barrier h", "alm", {"look_ahead": None}, ()),
    ("plain barrier, squared form", "alm", {"look_ahead": None, "form": "squared"}, ()),
    ("look-ahead to the place", "alm", {"look_ahead": PLACE}, ()),
    ("order 2 in positions", "alm", {"look_ahead": None, "order": 2}, ()),
    ("look-ahead 0.1 s", "alm", {"look_ahead": RATE | {"time": 0.1}}, ()),
    ("look-ahead 0.4 s", "alm", {"look_ahead": RATE | {"time": 0.4}}, ()),
    *((f"alpha {alpha:g}", "alm", {"alpha": alpha}, ()) for alpha in (0.1, 0.3, 0.85, 1.0)),
    *((f"rho {rho:g}", "alm", {}, (f"rho={rho}",)) for rho in (1.0, 3.0, 30.0)),
]


def varied(change: dict, folder: Path) -> Path:
    """The shipped constraint file with its one barrier changed."""
    content = yaml.safe_load((home() / "constraints" / "ball-run.yaml").read_text())
    (barrier,) = content["constraints"]
    for key, value in change.items():
        if key == "form":
            barrier["barrier"]["form"] = value
        elif value is None:
            barrier.pop(key)
        else:
            barrier[key] = value
    path = folder / "ball-run.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    table = Table(
        title=f"ball run, ghost obstacle, {arguments.episodes} episodes from seed {arguments.seed}"
    )
    for title in (
        "change",
        "return",
        "violation rate / %",
        "episodes violating",
        "worst / m",
        "saturation / %",
    ):
        table.add_column(title, justify="left" if title == "change" else "right")
    ball_run = resolve(Request(task="ball-run"))
    for name, method, change, settings in ROWS:
        with tempfile.TemporaryDirectory() as folder:
            path = varied(change, Path(folder))
            acting = controller(
                resolve(
                    Request(
                        task="ball-run",
                        method=method,
                        constraints=path,
                        settings=settings,
                        margin=0.0,
                    )
                )
            )
        if "squared" in name:
            sampler = acting.sampler.model_copy(update={"polish": False})
            acting = replace(acting, sampler=sampler)
        episodes = act(
            acting,
            ball_run.task,
            seeds,
            ball_run.declared,
            {"collide": False},
        )
        rate, saturation = (
            f"{episodes.mean('violation_rate'):.3f}",
            f"{episodes.mean('saturation'):.1f}",
        )
        table.add_row(
            name, episodes.returned(), rate, episodes.violating(), episodes.worst(), saturation
        )
        Console(stderr=True).print(name, episodes.returned())
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
