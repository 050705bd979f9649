"""The shipped tasks: a literal table from name to module."""

import importlib
from typing import TYPE_CHECKING

from cdiff_cli.errors import CdiffError, suggestion

if TYPE_CHECKING:
    from cdiff_cli.tasks.protocol import Task

TASKS = {
    "maze2d-umaze": "cdiff_cli.tasks.maze2d:UMAZE",
    "maze2d-large": "cdiff_cli.tasks.maze2d:LARGE",
    "ball-run": "cdiff_cli.tasks.ball_run.task:BALL_RUN",
    "hopper": "cdiff_cli.tasks.mujoco.locomotion:HOPPER",
    "swimmer": "cdiff_cli.tasks.mujoco.locomotion:SWIMMER",
    "gaussian2d": "cdiff_cli.tasks.gaussian2d:GAUSSIAN2D",
}


def load_task(name: str) -> "Task":
    """The task of that name; CdiffError with a suggestion if there is none."""
    if name not in TASKS:
        raise CdiffError(
            f'no task "{name}"{suggestion(name, TASKS)}; choose from {", ".join(TASKS)}'
        )
    module, attribute = TASKS[name].split(":")
    return getattr(importlib.import_module(module), attribute)
