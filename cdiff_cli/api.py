"""The public functions: arrays of numpy or torch in, the same kind of array out.

`import cdiff_cli as cdiff` shows them all; `cdiff_cli/__init__.py` lists what is public.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.dynamics import LinearDynamicsConstraint, dynamics_of
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.spec import load as spec
from cdiff_cli.constraints.spec.kinds import DYNAMICS_TOLERANCE
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.errors import CdiffError, SpecError
from cdiff_cli.evaluation import certificate
from cdiff_cli.models.checkpoint import load_checkpoint
from cdiff_cli.models.planner import InverseDynamics, Planner
from cdiff_cli.models.preset import ControlSettings, SamplerSettings
from cdiff_cli.models.recipe import load_recipe
from cdiff_cli.paths import home
from cdiff_cli.planning import open_loop
from cdiff_cli.planning.open_loop import Plans
from cdiff_cli.planning.problem import Problem, check_feasible
from cdiff_cli.planning.receding_horizon import Controller
from cdiff_cli.projection import project as projection
from cdiff_cli.sampling import make_method
from cdiff_cli.sampling.sampler import Method
from cdiff_cli.tasks import load_task
from cdiff_cli.tasks.protocol import observable_of
from cdiff_cli.yaml_files import Document

Trajectories = TypeVar("Trajectories", Array, torch.Tensor)


def load_constraints(path: str | Path, planner: Planner | None = None) -> Constraint:
    """The constraint g(x) <= 0 of a YAML file, as declared: at the waypoints.

    Coordinates, time step and observed quantities are those of the task that the file names.

    planner   whose dynamics `fit: demonstrations` stands for
    Raises SpecError, which names file and line.
    """
    path = Path(path)
    value = Document(path).value
    name = value.get("task") if isinstance(value, dict) else None
    if not isinstance(name, str):
        raise SpecError(f"{path}: task: expected the name of a task; `cdiff list tasks` has them")
    task = load_task(name)
    dynamics = None if planner is None else planner.dynamics
    observable = observable_of(task)
    return spec.load_constraints(path, name, task.layout, dynamics, observable, task.dt)[1]


def make_constraints(
    constraints: Sequence[Mapping[str, Any]],
    coordinates: Sequence[str],
    dt: float | None = None,
    observable: Sequence[str] = (),
) -> Constraint:
    """The constraint g(x) <= 0 of mappings, each as it would stand in a YAML file.

    coordinates   names of a state's coordinates, in order
    dt            seconds between waypoints; limits on rates and velocities need it
    observable    names of quantities that `Controller.act` is given
    Raises SpecError, which names the place in the list.
    """
    space = spec.Space(tuple(coordinates), dt, None, tuple(observable))
    return spec.make_constraints([dict(one) for one in constraints], space)[1]


def project(g: Constraint, x: Trajectories, pins: Pins | None = None) -> Trajectories:
    """The trajectories nearest to x that satisfy g: argmin |y - x|^2 s.t. g(y) <= 0.

    The paper's projection operator. Convex constraints: the global minimiser. Others: a feasible
    local one.

    x      [n, horizon, dim], environment units; numpy or torch
    pins   coordinates that stay as they are; None: no pins
    Raises InfeasibleError, which names constraints, where no trajectory is found.
    """
    z = torch.as_tensor(x)
    if z.ndim != 3:
        raise CdiffError(f"project: expected x of shape [n, horizon, dim], found {tuple(z.shape)}")
    y = projection.project(g, z, Pins.none(z) if pins is None else pins)
    return y if isinstance(x, torch.Tensor) else y.numpy()


def load_planner(task: str, checkpoint: str | Path | None = None, device: str = "cpu") -> Planner:
    """The planner of a task.

    checkpoint   a .safetensors file with its card beside it; None: the shipped one
    Raises CheckpointError where it is missing, damaged, or of another task.
    """
    known = load_task(task)
    recipe = load_recipe(task)
    path = (
        home() / "models" / task / "small.safetensors" if checkpoint is None else Path(checkpoint)
    )
    found = load_checkpoint(path, task, device)
    weight = recipe.returns if found.card.returns else 0.0
    return Planner.from_checkpoint(found, known.layout, known.dt, known.positions, weight)


def plan(
    planner: Planner,
    g: Constraint,
    method: str | Method = "alm",
    *,
    seeds: Sequence[int] = range(10),
    start: ArrayLike | None = None,
    goal: ArrayLike | None = None,
    on_segments: bool = True,
    sampler: SamplerSettings | None = None,
    on_step: Callable[[int], None] | None = None,
) -> Plans:
    """Whole plans that satisfy g, one per seed.

    Where the planner has linear dynamics, plans satisfy them too.

    method        a name of METHODS with its default constants, or make_method(name, {...})
    start, goal   pinned first and last state [dim], or one per seed [n, dim]; None: free
    on_segments   satisfy g between the waypoints too
    sampler       None: DDPM in the trained number of steps, with the final projection
    Raises InfeasibleError where g excludes the start or goal, or no plan is found.
    """
    settings = SamplerSettings(polish=True) if sampler is None else sampler
    enforced = g.on_segments() if on_segments else g
    if planner.dynamics is not None and not dynamics_of(g):
        fitted = LinearDynamicsConstraint.from_dynamics(
            "dynamics", planner.dynamics, DYNAMICS_TOLERANCE
        )
        enforced = Constraint((*enforced.parts, fitted))
    problem = Problem(
        planner=planner.respaced(settings.steps),
        declared=g,
        enforced=enforced,
        start=_state("start", start, planner),
        goal=_state("goal", goal, planner),
    )
    check_feasible(problem)
    return open_loop.plan(problem, _method(method), list(seeds), settings, on_step)


def controller(
    planner: Planner,
    g: Constraint,
    method: str | Method = "alm",
    *,
    inverse_dynamics: InverseDynamics | None = None,
    execute: int = 1,
    warm_start: float | None = None,
    fallback_action: Callable[[Array], Array] | None = None,
    sampler: SamplerSettings | None = None,
) -> Controller:
    """A controller that plans anew while acting; `init` and `act` fit into any loop.

    inverse_dynamics   (present states [n, dim], next states [n, dim]) -> inputs [n, m]; None: the
                       planner's own
    execute            steps per plan
    warm_start         share of the diffusion steps repeated on the previous plan; None: from noise
    fallback_action    state [dim] -> input [m] where no safe plan is found; None: the plan's own
    sampler            None: DDPM in the trained number of steps, with a projection of each plan
    """
    settings = SamplerSettings(polish=True) if sampler is None else sampler
    whole = planner.respaced(settings.steps)
    if inverse_dynamics is not None:
        whole = replace(whole, inverse_dynamics=inverse_dynamics)
    return Controller(
        planner=whole,
        declared=g,
        method=_method(method),
        sampler=settings,
        control=ControlSettings(execute=execute, warm_start=warm_start),
        fallback_action=fallback_action,
    )


@dataclass(frozen=True)
class Certificate:
    """What trajectories prove of a constraint, exactly where a closed form exists.

    counts    plans, and how many of them are safe at the waypoints and on the segments
    entries   per plan and constraint: status, worst value, where
    """

    counts: dict[str, int | None]
    entries: list[dict[str, Any]]

    @property
    def safe(self) -> bool:
        """Whether every trajectory is safe at its waypoints and between them."""
        return self.counts["safe_on_segments"] == self.counts["plans"]


def certify(
    g: Constraint, x: ArrayLike | torch.Tensor, coordinates: Sequence[str], dt: float | None = None
) -> Certificate:
    """The certificate of trajectories for g, with the tolerance 0.

    x             [n, horizon, dim], environment units
    coordinates   names of a state's coordinates, in order, for the places it names
    dt            seconds between waypoints; None: times are counted in waypoints
    """
    plans = np.asarray(x, dtype=np.float64)
    axes = certificate.Axes(tuple(coordinates), 1.0 if dt is None else dt)
    counts, entries = certificate.certify(g, plans, axes)
    return Certificate(counts, entries)


def _method(method: str | Method) -> Method:
    return make_method(method, {}) if isinstance(method, str) else method


def _state(name: str, state: ArrayLike | None, planner: Planner) -> Array | None:
    if state is None:
        return None
    values = np.asarray(state, dtype=np.float64)
    if values.ndim not in (1, 2) or values.shape[-1] != planner.dim:
        raise CdiffError(
            f"{name}: expected {planner.dim} numbers ({', '.join(planner.coordinates)}), "
            f"or that many per seed, found shape {values.shape}"
        )
    return values
