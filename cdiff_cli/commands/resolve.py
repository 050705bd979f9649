"""From the options of a command to a resolved problem: recipe, preset, method, constraints, checkpoint, pins."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import torch

from cdiff_cli.arrays import Array
from cdiff_cli.commands.margins import Chosen, Conditions, choose, read_calibrations
from cdiff_cli.constraints.dynamics import LinearDynamicsConstraint, dynamics_of, weighted
from cdiff_cli.constraints.spec.kinds import DYNAMICS_TOLERANCE
from cdiff_cli.constraints.spec.load import Kind, enforced, kinds_sha256, load_constraints
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.errors import CdiffError, CheckpointError, suggestion
from cdiff_cli.evaluation.conformal import tightened
from cdiff_cli.machine import choose_device
from cdiff_cli.models.checkpoint import Checkpoint, load_checkpoint
from cdiff_cli.models.denoiser import Denoiser, ObservingDenoiser, calls_a_step, guided
from cdiff_cli.models.normaliser import Normaliser
from cdiff_cli.models.recipe import Preset, Recipe, load_recipe
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.paths import home, shown
from cdiff_cli.planning.problem import Problem, check_feasible
from cdiff_cli.planning.start_goal import parse_state, random_pairs
from cdiff_cli.sampling.baselines import Conditional
from cdiff_cli.sampling.kernels import KERNELS
from cdiff_cli.sampling.methods import METHODS, Unconstrained, make_method, settings_of
from cdiff_cli.sampling.sampler import Method
from cdiff_cli.tasks import load_task
from cdiff_cli.tasks.protocol import Task


@dataclass(frozen=True)
class Request:
    """What the user asked for; None is the task's own default."""

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


@dataclass(frozen=True)
class Experiment:
    """Everything a command needs, checked."""

    options: Request
    recipe: Recipe
    preset: Preset
    kernel: str
    method: Method
    settings: dict[str, Any]
    problem: Problem
    kinds: Sequence[Kind]
    constraints_path: Path
    checkpoint: Checkpoint | None
    conditions: Conditions
    margins: Chosen
    conditional: Checkpoint | None = None

    @property
    def guided(self) -> Denoiser | None:
        """The clean estimate of a conditional planner; None of the other methods."""
        return None if self.conditional is None else self._guided(self.conditional, None)

    @property
    def seeing(self) -> ObservingDenoiser | None:
        """The same of a planner that is told what it observes; None of the others."""
        planner = self.conditional
        if planner is None or (telling := planner.telling) is None:
            return None
        names, device = planner.card.observed, self.problem.device
        return lambda seen, present: self._guided(
            planner, telling([seen[name] for name in names], present).to(device)
        )

    def _guided(self, planner: Checkpoint, told: torch.Tensor | None) -> Denoiser:
        return guided(planner.net, self.settings["weight"], planner.limit, told)

    @property
    def calls_a_step(self) -> int:
        """Network calls of a diffusion step: two where the planner is asked with its condition and without."""
        return calls_a_step(
            self.conditions.returns if self.conditional is None else self.settings["weight"]
        )

    @property
    def acts(self) -> bool:
        """Whether the task is a control task, which plans anew at every step."""
        return self.recipe.frame == "relative"

    @property
    def seeds(self) -> list[int]:
        return list(range(self.options.seed, self.options.seed + self.options.n))

    def row(self) -> dict[str, Any]:
        """The columns that say what was run."""
        return {
            "task": self.options.task,
            "constraints": self.constraints_path.stem,
            "method": self.options.method,
            "preset": self.options.preset + ("*" if self._changed() else ""),
            "on": self.settings.get("on", ""),
            "kernel": self.kernel,
        }

    def _changed(self) -> bool:
        """Whether an option departs from the preset."""
        asked = self.options
        changed = (
            asked.settings,
            asked.kernel,
            asked.steps,
            asked.no_dynamics,
            asked.execute,
            asked.warm,
            asked.action_noise,
        )
        return any(changed) or asked.extra_steps is not None or asked.margin is not None

    def config(self) -> dict[str, Any]:
        """The resolved configuration, for run.yaml."""
        options = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(self.options).items()}
        options["env"] = list(self.options.env)
        card = self.checkpoint.card if self.checkpoint else None
        pins = {name: None if s is None else s.tolist() for name, s in self._pins().items()}
        return {
            "options": options | {"settings": list(self.options.settings)},
            "method": {self.options.method: self.settings},
            "kernel": self.kernel,
            "extra_steps": self.conditions.extra_steps,
            "returns": self.conditions.returns,
            "polish": self.preset.polish,
            "safety": self.preset.safety,
            "dynamics": bool(dynamics_of(self.problem.enforced)),
            "margins": dict(self.margins.margins),
            "margins_from": self.margins.told(),
            "n_steps": self.problem.schedule.n_steps,
            "horizon": self.problem.horizon,
            **pins,
            "constraints": {
                "file": str(shown(self.constraints_path)),
                "sha256": hashlib.sha256(self.constraints_path.read_bytes()).hexdigest(),
                "content": [spec.model_dump(mode="json", exclude_none=True) for spec in self.kinds],  # type: ignore[attr-defined]
            },
            "checkpoint": None if card is None else card.model_dump(mode="json"),
            "conditional": None
            if self.conditional is None
            else self.conditional.card.model_dump(mode="json"),
        }

    def _pins(self) -> dict[str, Array | None]:
        return {"start": self.problem.start, "goal": self.problem.goal}

    @property
    def calibration_command(self) -> str:
        """The command that fits margins to what was asked for."""
        flags = {"settings": "--set", "steps": "--steps", "env": "--env"}
        asked, default = asdict(self.options), asdict(Request())
        words = [
            "cdiff rollout --calibrate --level 0.99 --episodes 100 --seed 5000",
            f"--task {self.options.task}",
        ]
        for name, value in asked.items():
            if value != default[name] and name not in ("task", "n", "seed", "device", "calibrate"):
                each = value if isinstance(value, tuple) else (value,)
                words += [f"{flags.get(name, '--' + name.replace('_', '-'))} {one}" for one in each]
        return " ".join(words)

    @property
    def note(self) -> str:
        """One line where the margins were calibrated on something else than what was asked for, or not at all."""
        return self.margins.note(
            self.conditions, str(self.constraints_path), self.calibration_command
        )


