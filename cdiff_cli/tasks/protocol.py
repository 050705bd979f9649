"""What a task is: a small core that every task has, and optional abilities.

An ability is a protocol of one to three members. Ask for it with isinstance:

    if isinstance(task, HasMap):
        walls = task.walls()
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from cdiff_cli.arrays import Array, Traj
from cdiff_cli.models.schedule import Schedule

Control = Literal["open_loop", "receding_horizon"]
"""How a task is run: one whole plan per episode, or a new plan at every environment step."""


@dataclass(frozen=True)
class Tolerances:
    """Accuracy that plans need, in the units of the task.

    position         largest error of a pinned coordinate in a plan with dynamics, in its own unit
    clearance        margin by which plans with dynamics satisfy the constraints, in units of g;
                     the execution stays near the plan, not on it
    velocity_weight  weight of a velocity error in the distance to the dynamics [s^2]; a position
                     error has weight 1
    """

    position: float = 1e-3
    clearance: float = 5e-3
    velocity_weight: float = 0.02


@runtime_checkable
class Task(Protocol):
    """The core of a task: names and units of its states, and how to run its environment."""

    @property
    def name(self) -> str: ...
    @property
    def layout(self) -> tuple[str, ...]:
        """Names of the coordinates of a state, in order; YAML and reports use the names."""
        ...

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each coordinate."""
        ...

    @property
    def positions(self) -> tuple[str, ...]:
        """Coordinates in which distances and jumps are measured."""
        ...

    @property
    def velocities(self) -> tuple[str, ...]:
        """Velocities of the positions, in the same order; empty if a state has none."""
        ...

    @property
    def shared_scale(self) -> tuple[tuple[str, ...], ...]:
        """Groups of coordinates that share one scale in the normaliser."""
        ...

    @property
    def dt(self) -> float:
        """Time between two waypoints [s]."""
        ...

    @property
    def control(self) -> Control:
        """Whether a plan is executed whole or replaced at every environment step."""
        ...

    @property
    def tolerances(self) -> Tolerances: ...

    def make_env(self, render: bool = False) -> Any:
        """A new Gymnasium environment."""
        ...

    def observe(self, obs: Any) -> Array:
        """State [dim] of an observation, or states [n, dim] of an episode of observations."""
        ...


@runtime_checkable
class ControlTask(Task, Protocol):
    """A task with control "receding_horizon"."""

    @property
    def actions(self) -> tuple[str, ...]:
        """Names of the inputs."""
        ...

    @property
    def invariant(self) -> tuple[str, ...]:
        """Coordinates that the dynamics do not depend on; networks do not get them."""
        ...

    @property
    def max_steps(self) -> int:
        """Environment steps per episode."""
        ...


# abilities -------------------------------------------------------------------------------------


@runtime_checkable
class Demonstrates(Protocol):
    """The task generates its own training data."""

    def demonstrate(self, n_steps: int, seed: int) -> Iterator[dict[str, Any]]:
        """Episodes of observations, actions and rewards, with n_steps environment steps in all."""
        ...


@runtime_checkable
class ReadsD4RL(Protocol):
    """D4RL's dataset of this environment uses other coordinates than the task."""

    def from_d4rl(self, states: Array) -> Array:
        """States [n, dim] of D4RL's dataset in the coordinates of the task."""
        ...


@runtime_checkable
class Tracks(Protocol):
    """A tracking controller follows plans in the environment."""

    @property
    def success_radius(self) -> float:
        """Largest distance to the goal that counts as success, in units of the positions."""
        ...

    def track(self, state: Array, target: Array) -> Array:
        """Input [m] that drives a state [dim] towards a target state [dim]."""
        ...

    def reset_to(self, env: Any, start: Array, goal: Array, seed: int) -> Any:
        """Start an episode in a state, with a goal state; returns the observation."""
        ...


@runtime_checkable
class Observes(Protocol):
    """The environment reports quantities besides the state, such as a moving obstacle."""

    @property
    def observable(self) -> tuple[str, ...]:
        """Names of the observed quantities that constraints may use."""
        ...

    def observed(self, env: Any) -> dict[str, float]:
        """Present value of each quantity by name; empty if the episode has none."""
        ...


@runtime_checkable
class DrawsObservations(Protocol):
    """The task can simulate observations for demonstrations that were recorded without any."""

    @property
    def relative_to(self) -> Mapping[str, str]:
        """Coordinate that a quantity is relative to when a network gets it, by quantity.

        Quantities without an entry are given as they are.
        """
        ...

    def observed_along(self, run: Array, rng: np.random.Generator) -> Mapping[str, Array]:
        """Values [n] of each quantity along a run of states [n, dim], drawn at random."""
        ...


@runtime_checkable
class Brakes(Protocol):
    """The task has an input that is safe when no plan is."""

    def brake(self, state: Array) -> Array:
        """Input [m] that stops the agent from a state [dim]."""
        ...


@runtime_checkable
class HasMap(Protocol):
    """Solid walls stand in the plane of the positions."""

    @property
    def footprint(self) -> float:
        """Clearance that a start and a goal need, in units of the positions."""
        ...

    def walls(self) -> Array:
        """Solid boxes (x_min, y_min, x_max, y_max) in the plane of the positions [n, 4]."""
        ...

    def is_free(self, point: Array, clearance: float = 0.0) -> bool:
        """Whether a disc of radius clearance at a point [2] touches no wall."""
        ...


@runtime_checkable
class HasRoutes(Protocol):
    """Starts and goals can be drawn at random, and the way between them has a known length."""

    def random_point(self, rng: np.random.Generator) -> Array:
        """A random free point [2]."""
        ...

    def path_length(self, start: Array, goal: Array) -> float:
        """Length of a shortest path between two points [2], in units of the positions."""
        ...


@runtime_checkable
class HasExactScore(Protocol):
    """The data distribution is known, so that no network is needed."""

    @property
    def scale(self) -> float:
        """Size of the normalised coordinates, in units of the state."""
        ...

    def denoiser(self, schedule: Schedule) -> Callable[[Traj, int], Traj]:
        """E[x_0 | x_t] as a function of (x_t, t), in normalised coordinates."""
        ...

    def truth(self, n: int, seed: int) -> Array:
        """Samples [n, dim] of the unconstrained distribution."""
        ...


@runtime_checkable
class HasEnvOptions(Protocol):
    """The environment takes options that a user may set."""

    @property
    def env_options(self) -> Mapping[str, tuple[Any, ...]]:
        """Allowed values of each option of make_env."""
        ...


def walls_of(task: Task) -> Array:
    """The walls of a task [n, 4]; none without a map."""
    return task.walls() if isinstance(task, HasMap) else np.empty((0, 4))


def observable_of(task: Task) -> tuple[str, ...]:
    """Names of the quantities that a task observes; none if it observes nothing."""
    return task.observable if isinstance(task, Observes) else ()


def observed_in(task: Task, env: Any) -> dict[str, float]:
    """Present value of each observed quantity; empty if the task observes nothing."""
    return task.observed(env) if isinstance(task, Observes) else {}
