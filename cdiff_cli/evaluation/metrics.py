"""Every reported number, as a pure function of saved arrays in environment units, float64. Definitions: README, Metrics.

x is always [n, horizon, dim]; g is the compiled constraint in environment units, positive where unsafe.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.dynamics import LinearDynamics
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.tasks.protocol import Task

SAFE = 1e-6  # g up to here counts as safe in shares: the rounding of float32 samplers. Certificates allow nothing


def violation(g: Constraint, x: Array) -> Array:
    """Sum over waypoints and rows of [g]_+ [n]: the paper's total violation."""
    return _rows(g, x).clamp_min(0).nan_to_num(0.0).sum(1).numpy()


def worst_waypoint(g: Constraint, x: Array) -> Array:
    """Largest g over all rows [n]; positive is unsafe."""
    return _largest(_rows(g, x)).numpy()


def worst_segment(g: Constraint, x: Array) -> Array:
    """Largest g on the straight segments between waypoints [n], exact for half-spaces, quadrics, balls and ellipsoids."""
    each = [part.segment_max(torch.from_numpy(x)) for part in g.parts]
    return _largest(
        torch.cat(each, 1) if each else torch.empty(len(x), 0, dtype=torch.float64)
    ).numpy()


def unsafe_segments(g: Constraint, x: Array) -> Array:
    """Number of segments between waypoints [n] on which some g exceeds SAFE; parts that say nothing of segments are left out."""
    unsafe = torch.zeros(len(x), max(x.shape[1] - 1, 1), dtype=torch.bool)
    for part in g.parts:
        rows = part.segment_max(torch.from_numpy(x))
        if part.spans and rows.shape == unsafe.shape:
            unsafe |= rows > SAFE
    return unsafe.sum(1).double().numpy()


def distance(x: Array, x_free: Array, columns: Sequence[int], power: float = 1.0) -> Array:
    """Sum over waypoints of |position - position of x_free| ** power [n]; x_free broadcasts (the paper's mean plan)."""
    length: Array = np.linalg.norm((x - x_free)[..., columns], axis=-1)
    return np.asarray((length**power).sum(-1))


def jump(x: Array, columns: Sequence[int]) -> Array:
    """Largest distance between neighbouring waypoints [n]."""
    return _steps(x, columns).max(-1, initial=0.0)


def smooth(jump: float, usual: float) -> bool:
    """Whether a plan's largest jump is at most 1.2 times the data's 99.9 % quantile."""
    return jump <= 1.2 * usual


def overhead(total_s: float, network_s: float) -> float:
    """Time outside the network over time inside it, %."""
    return 100.0 * (total_s - network_s) / max(network_s, 1e-9)


def mean_speed(x: Array, columns: Sequence[int], dt: float) -> Array:
    """Length of the path over its duration [n]."""
    return np.asarray(_steps(x, columns).sum(-1) / (dt * max(x.shape[1] - 1, 1)))


def residual(x: Array, positions: Sequence[int], velocities: Sequence[int], dt: float) -> Array:
    """Mean over waypoints of |p' - p - v' dt| [n]: how far positions and velocities contradict each other."""
    gap = np.diff(x[..., positions], axis=1) - dt * x[:, 1:][..., velocities]
    return np.asarray(np.linalg.norm(gap, axis=-1).mean(-1))


def acceleration(x: Array, velocities: Sequence[int], dt: float) -> Array:
    """Largest |v' - v| / dt [n]."""
    return np.asarray(_steps(x, velocities).max(-1, initial=0.0) / dt)