def resolve(options: Request) -> Experiment:
    """Read and check all that the options name; raises a CdiffError before anything is computed or written."""
    task = load_task(options.task)
    if options.n < 1:
        raise CdiffError(f"--n: expected at least 1 plan, found {options.n}")
    if (options.extra_steps or 0) < 0:
        raise CdiffError(f"--extra-steps: expected 0 or more, found {options.extra_steps}")
    if options.method not in METHODS:
        make_method(options.method, {})
    recipe = load_recipe(options.task)
    if options.preset not in recipe.presets:
        known = ", ".join(recipe.presets)
        raise CdiffError(
            f'no preset "{options.preset}"{suggestion(options.preset, recipe.presets)}; {task.name} has {known}'
        )
    _require_applicable(options, recipe.frame == "relative")
    preset = recipe.presets[options.preset]
    settings = {**preset.methods.get(options.method, {}), **parse_settings(options.settings)}
    method = make_method(options.method, settings)
    settings = settings_of(options.method, method)
    kernel = options.kernel or preset.kernel
    if kernel not in KERNELS:
        raise CdiffError(
            f'no kernel "{kernel}"{suggestion(kernel, KERNELS)}; choose from {", ".join(KERNELS)}'
        )
    path = options.constraints or shown(home() / "constraints" / recipe.constraints)
    device = choose_device(options.device)
    schedule = Schedule.cosine(recipe.n_steps)
    if hasattr(task, "denoiser"):
        checkpoint, returns, denoiser, normaliser = (
            None,
            0.0,
            task.denoiser(schedule),
            Normaliser.identity(len(task.layout)),
        )
        normaliser = Normaliser(normaliser.centre, normaliser.scale * task.scale)
    else:
        where = options.checkpoint or shown(
            home() / "models" / task.name / f"{options.recipe}.safetensors"
        )
        checkpoint = load_checkpoint(where, task.name, device)
        returns = recipe.returns if checkpoint.card.returns else 0.0
        denoiser, normaliser = (
            guided(checkpoint.net, returns, checkpoint.limit),
            checkpoint.normaliser,
        )
        if (checkpoint.card.horizon, checkpoint.card.n_steps) != (recipe.horizon, recipe.n_steps):
            schedule = Schedule.cosine(checkpoint.card.n_steps)
    fitted, observable = (
        checkpoint.dynamics if checkpoint else None,
        getattr(task, "observable", ()),
    )
    kinds, g = load_constraints(
        path, task.name, task.layout, fitted, observable, getattr(task, "dt", None)
    )
    limited = [kind.name for kind in kinds if kind.kind == "rate"]
    if limited and recipe.frame == "relative":
        raise CdiffError(
            f'"{limited[0]}": `kind: rate` is for whole plans, and {task.name} plans anew at every step; leave it out'
        )
    steps = preset.steps if options.steps is None else options.steps
    if steps is not None:
        if not 1 <= steps <= schedule.n_steps:
            source = f'preset "{options.preset}", steps' if options.steps is None else "--steps"
            raise CdiffError(
                f"{source}: expected 1 to {schedule.n_steps} (as trained), found {steps}"
            )
        schedule = schedule.respaced(steps)
    start = parse_state("--start", options.start, recipe.start, task)
    goal = parse_state("--goal", options.goal, recipe.goal, task)
    horizon = checkpoint.card.horizon if checkpoint else recipe.horizon
    if options.random:
        if checkpoint is None or not hasattr(task, "random_point"):
            raise CdiffError(f"--random: {task.name} has no start and goal to draw")
        start, goal = random_pairs(task, g, checkpoint.card, options.n, options.seed)
    obeyed = _obeyed(kinds, g, preset, task, None if options.no_dynamics else checkpoint)
    returns = 0.0 if isinstance(method, Conditional) else returns  # it asks for something else
    conditions = _conditions(options, preset, settings, kernel, schedule.n_steps, returns)
    margins = _margins(options, preset, method, g, checkpoint, path, kinds, conditions)
    problem = Problem(
        task,
        horizon,
        denoiser,
        schedule,
        normaliser,
        g,
        tightened(obeyed, margins.margins),
        start,
        goal,
        device,
    )
    check_feasible(problem)
    conditioned = _conditional(kinds, path, checkpoint) if isinstance(method, Conditional) else None
    return Experiment(
        options,
        recipe,
        preset,
        kernel,
        method,
        settings,
        problem,
        kinds,
        path,
        checkpoint,
        conditions,
        margins,
        conditioned,
    )


