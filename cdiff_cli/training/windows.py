"""Windows of demonstrations, the data set of a network, and fitting its normaliser."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError
from cdiff_cli.models.denoiser import ObservationEncoder
from cdiff_cli.models.normaliser import LEAST, Normaliser, ResidualNormaliser
from cdiff_cli.models.recipe import Recipe, TrainSpec
from cdiff_cli.tasks.protocol import ControlTask, DrawsObservations, Task
from cdiff_cli.training.labels import ConstraintLabel, drop
from cdiff_cli.training.return_labels import ReturnLabel

SAMPLES = 64  # demonstration windows in a checkpoint, for pictures
COPIES = 8  # simulated observations per demonstration
SCALED = 100_000  # windows, about, on which the scales are measured
AT_REST = 0.06  # speed below which a state is at rest, as a share of the largest speed
Draw = Callable[[int, torch.Generator], tuple[Tensor, Tensor | None]]
"""(number, generator) -> windows and, for a conditional planner, their labels."""


def end_pins(horizon: int, dim: int) -> Tensor:
    """Mask [horizon, dim] of the coordinates that are clean in training: first and last state."""
    pinned = torch.zeros(horizon, dim, dtype=torch.bool)
    pinned[[0, -1]] = True
    return pinned


@dataclass(frozen=True)
class SampledObservations:
    """Simulated observations for demonstrations that were recorded without any.

    Each demonstration is paired with COPIES independent draws from the task's observation model,
    so that the network does not memorise one obstacle per trajectory.

    names     names of the quantities
    values    in the order of the states of the windows   [copies, n, k]
    encoder   how a network gets them
    """

    names: tuple[str, ...]
    values: Tensor
    encoder: ObservationEncoder

    @classmethod
    def from_task(
        cls, task: Task, episodes: Sequence[Array], names: tuple[str, ...], seed: int
    ) -> "SampledObservations":
        """Draws of the task (observed_along); CdiffError if it has none."""
        if not isinstance(task, DrawsObservations):
            raise CdiffError(
                f"{task.name}: the constraints observe {', '.join(names)}, which demonstrations do "
                "not hold, and the task has no observed_along to draw them by; train for "
                "constraints without observed quantities"
            )
        rng = np.random.default_rng(seed)
        copies = []
        for _ in range(COPIES):
            runs = [task.observed_along(episode, rng) for episode in episodes]
            rows = [np.stack([run[name] for name in names], 1) for run in runs]
            copies.append(np.concatenate(rows))
        values = torch.from_numpy(np.stack(copies))
        states = torch.from_numpy(np.concatenate(episodes)).repeat(COPIES, 1)
        encoder = ObservationEncoder.fit(
            names, task.layout, task.relative_to, values.flatten(0, 1).unbind(1), states
        )
        return cls(names, values, encoder)

    def draw(self, rows: Tensor, generator: torch.Generator) -> tuple[Tensor, ...]:
        """Each quantity at those states [n], in a copy drawn at random."""
        copy = torch.randint(COPIES, (len(rows),), generator=generator)
        return self.values[copy, rows].unbind(1)


@dataclass(frozen=True)
class Windows:
    """All stretches of `horizon` consecutive states of the episodes.

    states       all episodes one after the other                  [n, dim]
    starts       rows of states where a window starts              [m]
    cumulative   cumulative probability of drawing each window     [m]
    """

    states: Tensor
    starts: Tensor
    cumulative: Tensor
    horizon: int

    @classmethod
    def from_episodes(cls, episodes: Sequence[Array], horizon: int) -> "Windows":
        """Windows of the episodes, all with the same probability."""
        lengths = [len(episode) for episode in episodes]
        if not lengths or max(lengths) < horizon:
            raise CdiffError(
                f"the longest of {len(lengths)} episodes has {max(lengths, default=0)} states, "
                f"a window needs {horizon}; use a dataset with longer episodes"
            )
        offsets = np.concatenate(([0], np.cumsum(lengths)[:-1]))
        starts = [
            offset + np.arange(n - horizon + 1)
            for offset, n in zip(offsets, lengths, strict=True)
            if n >= horizon
        ]
        rows = torch.from_numpy(np.concatenate(starts))
        uniform = torch.full((len(rows),), 1 / len(rows), dtype=torch.float64)
        return cls(torch.from_numpy(np.concatenate(episodes)), rows, uniform.cumsum(0), horizon)

    def favour_trips(
        self, share: float, positions: Sequence[int], velocities: Sequence[int]
    ) -> "Windows":
        """The same windows; `share` of the draws start and end at rest.

        Their probability is proportional to their length. Plans are pinned at rest at both ends,
        and a long trip fits a window in few places, so uniform draws would rarely resemble a plan.
        Without windows that start and end at rest, nothing changes.
        """
        speed = self.states[:, velocities].norm(dim=1)
        still = speed < AT_REST * speed.max()
        last = self.starts + self.horizon - 1
        steps = self.states[:, positions].diff(dim=0).norm(dim=1)
        travelled = torch.cat((torch.zeros(1), steps)).double().cumsum(0)
        length = travelled[last] - travelled[self.starts]
        weight = torch.where(still[self.starts] & still[last], length, 0.0)
        if share == 0 or float(weight.sum()) == 0:
            return self
        mixed = (1 - share) / len(weight) + share * weight / weight.sum()
        return replace(self, cumulative=mixed.cumsum(0))

    def __getitem__(self, index: Tensor) -> Tensor:
        """Windows with the numbers `index` [k] as [k, horizon, dim]."""
        return self.states[self.starts[index][:, None] + torch.arange(self.horizon)]

    def pick(self, n: int, generator: torch.Generator) -> Tensor:
        """Numbers of n windows drawn at random [n]."""
        level = torch.rand(n, generator=generator, dtype=torch.float64) * self.cumulative[-1]
        return torch.searchsorted(self.cumulative, level).clamp_max(len(self.starts) - 1)

    def draw(self, n: int, generator: torch.Generator) -> Tensor:
        """n windows drawn at random [n, horizon, dim]."""
        return self[self.pick(n, generator)]


@dataclass(frozen=True)
class TrainingSet:
    """Windows and labels that a network is trained on, in normalised coordinates.

    windows        normalised; in environment units if there is a frame
    normaliser     environment units to normalised ones; with a frame, those of the first state
    frame          normaliser of windows relative to their first state; None otherwise
    pinned         coordinates that are clean, in training as in sampling   [horizon, dim]
    dropout        share of the windows whose label is dropped
    dt             time between waypoints [s]
    observations   simulated quantities that the condition observes; None without any
    returns        labels of a planner that is conditioned on the return; None otherwise
    """

    windows: Windows
    normaliser: Normaliser
    frame: ResidualNormaliser | None
    pinned: Tensor
    condition: ConstraintLabel | None
    dropout: float
    dt: float
    observations: SampledObservations | None
    returns: ReturnLabel | None

    @classmethod
    def from_episodes(
        cls,
        task: Task,
        recipe: Recipe,
        spec: TrainSpec,
        episodes: Sequence[Array],
        condition: ConstraintLabel | None,
        seed: int,
        returns: ReturnLabel | None = None,
    ) -> "TrainingSet":
        """The set of a recipe, from episodes of states in environment units."""
        observed = condition.observed if condition else ()
        observations = (
            SampledObservations.from_task(task, episodes, observed, seed) if observed else None
        )
        relative = recipe.frame == "relative"
        windows, normaliser, frame = (
            _relative_windows(task, episodes, recipe.horizon)
            if relative
            else (*_limited_windows(task, episodes, recipe.horizon, spec.trips), None)
        )
        pinned = end_pins(recipe.horizon, len(task.layout))
        pinned[-1] = not relative
        return cls(
            windows,
            normaliser,
            frame,
            pinned,
            condition,
            spec.dropout,
            task.dt,
            observations,
            returns,
        )

    def draw(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor | None]:
        """n windows and, for a conditional planner, their labels; zeros where these are dropped."""
        index = self.windows.pick(n, generator)
        x = self.windows[index]
        z = x if self.frame is None else self.frame.encode(x)
        label = self._label(x, self.windows.starts[index], generator)
        return z, None if label is None else drop(label, self.dropout, generator)

    def _label(self, x: Tensor, rows: Tensor, generator: torch.Generator) -> Tensor | None:
        """Labels of the windows x, which start at those rows of the states [n, k]."""
        if self.condition is None:
            return None if self.returns is None else self.returns.label[rows]
        states = x if self.frame is not None else self.normaliser.decode(x.double())
        if self.observations is None:
            return self.condition.label(states)
        values = self.observations.draw(rows, generator)
        observed = dict(zip(self.observations.names, values, strict=True))
        label = self.condition.label(states, observed, self.dt)
        return torch.cat((label, self.observations.encoder(values, states[:, 0])), 1)

    def tensors(self) -> dict[str, Tensor]:
        """What a checkpoint keeps of the set."""
        numbers = torch.linspace(0, len(self.windows.starts) - 1, SAMPLES).long()
        sample = self.windows[numbers].double()
        if self.frame is None:
            sample = self.normaliser.decode(sample)
        kept = {"demonstrations": sample.float()}
        kept |= {
            "normaliser.centre": self.normaliser.centre,
            "normaliser.scale": self.normaliser.scale,
        }
        if self.frame is not None:
            kept |= {
                f"frame.{name}": value.contiguous() for name, value in self.frame.record().items()
            }
        if self.observations is not None:
            encoder = vars(self.observations.encoder).items()
            kept |= {f"telling.{name}": value.contiguous() for name, value in encoder}
        return kept


def _relative_windows(
    task: Task, episodes: Sequence[Array], horizon: int
) -> tuple[Windows, Normaliser, ResidualNormaliser]:
    """Windows in environment units, and their normaliser relative to the first state."""
    windows = Windows.from_episodes([e.astype(np.float32) for e in episodes], horizon)
    invariant = task.invariant if isinstance(task, ControlTask) else ()
    frame = fit_residual_normaliser(windows, task.layout, task.shared_scale, invariant)
    return windows, frame.state, frame


def _limited_windows(
    task: Task, episodes: Sequence[Array], horizon: int, trips: float
) -> tuple[Windows, Normaliser]:
    """Windows normalised by the limits of the data; `trips` is the share that favours trips."""
    normaliser = Normaliser.fit(np.concatenate(episodes), task.layout, task.shared_scale)
    encoded = [normaliser.encode(torch.from_numpy(e)).float().numpy() for e in episodes]
    windows = Windows.from_episodes(encoded, horizon)
    if task.velocities:
        positions = [task.layout.index(name) for name in task.positions]
        velocities = [task.layout.index(name) for name in task.velocities]
        windows = windows.favour_trips(trips, positions, velocities)
    return windows, normaliser


def fit_residual_normaliser(
    windows: Windows,
    layout: Sequence[str],
    shared: Sequence[Sequence[str]],
    invariant: Sequence[str],
) -> ResidualNormaliser:
    """Least squares and scales of windows in environment units.

    Coordinates of a shared group share their scales.
    """
    number = len(windows.starts)
    x = windows[torch.arange(number)[:: max(1, number // SCALED)]].double()
    ahead, spread = x - x[:, :1], x[:, 0].std(0)
    groups = [[layout.index(name) for name in group] for group in shared]
    for columns in groups:
        spread[columns] = spread[columns].max()
    state = Normaliser(x[:, 0].mean(0), spread.clamp_min(LEAST))
    used = torch.tensor([name not in invariant for name in layout])
    first = torch.where(used, state.encode(x[:, 0]), 0.0)
    known = torch.cat((first, torch.ones_like(first[:, :1])), 1)
    solution = torch.linalg.lstsq(known, ahead.flatten(1), driver="gelsd").solution
    coefficients = solution.unflatten(1, ahead.shape[1:])
    gain, mean = coefficients[:-1].permute(1, 2, 0), coefficients[-1]
    scale = (ahead - mean - torch.einsum("kij,nj->nki", gain, first)).std(0)
    for columns in groups:
        scale[:, columns] = scale[:, columns].amax(1, keepdim=True)
    return ResidualNormaliser(state, used, mean, gain, scale.clamp_min(LEAST))
