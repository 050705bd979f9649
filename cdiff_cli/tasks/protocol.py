"""What a task offers: names and units of its states, and how it is run."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Tolerances:
    """How near is near enough, in a task's own units.

    position         up to which a plan under dynamics may miss a pinned coordinate, in the unit of each
    clearance        how far inside the constraints plans under dynamics are made, in the units of g: the execution stays near the
                     plan, not on it
    velocity_weight  of a rate beside 1 for a position in the distance to the dynamics, s^2: a plan's places matter more than its
                     rates
    """

    position: float = 1e-3
    clearance: float = 5e-3
    velocity_weight: float = 0.02


class Task(Protocol):
    """One environment: names, units and geometry of its states, demonstrations, and how to run it."""

    @property
    def name(self) -> str: ...
    @property
    def layout(self) -> tuple[str, ...]:
        """Names of a state's coordinates, in order; YAML and reports use these, never indices."""
        ...

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each coordinate."""
        ...

    @property
    def positions(self) -> tuple[str, ...]:
        """The coordinates distances and jumps are measured in."""
        ...

    @property
    def velocities(self) -> tuple[str, ...]:
        """The rates of the positions, or nothing where the state has none."""
        ...

    @property
    def shared_scale(self) -> tuple[tuple[str, ...], ...]:
        """Groups of coordinates that share one scale in the normaliser."""
        ...

    @property
    def dt(self) -> float:
        """Seconds between waypoints."""
        ...

    @property
    def tolerances(self) -> Tolerances:
        """What planning takes for near enough."""
        ...

    def make_env(self, render: bool = False) -> Any: ...
    def observe(self, obs: Any) -> NDArray[np.float64]: ...
    def from_d4rl(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """States of D4RL's dataset of this environment, in this task's frame."""
        ...

    def demonstrate(self, n_steps: int, seed: int) -> Iterator[dict[str, Any]]: ...
    def walls(self) -> NDArray[np.float64]:
        """Solid boxes (x_min, y_min, x_max, y_max) in the plane of the positions [n, 4]."""
        ...


class ControlTask(Task, Protocol):
    """A task that is replanned at every environment step: what receding_horizon.py asks of it besides."""

    @property
    def actions(self) -> tuple[str, ...]:
        """Names of the inputs."""
        ...

    @property
    def invariant(self) -> tuple[str, ...]:
        """Coordinates that nothing depends on; networks are not shown them."""
        ...

    @property
    def max_steps(self) -> int:
        """Environment steps of an episode."""
        ...

    @property
    def observable(self) -> tuple[str, ...]:
        """Names of the observed quantities that constraints may use."""
        ...

    def observed(self, env: Any) -> dict[str, float]:
        """Their present values."""
        ...