def _conditions(
    options: Request,
    preset: Preset,
    settings: dict[str, Any],
    kernel: str,
    steps: int,
    returns: float,
) -> Conditions:
    """How plans are made and followed, the options first, else the preset."""
    extra = options.extra_steps
    return Conditions(
        method=options.method,
        preset=options.preset,
        settings=settings,
        kernel=kernel,
        steps=steps,
        extra_steps=preset.extra_steps_for(options.method) if extra is None else extra,
        temperature=preset.temperature,
        polish=preset.polish,
        execute=1 if options.execute is None else options.execute,
        warm=options.warm,
        action_noise=options.action_noise,
        env=tuple(sorted(options.env)),
        returns=returns,
    )


def _margins(
    options: Request,
    preset: Preset,
    method: Method,
    g: Constraint,
    checkpoint: Checkpoint | None,
    path: Path,
    kinds: Sequence[Kind],
    conditions: Conditions,
) -> Chosen:
    """The margins asked for, else those calibrated on the nearest conditions."""
    if options.margin is not None:
        return Chosen({part.name: options.margin for part in g.parts}, "given")
    if (
        not preset.margin
        or checkpoint is None
        or options.calibrate
        or isinstance(method, Unconstrained | Conditional)
    ):
        return Chosen({}, "unused")
    known = read_calibrations(checkpoint.path)
    return choose(known, checkpoint.card.weights_sha256, path.stem, kinds_sha256(kinds), conditions)


