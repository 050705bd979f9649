"""From a request to an experiment: find, load, decide, compile, check, in that order."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from cdiff_cli.arrays import Array
from cdiff_cli.commands.experiment import Experiment, Request
from cdiff_cli.commands.margins import ChosenMargins, choose_margins, read_calibrations
from cdiff_cli.constraints.dynamics import LinearDynamicsConstraint, dynamics_of, weighted
from cdiff_cli.constraints.spec.kinds import DYNAMICS_TOLERANCE
from cdiff_cli.constraints.spec.load import Kind, enforced, kinds_sha256, load_constraints
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.errors import CdiffError, CheckpointError, suggestion
from cdiff_cli.evaluation.conformal import tightened
from cdiff_cli.machine import choose_device
from cdiff_cli.models.checkpoint import Checkpoint, load_checkpoint
from cdiff_cli.models.normaliser import Normaliser
from cdiff_cli.models.planner import Planner
from cdiff_cli.models.preset import Preset
from cdiff_cli.models.recipe import Recipe, load_recipe
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.paths import home, shown
from cdiff_cli.planning.problem import Problem, check_feasible
from cdiff_cli.planning.start_goal import parse_state, random_pairs
from cdiff_cli.sampling import KERNELS, METHODS, complete_settings, make_method
from cdiff_cli.sampling.sampler import Method
from cdiff_cli.tasks import load_task
from cdiff_cli.tasks.protocol import HasExactScore, HasRoutes, Task, observable_of

WHOLE_PLAN_OPTIONS = ("start", "goal", "random", "no_dynamics")
CONTROL_OPTIONS = ("execute", "warm", "margin", "action_noise", "env", "calibrate")


def resolve(request: Request) -> Experiment:
    """Everything that the request names, read and checked.

    Raises a CdiffError before anything is computed or written.
    """
    task, recipe = find(request)
    loaded = load_planner(task, recipe, request)
    preset, base, method = decide(request, recipe, loaded)
    path, kinds, declared = compile_constraints(task, recipe, request, loaded)
    start, goal = ends(request, recipe, task, declared, loaded.checkpoint)
    margins = margins_for(request, preset, method, declared, loaded.checkpoint, path, kinds)
    problem = Problem(
        planner=loaded.planner.respaced(preset.sampler.steps),
        declared=declared,
        enforced=tightened(
            enforced_form(kinds, declared, preset, task, loaded.planner), margins.margins
        ),
        start=start,
        goal=goal,
        tolerances=task.tolerances,
    )
    check_feasible(problem, task)
    conditional = None
    planner = problem.planner
    if method.planner == "conditional":
        conditional = load_conditional(kinds, path, loaded.checkpoint)
        weight = preset.methods[request.method]["weight"]
        planner = conditioned(planner, as_planner(conditional, task, weight))
    return Experiment(
        request=request,
        task=task,
        recipe=recipe,
        preset=preset,
        changed=bool(preset.differences(base)) or request.margin is not None,
        method=method,
        problem=problem,
        planner=planner,
        kinds=kinds,
        constraints_path=path,
        margins=margins,
        checkpoint=loaded.checkpoint,
        conditional=conditional,
    )


# 1. Names exist, options apply --------------------------------------------------------------------


def find(request: Request) -> tuple[Task, Recipe]:
    """The task and its recipe; refuses unknown names and options that would be ignored."""
    task = load_task(request.task)
    if request.n < 1:
        raise CdiffError(f"--n: expected at least 1 plan, found {request.n}")
    if (request.extra_steps or 0) < 0:
        raise CdiffError(f"--extra-steps: expected 0 or more, found {request.extra_steps}")
    if request.method not in METHODS:
        make_method(request.method, {})
    recipe = load_recipe(request.task)
    if request.preset not in recipe.presets:
        known = ", ".join(recipe.presets)
        near = suggestion(request.preset, recipe.presets)
        raise CdiffError(f'no preset "{request.preset}"{near}; {task.name} has {known}')
    if request.kernel is not None and request.kernel not in KERNELS:
        near = suggestion(request.kernel, KERNELS)
        raise CdiffError(f'no kernel "{request.kernel}"{near}; choose from {", ".join(KERNELS)}')
    _refuse_ignored_options(request, task.control == "receding_horizon")
    return task, recipe


def _refuse_ignored_options(request: Request, control: bool) -> None:
    default = Request()
    for name in WHOLE_PLAN_OPTIONS if control else CONTROL_OPTIONS:
        if getattr(request, name) != getattr(default, name):
            flag = "--" + name.replace("_", "-")
            why = f"is for control tasks, and {request.task} is planned once"
            if control:
                why = f"is for whole plans, and {request.task} plans anew at every step"
            raise CdiffError(f"{flag} {why}; leave it out")
    if request.calibrate and request.margin is not None:
        raise CdiffError("--margin: --calibrate acts without one; leave it out")
    if not 0 <= (request.margin or 0) < math.inf:
        raise CdiffError(
            f"--margin: expected 0 or more, in the units of h, found {request.margin:g}"
        )
    if not 0 <= request.action_noise < math.inf:
        raise CdiffError(f"--action-noise: expected 0 or more, found {request.action_noise:g}")
    if request.warm is not None and not 0 < request.warm <= 1:
        raise CdiffError(
            "--warm: expected a share of the diffusion steps above 0 and at most 1, "
            f"found {request.warm:g}"
        )


# 2. The planner: a checkpoint, or an exact score --------------------------------------------------


@dataclass(frozen=True)
class Loaded:
    """A planner with its trained schedule, and its checkpoint; None for an exact score."""

    planner: Planner
    checkpoint: Checkpoint | None
    return_weight: float


def load_planner(task: Task, recipe: Recipe, request: Request) -> Loaded:
    """The unconditional planner of the request."""
    device = choose_device(request.device)
    if isinstance(task, HasExactScore):
        schedule, scale = Schedule.cosine(recipe.n_steps), task.scale
        identity = Normaliser.identity(len(task.layout))
        planner = Planner(
            denoiser=task.denoiser(schedule),
            schedule=schedule,
            normaliser=Normaliser(identity.centre, identity.scale * scale),
            horizon=recipe.horizon,
            coordinates=task.layout,
            dt=task.dt,
            positions=task.positions,
            device=device,
        )
        return Loaded(planner, None, 0.0)
    default = home() / "models" / task.name / f"{request.recipe}.safetensors"
    checkpoint = load_checkpoint(request.checkpoint or shown(default), task.name, device)
    weight = recipe.returns if checkpoint.card.returns else 0.0
    return Loaded(as_planner(checkpoint, task, weight), checkpoint, weight)


def as_planner(checkpoint: Checkpoint, task: Task, weight: float) -> Planner:
    """The planner of a task's checkpoint."""
    return Planner.from_checkpoint(checkpoint, task.layout, task.dt, task.positions, weight)


