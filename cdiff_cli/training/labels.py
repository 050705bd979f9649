"""Classifier-free conditioning: labels of training windows by constraints, what is observed beside them, the guided estimate."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.observed import ObservedValues
from cdiff_cli.constraints.spec.load import kinds_sha256, load_constraints
from cdiff_cli.constraints.trajectory import Constraint

LABELS = 2  # entries of a label


@dataclass(frozen=True)
class ConstraintLabel:
    """Constraints that a planner is conditioned on.

    name      of the constraint file, without its ending
    g         environment units
    sha256    of what the file says, comments left out
    observed  names of the quantities that g waits for
    """

    name: str
    g: Constraint
    sha256: str
    observed: tuple[str, ...] = ()

    @classmethod
    def read(cls, path: Path, task: Any) -> "ConstraintLabel":
        """The constraints of a file; raises SpecError."""
        observable = getattr(task, "observable", ())
        kinds, g = load_constraints(
            path, task.name, task.layout, None, observable, getattr(task, "dt", None)
        )
        return cls(
            path.stem,
            g,
            kinds_sha256(kinds),
            tuple(name for name in observable if name in g.observes),
        )

    @property
    def entries(self) -> int:
        """What a network is told: a label, and each quantity."""
        return LABELS + len(self.observed)

    def label(self, x: Traj, seen: ObservedValues | None = None, dt: float = 1.0) -> Tensor:
        """(1 where a window obeys g, else -1; its largest g clipped to [0, 1]) [batch, 2]. x in environment units.

        seen   what is observed at the first waypoint of each window
        dt     seconds between waypoints
        """
        g = self.g.bind(seen or {}, dt, x.shape[1])
        worst = g.to(x)(x).amax(1)
        return torch.stack((torch.where(worst <= 0, 1.0, -1.0), worst.clamp(0.0, 1.0).float()), 1)


def drop(label: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """The labels with that share of them, drawn at random, replaced by zeros: no condition."""
    keep = torch.rand(len(label), 1, generator=generator) >= share
    return label * keep
