"""Starts and goals of whole plans: as the user gives them, or drawn at random."""

from typing import Any

import numpy as np
import torch

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.rate import max_rate
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.errors import CdiffError
from cdiff_cli.models.recipe import Card


def parse_state(
    flag: str, text: str | None, default: dict[str, float] | None, task: Any
) -> Array | None:
    """The state [dim] of '0.3,-1.2' (the positions, at rest) or 'x=0.3,y=-1.2,vx=1'.

    Coordinates left out are 0. Raises CdiffError for unknown names and for what is no number.
    """
    if text is None and default is None:
        return None
    values = dict(default or {}) if text is None else {}
    for i, piece in enumerate((text or "").split(",") if text is not None else []):
        name, equals, number = piece.rpartition("=")
        name = name.strip() if equals else task.positions[i] if i < len(task.positions) else ""
        if name not in task.layout:
            raise CdiffError(
                f'{flag}: no coordinate "{name or piece}"; expected {",".join(task.positions)} '
                "as 0.3,-1.2 or x=0.3,y=-1.2"
            )
        try:
            values[name] = float(number)
        except ValueError:
            raise CdiffError(f"{flag}: expected a number for {name}, found {number!r}") from None
    missing = [name for name in task.positions if name not in values]
    if missing:
        raise CdiffError(
            f"{flag}: {', '.join(missing)} missing; "
            f"give {','.join(task.positions)}, as {flag} 0.3,-1.2"
        )
    state = np.array([values.get(name, 0.0) for name in task.layout])
    if not np.isfinite(state).all():
        raise CdiffError(f"{flag}: expected finite numbers, found {text}")
    return state


def fastest(task: Any, g: Constraint) -> float:
    """The largest speed that limits on the rate of the positions allow, m/s; inf without any."""
    return max_rate(g, {task.layout.index(name) for name in task.positions})


def random_pairs(task: Any, g: Constraint, card: Card, n: int, seed: int) -> tuple[Array, Array]:
    """n random feasible starts and goals [n, dim], at rest.

    The constraints allow both, and the shortest way between them asks for no more speed over one
    horizon than 95 % of the data's windows have.
    Raises CdiffError where 100 000 draws hold too few.
    """
    rng, starts, goals = np.random.default_rng(seed), [], []
    still = np.zeros(len(task.layout) - len(task.positions))
    for _ in range(100_000):
        pair = np.stack([np.concatenate((task.random_point(rng), still)) for _ in range(2)])
        speed = task.path_length(*pair[:, :2]) / ((card.horizon - 1) * task.dt)
        x = torch.from_numpy(pair)
        levels = [part.level for part in g.parts if part.level is not None]
        if speed > fastest(task, g):
            continue
        if speed <= card.data["speed_q95"] and all(bool((level(x) <= 0).all()) for level in levels):
            starts.append(pair[0])
            goals.append(pair[1])
            if len(starts) == n:
                return np.stack(starts), np.stack(goals)
    raise CdiffError(
        "no feasible pair of start and goal in 100000 draws: "
        "the constraints leave too little of the maze"
    )
