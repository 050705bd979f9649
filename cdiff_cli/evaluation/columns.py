"""The columns of rows.csv and of tables: heading, digits, definition, and the tables they form."""

from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]


@dataclass(frozen=True)
class Column:
    """How a metric is shown: heading with unit, digits after the point, definition.

    share   each value is 0 or 1, so that the mean is a rate
    """

    title: str
    digits: int
    meaning: str
    share: bool = False


def _rate(title: str, meaning: str) -> Column:
    return Column(title, 2, meaning, share=True)


COLUMNS = {
    "distance": Column(
        "distance / m",
        2,
        "sum over waypoints of |p - p_free|, p_free the unconstrained plan of the same noise",
    ),
    "violation": Column(
        "violation / g",
        4,
        "sum over waypoints and constraints of [g]_+, in the constraints' own units",
    ),
    "worst_waypoint": Column(
        "worst waypoint / g", 4, "largest g at a waypoint; positive is unsafe"
    ),
    "worst_segment": Column(
        "worst segment / g", 4, "largest g on the straight segments between waypoints"
    ),
    "jump": Column("jump / m", 4, "largest distance between neighbouring waypoints"),
    "mean_speed": Column("speed / m/s", 2, "mean speed of the plan: its length over its duration"),
    "residual": Column("residual / m", 5, "mean of |p' - p - v' dt|: positions against velocities"),
    "acceleration": Column("acceleration / m/s^2", 1, "largest |v' - v| / dt"),
    "smooth": _rate(
        "smooth",
        "share of plans whose largest jump is at most 1.2 times the data's 99.9 % quantile",
    ),
    "torn": _rate(
        "torn",
        "share of plans that are not smooth (the trap rate): they jump across an obstacle",
    ),
    "wall": _rate("in wall", "share of plans with a waypoint or segment inside a wall"),
    "safe_waypoints": _rate(
        "safe at waypoints", "share of plans with no g above 1e-6 at a waypoint"
    ),
    "safe_segments": _rate(
        "safe between", "share of plans with no g above 1e-6 at or between the waypoints"
    ),
    "unsafe_segments": Column(
        "unsafe segments", 1, "number of segments between waypoints on which some g exceeds 1e-6"
    ),
    "feasible": _rate(
        "feasible",
        "share of plans whose every step the fitted dynamics make with inputs within their bounds",
    ),
    "effort": Column(
        "effort",
        2,
        "largest input that a step of the plan needs, over its bound; above 1 no actuator follows",
    ),
    "polish": Column("polish / m", 5, "largest displacement by the final exact projection"),
    "calls": Column("calls", 0, "network calls per plan"),
    "plan_ms": Column("plan / ms", 1, "wall time of the batch over its number of plans"),
    "step_ms": Column("step / ms", 2, "wall time of the batch over its network calls"),
    "overhead": Column("overhead / %", 1, "time outside the network over time inside it"),
    "violation_paper": Column("violation (paper)", 4, "violation in the paper's units"),
    "distance_paper": Column(
        "distance (paper)", 2, "the paper's definition: distance to the mean unconstrained plan"
    ),
    "reward": Column("return", 1, "sum of rewards"),
    "safe_executed": _rate("safe executed", "share of episodes with no unsafe state, g > 1e-6"),
    "executed_violation": Column("executed violation / g", 4, "sum over executed states of [g]_+"),
    "executed_worst": Column("executed worst / g", 4, "largest g of an executed state"),
    "violation_rate": Column("violation rate / %", 2, "share of executed states that are unsafe"),
    "plan_violation": Column(
        "plan violation / g", 4, "violation of a plan, mean over those of the episode"
    ),
    "safe_plans": Column(
        "safe plans", 3, "share of the episode's plans with no g above 1e-6 at a waypoint"
    ),
    "fell": _rate("fell", "share of episodes that the environment ended early"),
    "diverged": _rate("diverged", "share of episodes whose plans or states were not finite"),
    "contacts": Column("contacts", 2, "environment steps in contact with the obstacle"),
    "braked": Column(
        "braked / %", 1, "share of steps at which no plan was feasible and the agent braked instead"
    ),
    "saturation": Column("saturation / %", 1, "share of executed inputs that are at their bounds"),
    "latency_ms": Column(
        "latency / ms", 2, "median wall time of planning per control step, all episodes at once"
    ),
    "latency_p95": Column(
        "latency 95 % / ms", 2, "95 % quantile of the wall time of planning per control step"
    ),
    "steps": Column("steps", 0, "environment steps"),
    "success": _rate(
        "success",
        "share of episodes that end within the environment's success radius of the goal",
    ),
    "goal_distance": Column("goal distance / m", 3, "distance to the goal at the end"),
}
FORMATS = ("rich", "markdown", "latex", "csv", "json")
KEYS = ("task", "constraints", "method", "preset")
PLAN_TABLE = (
    "distance",
    "violation",
    "worst_waypoint",
    "worst_segment",
    "unsafe_segments",
    "torn",
    "jump",
    "mean_speed",
    "calls",
    "plan_ms",
    "step_ms",
)
COSTS = ("calls", "plan_ms", "step_ms", "overhead")
"""Metrics of a method or a batch, not of a seed: no test applies to them."""
QUALITY_TABLE = (
    "wall",
    "smooth",
    "jump",
    "residual",
    "acceleration",
    "mean_speed",
    "success",
    "goal_distance",
)
ROLLOUT_TABLE = (
    "success",
    "executed_violation",
    "executed_worst",
    "violation_rate",
    "goal_distance",
    "reward",
    "steps",
)
SAFETY_TABLE = (
    "safe_waypoints",
    "safe_segments",
    "feasible",
    "safe_executed",
    "violation_rate",
    "success",
    "wall",
    "effort",
    "distance",
)
CONTROL_TABLE = (
    "reward",
    "violation_rate",
    "executed_violation",
    "executed_worst",
    "safe_executed",
    "plan_violation",
    "fell",
    "contacts",
    "braked",
    "saturation",
    "calls",
    "latency_ms",
    "latency_p95",
    "overhead",
)
PAPER_TABLE = ("distance", "distance_paper", "violation_paper", "step_ms")

PLAN_SHORT_TABLE = ("violation", "safe_segments", "torn", "distance", "calls")
ROLLOUT_SHORT_TABLE = ("safe_executed", "violation_rate", "success", "safe_segments", "distance")
CONTROL_SHORT_TABLE = ("reward", "safe_executed", "violation_rate", "fell", "contacts")
PAPER_CONTROL_SHORT_TABLE = ("reward", "plan_violation", "executed_violation", "violation_rate")
"""What `cdiff compare` shows unless more is requested, the most important first."""


def torn(smooth: float) -> float:
    """1 where a plan is not smooth, else 0; computed at comparison from the saved column."""
    return 1.0 - smooth