def conditioned(planner: Planner, conditional: Planner) -> Planner:
    """The planner with the denoiser of one that was trained on from it for certain constraints."""
    return replace(
        planner,
        denoiser=conditional.denoiser,
        conditioned_denoiser=conditional.conditioned_denoiser,
        calls_per_step=conditional.calls_per_step,
    )


def load_conditional(
    kinds: Sequence[Kind], path: Path, checkpoint: Checkpoint | None
) -> Checkpoint:
    """The planner that was trained for these constraints."""
    if checkpoint is None:
        raise CdiffError(
            "conditional: this task's score is exact, no planner can be trained for its constraints"
        )
    card = checkpoint.card
    where = shown(home() / "models" / card.task / f"conditional-{path.stem}.safetensors")
    advice = f"train it with `cdiff train --task {card.task} --conditional {path}`"
    if not where.exists():
        raise CheckpointError(f"{where}: no conditional planner for these constraints; {advice}")
    found = load_checkpoint(where, card.task, next(checkpoint.net.parameters()).device)
    if found.card.constraints != kinds_sha256(kinds):
        raise CheckpointError(
            f"{where}: trained for other constraints than {path} holds now; {advice} again"
        )
    if (found.card.horizon, found.card.n_steps) != (card.horizon, card.n_steps):
        raise CheckpointError(
            f"{where}: trained for another horizon or n_steps than {checkpoint.path}; "
            f"{advice} again"
        )
    return found


# 3. The preset and the method ---------------------------------------------------------------------


def decide(request: Request, recipe: Recipe, loaded: Loaded) -> tuple[Preset, Preset, Method]:
    """The preset with the options applied, the recipe's own, and the method."""
    own = recipe.presets[request.preset].of_method(request.method)
    constants = own.methods[request.method]
    chosen = {**constants, **parse_settings(request.settings)}
    method = make_method(request.method, chosen)
    trained = loaded.planner.schedule.n_steps
    steps = own.sampler.steps if request.steps is None else request.steps
    if steps is not None and not 1 <= steps <= trained:
        source = "--steps" if request.steps is not None else f'preset "{request.preset}", steps'
        raise CdiffError(f"{source}: expected 1 to {trained} (as trained), found {steps}")
    most = loaded.planner.horizon - 1
    if request.execute is not None and not 1 <= request.execute <= most:
        raise CdiffError(
            f"--execute: expected 1 to {most} steps of a plan of {loaded.planner.horizon}, "
            f"found {request.execute}"
        )
    resolved = own.updated(
        {
            "sampler.steps": own.sampler.steps or trained,
            # A conditional planner is guided towards the constraints instead.
            "sampler.return_weight": 0.0
            if method.planner == "conditional"
            else loaded.return_weight,
            "control.env": tuple(sorted(request.env or own.control.env)),
            "methods": {request.method: complete_settings(request.method, constants)},
        }
    )
    options = {
        "sampler.kernel": request.kernel,
        "sampler.steps": steps,
        "sampler.extra_steps": request.extra_steps,
        "control.execute": request.execute,
        "control.warm_start": request.warm,
        "control.action_noise": request.action_noise or None,
        "enforce.dynamics": False if request.no_dynamics else None,
        "methods": {request.method: complete_settings(request.method, chosen)},
    }
    return (
        resolved.updated({name: value for name, value in options.items() if value is not None}),
        resolved,
        method,
    )


