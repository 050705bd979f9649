"""Labels for classifier-free guidance: whether a training window satisfies the constraints."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from cdiff_cli.arrays import Traj
from cdiff_cli.constraints.observed import ObservedValues
from cdiff_cli.constraints.spec.load import kinds_sha256, load_constraints
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.tasks.protocol import Task, observable_of

LABELS = 2  # entries of a label


@dataclass(frozen=True)
class ConstraintLabel:
    """Constraints that a planner is conditioned on.

    name       name of the constraint file, without its ending
    g          environment units
    sha256     hash of the content of the file, without comments
    observed   names of the observed quantities that g depends on
    """

    name: str
    g: Constraint
    sha256: str
    observed: tuple[str, ...] = ()

    @classmethod
    def read(cls, path: Path, task: Task) -> "ConstraintLabel":
        """The constraints of a file; raises SpecError."""
        observable = observable_of(task)
        kinds, g = load_constraints(path, task.name, task.layout, None, observable, task.dt)
        observed = tuple(name for name in observable if name in g.observes)
        return cls(path.stem, g, kinds_sha256(kinds), observed)

    @property
    def entries(self) -> int:
        """Number of inputs that a network gets: the label, and each observed quantity."""
        return LABELS + len(self.observed)

    def label(self, x: Traj, observed: ObservedValues | None = None, dt: float = 1.0) -> Tensor:
        """(1 if a window satisfies g, else -1; its largest g clipped to [0, 1]) [batch, 2].

        x          windows, environment units
        observed   observed quantities at the first waypoint of each window
        dt         time between waypoints [s]
        """
        g = self.g.bind(observed or {}, dt, x.shape[1])
        worst = g.to(x)(x).amax(1)
        return torch.stack((torch.where(worst <= 0, 1.0, -1.0), worst.clamp(0.0, 1.0).float()), 1)


def drop(label: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Labels, a random share of them replaced by zeros, which mean no condition."""
    keep = torch.rand(len(label), 1, generator=generator) >= share
    return label * keep
