"""Windows of demonstrations, the data sets made of them, and normalisers fitted to them."""

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

SAMPLES = 64  # demonstration windows kept in a checkpoint, for pictures
COPIES = 8  # of the demonstrations, each beside other observed quantities
Draw = Callable[[int, torch.Generator], tuple[Tensor, Tensor | None]]
"""(how many, generator) -> windows and, of a conditional planner, their labels."""


def end_pins(horizon: int, dim: int) -> Tensor:
    """Mask [horizon, dim] of the coordinates given clean in training: the whole first and last state."""
    pinned = torch.zeros(horizon, dim, dtype=torch.bool)
    pinned[[0, -1]] = True
    return pinned


@dataclass(frozen=True)
class SampledObservations:
    """What would have been observed beside the demonstrations, had there been something to observe: several times over, for each
    is one of many.

    names    of the quantities
    values   in the order of the windows' states   [copies, n, k]
    telling  how a network is told of them
    """

    names: tuple[str, ...]
    values: Tensor
    telling: ObservationEncoder

    @classmethod
    def from_task(
        cls, task: Task, episodes: Sequence[Array], names: tuple[str, ...], seed: int
    ) -> "SampledObservations":
        """Drawn by the task's own law (observed_along); CdiffError where it has none."""
        if not isinstance(task, DrawsObservations):
            raise CdiffError(
                f"{task.name}: the constraints observe {', '.join(names)}, which demonstrations do not hold, and the task has no "
                "observed_along to draw them by; train for constraints without observed quantities"
            )
        rng = np.random.default_rng(seed)
        copies = []
        for _ in range(COPIES):
            seen = [task.observed_along(episode, rng) for episode in episodes]
            copies.append(
                np.concatenate([np.stack([each[name] for name in names], 1) for each in seen])
            )
        values, states = (
            torch.from_numpy(np.stack(copies)),
            torch.from_numpy(np.concatenate(episodes)),
        )
        every = values.flatten(0, 1).unbind(1)
        return cls(
            names,
            values,
            ObservationEncoder.fit(names, task.layout, every, states.repeat(COPIES, 1)),
        )

    def draw(self, rows: Tensor, generator: torch.Generator) -> tuple[Tensor, ...]:
        """Each quantity as it was at those states [n], in a copy drawn at random."""
        copy = torch.randint(COPIES, (len(rows),), generator=generator)
        return self.values[copy, rows].unbind(1)


@dataclass(frozen=True)
class Windows:
    """All stretches of `horizon` consecutive states of the episodes.

    states       all episodes one after the other          [n, dim]
    starts       where a window may begin                  [m]
    cumulative   running sum of the drawing probabilities  [m]
    """

    states: Tensor
    starts: Tensor
    cumulative: Tensor
    horizon: int

    @classmethod
    def from_episodes(cls, episodes: Sequence[Array], horizon: int) -> "Windows":
        """Windows, each as likely as any other."""
        lengths = [len(episode) for episode in episodes]
        if not lengths or max(lengths) < horizon:
            raise CdiffError(
                f"the longest of {len(lengths)} episodes has {max(lengths, default=0)} states, a window needs {horizon}; "
                "use a dataset with longer episodes"
            )
        offsets = np.concatenate(([0], np.cumsum(lengths)[:-1]))
        starts = [
            o + np.arange(n - horizon + 1)
            for o, n in zip(offsets, lengths, strict=True)
            if n >= horizon
        ]
        every = torch.from_numpy(np.concatenate(starts))
        uniform = torch.full((len(every),), 1 / len(every), dtype=torch.float64)
        return cls(torch.from_numpy(np.concatenate(episodes)), every, uniform.cumsum(0), horizon)

    def favour_trips(
        self, share: float, positions: Sequence[int], velocities: Sequence[int]
    ) -> "Windows":
        """The same windows, `share` of the draws among those that begin and end at rest, in proportion to their length.

        Plans are pinned at rest at both ends, and long trips fit a window in few places: drawn evenly, the windows most
        like a plan would be the rarest. Without such windows nothing changes.
        """
        speed = self.states[:, velocities].norm(dim=1)
        still = speed < 0.06 * speed.max()
        last = self.starts + self.horizon - 1
        walked = (
            torch.cat((torch.zeros(1), self.states[:, positions].diff(dim=0).norm(dim=1)))
            .double()
            .cumsum(0)
        )
        weight = torch.where(
            still[self.starts] & still[last], walked[last] - walked[self.starts], 0.0
        )
        if share == 0 or float(weight.sum()) == 0:
            return self
        mixed = (1 - share) / len(weight) + share * weight / weight.sum()
        return replace(self, cumulative=mixed.cumsum(0))

    def __getitem__(self, index: Tensor) -> Tensor:
        """Windows number `index` [k] as [k, horizon, dim]."""
        return self.states[self.starts[index][:, None] + torch.arange(self.horizon)]

    def pick(self, n: int, generator: torch.Generator) -> Tensor:
        """Numbers of n windows [n]."""
        where = torch.rand(n, generator=generator, dtype=torch.float64) * self.cumulative[-1]
        return torch.searchsorted(self.cumulative, where).clamp_max(len(self.starts) - 1)

    def draw(self, n: int, generator: torch.Generator) -> Tensor:
        return self[self.pick(n, generator)]


