"""Safe planning with diffusion models.

`import cdiff_cli as cdiff` is the form. Names are imported when they are first used, so importing
the package loads no torch and changes nothing in the host process.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cdiff_cli.api import (
        Certificate,
        certify,
        controller,
        load_constraints,
        load_planner,
        make_constraints,
        plan,
        project,
    )
    from cdiff_cli.constraints.pins import Pins
    from cdiff_cli.constraints.trajectory import Constraint
    from cdiff_cli.errors import CdiffError
    from cdiff_cli.evaluation import metrics
    from cdiff_cli.models import adapters
    from cdiff_cli.models.normaliser import Normaliser
    from cdiff_cli.models.planner import Planner
    from cdiff_cli.models.preset import ControlSettings, SamplerSettings
    from cdiff_cli.models.schedule import Schedule
    from cdiff_cli.planning.open_loop import Plans
    from cdiff_cli.planning.receding_horizon import Controller, rollout
    from cdiff_cli.sampling import METHODS, make_method
    from cdiff_cli.tasks import load_task
    from cdiff_cli.tasks.protocol import Task

__version__ = "0.1.0"

PUBLIC = {
    "Certificate": "api",
    "certify": "api",
    "controller": "api",
    "load_constraints": "api",
    "load_planner": "api",
    "make_constraints": "api",
    "plan": "api",
    "project": "api",
    "Pins": "constraints.pins",
    "Constraint": "constraints.trajectory",
    "CdiffError": "errors",
    "metrics": "evaluation",
    "adapters": "models",
    "Normaliser": "models.normaliser",
    "Planner": "models.planner",
    "ControlSettings": "models.preset",
    "SamplerSettings": "models.preset",
    "Schedule": "models.schedule",
    "Plans": "planning.open_loop",
    "Controller": "planning.receding_horizon",
    "rollout": "planning.receding_horizon",
    "METHODS": "sampling",
    "make_method": "sampling",
    "load_task": "tasks",
    "Task": "tasks.protocol",
}
"""Each public name and the module that defines it, or the package of a public module."""

__all__ = [*PUBLIC, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = f"{__name__}.{PUBLIC[name]}"
    if name in ("metrics", "adapters"):
        return import_module(f"{home}.{name}")
    return getattr(import_module(home), name)


def __dir__() -> list[str]:
    return sorted(__all__)
