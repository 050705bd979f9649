"""Linear dynamics with bounded inputs.

    x^{tau+1} = A x^tau + B u^tau + c,   low <= u <= high

projection/dynamics.py finds the nearest trajectory that satisfies them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from cdiff_cli.arrays import Pull, Rows, Traj, each_end
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.protocol import selected
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint, check_fixed_rows


@dataclass(frozen=True)
class LinearDynamics:
    """x' = A x + B u + c with low <= u <= high, in environment units.

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
        """The states [batch, horizon, n] from x0 [batch, n] under u [batch, horizon - 1, m]."""
        x, power, reach = torch.cat((x0[:, None], u @ self.B.T + self.c), 1), self.A, 1
        while reach < x.shape[1]:  # x holds the contribution of the last `reach` steps per state
            x = torch.cat((x[:, :reach], x[:, reach:] + x[:, :-reach] @ power.T), 1)
            power, reach = power @ power, 2 * reach
        return x

    def unbounded_inputs(self, x: Traj) -> Tensor:
        """The inputs that come closest to producing x, without bounds [batch, horizon - 1, m]."""
        return (x[:, 1:] - x[:, :-1] @ self.A.T - self.c) @ torch.linalg.pinv(self.B).T

    def inputs(self, x: Traj) -> Tensor:
        """The inputs that come closest to producing x, clamped to their bounds."""
        return torch.clamp(self.unbounded_inputs(x), self.low, self.high)

    def residual(self, x: Traj) -> Tensor:
        """|x' - A x - B u - c| per step, u = inputs(x) [batch, horizon - 1]."""
        return (x[:, 1:] - self(x[:, :-1], self.inputs(x))).norm(dim=-1)


@dataclass(frozen=True, eq=False)
class LinearDynamicsConstraint:
    """Each step satisfies the dynamics: |x' - A x - B u - c| <= tolerance for some u within bounds.

    One row per step.

    dynamics       environment units
    centre, scale  the trajectories z that it is applied to are x = centre + scale * z        [n]
    weight         weight per coordinate in the distance of the projection, environment units [n]
    tolerance      environment units
    """

    name: str
    dynamics: LinearDynamics
    centre: Tensor
    scale: Tensor
    weight: Tensor
    tolerance: float

    trailing: ClassVar = {"centre": 1, "scale": 1}
    level = None
    support = 2
    spans = False  # dynamics restrict the waypoints alone
    affine = False  # rows are absolute values
    exact_on_segments = True

    @classmethod
    def from_dynamics(
        cls, name: str, dynamics: LinearDynamics, tolerance: float
    ) -> "LinearDynamicsConstraint":
        """The constraint in environment units, with weight 1 for every coordinate."""
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
        """The row of each step."""
        return self(x)

    def segment_argmax(self, x: Traj) -> None:
        return None

    def state_values(self, x: Traj) -> Rows:
        return torch.nn.functional.pad(self(x), (1, 0), value=-torch.inf)

    def on_segments(self) -> tuple[TrajectoryConstraint, ...]:
        return (self,)

    def coordinates(self, dim: int) -> list[int]:
        return list(range(dim))

    def restrict(self, columns: Sequence[int]) -> "LinearDynamicsConstraint":
        """The part itself, because `columns` are all coordinates."""
        return self

    def check_pins(self, pins: Pins, tolerance: float) -> None:
        check_fixed_rows(self, pins, tolerance)


def dynamics_of(g: Constraint) -> list[LinearDynamicsConstraint]:
    """The parts of g that are dynamics."""
    return [part for part in g.parts if isinstance(part, LinearDynamicsConstraint)]


def split(g: Constraint) -> tuple[Constraint, Constraint]:
    """g without its dynamics, and its dynamics alone."""
    dynamics = dynamics_of(g)
    if not dynamics:
        return g, Constraint(())
    others = tuple(part for part in g.parts if part not in dynamics)
    return Constraint(others), Constraint(tuple(dynamics))


def weighted(g: Constraint, weight: Tensor) -> Constraint:
    """g with a weight per coordinate [n] in the distance of every projection onto its dynamics."""
    return Constraint(
        tuple(
            replace(part, weight=weight) if isinstance(part, LinearDynamicsConstraint) else part
            for part in g.parts
        )
    )