@dataclass(frozen=True)
class TrainingSet:
    """The windows that a network is trained on, in its own coordinates.

    frame    of relative windows; None where the data's limits are the coordinates
    pinned   coordinates given clean, in training as in sampling   [horizon, dim]
    beside   quantities that the condition observes; None of the others
    returns  labels of a planner that is conditioned on the return; None of the others
    """

    windows: Windows
    normaliser: Normaliser
    frame: ResidualNormaliser | None
    pinned: Tensor
    condition: ConstraintLabel | None
    dropout: float
    dt: float
    beside: SampledObservations | None
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
        observed = condition.observed if condition else ()
        asked = (
            condition,
            spec.dropout,
            task.dt,
            SampledObservations.from_task(task, episodes, observed, seed) if observed else None,
            returns,
        )
        pinned = end_pins(recipe.horizon, len(task.layout))
        if recipe.frame == "relative":
            windows = Windows.from_episodes(
                [e.astype(np.float32) for e in episodes], recipe.horizon
            )
            invariant = task.invariant if isinstance(task, ControlTask) else ()
            frame = fit_residual_normaliser(windows, task.layout, task.shared_scale, invariant)
            pinned[-1] = False
            return cls(windows, frame.state, frame, pinned, *asked)
        normaliser = Normaliser.fit(np.concatenate(episodes), task.layout, task.shared_scale)
        windows = Windows.from_episodes(
            [normaliser.encode(torch.from_numpy(e)).float().numpy() for e in episodes],
            recipe.horizon,
        )
        if task.velocities:
            columns = [
                [task.layout.index(name) for name in names]
                for names in (task.positions, task.velocities)
            ]
            windows = windows.favour_trips(spec.trips, *columns)
        return cls(windows, normaliser, None, pinned, *asked)

    def draw(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor | None]:
        """n windows and, of a conditional planner, what it is told of them; of some of them nothing."""
        index = self.windows.pick(n, generator)
        x = self.windows[index]
        z = x if self.frame is None else self.frame.encode(x)
        if self.condition is None:
            returns = self.returns
            return z, None if returns is None else drop(
                returns.label[self.windows.starts[index]], self.dropout, generator
            )
        states = x if self.frame is not None else self.normaliser.decode(x.double())
        if self.beside is None:
            return z, drop(self.condition.label(states), self.dropout, generator)
        seen = self.beside.draw(self.windows.starts[index], generator)
        label = self.condition.label(
            states, dict(zip(self.beside.names, seen, strict=True)), self.dt
        )
        told = self.beside.telling(seen, states[:, 0])
        return z, drop(torch.cat((label, told), 1), self.dropout, generator)

    def tensors(self) -> dict[str, Tensor]:
        """What a checkpoint keeps of them."""
        sample = self.windows[
            torch.linspace(0, len(self.windows.starts) - 1, SAMPLES).long()
        ].double()
        kept = {
            "normaliser.centre": self.normaliser.centre,
            "normaliser.scale": self.normaliser.scale,
        }
        if self.frame is None:
            return kept | {"demonstrations": self.normaliser.decode(sample).float()}
        if self.beside is not None:
            kept |= {
                f"telling.{name}": value.contiguous()
                for name, value in vars(self.beside.telling).items()
            }
        kept |= {
            f"frame.{name}": getattr(self.frame, name).contiguous()
            for name in ("seen", "mean", "gain", "scale")
        }
        return kept | {"demonstrations": sample.float()}


SAMPLED = 100_000  # windows that the scales are measured on


def fit_residual_normaliser(
    windows: Windows,
    layout: Sequence[str],
    shared: Sequence[Sequence[str]],
    invariant: Sequence[str],
) -> ResidualNormaliser:
    """The frame of the windows (raw states); coordinates of a shared group share their scales."""
    every = torch.arange(len(windows.starts))
    x = windows[every[:: max(1, len(every) // SAMPLED)]].double()
    ahead, spread = x - x[:, :1], x[:, 0].std(0)
    for group in shared:
        columns = [layout.index(name) for name in group]
        spread[columns] = spread[columns].max()
    state, seen = (
        Normaliser(x[:, 0].mean(0), spread.clamp_min(LEAST)),
        torch.tensor([name not in invariant for name in layout]),
    )
    told = torch.where(seen, state.encode(x[:, 0]), 0.0)
    known = torch.cat((told, torch.ones_like(told[:, :1])), 1)
    found = torch.linalg.lstsq(known, ahead.flatten(1), driver="gelsd").solution.unflatten(
        1, ahead.shape[1:]
    )
    gain, mean = found[:-1].permute(1, 2, 0), found[-1]
    scale = (ahead - mean - torch.einsum("kij,nj->nki", gain, told)).std(0)
    for group in shared:
        columns = [layout.index(name) for name in group]
        scale[:, columns] = scale[:, columns].amax(1, keepdim=True)
    return ResidualNormaliser(state, seen, mean, gain, scale.clamp_min(LEAST))
