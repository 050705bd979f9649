"""How many steps per second does the ball-run environment make?

    python tests/benchmarks/speed/ball_run.py [--episodes 50]

One thread; resets are included.
"""

import argparse

import numpy as np
from rich.console import Console
from rich.table import Table
from timing import milliseconds

from cdiff_cli.tasks.ball_run.env import HEIGHT, MAX_STEPS, WIDTH, BallRunEnv
from cdiff_cli.tasks.ball_run.obstacles import PATTERNS

parser = argparse.ArgumentParser()
parser.add_argument(
    "--episodes",
    type=int,
    default=50,
    help="episodes per repeat; the result is the median of three repeats",
)
episodes = parser.parse_args().episodes
push = np.array([0.4, 0.0], dtype=np.float32)

table = Table(
    "pattern",
    "solid: steps/s",
    "ghost: steps/s",
    title=f"{episodes} episodes of {MAX_STEPS} steps, median of 3",
)


def play(env: BallRunEnv) -> None:
    for seed in range(episodes):
        env.reset(seed=seed)
        for _ in range(MAX_STEPS):
            env.step(push)


for pattern in ("none", *PATTERNS):
    pace = []
    for collide in (True, False):
        env = BallRunEnv(pattern, collide=collide)
        pace.append(1e3 * episodes * MAX_STEPS / milliseconds(lambda env=env: play(env), 3))
        env.close()
    table.add_row(pattern, *(f"{steps:.0f}" for steps in pace))
console = Console()
console.print(table)
shown = BallRunEnv("leader", render_mode="rgb_array")
shown.reset(seed=0)
console.print(f"a picture of {WIDTH} x {HEIGHT}: {milliseconds(shown.render, 9):.0f} ms")
