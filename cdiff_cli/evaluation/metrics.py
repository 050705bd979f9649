"""Every reported number, as a pure function of saved arrays.

Arrays are float64 and in environment units. x is [n, horizon, dim]: n plans, or n executed
episodes. g is the compiled constraint, positive where unsafe. columns.py defines each metric in
words.
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
from cdiff_cli.planning.episodes import Episodes
from cdiff_cli.tasks.protocol import Task, walls_of

SAFE = 1e-6  # largest g that counts as safe in shares: rounding of float32; certificates allow none
SMOOTH = 1.2  # largest jump of a smooth plan, over the 99.9 % quantile of the data
REACHED = 1e-5  # largest residual of a step that the dynamics make, environment units
SATURATED = 1e-6  # largest distance of a saturated input from its bound, units of the input
SUMMED_INFO = ("contact",)  # entries of `info` whose sum over an episode becomes a metric


# constraints -------------------------------------------------------------------------------------


def violation(g: Constraint, x: Array) -> Array:
    """Sum over waypoints and rows of [g]_+ [n]: the paper's total violation."""
    return _rows(g, x).clamp_min(0).nan_to_num(0.0).sum(1).numpy()


def worst_waypoint(g: Constraint, x: Array) -> Array:
    """Largest g over all rows [n]; positive is unsafe, -inf without constraints."""
    return _largest(_rows(g, x)).numpy()


def worst_segment(g: Constraint, x: Array) -> Array:
    """Largest g on the straight segments between waypoints [n].

    It is exact for half-spaces, quadrics, balls and ellipsoids.
    """
    rows = [part.segment_max(torch.from_numpy(x)) for part in g.parts]
    none = torch.empty(len(x), 0, dtype=torch.float64)
    return _largest(torch.cat(rows, 1) if rows else none).numpy()


def unsafe_segments(g: Constraint, x: Array) -> Array:
    """Number of segments between waypoints [n] on which some g exceeds SAFE.

    Constraints that say nothing about segments are left out.
    """
    unsafe = torch.zeros(len(x), max(x.shape[1] - 1, 1), dtype=torch.bool)
    for part in g.parts:
        rows = part.segment_max(torch.from_numpy(x))
        if part.spans and rows.shape == unsafe.shape:
            unsafe |= rows > SAFE
    return unsafe.sum(1).double().numpy()


def boundary_mass(g: Constraint, x: Array, within: float) -> float:
    """Share of samples that are unsafe or at most `within` inside the boundary: g >= -within."""
    return float((_rows(g, x).amax(1) >= -within).double().mean())


# motion ------------------------------------------------------------------------------------------


def distance(x: Array, x_free: Array, columns: Sequence[int], power: float = 1.0) -> Array:
    """Sum over waypoints of |p - p_free| ** power [n], p the positions; x_free broadcasts."""
    length: Array = np.linalg.norm((x - x_free)[..., columns], axis=-1)
    return np.asarray((length**power).sum(-1))


def jump(x: Array, columns: Sequence[int]) -> Array:
    """Largest distance between neighbouring waypoints [n]."""
    return _steps(x, columns).max(-1, initial=0.0)


def smooth(jump: float, usual: float) -> bool:
    """Whether the largest jump of a plan is usual: at most 1.2 times the data's 99.9 % quantile."""
    return jump <= SMOOTH * usual


def mean_speed(x: Array, columns: Sequence[int], dt: float) -> Array:
    """Length of the path over its duration [n], position units per second."""
    return np.asarray(_steps(x, columns).sum(-1) / (dt * max(x.shape[1] - 1, 1)))


def residual(x: Array, positions: Sequence[int], velocities: Sequence[int], dt: float) -> Array:
    """Mean over waypoints of |p' - p - v' dt| [n]: contradiction of positions and velocities."""
    gap = np.diff(x[..., positions], axis=1) - dt * x[:, 1:][..., velocities]
    return np.asarray(np.linalg.norm(gap, axis=-1).mean(-1))


def acceleration(x: Array, velocities: Sequence[int], dt: float) -> Array:
    """Largest |v' - v| / dt [n], velocity units per second."""
    return np.asarray(_steps(x, velocities).max(-1, initial=0.0) / dt)


