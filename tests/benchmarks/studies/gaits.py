"""How do the shipped gaits of a locomotion task differ?

    python tests/benchmarks/studies/gaits.py [--task hopper] [--expert FILE] [--episodes 10]
        [--seed 30000]

The walks are without noise, except in the last three columns: return and falls under action noise.
The columns about the gait leave out the first second. The period is the first lag at which the
velocity that the task's constraint bounds repeats best.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from cdiff_cli.tasks import load_task
from cdiff_cli.tasks.mujoco.locomotion import Gait

BOUNDED = {"hopper": "thigh_velocity", "swimmer": "rotor2_velocity"}


def period(w: np.ndarray) -> int:
    """Steps after which w [n] repeats: the best lag after the first negative autocorrelation."""
    w = w - w.mean()
    correlation = np.correlate(w, w, "full")[len(w) - 1 :]
    begin = int(np.argmax(correlation < 0))
    return begin + int(np.argmax(correlation[begin : len(w) // 2]))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="hopper", choices=BOUNDED)
    parser.add_argument("--expert", type=Path, help="gaits of another file than the shipped one")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=30_000)
    arguments = parser.parse_args()
    task = load_task(arguments.task)
    env, at = task.make_env().unwrapped, task.layout.index(BOUNDED[task.name])
    gaits = task.experts()
    if arguments.expert:
        gaits = [
            Gait(np.array(p["W"]), np.array(p["b"]))
            for p in json.loads(arguments.expert.read_text())["policies"]
        ]
    table = Table(
        title=f"{task.name}: {arguments.episodes} walks per gait from seed {arguments.seed}"
    )
    titles = (
        "gait",
        "return",
        "falls",
        "period / steps",
        f"|{BOUNDED[task.name]}| 50, 90, 95, 100 %",
        "vx / m/s",
        f"{task.layout[0]}",
    )
    for title in (*titles, "noise 0.05", "noise 0.1", "noise 0.2"):
        table.add_column(title, justify="right")
    seeds = range(arguments.seed, arguments.seed + arguments.episodes)
    for number, gait in enumerate(gaits):
        walks, outs = [], []
        for seed in seeds:
            states: list[np.ndarray] = []
            outs.append(task.walk(env, gait, seed, states=states))
            walks.append(np.array(states)[round(1 / task.dt) :])
        x = np.concatenate(walks)
        quantiles = " ".join(f"{q:.2f}" for q in np.quantile(np.abs(x[:, at]), (0.5, 0.9, 0.95, 1)))
        reward = np.array([out.reward for out in outs])
        row = [
            str(number),
            f"{reward.mean():.0f} ± {reward.std(ddof=1):.0f}",
            str(sum(out.fell for out in outs)),
        ]
        row += [f"{np.median([period(walk[:, at]) for walk in walks]):.0f}", quantiles]
        row += [
            f"{x[:, task.layout.index('vx')].mean():.2f}",
            f"{x[:, 0].mean():.3f} ({x[:, 0].min():.2f} to {x[:, 0].max():.2f})",
        ]
        for noise in (0.05, 0.1, 0.2):
            noisy = [task.walk(env, gait, seed, noise) for seed in seeds]
            row.append(
                f"{np.mean([out.reward for out in noisy]):.0f} ({sum(out.fell for out in noisy)})"
            )
        table.add_row(*row)
    Console(width=170).print(table)


if __name__ == "__main__":
    main()
