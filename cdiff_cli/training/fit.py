"""Training: from demonstrations to a checkpoint, in named steps."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.dynamics import LinearDynamics
from cdiff_cli.errors import CdiffError, suggestion
from cdiff_cli.machine import device_name, git_commit
from cdiff_cli.models.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from cdiff_cli.models.networks import InverseDynamics
from cdiff_cli.models.recipe import Recipe, TrainSpec
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.paths import home, shown
from cdiff_cli.tasks.protocol import Task
from cdiff_cli.training.data_statistics import data_statistics
from cdiff_cli.training.demonstrations import (
    Progress,
    dataset_name,
    demonstrations,
    digest,
    load_dataset,
    load_inputs,
    load_rewards,
)
from cdiff_cli.training.inverse_dynamics import fit_inverse
from cdiff_cli.training.labels import LABELS, ConstraintLabel
from cdiff_cli.training.return_labels import ReturnLabel
from cdiff_cli.training.state import TrainingState
from cdiff_cli.training.system_identification import fit_dynamics
from cdiff_cli.training.windows import TrainingSet

LINEAR = 0.99  # share of the transitions that linear dynamics must explain to be enforced on plans
STATE = "state.safetensors"
MODEL = "model.safetensors"


@dataclass(frozen=True)
class Status:
    """Progress after a training step: first of the planner, then of the inverse dynamics."""

    step: int
    steps: int
    loss: float
    what: str = "training"


OnStep = Callable[[Status], None]


def train(
    task: Task,
    recipe: Recipe,
    size: str,
    *,
    seed: int,
    device: torch.device,
    work: Path,
    resume: bool = False,
    dataset: str | None = None,
    condition: ConstraintLabel | None = None,
    save_every: int = 500,
    on_data: Progress | None = None,
    on_step: OnStep | None = None,
) -> Checkpoint:
    """Train the network of one size of a recipe; returns the checkpoint work/model.safetensors.

    The state of the training is saved as work/state.safetensors every save_every steps and when it
    is interrupted. resume continues from there. On one CPU with as many threads, the result has
    the same bits as an uninterrupted training.

    condition   constraints to condition the planner on; the network needs room for their labels
    """
    spec = _spec(task, recipe, size, condition)
    data = _load_data(task, recipe, spec, dataset, on_data)
    training_set = TrainingSet.from_episodes(
        task, recipe, spec, data.episodes, condition, seed, data.returns
    )
    commit = git_commit()
    sha256 = digest(data.episodes)
    state = TrainingState.start(len(task.layout), recipe, spec, seed, device, sha256)
    if resume:
        state.load(work / STATE)
    elif spec.begin:
        path = home() / "models" / task.name / f"{spec.begin}.safetensors"
        state.start_from(load_checkpoint(shown(path), task.name, device))
    work.mkdir(parents=True, exist_ok=True)
    _minimise(state, training_set, Schedule.cosine(recipe.n_steps), work, save_every, on_step)
    dynamics = fit_dynamics(data.episodes, data.inputs)
    inverse = _fit_inverse(data, recipe, spec, seed, on_step) if spec.inverse else None
    card = _card(task, data, state, condition) | {
        "recipe": size if condition is None else f"conditional-{condition.name}",
        "commit": commit,
        "linear": None if dynamics is None else round(dynamics[1], 6),
        "inverse": None if inverse is None else inverse[1],
    }
    tensors = _planner_tensors(state, training_set) | _dynamics_tensors(dynamics, inverse)
    return save_checkpoint(work / MODEL, tensors, card)


# before training ---------------------------------------------------------------------------------


def _spec(task: Task, recipe: Recipe, size: str, condition: ConstraintLabel | None) -> TrainSpec:
    """How that size of the recipe is trained; CdiffError if it does not fit the condition."""
    if not recipe.train:
        raise CdiffError(f"{task.name} needs no training: its score is exact")
    if size not in recipe.train:
        raise CdiffError(
            f'no recipe "{size}"{suggestion(size, recipe.train)}; '
            f"{task.name} has {', '.join(recipe.train)}"
        )
    spec = recipe.train[size]
    entries = condition.entries if condition else LABELS if spec.returns else 0
    if condition and spec.returns:
        expected = "no --conditional FILE beside its returns"
    elif spec.network.conditions != entries:
        expected = f"conditions: {entries} in its network" if entries else "--conditional FILE"
    else:
        return spec
    raise CdiffError(
        f'recipe "{size}" of {task.name}: expected {expected}; '
        "choose another recipe or change this one"
    )


@dataclass(frozen=True)
class _Data:
    """The episodes of a dataset.

    source      Minari id or path of the dataset
    episodes    states of each [n, dim], environment units
    inputs      inputs of each [n - 1, m]; empty if the dataset has none
    returns     labels of a planner that is conditioned on the return; None otherwise
    """

    source: str
    episodes: list[Array]
    inputs: list[Array]
    returns: ReturnLabel | None


def _load_data(
    task: Task, recipe: Recipe, spec: TrainSpec, dataset: str | None, on_data: Progress | None
) -> _Data:
    """The dataset of that name, or the task's own demonstrations."""
    if dataset:
        source, episodes = dataset, load_dataset(task, dataset)
    else:
        source, number = dataset_name(task), recipe.demonstrations
        episodes = demonstrations(task, number.steps, number.seed, on_data)
    # before the long part, so that a dataset without inputs or rewards is refused at once
    inputs = load_inputs(task, source)
    returns = None
    if spec.returns:
        rewards = load_rewards(source, episodes)
        returns = ReturnLabel.from_episodes(episodes, rewards, spec.returns.discount)
    return _Data(source, episodes, inputs, returns)


