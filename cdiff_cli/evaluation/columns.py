"""The columns of rows.csv and of tables: heading, digits and definition of each, and which table shows which."""

from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]


@dataclass(frozen=True)
class Column:
    """How a metric is shown: heading with unit, digits, what it is."""

    title: str
    digits: int
    meaning: str

    @property
    def share(self) -> bool:
        """Whether each value is 0 or 1, so that the mean is a rate."""
        return self.meaning.startswith(("share of plans", "share of episodes"))


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
    "mean_speed": Column(
        "speed / m/s", 2, "mean speed the plan asks for: its length over its duration"
    ),
    "residual": Column("residual / m", 5, "mean of |p' - p - v' dt|: positions against velocities"),
    "acceleration": Column("acceleration / m/s^2", 1, "largest |v' - v| / dt"),
    "smooth": Column(
        "smooth",
        2,
        "share of plans whose largest jump is at most 1.2 times the data's 99.9 % quantile",
    ),
    "torn": Column(
        "torn",
        2,
        "share of plans that are not smooth (the trap rate): they jump across what they should go round",
    ),
    "wall": Column("in wall", 2, "share of plans with a waypoint or segment inside a wall"),
    "safe_waypoints": Column(
        "safe at waypoints", 2, "share of plans with no g above 1e-6 at a waypoint"
    ),
    "safe_segments": Column(
        "safe between", 2, "share of plans with no g above 1e-6 at or between the waypoints"
    ),
    "unsafe_segments": Column(
        "unsafe segments", 1, "number of segments between waypoints on which some g exceeds 1e-6"
    ),
    "feasible": Column(
        "feasible",
        2,
        "share of plans whose every step the fitted dynamics make with inputs within their bounds",
    ),
    "effort": Column(
        "effort",
        2,
        "largest input that a step of the plan asks for, over its bound; above 1 no actuator follows",
    ),
    "polish": Column("polish / m", 5, "largest displacement by the final exact projection"),
    "calls": Column("calls", 0, "network calls a plan"),
    "plan_ms": Column("plan / ms", 1, "wall time of the batch over its number of plans"),
    "step_ms": Column("step / ms", 2, "wall time of the batch over its network calls"),
    "overhead": Column("overhead / %", 1, "time outside the network over time inside it"),
    "violation_paper": Column("violation (paper)", 4, "violation in the paper's units"),
    "distance_paper": Column(
        "distance (paper)", 2, "the paper's definition: distance to the mean unconstrained plan"
    ),
    "reward": Column("return", 1, "sum of rewards"),
    "safe_executed": Column("safe executed", 2, "share of episodes with no unsafe state, g > 1e-6"),
    "executed_violation": Column("executed violation / g", 4, "sum over executed states of [g]_+"),
    "executed_worst": Column("executed worst / g", 4, "largest g of an executed state"),
    "violation_rate": Column("violation rate / %", 2, "share of executed states that are unsafe"),
    "plan_violation": Column(
        "plan violation / g", 4, "violation of a plan, mean over those of the episode"
    ),
    "safe_plans": Column(
        "safe plans", 3, "share of the episode's plans with no g above 1e-6 at a waypoint"
    ),
    "fell": Column("fell", 2, "share of episodes that the environment ended early"),
    "diverged": Column(
        "diverged", 2, "share of episodes whose plans or states were no longer finite"
    ),
    "contacts": Column("contacts", 2, "environment steps in contact with the obstacle"),
    "braked": Column(
        "braked / %", 1, "share of steps at which no plan obeyed and the agent braked instead"
    ),
    "saturation": Column("saturation / %", 1, "share of executed inputs that are at their bounds"),
    "latency_ms": Column(
        "latency / ms", 2, "median wall time of planning at a control step, all episodes at once"
    ),
    "latency_p95": Column("latency 95 % / ms", 2, "its 95 % quantile"),
    "steps": Column("steps", 0, "environment steps"),
    "success": Column(
        "success",
        2,
        "share of episodes that end within the environment's success radius of the goal",
    ),
    "goal_distance": Column("goal distance / m", 3, "distance to the goal at the end"),
}
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
"""Of a method or a batch, not of a seed: nothing to test."""
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


def torn(smooth: float) -> float:
    """1 where a plan is not smooth, else 0: told at comparison, from the saved column."""
    return 1.0 - smooth
