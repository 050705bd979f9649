"""What a moving constraint costs a control step: binding it, pulling it back, one projection, one linearisation.

    python tests/benchmarks/moving.py [--batch 1] [--horizon 16] [--repeats 300]

Medians in microseconds, one thread, float32, the present state pinned. `idle`: plans that satisfy the constraint; `active`: plans
half of whose waypoints do not.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from cdiff_cli.constraint import Chain, Constraint, Pins, pull_back
from cdiff_cli.levels import Affine
from cdiff_cli.projection import project
from cdiff_cli.spec import Dcbf

LAYOUT = ("x", "y", "vx", "vy")
CENTRE = {"x": "obstacle.x", "y": "obstacle.y"}
BALL = {"kind": "quadratic", "side": "outside", "centre": CENTRE, "radius": 1.2}
MOVING = {"barrier": BALL, "velocity": {"x": "obstacle.vx", "y": "obstacle.vy"}}
AHEAD = {"look_ahead": {"time": 0.1, "velocity": {"x": "vx", "y": "vy"}}}

parser = argparse.ArgumentParser()
parser.add_argument("--batch", type=int, default=1)
parser.add_argument("--horizon", type=int, default=16)
parser.add_argument("--repeats", type=int, default=300)
arguments = parser.parse_args()
torch.set_num_threads(1)


def microseconds(call: Callable[[], Any]) -> float:
    """Median time of a call, after some to warm up."""
    times = []
    for _ in range(arguments.repeats + 20):
        began = time.perf_counter()
        call()
        times.append(1e6 * (time.perf_counter() - began))
    return statistics.median(times[20:])


def dcbf(**more: Any) -> Constraint:
    return Constraint((Dcbf.model_validate({"kind": "dcbf", "name": "b", "alpha": 0.3} | more).compile(LAYOUT),))


speed = Affine(torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=torch.float64), torch.tensor(2.0, dtype=torch.float64))
CASES = {
    "dcbf, half-space": Constraint((Chain("s", speed, 0.3),)),
    "dcbf, moving ball": dcbf(**MOVING),
    "dcbf, moving ball, order 2": dcbf(**MOVING, order=2),
    "dcbf, moving ball, look-ahead": dcbf(**MOVING, **AHEAD),
}
batch, horizon, dt = arguments.batch, arguments.horizon, 1 / 30
rng = torch.Generator().manual_seed(0)
here = torch.zeros(batch, 4, dtype=torch.float64)
here[:, 2] = 3.0
way = torch.arange(horizon, dtype=torch.float64) * dt
centre = here[:, None].repeat(1, horizon, 1)
centre[..., 0] += 3.0 * way
scale = (0.1 + way)[:, None].expand(horizon, 4)
mask = torch.zeros(horizon, 4, dtype=torch.bool)
mask[0] = True
z = 0.1 * torch.randn(batch, horizon, 4, generator=rng)
pins = Pins(mask, z)

table = Table(title=f"batch {batch}, horizon {horizon}, microseconds, median of {arguments.repeats}", title_justify="left")
for heading in ("constraint", "bind", "pull back", "project idle", "project active", "linearise and pull"):
    table.add_column(heading, justify="left" if heading == "constraint" else "right")
with torch.inference_mode():
    for name, g in CASES.items():
        cells: dict[str, list[float]] = {"idle": [], "active": []}
        for case, gap in (("idle", 9.0), ("active", 1.5)):
            seen = {
                "obstacle.x": torch.full((batch,), gap, dtype=torch.float64),
                "obstacle.y": torch.full((batch,), 0.2, dtype=torch.float64),
                "obstacle.vx": torch.full((batch,), -0.5, dtype=torch.float64),
                "obstacle.vy": torch.zeros(batch, dtype=torch.float64),
            }
            now = Constraint((Chain("s", Affine(speed.a, torch.tensor(gap)), 0.3),)) if "half" in name else g
            bound = now.bind(seen, dt, horizon)
            back = pull_back(bound, centre, scale).to(z)
            assert bool((back(z) > 0).any()) == (case == "active")
            rows, pull, _ = back.linearise(z)
            cells[case] = [
                microseconds(lambda now=now, seen=seen: now.bind(seen, dt, horizon)),
                microseconds(lambda bound=bound: pull_back(bound, centre, scale).to(z)),
                microseconds(lambda back=back: project(back, z, pins, strict=False)),
                microseconds(lambda back=back, rows=rows: back.linearise(z)[1](rows)),
            ]
        bind, pulled, active, linear = cells["active"]
        table.add_row(name, *(f"{value:.0f}" for value in (bind, pulled, cells["idle"][2], active, linear)))
Console(width=140).print(table)
