"""Fitting the denoiser; checkpoints as safetensors with a card; training that resumes to the same bits."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.dynamics import LinearDynamics
from cdiff_cli.errors import CdiffError, CheckpointError, suggestion
from cdiff_cli.machine import device_name, git_commit
from cdiff_cli.models.checkpoint import (
    Checkpoint,
    Network,
    build,
    load_checkpoint,
    read_safetensors,
    save_checkpoint,
    write_safetensors,
)
from cdiff_cli.models.recipe import Recipe, TrainSpec
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.paths import home, shown
from cdiff_cli.tasks.protocol import Task
from cdiff_cli.training.demonstrations import (
    Progress,
    demonstrations,
    digest,
    load_dataset,
    load_inputs,
    load_rewards,
)
from cdiff_cli.training.inverse_dynamics import fit_inverse
from cdiff_cli.training.labels import LABELS, ConstraintLabel
from cdiff_cli.training.loss import Weighing, training_loss
from cdiff_cli.training.return_labels import ReturnLabel
from cdiff_cli.training.system_identification import fit
from cdiff_cli.training.windows import Draw, TrainingSet

LINEAR = 0.99  # share of the transitions that linear dynamics must explain to be kept: plans are held to them


@dataclass(frozen=True)
class Status:
    """Told after each training step of the planner, then of the inverse dynamics."""

    step: int
    steps: int
    loss: float
    what: str = "training"


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
    on_step: Callable[[Status], None] | None = None,
) -> Checkpoint:
    """Train the recipe's network of that size and return the finished checkpoint, saved at work/model.safetensors.

    work holds state.safetensors, written every save_every steps and on interruption; resume goes on from there and, on one
    CPU with as many threads, ends with the same bits as an uninterrupted run.

    condition   constraints to condition the planner on; the recipe's network must have room for their labels
    """
    if not recipe.train:
        raise CdiffError(f"{task.name} needs no training: its score is exact")
    if size not in recipe.train:
        raise CdiffError(
            f'no recipe "{size}"{suggestion(size, recipe.train)}; {task.name} has {", ".join(recipe.train)}'
        )
    spec = recipe.train[size]
    entries = condition.entries if condition else LABELS if spec.returns else 0
    if spec.network.conditions != entries or (condition and spec.returns):
        wanted = f"conditions: {entries} in its network" if entries else "--conditional FILE"
        wanted = (
            "no --conditional FILE beside its returns" if condition and spec.returns else wanted
        )
        raise CdiffError(
            f'recipe "{size}" of {task.name}: expected {wanted}; choose another recipe or mend it'
        )
    asked = recipe.demonstrations
    episodes = (
        load_dataset(task, dataset)
        if dataset
        else demonstrations(task, asked.steps, asked.seed, on_data)
    )
    source = dataset or f"cdiff/{task.name}-v0"
    inputs = load_inputs(
        task, source
    )  # before the long part: a dataset without them is refused at once
    returns = (
        ReturnLabel.from_episodes(episodes, load_rewards(source, episodes), spec.returns.discount)
        if spec.returns
        else None
    )
    data = TrainingSet.from_episodes(task, recipe, spec, episodes, condition, seed, returns)
    commit = git_commit()
    state = _Fit.start(len(task.layout), recipe, spec, seed, device, digest(episodes))
    if resume:
        state.load(work / "state.safetensors")
    elif spec.begin:
        state.begin(
            load_checkpoint(
                shown(home() / "models" / task.name / f"{spec.begin}.safetensors"),
                task.name,
                device,
            )
        )
    schedule, pinned = Schedule.cosine(recipe.n_steps), data.pinned.to(device)
    work.mkdir(parents=True, exist_ok=True)
    began = time.monotonic() - state.wall_s
    try:
        while state.step < spec.steps:
            loss = state.advance(data.draw, schedule, pinned)
            if on_step:
                on_step(Status(state.step, spec.steps, loss))
            state.wall_s = time.monotonic() - began
            if state.step % save_every == 0:
                state.save(work / "state.safetensors")
    except BaseException:
        if state.rewind():
            state.save(work / "state.safetensors")
        raise
    state.save(work / "state.safetensors")
    dynamics = fit_dynamics(episodes, inputs)
    inverse, explained = None, None

    def told(step: int, steps: int, loss: float) -> None:
        if on_step:
            on_step(Status(step, steps, loss, "inverse dynamics"))

    if spec.inverse is not None:
        inverse, explained = fit_inverse(episodes, inputs, recipe.horizon, spec.inverse, seed, told)
    card = {
        "task": task.name,
        "recipe": size if condition is None else f"conditional-{condition.name}",
        "horizon": recipe.horizon,
        "n_steps": recipe.n_steps,
        "network": spec.network.model_dump(mode="json"),
        "parameters": sum(p.numel() for p in state.ema.parameters()),
        "steps": state.step,
        "seed": seed,
        "loss": round(state.loss_average, 7),
        "mse": round(state.mse_average, 7),
        "dataset": source,
        "data_sha256": state.data_sha256,
        "commit": commit,
        "device": device_name(device),
        "threads": torch.get_num_threads(),
        "wall_s": round(state.wall_s, 1),
        "data": data_statistics(task, episodes, recipe.horizon),
        "linear": None if dynamics is None else round(dynamics[1], 6),
        "inverse": explained,
        "constraints": condition.sha256 if condition else None,
        "observed": condition.observed if condition else (),
        "returns": returns.told(spec.returns.discount) if returns and spec.returns else None,
    }
    tensors = {
        f"net.{name}": value.half().cpu().contiguous()
        for name, value in state.ema.state_dict().items()
    } | data.tensors()
    if inverse is not None:
        tensors |= {
            f"inverse.{name}": value.contiguous() for name, value in inverse.state_dict().items()
        }
    if dynamics is not None and dynamics[1] >= LINEAR:
        tensors |= {f"dynamics.{name}": value for name, value in vars(dynamics[0]).items()}
    return save_checkpoint(work / "model.safetensors", tensors, card)


def fit_dynamics(
    episodes: Sequence[Array], inputs: Sequence[Array]
) -> tuple[LinearDynamics, float] | None:
    """Linear dynamics of the episodes and the share of their transitions that they explain; None without inputs."""
    if not inputs:
        return None
    steps = [(x[:-1], u[: len(x) - 1], x[1:]) for x, u in zip(episodes, inputs, strict=True)]
    x, u, after = (np.concatenate(part) for part in zip(*steps, strict=True))
    return fit(x, u, after)


@dataclass
class _Fit:
    """All that changes in training; exactly what is saved."""

    net: Network
    ema: Network
    optimiser: torch.optim.Adam
    generator: torch.Generator
    spec: TrainSpec
    horizon: int
    n_steps: int
    device: torch.device
    seed: int
    data_sha256: str
    step: int = 0
    loss_average: float = math.nan
    mse_average: float = math.nan
    wall_s: float = 0.0
    drawn_from: Tensor | None = None  # the generator before the step under way
    whole: bool = True  # no update is under way

    @classmethod
    def start(
        cls,
        dim: int,
        recipe: Recipe,
        spec: TrainSpec,
        seed: int,
        device: torch.device,
        data_sha256: str,
    ) -> "_Fit":
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(
                seed
            )  # weight initialisation draws from the global generator; fork_rng restores it
            net, ema = (build(dim, recipe.horizon, spec.network) for _ in range(2))
        ema.load_state_dict(net.state_dict())
        net, ema = net.to(device), ema.to(device).requires_grad_(False)
        optimiser = torch.optim.Adam(net.parameters(), spec.learning_rate)
        generator = torch.Generator().manual_seed(seed)
        return cls(
            net,
            ema,
            optimiser,
            generator,
            spec,
            recipe.horizon,
            recipe.n_steps,
            device,
            seed,
            data_sha256,
        )

    def begin(self, base: Checkpoint) -> None:
        """Go on from the weights of a finished checkpoint of the same data and, but for the labels, the same network: what its own
        labels mean, of the return, is left behind.
        """
        if base.card.data_sha256 != self.data_sha256:
            first = f"train it on these first, with --recipe {base.card.recipe}"
            raise CheckpointError(
                f"{base.path}: trained on other demonstrations, and this one begins from it; {first}"
            )
        if (
            base.card.network.model_copy(update={"conditions": self.spec.network.conditions})
            != self.spec.network
        ):
            raise CheckpointError(
                f"{base.path}: its network is not the one of this recipe, which begins from it; mend recipe.yaml"
            )
        weights = {
            name: value
            for name, value in base.net.state_dict().items()
            if not name.startswith("condition.")
        }
        for net in (self.net, self.ema):
            net.load_state_dict(net.state_dict() | weights)

    def advance(self, draw: Draw, schedule: Schedule, pinned: Tensor) -> float:
        """One optimiser step; returns the loss."""
        spec, loss_value, mse_value = self.spec, 0.0, 0.0
        weighing = Weighing(spec.smoothness, spec.emphasis)
        for group in self.optimiser.param_groups:
            group["lr"] = spec.learning_rate * self._rate()
        self.optimiser.zero_grad()
        self.drawn_from = self.generator.get_state()
        for _ in range(spec.accumulate):
            x0, label = draw(spec.batch, self.generator)
            x0, label = x0.to(self.device), None if label is None else label.to(self.device)
            loss, mse = training_loss(
                self.net, schedule, x0, pinned, weighing, self.generator, spec.bf16, label
            )
            (loss / spec.accumulate).backward()  # type: ignore[no-untyped-call]
            loss_value, mse_value = (
                loss_value + loss.item() / spec.accumulate,
                mse_value + mse.item() / spec.accumulate,
            )
        if not math.isfinite(loss_value):
            raise CdiffError(
                f"the loss is {loss_value} at step {self.step}: training diverged; lower learning_rate"
            )
        if spec.clip is not None:
            nn.utils.clip_grad_norm_(self.net.parameters(), spec.clip)
        self.whole = False
        self.optimiser.step()
        self.step += 1
        decay = min(spec.ema, self.step / (self.step + 10))
        with torch.no_grad():
            for mean, new in zip(self.ema.parameters(), self.net.parameters(), strict=True):
                mean.lerp_(new, 1 - decay)
        self.loss_average = _average(self.loss_average, loss_value)
        self.mse_average = _average(self.mse_average, mse_value)
        self.drawn_from, self.whole = None, True
        return loss_value

    def rewind(self) -> bool:
        """Undo the draws of a step broken off; False where its update had begun, so that the state is of no use."""
        if self.drawn_from is not None:
            self.generator.set_state(self.drawn_from)
        return self.whole

    def _rate(self) -> float:
        """Learning rate as a share of the recipe's: a short warm-up, then a cosine to zero."""
        warm = min(1.0, (self.step + 1) / 200)
        return (
            warm
            if self.spec.schedule == "constant"
            else warm * (0.5 + 0.5 * math.cos(math.pi * self.step / self.spec.steps))
        )

    def _task(self) -> dict[str, str]:
        """What a resumed training must share with the one it goes on from."""
        facts = {k: str(getattr(self, k)) for k in ("seed", "data_sha256", "horizon", "n_steps")}
        return facts | {"spec": self.spec.model_dump_json()}

    def save(self, path: Path) -> None:
        tensors = {f"net.{k}": v for k, v in self.net.state_dict().items()}
        tensors |= {f"ema.{k}": v for k, v in self.ema.state_dict().items()}
        for index, state in self.optimiser.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{k}": v for k, v in state.items()}
        tensors["generator"] = self.generator.get_state()
        facts = {
            k: str(getattr(self, k)) for k in ("step", "loss_average", "mse_average", "wall_s")
        } | self._task()
        write_safetensors(path, {k: v.cpu().contiguous() for k, v in tensors.items()}, facts)

    def load(self, path: Path) -> None:
        tensors, facts = read_safetensors(
            path, "start without --resume to train from the beginning"
        )
        for name, mine in self._task().items():
            if facts.get(name) != mine:
                raise CheckpointError(
                    f"{shown(path)}: its {name} is {facts.get(name)}, here it is {mine}; leave --resume out, or train as before"
                )
        self.net.load_state_dict({k[4:]: v for k, v in tensors.items() if k.startswith("net.")})
        self.ema.load_state_dict({k[4:]: v for k, v in tensors.items() if k.startswith("ema.")})
        adam = self.optimiser.state_dict()
        for name, value in tensors.items():
            if name.startswith("adam."):
                _, index, key = name.split(".")
                adam["state"].setdefault(int(index), {})[key] = value
        self.optimiser.load_state_dict(adam)
        self.generator.set_state(tensors["generator"])
        self.step = int(facts["step"])
        self.loss_average, self.mse_average = (
            float(facts["loss_average"]),
            float(facts["mse_average"]),
        )
        self.wall_s = float(facts["wall_s"])


