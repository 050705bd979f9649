"""A planner as a value: a denoiser and what sampling has to know about it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.dynamics import LinearDynamics
from cdiff_cli.constraints.observed import ObservedValues
from cdiff_cli.models.denoiser import Denoiser, ObservingDenoiser, calls_a_step, guided
from cdiff_cli.models.normaliser import Normaliser, ResidualNormaliser
from cdiff_cli.models.schedule import Schedule

if TYPE_CHECKING:
    from cdiff_cli.models.checkpoint import Checkpoint

CPU = torch.device("cpu")

InverseDynamics = Callable[[Array, Array], Array]
"""(present states [n, dim], next states [n, dim]) -> inputs [n, m], environment units."""


@dataclass(frozen=True)
class Planner:
    """What sampling asks of a diffusion planner.

    denoiser              (x_t, t) -> clean estimate, normalised coordinates [batch, horizon, dim];
                          t is the step as trained, schedule.t
    schedule              noise levels
    normaliser            environment units to those of the network, and back
    horizon               waypoints per plan
    coordinates           names of a state's coordinates, in order; constraints use them
    dt                    seconds between waypoints; None where waypoints are not in time
    positions             coordinates that distances are measured in; all where none are named
    dynamics              linear dynamics that plans can be made to satisfy; None: unknown
    inverse_dynamics      the input that leads from one state to the next; control needs it
    conditioned_denoiser  the denoiser of a planner that is conditioned on observed quantities
    calls_per_step        network calls per diffusion step
    device                where the denoiser computes
    """

    denoiser: Denoiser
    schedule: Schedule
    normaliser: Normaliser | ResidualNormaliser
    horizon: int
    coordinates: tuple[str, ...]
    dt: float | None = None
    positions: tuple[str, ...] = ()
    dynamics: LinearDynamics | None = None
    inverse_dynamics: InverseDynamics | None = None
    conditioned_denoiser: ObservingDenoiser | None = None
    calls_per_step: int = 1
    device: torch.device = CPU

    @property
    def dim(self) -> int:
        """Coordinates per state."""
        return len(self.coordinates)

    @property
    def position_columns(self) -> list[int]:
        """Columns of the coordinates that distances are measured in."""
        return [self.coordinates.index(name) for name in self.positions or self.coordinates]

    def respaced(self, steps: int | None) -> "Planner":
        """The planner with its schedule in fewer steps; None: as it is."""
        return self if steps is None else replace(self, schedule=self.schedule.respaced(steps))

    @classmethod
    def from_checkpoint(
        cls,
        checkpoint: "Checkpoint",
        coordinates: tuple[str, ...],
        dt: float | None = None,
        positions: tuple[str, ...] = (),
        weight: float = 0.0,
    ) -> "Planner":
        """The planner of a checkpoint, on the device that its network is on.

        weight   guidance weight of a network with a condition (classifier-free guidance)
        """
        net, limit, card = checkpoint.net, checkpoint.limit, checkpoint.card
        device = next(net.parameters()).device
        conditioned = None
        if (encoder := checkpoint.telling) is not None:
            # A name bound here, for mypy and for the closure.
            encode, names = encoder, card.observed

            def conditioned(observed: ObservedValues, present: Tensor) -> Denoiser:
                condition = encode([observed[name] for name in names], present).to(device)
                return guided(net, weight, limit, condition)

        inverse = checkpoint.inverse

        def input_between(present: Array, following: Array) -> Array:
            assert inverse is not None
            states = (torch.from_numpy(x).float().to(device) for x in (present, following))
            return inverse(*states).double().cpu().numpy()

        return cls(
            denoiser=guided(net, weight, limit),
            schedule=Schedule.cosine(card.n_steps),
            normaliser=checkpoint.frame or checkpoint.normaliser,
            horizon=card.horizon,
            coordinates=coordinates,
            dt=dt,
            positions=positions,
            dynamics=checkpoint.dynamics,
            inverse_dynamics=None if inverse is None else input_between,
            conditioned_denoiser=conditioned,
            calls_per_step=calls_a_step(weight),
            device=device,
        )