def effort(dynamics: LinearDynamics, x: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Largest input that a step of each plan asks for, over its bound (least squares); and whether the dynamics make every
    step, to 1e-5, within the bounds. Both [n]
    """
    states = torch.from_numpy(x)
    middle, half = (dynamics.high + dynamics.low) / 2, (dynamics.high - dynamics.low) / 2
    asked = ((dynamics.unbounded_inputs(states) - middle) / half).abs().flatten(1)
    return _largest(asked).numpy(), (dynamics.residual(states) <= 1e-5).all(1).numpy()


def hits_wall(x: Array, columns: Sequence[int], boxes: Array) -> NDArray[np.bool_]:
    """Whether a waypoint or a segment between waypoints enters a box (x_min, y_min, x_max, y_max) [n]."""
    if len(boxes) == 0:
        return np.zeros(len(x), dtype=bool)
    if x.shape[1] == 1:
        x = x.repeat(2, axis=1)  # a segment of no length: the waypoint itself
    hit = np.zeros(len(x), dtype=bool)
    p = x[:, :-1][..., columns]
    d = x[:, 1:][..., columns] - p
    with np.errstate(divide="ignore", invalid="ignore"):
        for (
            box
        ) in boxes:  # slab test: the segment is inside while it is between both pairs of sides
            near, far = (box[:2] - p) / d, (box[2:] - p) / d
            still = d == 0
            between = (p > box[:2]) & (p < box[2:])
            enter = np.where(still, np.where(between, -np.inf, np.inf), np.minimum(near, far)).max(
                -1
            )
            leave = np.where(still, np.where(between, np.inf, -np.inf), np.maximum(near, far)).min(
                -1
            )
            hit |= (np.maximum(enter, 0) < np.minimum(leave, 1)).any(1)
    return hit


def plan_metrics(
    task: Task, g: Constraint, x: Array, x_free: Array, paper_units: Any
) -> list[dict[str, float]]:
    """The metrics of each plan."""
    at = [task.layout.index(name) for name in task.positions]
    columns: dict[str, Array] = {
        "violation": violation(g, x),
        "worst_waypoint": worst_waypoint(g, x),
        "worst_segment": worst_segment(g, x),
        "unsafe_segments": unsafe_segments(g, x),
        "safe_waypoints": (worst_waypoint(g, x) <= SAFE).astype(np.float64),
        "safe_segments": ((worst_waypoint(g, x) <= SAFE) & (worst_segment(g, x) <= SAFE)).astype(
            np.float64
        ),
        "distance": distance(x, x_free, at),
        "violation_paper": violation(g, x) * paper_units.violation,
        "jump": jump(x, at),
    }
    if len(x) > 1:  # a single plan is its own mean
        columns["distance_paper"] = distance(
            x, x_free.mean(0, keepdims=True), at, paper_units.distance_power
        )
    if task.velocities:
        rate = [task.layout.index(name) for name in task.velocities]
        columns |= {
            "mean_speed": mean_speed(x, at, task.dt),
            "residual": residual(x, at, rate, task.dt),
            "acceleration": acceleration(x, rate, task.dt),
            "wall": hits_wall(x, at, task.walls()).astype(np.float64),
        }
    return [{name: float(values[i]) for name, values in columns.items()} for i in range(len(x))]


def rollout_metrics(
    g: Constraint, x: Array, reward: Array, success: NDArray[np.bool_], goal_distance: Array
) -> list[dict[str, float]]:
    """The metrics of each executed episode; states after its end are NaN."""
    rows = _rows(g, x)
    steps = np.isfinite(x).all(-1).sum(1) - 1
    unsafe = (g.state_values(torch.from_numpy(x)) > SAFE).any(-1).numpy()
    return [
        {
            "reward": float(np.nansum(reward[i])),
            "safe_executed": float(not unsafe[i].any()),
            "executed_violation": float(rows[i].clamp_min(0).nan_to_num(0.0).sum()),
            "executed_worst": float(_largest(rows[i : i + 1])[0]),
            "violation_rate": 100.0 * float(unsafe[i].sum()) / max(int(steps[i]) + 1, 1),
            "steps": float(steps[i]),
            "success": float(success[i]),
            "goal_distance": float(goal_distance[i]),
        }
        for i in range(len(x))
    ]


def executed_levels(g: Constraint, x: Array, observed: Mapping[str, Array], dt: float) -> Array:
    """Value of each part's level at every executed state, each against what was observed at its own time [n, steps + 1, parts].

    observed   quantities by name, each [n, steps + 1]
    """
    flat = {name: torch.from_numpy(values.reshape(-1)) for name, values in observed.items()}
    states = torch.from_numpy(np.ascontiguousarray(x.reshape(-1, 1, x.shape[-1]), dtype=np.float64))
    return g.bind(flat, dt, 1).state_values(states).numpy().reshape(*x.shape[:2], len(g.parts))


def control_metrics(
    episodes: Any, levels: Array, bounds: tuple[Array, Array]
) -> list[dict[str, float]]:
    """The metrics of each closed-loop episode.

    episodes   as receding_horizon.py returns them
    levels     of the executed states [n, steps + 1, parts], by executed_levels
    bounds     lowest and highest input [m]
    """
    over = np.nan_to_num(levels, nan=-np.inf).max(-1, initial=-np.inf)
    steps = np.isfinite(episodes.reward).sum(1)
    saturated = (np.abs(episodes.u - bounds[0]) < 1e-6) | (np.abs(episodes.u - bounds[1]) < 1e-6)
    rows = []
    for i, (worst, count) in enumerate(zip(over, steps, strict=True)):
        made = episodes.violation[i][np.isfinite(episodes.violation[i])]
        excess = np.clip(np.nan_to_num(levels[i], nan=0.0), 0.0, None)
        row = {
            "reward": float(np.nansum(episodes.reward[i])),
            "plan_violation": float(made.mean()) if len(made) else math.nan,
            "safe_plans": float((made <= SAFE).mean()) if len(made) else math.nan,
            "safe_executed": float(
                not (worst > SAFE).any() and not episodes.diverged[i]
            ),  # a lost state is not safe
            "executed_violation": float(excess.sum()),
            "executed_worst": float(worst.max(initial=-np.inf)),
            "violation_rate": 100.0 * float((worst > SAFE).sum()) / max(int(count) + 1, 1),
            "fell": float(episodes.fell[i]),
            "diverged": float(episodes.diverged[i]),
            "braked": 100.0 * float(episodes.braked[i, :count].mean()) if count else 0.0,
            "saturation": 100.0 * float(saturated[i, :count].mean()) if count else math.nan,
            "steps": float(count),
            "calls": float(np.nanmean(episodes.calls[i])) if len(made) else math.nan,
            "latency_ms": 1e3 * float(np.median(episodes.latency_s)),
            "latency_p95": 1e3 * float(np.quantile(episodes.latency_s, 0.95)),
            "overhead": overhead(
                float(np.median(episodes.latency_s)), float(np.median(episodes.network_s))
            ),
        }
        rows.append(
            row
            | {
                f"{name}s": float(np.nansum(told[i]))
                for name, told in episodes.info.items()
                if name == "contact"
            }
        )
    return rows


def boundary_mass(g: Constraint, x: Array, within: float) -> float:
    """Share of samples at most `within` inside the boundary of the allowed set (0 <= -g <= within, or unsafe)."""
    return float((_rows(g, x).amax(1) >= -within).double().mean())


def _rows(g: Constraint, x: Array) -> torch.Tensor:
    return g(torch.from_numpy(np.ascontiguousarray(x, dtype=np.float64)))


def _largest(rows: torch.Tensor) -> torch.Tensor:
    """Largest entry of each row, NaN left out; -inf where there is none."""
    if rows.shape[1] == 0:
        return torch.full((len(rows),), -torch.inf, dtype=torch.float64)
    return rows.nan_to_num(-torch.inf, posinf=torch.inf, neginf=-torch.inf).amax(1)


def _steps(x: Array, columns: Sequence[int]) -> Array:
    return np.asarray(np.linalg.norm(np.diff(x[..., columns], axis=1), axis=-1))
