"""The final projection of finished plans, in float64."""

import numpy as np
import torch
from torch import Tensor

from cdiff_cli.arrays import Array, Traj
from cdiff_cli.constraints.dynamics import LinearDynamicsConstraint, dynamics_of, split
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.planning.problem import POLISH_MARGIN, Problem
from cdiff_cli.projection.project import project, project_reachable

FALLBACK_CLEARANCE = 1e-5
"""Clearance for plans that the task's own clearance makes infeasible, units of g."""

TOLERANCES = (5e-4, 5e-5, 5e-6)
"""Tolerances of the projection with dynamics, one after the other, environment units."""


def polish_plans(problem: Problem, z: Traj) -> tuple[Traj, Array, Array | None]:
    """Finished plans projected onto all constraints, tightened a little.

    z   normalised, float64 [n, horizon, dim]
    Returns the plans, their largest displacement [n] in environment units, and, where dynamics are
    enforced, the inputs [n, horizon - 1, m] that produce them to rounding.
    Raises InfeasibleError where no trajectory is found.
    """
    pins = problem.pins(len(z), torch.float64, torch.device("cpu"))
    centre, scale = problem.normaliser.centre, problem.normaliser.scale
    inputs = None
    if dynamics_of(problem.enforced):
        out, inputs = _with_dynamics(problem, z, pins)
    else:
        out = project(pull_back(problem.enforced.tighten(POLISH_MARGIN), centre, scale), z, pins)
    shift = (scale * (out - z))[..., problem.planner.position_columns].norm(dim=-1).amax(1)
    return out, shift.numpy(), inputs


def _with_dynamics(problem: Problem, z: Traj, pins: Pins) -> tuple[Traj, Array]:
    """Plans near z that the dynamics produce, and their inputs.

    Solved ever more finely until the rollout of the inputs is safe and ends where it is pinned. A
    plan that cannot keep the task's clearance, as from a start that does not, keeps
    FALLBACK_CLEARANCE if that is safe.
    """
    (constraint,) = dynamics_of(problem.enforced)
    others, clearance = split(problem.enforced)[0], problem.tolerances.clearance
    todo, warm = torch.arange(len(z)), None
    u = torch.zeros(len(z), z.shape[1] - 1, constraint.dynamics.B.shape[1], dtype=z.dtype)
    x = z.clone()
    tries = [(clearance, tolerance) for tolerance in TOLERANCES]
    for margin, tolerance in (*tries, (FALLBACK_CLEARANCE, TOLERANCES[-1])):
        first = margin == clearance
        inside = Constraint((constraint, *others.tighten(margin).parts))
        g = pull_back(inside, problem.normaliser.centre, problem.normaliser.scale).select(todo)
        pinned = Pins(pins.mask, pins.values[todo])
        near, warm = project_reachable(g, z[todo], pinned, warm if first else None, tolerance)
        path, inputs = _rolled_out(problem, constraint, near, warm.u)
        wrong = _misses(problem, path, pinned) | _unsafe(problem, others, path)
        kept = ~wrong | first
        x[todo[kept]], u[todo[kept]] = path[kept], inputs[kept]
        if not bool(wrong.any()):
            break
        warm, todo = warm.select(wrong), todo[wrong]
    return x, np.asarray(u)


def _rolled_out(
    problem: Problem, constraint: LinearDynamicsConstraint, near: Traj, u: Tensor
) -> tuple[Traj, Tensor]:
    """What the inputs, clamped to their bounds, produce from the first states."""
    dynamics, normaliser = constraint.dynamics, problem.normaliser
    inputs = torch.clamp(u, dynamics.low, dynamics.high)
    return normaliser.encode(dynamics.rollout(normaliser.decode(near[:, 0]), inputs)), inputs


def _misses(problem: Problem, path: Traj, pins: Pins) -> Tensor:
    """Plans that miss a pinned coordinate by more than the task's tolerance [n]."""
    gap = problem.normaliser.scale * torch.where(pins.mask, path - pins.values, 0.0)
    return gap.abs().amax((1, 2)) > problem.tolerances.position


def _unsafe(problem: Problem, g: Constraint, path: Traj) -> Tensor:
    """Plans that violate g anywhere [n]."""
    return (g(problem.normaliser.decode(path)) > 0).any(1)