# training ----------------------------------------------------------------------------------------


def _minimise(
    state: TrainingState,
    training_set: TrainingSet,
    schedule: Schedule,
    work: Path,
    save_every: int,
    on_step: OnStep | None,
) -> None:
    """Optimiser steps to the end of the recipe; the state is saved regularly and at an error."""
    pinned = training_set.pinned.to(state.device)
    steps = state.spec.steps
    start = time.monotonic() - state.wall_s
    try:
        while state.step < steps:
            loss = state.advance(training_set.draw, schedule, pinned)
            if on_step:
                on_step(Status(state.step, steps, loss))
            state.wall_s = time.monotonic() - start
            if state.step % save_every == 0:
                state.save(work / STATE)
    except BaseException:
        if state.rewind():
            state.save(work / STATE)
        raise
    state.save(work / STATE)


def _fit_inverse(
    data: _Data, recipe: Recipe, spec: TrainSpec, seed: int, on_step: OnStep | None
) -> tuple[InverseDynamics, dict[str, float]]:
    """The inverse dynamics and its R^2."""

    def report(step: int, steps: int, loss: float) -> None:
        if on_step:
            on_step(Status(step, steps, loss, "inverse dynamics"))

    assert spec.inverse is not None
    return fit_inverse(data.episodes, data.inputs, recipe.horizon, spec.inverse, seed, report)


# after training ----------------------------------------------------------------------------------


def _card(
    task: Task, data: _Data, state: TrainingState, condition: ConstraintLabel | None
) -> dict[str, Any]:
    """The entries of the card that describe the data and the planner."""
    spec, returns = state.spec, data.returns
    return {
        "task": task.name,
        "horizon": state.horizon,
        "n_steps": state.n_steps,
        "network": spec.network.model_dump(mode="json"),
        "parameters": sum(p.numel() for p in state.ema.parameters()),
        "steps": state.step,
        "seed": state.seed,
        "loss": round(state.loss_average, 7),
        "mse": round(state.mse_average, 7),
        "dataset": data.source,
        "data_sha256": state.data_sha256,
        "device": device_name(state.device),
        "threads": torch.get_num_threads(),
        "wall_s": round(state.wall_s, 1),
        "data": data_statistics(task, data.episodes, state.horizon),
        "constraints": condition.sha256 if condition else None,
        "observed": condition.observed if condition else (),
        "returns": returns.record(spec.returns.discount) if returns and spec.returns else None,
    }


def _planner_tensors(state: TrainingState, training_set: TrainingSet) -> dict[str, Tensor]:
    """Weights in half precision, the normaliser and a few windows."""
    weights = state.ema.state_dict().items()
    kept = {f"net.{name}": value.half().cpu().contiguous() for name, value in weights}
    return kept | training_set.tensors()


def _dynamics_tensors(
    dynamics: tuple[LinearDynamics, float] | None,
    inverse: tuple[InverseDynamics, dict[str, float]] | None,
) -> dict[str, Tensor]:
    """Inverse dynamics, and linear dynamics if they explain enough of the data."""
    kept: dict[str, Tensor] = {}
    if inverse is not None:
        state = inverse[0].state_dict().items()
        kept |= {f"inverse.{name}": value.contiguous() for name, value in state}
    if dynamics is not None and dynamics[1] >= LINEAR:
        kept |= {f"dynamics.{name}": value for name, value in vars(dynamics[0]).items()}
    return kept
