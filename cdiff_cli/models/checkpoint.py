"""Checkpoints: weights as safetensors, and a card with their hash and origin."""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
import yaml
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from cdiff_cli.constraints.dynamics import LinearDynamics
from cdiff_cli.errors import CheckpointError
from cdiff_cli.models.denoiser import ObservationEncoder
from cdiff_cli.models.networks import InverseDynamics, ResidualMlp, TemporalUnet
from cdiff_cli.models.normaliser import Normaliser, ResidualNormaliser
from cdiff_cli.models.recipe import Card, MlpSpec, NetworkSpec
from cdiff_cli.paths import home, shown
from cdiff_cli.yaml_files import load

Network = TemporalUnet | ResidualMlp
RELATIVE_LIMIT = 8.0  # limit of a clean estimate of a relative window, in standard deviations
Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True)
class Checkpoint:
    """A trained denoiser, with its normaliser and dynamics.

    normaliser       environment units to those of the network; with a frame, of the present state
    demonstrations   a few windows of the training data, environment units   [k, horizon, dim]
    dynamics         linear dynamics of the training data, environment units; None if they explain
                     too little of it, or if the data has no inputs
    frame            normaliser of windows relative to their first state; None without
    inverse          inverse dynamics u = IDM(x^0, x^1), environment units; None without
    telling          encoder of the observed quantities of a conditional planner; None without
    """

    net: Network
    normaliser: Normaliser
    demonstrations: Tensor
    card: Card
    path: Path
    dynamics: LinearDynamics | None = None
    frame: ResidualNormaliser | None = None
    inverse: InverseDynamics | None = None
    telling: ObservationEncoder | None = None

    @property
    def limit(self) -> float:
        """Limit of a clean estimate, in normalised coordinates."""
        return 1.0 if self.frame is None else RELATIVE_LIMIT


def build(dim: int, horizon: int, network: NetworkSpec | MlpSpec) -> Network:
    """A network of that size, with weights drawn from the global generator."""
    if isinstance(network, MlpSpec):
        return ResidualMlp(dim, horizon, network.width, network.depth, network.conditions)
    return TemporalUnet(dim, **network.model_dump(exclude={"kind"}))


def write_safetensors(
    path: Path, tensors: dict[str, Tensor], facts: dict[str, str] | None = None
) -> None:
    """Write a file beside its place and rename it, so that no reader gets half of it."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        save_file(tensors, partial, facts)
        partial.chmod(0o644)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def read_safetensors(path: Path, advice: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a file; the CheckpointError of a bad one ends with the advice."""
    from safetensors import SafetensorError, safe_open

    if not path.exists():
        raise CheckpointError(f"{shown(path)}: no such checkpoint; {advice}")
    try:
        with safe_open(path, "pt") as file:
            facts = dict(file.metadata() or {})
        return load_file(path), facts
    except (SafetensorError, OSError) as error:
        raise CheckpointError(
            f"{shown(path)}: damaged or not a checkpoint ({error}); {advice}"
        ) from None


def save_checkpoint(path: Path, tensors: dict[str, Tensor], card: dict[str, Any]) -> Checkpoint:
    """Write the weights, then the card with their hash; returns the checkpoint as loaded."""
    write_safetensors(path, tensors)
    card |= {"weights_sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    text = yaml.safe_dump(Card(**card).model_dump(mode="json"), sort_keys=False)
    partial = card_path(path).with_name(f".{card_path(path).name}.{os.getpid()}")
    partial.write_text(text)
    os.replace(partial, card_path(path))
    return load_checkpoint(path)


def card_path(path: Path) -> Path:
    """Path of the card of a checkpoint."""
    return path.with_name(path.name.removesuffix(".safetensors") + ".card.yaml")


def install(checkpoint: Checkpoint) -> Path:
    """Copy a finished checkpoint to models/<task>/, where `cdiff plan` looks.

    An older one of the same recipe is kept as <recipe>.previous.
    """
    folder = home() / "models" / checkpoint.card.task
    target = folder / f"{checkpoint.card.recipe}.safetensors"
    if target.exists():
        previous = folder / f"{checkpoint.card.recipe}.previous.safetensors"
        if card_path(target).exists():
            os.replace(card_path(target), card_path(previous))
        os.replace(target, previous)
    tensors, _ = read_safetensors(checkpoint.path, "train again")
    save_checkpoint(target, tensors, checkpoint.card.model_dump(mode="json"))
    return target


def load_checkpoint(
    path: Path, task: str | None = None, device: torch.device | str = "cpu"
) -> Checkpoint:
    """A checkpoint; CheckpointError if it or its card is missing, damaged, or of another task."""
    advice = (
        f"train one with `cdiff train --task {task or path.parent.name}`, "
        "or name another with --checkpoint"
    )
    card = _verified_card(path, task, advice)
    tensors, _ = read_safetensors(path, advice)
    parts: dict[str, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        part, _, rest = name.partition(".")
        parts.setdefault(part, {})[rest] = value
    normaliser, windows = Normaliser(**parts["normaliser"]), parts["demonstrations"][""]
    with torch.random.fork_rng(devices=[]):
        net = build(windows.shape[-1], card.horizon, card.network)
    return Checkpoint(
        _loaded(net, parts["net"], device),
        normaliser,
        windows,
        card,
        path,
        dynamics=LinearDynamics(**parts["dynamics"]) if "dynamics" in parts else None,
        frame=ResidualNormaliser.from_record(normaliser, parts["frame"])
        if "frame" in parts
        else None,
        inverse=_inverse(parts["inverse"], device) if "inverse" in parts else None,
        telling=ObservationEncoder(**parts["telling"]) if "telling" in parts else None,
    )


def _verified_card(path: Path, task: str | None, advice: str) -> Card:
    """The card of a checkpoint, if it belongs to the task and the weights have its hash."""
    if not path.exists():
        raise CheckpointError(f"{shown(path)}: no such checkpoint; {advice}")
    if not card_path(path).exists():
        raise CheckpointError(
            f"{shown(card_path(path))}: the checkpoint's card is missing; {advice}"
        )
    card = load(card_path(path), Card)
    if task is not None and card.task != task:
        raise CheckpointError(
            f"{shown(path)}: a checkpoint of {card.task}, asked for was {task}; {advice}"
        )
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    if sha256 != card.weights_sha256:
        raise CheckpointError(
            f"{shown(path)}: truncated or altered: sha256 {sha256[:12]}..., "
            f"its card says {card.weights_sha256[:12]}...; restore it, or {advice}"
        )
    return card


def _loaded(net: Module, tensors: dict[str, Tensor], device: torch.device | str) -> Module:
    net.load_state_dict({name: value.float() for name, value in tensors.items()})
    return net.to(device).eval().requires_grad_(False)


def _inverse(tensors: dict[str, Tensor], device: torch.device | str) -> InverseDynamics:
    with torch.random.fork_rng(devices=[]):
        net = InverseDynamics(
            tensors["centre"].shape[1], len(tensors["low"]), len(tensors["layers.0.bias"])
        )
    return _loaded(net, tensors, device)
