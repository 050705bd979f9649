"""Statistics of demonstrations that plans are compared with."""

from collections.abc import Sequence

import numpy as np

from cdiff_cli.arrays import Array
from cdiff_cli.tasks.protocol import Task


def data_statistics(task: Task, episodes: Sequence[Array], horizon: int) -> dict[str, float]:
    """Jumps between states, accelerations, and mean speeds over one horizon.

    Jumps are in units of the positions, speeds in units per second. Empty without positions.
    Episodes shorter than the horizon do not count for the speeds.
    """
    if not task.positions:
        return {}
    positions = [task.layout.index(name) for name in task.positions]
    jumps = [_changes(episode, positions) for episode in episodes]
    jump = np.concatenate(jumps)
    facts = {"jump_q999": np.quantile(jump, 0.999), "jump_max": jump.max()}
    if task.velocities:
        velocities = [task.layout.index(name) for name in task.velocities]
        acceleration = np.concatenate([_changes(e, velocities) for e in episodes]) / task.dt
        facts["acceleration_q999"] = np.quantile(acceleration, 0.999)
        facts["acceleration_max"] = acceleration.max()
    window = np.ones(horizon - 1)
    lengths = [np.convolve(steps, window, "valid") for steps in jumps if len(steps) + 1 >= horizon]
    speed = np.concatenate(lengths) / ((horizon - 1) * task.dt)
    facts["speed_q50"] = np.quantile(speed, 0.5)
    facts["speed_q95"] = np.quantile(speed, 0.95)
    facts["speed_max"] = speed.max()
    return {name: round(float(value), 5) for name, value in facts.items()}


def _changes(episode: Array, columns: list[int]) -> Array:
    """Norm of the change of those coordinates at each step [n - 1]."""
    return np.linalg.norm(np.diff(episode[:, columns], axis=0), axis=1)