def parse_settings(settings: Sequence[str]) -> dict[str, str]:
    """["rho=0.05"] -> {"rho": "0.05"}."""
    pairs = {}
    for text in settings:
        key, equals, value = text.partition("=")
        if not equals or not key or not value:
            raise CdiffError(f"--set: expected name=value such as rho=0.05, found {text!r}")
        pairs[key.strip()] = value.strip()
    return pairs


# 4. The constraints -------------------------------------------------------------------------------


def compile_constraints(
    task: Task, recipe: Recipe, request: Request, loaded: Loaded
) -> tuple[Path, list[Kind], Constraint]:
    """The constraint file, its kinds, and the g(x) <= 0 they declare."""
    path = request.constraints or shown(home() / "constraints" / recipe.constraints)
    kinds, declared = load_constraints(
        path, task.name, task.layout, loaded.planner.dynamics, observable_of(task), task.dt
    )
    limited = [kind.name for kind in kinds if kind.kind == "rate"]
    if limited and task.control == "receding_horizon":
        raise CdiffError(
            f'"{limited[0]}": `kind: rate` is for whole plans, '
            f"and {task.name} plans anew at every step; leave it out"
        )
    return path, kinds, declared


def enforced_form(
    kinds: Sequence[Kind], declared: Constraint, preset: Preset, task: Task, planner: Planner
) -> Constraint:
    """What plans satisfy: g on segments where that is asked, and the planner's dynamics."""
    parts = enforced(kinds, declared, preset.enforce.safety).parts
    if preset.enforce.dynamics and planner.dynamics is not None and not dynamics_of(declared):
        fitted = LinearDynamicsConstraint.from_dynamics(
            "dynamics", planner.dynamics, DYNAMICS_TOLERANCE
        )
        parts = (*parts, fitted)
    slow = task.tolerances.velocity_weight
    weight = torch.tensor(
        [slow if name in task.velocities else 1.0 for name in task.layout], dtype=torch.float64
    )
    parts = weighted(Constraint(parts), weight).parts
    same = len(parts) == len(declared.parts) and all(
        part is one for part, one in zip(parts, declared.parts, strict=True)
    )
    return declared if same else Constraint(parts)


def margins_for(
    request: Request,
    preset: Preset,
    method: Method,
    declared: Constraint,
    checkpoint: Checkpoint | None,
    path: Path,
    kinds: Sequence[Kind],
) -> ChosenMargins:
    """The margins asked for, else those calibrated on the nearest preset."""
    if request.margin is not None:
        return ChosenMargins({part.name: request.margin for part in declared.parts}, "given")
    wanted = preset.control.margins and not request.calibrate and method.enforces
    if not wanted or checkpoint is None:
        return ChosenMargins({}, "unused")
    known = read_calibrations(checkpoint.path)
    weights, content = checkpoint.card.weights_sha256, kinds_sha256(kinds)
    return choose_margins(known, weights, path.stem, content, request.method, preset)


# 5. Start and goal --------------------------------------------------------------------------------


def ends(
    request: Request,
    recipe: Recipe,
    task: Task,
    declared: Constraint,
    checkpoint: Checkpoint | None,
) -> tuple[Array | None, Array | None]:
    """The start and goal, parsed or drawn."""
    if request.random:
        if checkpoint is None or not isinstance(task, HasRoutes):
            raise CdiffError(f"--random: {task.name} has no start and goal to draw")
        return random_pairs(task, declared, checkpoint.card, request.n, request.seed)
    return (
        parse_state("--start", request.start, recipe.start, task),
        parse_state("--goal", request.goal, recipe.goal, task),
    )


def needed_speed(experiment: Experiment) -> tuple[float, float] | None:
    """Mean speed that the shortest way asks for, and the 95 % quantile of the data's windows.

    In m/s; None where they have no meaning.
    """
    problem, task, checkpoint = experiment.problem, experiment.task, experiment.checkpoint
    if problem.start is None or problem.goal is None:
        return None
    if checkpoint is None or experiment.request.random:
        return None
    if not isinstance(task, HasRoutes):
        return None
    columns = problem.planner.position_columns
    length = task.path_length(problem.start[columns], problem.goal[columns])
    return length / ((problem.planner.horizon - 1) * task.dt), checkpoint.card.data["speed_q95"]