def _average(old: float, new: float) -> float:
    return new if math.isnan(old) else 0.999 * old + 0.001 * new


def data_statistics(task: Task, episodes: list[Any], horizon: int) -> dict[str, float]:
    """What plans are held against: jumps between waypoints, accelerations, mean speeds over one horizon."""
    if not task.positions:
        return {}
    at = [task.layout.index(name) for name in task.positions]
    jump = np.concatenate([np.linalg.norm(np.diff(e[:, at], axis=0), axis=1) for e in episodes])
    facts = {"jump_q999": np.quantile(jump, 0.999), "jump_max": jump.max()}
    if task.velocities:
        rate = [task.layout.index(name) for name in task.velocities]
        change = (
            np.concatenate([np.linalg.norm(np.diff(e[:, rate], axis=0), axis=1) for e in episodes])
            / task.dt
        )
        facts |= {"acceleration_q999": np.quantile(change, 0.999), "acceleration_max": change.max()}
    long = [e for e in episodes if len(e) >= horizon]
    travelled = [
        np.convolve(
            np.linalg.norm(np.diff(e[:, at], axis=0), axis=1), np.ones(horizon - 1), "valid"
        )
        for e in long
    ]
    speed = np.concatenate(travelled) / ((horizon - 1) * task.dt)
    facts |= {
        "speed_q50": np.quantile(speed, 0.5),
        "speed_q95": np.quantile(speed, 0.95),
        "speed_max": speed.max(),
    }
    return {name: round(float(value), 5) for name, value in facts.items()}