def _require_applicable(options: Request, acts: bool) -> None:
    """Refuse options that would be ignored: those of whole plans on a control task, those of control on another."""
    whole = ("start", "goal", "random", "no_dynamics")
    control = ("execute", "warm", "margin", "action_noise", "env", "calibrate")
    default = Request()
    for name in whole if acts else control:
        if getattr(options, name) != getattr(default, name):
            flag = "--" + name.replace("_", "-")
            why = (
                "is for whole plans, and {} plans anew at every step"
                if acts
                else "is for control tasks, and {} is planned once"
            )
            raise CdiffError(f"{flag} {why.format(options.task)}; leave it out")
    if options.calibrate and options.margin is not None:
        raise CdiffError("--margin: --calibrate acts without one; leave it out")
    if not 0 <= (options.margin or 0) < math.inf:
        raise CdiffError(
            f"--margin: expected 0 or more, in the units of h, found {options.margin:g}"
        )
    if not 0 <= options.action_noise < math.inf:
        raise CdiffError(f"--action-noise: expected 0 or more, found {options.action_noise:g}")


def _conditional(kinds: Sequence[Kind], path: Path, checkpoint: Checkpoint | None) -> Checkpoint:
    """The planner that was trained for these constraints."""
    if checkpoint is None:
        raise CdiffError(
            "conditional: this task's score is exact, no planner can be trained for its constraints"
        )
    task = checkpoint.card.task
    where = shown(home() / "models" / task / f"conditional-{path.stem}.safetensors")
    advice = f"train it with `cdiff train --task {task} --conditional {path}`"
    if not where.exists():
        raise CheckpointError(f"{where}: no conditional planner for these constraints; {advice}")
    found = load_checkpoint(where, task, next(checkpoint.net.parameters()).device)
    if found.card.constraints != kinds_sha256(kinds):
        raise CheckpointError(
            f"{where}: trained for other constraints than {path} holds now; {advice} again"
        )
    if (found.card.horizon, found.card.n_steps) != (
        checkpoint.card.horizon,
        checkpoint.card.n_steps,
    ):
        raise CheckpointError(
            f"{where}: trained for another horizon or n_steps than {checkpoint.path}; {advice} again"
        )
    return found


def _obeyed(
    kinds: Sequence[Kind], g: Constraint, preset: Preset, task: Task, checkpoint: Checkpoint | None
) -> Constraint:
    """What sampling obeys: g, on segments where that is asked, and the checkpoint's dynamics where the preset asks for them."""
    parts = enforced(kinds, g, preset.safety).parts
    dynamics = checkpoint.dynamics if checkpoint else None
    if preset.dynamics and dynamics is not None and not dynamics_of(g):
        parts = (
            *parts,
            LinearDynamicsConstraint.from_dynamics("dynamics", dynamics, DYNAMICS_TOLERANCE),
        )
    slow = task.tolerances.velocity_weight
    weight = torch.tensor(
        [slow if name in task.velocities else 1.0 for name in task.layout], dtype=torch.float64
    )
    parts = weighted(Constraint(parts), weight).parts
    unchanged = len(parts) == len(g.parts) and all(
        part is declared for part, declared in zip(parts, g.parts, strict=True)
    )
    return g if unchanged else Constraint(parts)


def needed_speed(resolved: Experiment) -> tuple[float, float] | None:
    """(mean speed the shortest way asks for, 95 % of the data's windows stay below), m/s; None where it has no meaning."""
    problem, task = resolved.problem, resolved.problem.task
    if (
        problem.start is None
        or problem.goal is None
        or resolved.checkpoint is None
        or resolved.options.random
    ):
        return None
    columns = [task.layout.index(name) for name in task.positions]
    length = cast(Any, task).path_length(problem.start[columns], problem.goal[columns])
    return length / ((problem.horizon - 1) * task.dt), resolved.checkpoint.card.data["speed_q95"]


def parse_settings(settings: Sequence[str]) -> dict[str, str]:
    """["rho=0.05"] -> {"rho": "0.05"}."""
    pairs = {}
    for text in settings:
        key, equals, value = text.partition("=")
        if not equals or not key or not value:
            raise CdiffError(f"--set: expected name=value such as rho=0.05, found {text!r}")
        pairs[key.strip()] = value.strip()
    return pairs
