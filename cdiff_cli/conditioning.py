"""Classifier-free conditioning on constraints: labels of training windows, and the guided clean estimate."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from cdiff_cli.constraint import Constraint, Traj
from cdiff_cli.diffusion import Denoiser

LABELS = 2  # entries of a label


@dataclass(frozen=True)
class Condition:
    """Constraints that a planner is conditioned on.

    name      of the constraint file, without its ending
    g         environment units
    sha256    of what the file says, comments left out
    """

    name: str
    g: Constraint
    sha256: str

    def label(self, x: Traj) -> Tensor:
        """(1 where a window obeys g, else -1; its largest g clipped to [0, 1]) [batch, 2]. x in environment units."""
        worst = self.g.to(x)(x).amax(1)
        return torch.stack((torch.where(worst <= 0, 1.0, -1.0), worst.clamp(0.0, 1.0).float()), 1)


def drop(label: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """The labels with that share of them, drawn at random, replaced by zeros: no condition."""
    keep = torch.rand(len(label), 1, generator=generator) >= share
    return label * keep


def content_sha256(kinds: Sequence[Any]) -> str:
    """Hash of the constraints as read, so that a comment in their file changes nothing."""
    said = [kind.model_dump(mode="json", exclude_none=True) for kind in kinds]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def guided(net: nn.Module, weight: float, limit: float = 1.0) -> Denoiser:
    """x0 = x0(no condition) + weight (x0(obeys) - x0(no condition)) (Ho and Salimans, 2022, Eq. 6 for estimates of x0), clipped to
    the data's limits. Both estimates are made in one batch; weight 1 needs the conditioned one alone.
    """

    def clean(x: Traj, t: int) -> Traj:
        obeys = torch.tensor([1.0, 0.0], device=x.device)
        steps = torch.full((len(x),), float(t), device=x.device)
        if weight == 1.0:
            return net(x, steps, obeys.expand(len(x), -1)).clamp(-limit, limit)
        label = torch.cat((obeys.expand(len(x), -1), torch.zeros(len(x), LABELS, device=x.device)))
        asked, free = net(torch.cat((x, x)), torch.cat((steps, steps)), label).chunk(2)
        return (free + weight * (asked - free)).clamp(-limit, limit)

    return clean
