"""Linear dynamics with bounded inputs: what they make, their rows, fitting them.

    x^{tau+1} = A x^tau + B u^tau + c,   low <= u <= high

The nearest trajectory that they make is found in projection/dynamics.py.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj, each_end
from cdiff_cli.constraints.state_sets import selected
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint


@dataclass(frozen=True)
class LinearDynamics:
    """x' = A x + B u + c with low <= u <= high.

    A [n, n], B [n, m], c [n], low, high [m]
    """

    A: Tensor
    B: Tensor
    c: Tensor
    low: Tensor
    high: Tensor

    def __call__(self, x: Tensor, u: Tensor) -> Tensor:
        return x @ self.A.T + u @ self.B.T + self.c

    def to(self, like: Tensor) -> "LinearDynamics":
        return LinearDynamics(*(v.to(like) for v in (self.A, self.B, self.c, self.low, self.high)))

    def rollout(self, x0: Tensor, u: Tensor) -> Traj:
        """States from x0 [batch, n] under the inputs u [batch, horizon - 1, m]: [batch, horizon, n]."""
        x, power, reach = torch.cat((x0[:, None], u @ self.B.T + self.c), 1), self.A, 1
        while reach < x.shape[1]:  # each state then holds what its last `reach` steps contribute
            x = torch.cat((x[:, :reach], x[:, reach:] + x[:, :-reach] @ power.T), 1)
            power, reach = power @ power, 2 * reach
        return x

    def wanted(self, x: Traj) -> Tensor:
        """The inputs that come closest to producing x, whatever their size [batch, horizon - 1, m]."""
        return (x[:, 1:] - x[:, :-1] @ self.A.T - self.c) @ torch.linalg.pinv(self.B).T

    def inputs(self, x: Traj) -> Tensor:
        """The same, cut to the inputs' bounds."""
        return torch.clamp(self.wanted(x), self.low, self.high)

    def residual(self, x: Traj) -> Tensor:
        """|x' - A x - B u - c| of each step under those inputs [batch, horizon - 1]."""
        return (x[:, 1:] - self(x[:, :-1], self.inputs(x))).norm(dim=-1)


@dataclass(frozen=True, eq=False)
class LinearDynamicsConstraint:
    """Each step is one that the dynamics can make: |x' - A x - B u - c| <= tolerance for some u within its bounds. A row a step.

    dynamics       environment units
    centre, scale  of the trajectories it is applied to: x = centre + scale * z   [n]
    weight         of each coordinate in the distance of its projection, environment units   [n]
    """

    name: str
    dynamics: LinearDynamics
    centre: Tensor
    scale: Tensor
    weight: Tensor
    tolerance: float

    trailing: ClassVar = {"centre": 1, "scale": 1}
    spans = False  # between two states there is nothing to obey
    affine = False  # rows are absolute values

    @classmethod
    def from_dynamics(
        cls, name: str, dynamics: LinearDynamics, tolerance: float
    ) -> "LinearDynamicsConstraint":
        """Of trajectories in environment units, every coordinate weighing 1."""
        one = torch.ones_like(dynamics.c)
        return cls(name, dynamics, torch.zeros_like(one), one, one, tolerance)

    def labels(self, horizon: int) -> list[str]:
        return [f"{self.name}@{tau}-{tau + 1}" for tau in range(horizon - 1)]

    def decode(self, z: Traj) -> Traj:
        return self.centre + self.scale * z

    def encode(self, x: Traj) -> Traj:
        return (x - self.centre) / self.scale

    def __call__(self, x: Traj) -> Rows:
        return self.dynamics.residual(self.decode(x)) - self.tolerance

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        state = self.decode(x)
        miss = state[:, 1:] - self.dynamics(state[:, :-1], self.dynamics.inputs(state))
        length = miss.norm(dim=-1)
        unit = miss / length[..., None].clamp_min(1e-12)
        first, last = each_end(self.scale, 1)
        back, on = unit @ self.dynamics.A * first, unit * last

        def pull(w: Rows) -> Traj:
            out = torch.zeros_like(x)
            out[:, :-1] -= w[..., None] * back
            out[:, 1:] += w[..., None] * on
            return out

        return length - self.tolerance, pull, 2 * (back.square().sum(-1) + on.square().sum(-1))

    def pull_back(self, centre: Tensor, scale: Tensor) -> "LinearDynamicsConstraint":
        return replace(self, centre=self.centre + self.scale * centre, scale=self.scale * scale)

    def select(self, which: Tensor) -> "LinearDynamicsConstraint":
        return selected(self, which)

    def to(self, like: Tensor) -> "LinearDynamicsConstraint":
        moved = {
            name: getattr(self, name).to(like) for name in ("dynamics", "centre", "scale", "weight")
        }
        return replace(self, **moved)

    def tighten(self, margin: float) -> "LinearDynamicsConstraint":
        return replace(self, tolerance=self.tolerance - margin)

    tighten_level = tighten

    def segment_max(self, x: Traj) -> Rows:
        """A step's own row."""
        return self(x)

    def state_values(self, x: Traj) -> Rows:
        return torch.nn.functional.pad(self(x), (1, 0), value=-torch.inf)

    def on_segments(self) -> tuple[TrajectoryConstraint, ...]:
        return (self,)


def dynamics_of(g: Constraint) -> list[LinearDynamicsConstraint]:
    """The parts that ask for dynamics to be obeyed."""
    return [part for part in g.parts if isinstance(part, LinearDynamicsConstraint)]


def split(g: Constraint) -> tuple[Constraint, Constraint]:
    """g without its dynamics, and its dynamics alone."""
    found = dynamics_of(g)
    if not found:
        return g, Constraint(())
    return Constraint(tuple(part for part in g.parts if part not in found)), Constraint(
        tuple(found)
    )
