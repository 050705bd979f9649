"""A request as typed, and the experiment it resolves to: one record per decision."""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from cdiff_cli.arrays import Array
from cdiff_cli.commands.margins import ChosenMargins
from cdiff_cli.constraints.dynamics import dynamics_of
from cdiff_cli.constraints.spec.load import Kind
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.models.checkpoint import Checkpoint
from cdiff_cli.models.planner import Planner
from cdiff_cli.models.preset import Preset
from cdiff_cli.models.recipe import Recipe
from cdiff_cli.paths import shown
from cdiff_cli.planning.problem import Problem
from cdiff_cli.sampling.sampler import Method
from cdiff_cli.tasks.protocol import Task


@dataclass(frozen=True)
class Request:
    """What the user typed; None is the task's own default."""

    task: str = "maze2d-umaze"
    method: str = "alm"
    preset: str = "recommended"
    constraints: Path | None = None
    checkpoint: Path | None = None
    recipe: str = "small"
    start: str | None = None
    goal: str | None = None
    kernel: str | None = None
    steps: int | None = None
    extra_steps: int | None = None
    settings: tuple[str, ...] = ()
    n: int = 10
    seed: int = 0
    device: str = "auto"
    random: bool = False
    no_dynamics: bool = False
    execute: int | None = None
    warm: float | None = None
    margin: float | None = None
    action_noise: float = 0.0
    env: tuple[str, ...] = ()
    calibrate: bool = False

    @classmethod
    def from_options(cls, values: dict[str, Any]) -> "Request":
        """The request of a command's options by name; lists become tuples."""
        lists = {name: tuple(values.get(name) or ()) for name in ("settings", "env")}
        known = {field.name for field in fields(cls)}
        return cls(**{name: v for name, v in (values | lists).items() if name in known})

    @property
    def calibration_command(self) -> str:
        """The command that fits margins to this request."""
        flags = {"settings": "--set"}
        left_out = ("task", "n", "seed", "device", "calibrate")
        words = ["cdiff rollout --calibrate --level 0.99 --episodes 100 --seed 5000"]
        words.append(f"--task {self.task}")
        for field in fields(self):
            value = getattr(self, field.name)
            if value == field.default or field.name in left_out:
                continue
            flag = flags.get(field.name, "--" + field.name.replace("_", "-"))
            words += [f"{flag} {one}" for one in (value if isinstance(value, tuple) else (value,))]
        return " ".join(words)


@dataclass(frozen=True)
class Experiment:
    """Everything that a command needs, checked.

    preset           as resolved: options applied, one method's constants, steps as counted
    changed          whether an option departs from the recipe's preset
    problem          planner, declared and enforced constraints, start and goal; its planner is the
                     unconditional one
    planner          what the method samples: conditional for a method that asks for it
    margins          what the enforced constraints are tightened by, and where that is from
    """

    request: Request
    task: Task
    recipe: Recipe
    preset: Preset
    changed: bool
    method: Method
    problem: Problem
    planner: Planner
    kinds: Sequence[Kind]
    constraints_path: Path
    margins: ChosenMargins
    checkpoint: Checkpoint | None = None
    conditional: Checkpoint | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """The method's constants."""
        return self.preset.methods[self.request.method]

    @property
    def declared(self) -> Constraint:
        """What is scored."""
        return self.problem.declared

    @property
    def replans(self) -> bool:
        """Whether the task plans anew at every step."""
        return self.task.control == "receding_horizon"

    @property
    def seeds(self) -> list[int]:
        """One per plan or episode."""
        return list(range(self.request.seed, self.request.seed + self.request.n))

    @property
    def constrained(self) -> Problem:
        """The problem with the planner that the method samples."""
        return replace(self.problem, planner=self.planner)

    @property
    def note(self) -> str:
        """One line where margins were not calibrated for this request; else nothing."""
        command = self.request.calibration_command
        return self.margins.note(self.preset, str(self.constraints_path), command)

    def row(self) -> dict[str, Any]:
        """The columns of rows.csv that say what was run."""
        return {
            "task": self.request.task,
            "constraints": self.constraints_path.stem,
            "method": self.request.method,
            "preset": self.request.preset + ("*" if self.changed else ""),
            "on": self.settings.get("on", ""),
            "kernel": self.preset.sampler.kernel,
        }

    def record(self) -> dict[str, Any]:
        """The resolved configuration, for run.yaml."""
        return {
            "options": _plain(asdict(self.request)),
            "preset": self.preset.model_dump(mode="json"),
            "dynamics": bool(dynamics_of(self.problem.enforced)),
            "margins": dict(self.margins.margins),
            "margins_from": self.margins.record(),
            "horizon": self.problem.planner.horizon,
            "start": _listed(self.problem.start),
            "goal": _listed(self.problem.goal),
            "constraints": self.constraints_record(),
            "checkpoint": _card(self.checkpoint),
            "conditional": _card(self.conditional),
        }

    def constraints_record(self) -> dict[str, Any]:
        """File, hash and content of the constraints."""
        kinds: Sequence[Any] = self.kinds
        content = [kind.model_dump(mode="json", exclude_none=True) for kind in kinds]
        return {
            "file": str(shown(self.constraints_path)),
            "sha256": hashlib.sha256(self.constraints_path.read_bytes()).hexdigest(),
            "content": content,
        }


def _plain(options: dict[str, Any]) -> dict[str, Any]:
    """Options as YAML holds them."""
    listed = {k: list(v) if isinstance(v, tuple) else v for k, v in options.items()}
    return {k: str(v) if isinstance(v, Path) else v for k, v in listed.items()}


def _listed(state: Array | None) -> Any:
    return None if state is None else state.tolist()


def _card(checkpoint: Checkpoint | None) -> dict[str, Any] | None:
    return None if checkpoint is None else checkpoint.card.model_dump(mode="json")