def effort(dynamics: LinearDynamics, x: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Largest input that a step of each plan needs, over its bound [n]; whether it is feasible [n].

    The input is the least-squares solution of x' = A x + B u + c. A plan is feasible if inputs
    within the bounds make its every step, to REACHED.
    """
    states = torch.from_numpy(x)
    middle, half = (dynamics.high + dynamics.low) / 2, (dynamics.high - dynamics.low) / 2
    share = ((dynamics.unbounded_inputs(states) - middle) / half).abs().flatten(1)
    return _largest(share).numpy(), (dynamics.residual(states) <= REACHED).all(1).numpy()


def hits_wall(x: Array, columns: Sequence[int], boxes: Array) -> NDArray[np.bool_]:
    """Whether a waypoint or a segment between waypoints enters a box [n]; touching is no hit.

    columns   the two positions
    boxes     (x_min, y_min, x_max, y_max)   [k, 4]
    """
    if x.shape[1] == 1:
        x = x.repeat(2, axis=1)  # a waypoint is a segment of length zero
    hit = np.zeros(len(x), dtype=bool)
    p = x[:, :-1][..., columns]
    d = x[:, 1:][..., columns] - p
    for box in boxes:
        enter, leave = _slab(p, d, box[:2], box[2:])
        hit |= (np.maximum(enter, 0) < np.minimum(leave, 1)).any(1)
    return hit


def _slab(p: Array, d: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Interval of s in which the line p + s d is between both pairs of sides of a box.

    Where d is zero in a coordinate, the line is between that pair always or never.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        to_low, to_high = (low - p) / d, (high - p) / d
    steady, between = d == 0, (p > low) & (p < high)
    always = np.where(between, -np.inf, np.inf)
    enter = np.where(steady, always, np.minimum(to_low, to_high)).max(-1)
    leave = np.where(steady, -always, np.maximum(to_low, to_high)).min(-1)
    return enter, leave


# cost --------------------------------------------------------------------------------------------


def overhead(total_s: float, network_s: float) -> float:
    """Time outside the network over time inside it, %."""
    return 100.0 * (total_s - network_s) / max(network_s, 1e-9)


# one row per plan or episode ---------------------------------------------------------------------


def plan_metrics(
    task: Task, g: Constraint, x: Array, x_free: Array, paper_units: Any
) -> list[dict[str, float]]:
    """The metrics of each plan.

    A single plan has no distance to the mean plan. Speed, residual and acceleration need
    velocities in the state; wall hits need walls.

    x_free        unconstrained plans from the same noise   [n, horizon, dim]
    paper_units   scale of the violation and power of the distance in the paper's tables
    """
    positions = [task.layout.index(name) for name in task.positions]
    velocities = [task.layout.index(name) for name in task.velocities]
    walls = walls_of(task)
    total, worst, between = violation(g, x), worst_waypoint(g, x), worst_segment(g, x)
    measured: dict[str, Any] = {
        "violation": total,
        "worst_waypoint": worst,
        "worst_segment": between,
        "unsafe_segments": unsafe_segments(g, x),
        "safe_waypoints": worst <= SAFE,
        "safe_segments": (worst <= SAFE) & (between <= SAFE),
        "distance": distance(x, x_free, positions),
        "violation_paper": total * paper_units.violation,
        "jump": jump(x, positions),
    }
    if len(x) > 1:
        mean = x_free.mean(0, keepdims=True)
        measured["distance_paper"] = distance(x, mean, positions, paper_units.distance_power)
    if velocities:
        measured |= {
            "mean_speed": mean_speed(x, positions, task.dt),
            "residual": residual(x, positions, velocities, task.dt),
            "acceleration": acceleration(x, velocities, task.dt),
        }
    if len(walls):
        measured["wall"] = hits_wall(x, positions, walls)
    return [{name: float(values[i]) for name, values in measured.items()} for i in range(len(x))]


def rollout_metrics(
    g: Constraint, x: Array, reward: Array, success: NDArray[np.bool_], goal_distance: Array
) -> list[dict[str, float]]:
    """The metrics of each executed plan; states after the end of an episode are NaN."""
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
    """Value f of each constraint at every executed state [n, steps + 1, parts].

    Each state is judged by what was observed at its own time.

    observed   quantities by name, each [n, steps + 1]
    """
    flat = {name: torch.from_numpy(values.reshape(-1)) for name, values in observed.items()}
    states = torch.from_numpy(np.ascontiguousarray(x.reshape(-1, 1, x.shape[-1]), dtype=np.float64))
    return g.bind(flat, dt, 1).state_values(states).numpy().reshape(*x.shape[:2], len(g.parts))


def control_metrics(
    episodes: Episodes, levels: Array, bounds: tuple[Array, Array]
) -> list[dict[str, float]]:
    """The metrics of each closed-loop episode.

    Of the numbers that an environment reports in `info`, only SUMMED_INFO becomes a metric, as a
    sum over the episode: "contact" becomes "contacts". An episode with a state that is not finite
    is not safe. Latency is that of all episodes together, and equal in every row.

    levels   f at the executed states, by executed_levels()   [n, steps + 1, parts]
    bounds   lowest and highest input                         [m] each
    """
    latency, network = episodes.latency_s, float(np.median(episodes.network_s))
    cost = {
        "latency_ms": 1e3 * float(np.median(latency)),
        "latency_p95": 1e3 * float(np.quantile(latency, 0.95)),
        "overhead": overhead(float(np.median(latency)), network),
    }
    safety, running = _safety_metrics(episodes, levels), _run_metrics(episodes, bounds)
    return [
        safety[i] | running[i] | cost | _summed_info(episodes, i) for i in range(len(episodes.x))
    ]


def _safety_metrics(episodes: Episodes, levels: Array) -> list[dict[str, float]]:
    """Return, and safety of the plans and of the executed states."""
    worst = np.nan_to_num(levels, nan=-np.inf).max(-1, initial=-np.inf)
    excess = np.clip(np.nan_to_num(levels, nan=0.0), 0.0, None)
    unsafe = worst > SAFE
    steps = np.isfinite(episodes.reward).sum(1)
    rows = []
    for i, violations in enumerate(episodes.violation):
        planned = violations[np.isfinite(violations)]
        rows.append(
            {
                "reward": float(np.nansum(episodes.reward[i])),
                "plan_violation": _mean(planned),
                "safe_plans": _mean(planned <= SAFE),
                "safe_executed": float(not unsafe[i].any() and not episodes.diverged[i]),
                "executed_violation": float(excess[i].sum()),
                "executed_worst": float(worst[i].max(initial=-np.inf)),
                "violation_rate": 100.0 * float(unsafe[i].sum()) / max(int(steps[i]) + 1, 1),
                "fell": float(episodes.fell[i]),
                "diverged": float(episodes.diverged[i]),
            }
        )
    return rows


def _run_metrics(episodes: Episodes, bounds: tuple[Array, Array]) -> list[dict[str, float]]:
    """Braked steps and inputs at their bounds, %; number of steps; network calls per plan."""
    low, high = (np.abs(episodes.u - bound) < SATURATED for bound in bounds)
    saturated = low | high
    steps = np.isfinite(episodes.reward).sum(1)
    finite = np.asarray(np.isfinite(episodes.violation).any(1))  # whether any plan was
    return [
        {
            "braked": 100.0 * float(episodes.braked[i, :n].mean()) if n else 0.0,
            "saturation": 100.0 * _mean(saturated[i, :n]),
            "steps": float(n),
            "calls": float(np.nanmean(episodes.calls[i])) if finite[i] else math.nan,
        }
        for i, n in enumerate(steps)
    ]


def _summed_info(episodes: Episodes, i: int) -> dict[str, float]:
    return {
        f"{name}s": float(np.nansum(episodes.info[name][i]))
        for name in SUMMED_INFO
        if name in episodes.info
    }


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if values.size else math.nan


def _rows(g: Constraint, x: Array) -> torch.Tensor:
    return g(torch.from_numpy(np.ascontiguousarray(x, dtype=np.float64)))


def _largest(rows: torch.Tensor) -> torch.Tensor:
    """Largest entry of each row without NaN; -inf for an empty row."""
    if rows.shape[1] == 0:
        return torch.full((len(rows),), -torch.inf, dtype=torch.float64)
    return rows.nan_to_num(-torch.inf, posinf=torch.inf, neginf=-torch.inf).amax(1)


def _steps(x: Array, columns: Sequence[int]) -> Array:
    """Distance between neighbouring waypoints [n, horizon - 1]."""
    return np.asarray(np.linalg.norm(np.diff(x[..., columns], axis=1), axis=-1))
