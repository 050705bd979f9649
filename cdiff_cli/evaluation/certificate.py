"""Certificates of runs: the worst value of each plan and constraint, its place, and its status.

A certificate is a pure function of saved arrays, float64 and in environment units. The tolerance
is 0: every value above zero is unsafe.
"""

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.tasks.protocol import Task

Entry = dict[str, Any]
FORMAT = 1
TIE = 1e-9  # [units of g] values this close are equal, so that rounding does not choose the place
SAFE = "safe"
UNSAFE_AT_WAYPOINTS = "unsafe at waypoints"
UNSAFE_BETWEEN = "unsafe between waypoints"
UNKNOWN_BETWEEN = "unknown between waypoints"  # no known value above zero, and no exact maximum


class Saved(NamedTuple):
    """Trajectories of a .npz file.

    x        states, NaN after the end of an episode   [n, steps, dim]
    seeds    one per trajectory                        [n]
    sha256   hash of the file
    """

    x: Array
    seeds: Sequence[int]
    sha256: str


class Axes(NamedTuple):
    """What naming a place in a plan takes: coordinates, and seconds between waypoints."""

    layout: tuple[str, ...]
    dt: float


def certificate(
    task: Task,
    constraints: Mapping[str, Any],
    g: Constraint,
    plan: Saved,
    rollout: Saved | None = None,
) -> Entry:
    """The certificate of a run, ready for JSON.

    constraints   file and content, as in run.yaml
    g             the content compiled, environment units
    plan          the plans
    rollout       the executed episodes, in the order of the plans
    """
    entries = _entries(task, g, plan, rollout)
    return {
        "format": FORMAT,
        "task": task.name,
        "constraints": {
            "file": constraints["file"],
            "sha256": content_sha256(constraints["content"]),
        },
        "plan_sha256": plan.sha256,
        "rollout_sha256": rollout.sha256 if rollout else None,
        "tolerance": 0,
        "counts": _counts(entries, len(plan.x), len(g.parts), rollout is not None),
        "entries": entries,
    }


def content_sha256(content: Any) -> str:
    """sha256 of the content of a constraint file: of its JSON with sorted keys and no spaces."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def summary(counts: Mapping[str, Any]) -> str:
    """'10 of 10 plans safe at the waypoints, 9 of 10 between them', and as executed if known."""
    n, executed = counts["plans"], counts["safe_executed"]
    parts = [
        f"{counts['safe_at_waypoints']} of {n} plans safe at the waypoints",
        f"{counts['safe_on_segments']} of {n} between them",
    ]
    if executed is not None:
        parts.append(f"{executed} of {n} as executed")
    return ", ".join(parts)


def _entries(task: Task | Axes, g: Constraint, plan: Saved, rollout: Saved | None) -> list[Entry]:
    """One entry per plan and constraint, plan by plan."""
    by_part = [
        (
            part.name,
            _at_waypoints(part, plan.x, task),
            _on_segments(part, plan.x, task),
            _executed(part, rollout, task),
        )
        for part in g.parts
    ]
    return [
        {
            "seed": int(seed),
            "constraint": name,
            "status": _status(at[i], on[i]),
            "waypoints": at[i],
            "segments": on[i],
            **({"executed": executed[i]} if executed else {}),
        }
        for i, seed in enumerate(plan.seeds)
        for name, at, on, executed in by_part
    ]


def _status(at: Entry, on: Entry) -> str:
    if not at["safe"]:
        return UNSAFE_AT_WAYPOINTS
    if on["safe"]:
        return SAFE
    undecided = not on["exact"] and on["worst"] is not None and on["worst"] <= 0
    return UNKNOWN_BETWEEN if undecided else UNSAFE_BETWEEN


def _counts(entries: Sequence[Entry], n: int, parts: int, executed: bool) -> dict[str, int | None]:
    """Numbers of plans that are safe under all constraints."""

    def count(where: str) -> int:
        plans = (entries[i * parts : (i + 1) * parts] for i in range(n))
        return sum(all(entry[where]["safe"] for entry in plan) for plan in plans)

    return {
        "plans": n,
        "safe_at_waypoints": count("waypoints"),
        "safe_on_segments": count("segments"),
        "safe_executed": count("executed") if executed else None,
    }


def _at_waypoints(part: TrajectoryConstraint, x: Array, task: Task | Axes) -> list[Entry]:
    """The worst row of each plan: its value, label, waypoint tau and state.

    The waypoint of a row on a step is the one that the step leads to.
    """
    rows, labels = _values(part(_tensor(x))), part.labels(x.shape[1])
    entries = []
    for i, values in enumerate(rows):
        row = _first_worst(values)
        label = None if row is None else labels[row]
        tau = None
        if row is not None and label is not None:
            tau = _waypoint(part, label, row, len(values), x.shape[1])
        entries.append(
            {
                "worst": _largest(values),
                "label": label,
                "tau": tau,
                "time": None if tau is None else _time(tau, task),
                "state": None if tau is None else _state(task, x[i, tau]),
                "safe": bool((values <= 0).all()),
            }
        )
    return entries


def _on_segments(part: TrajectoryConstraint, x: Array, task: Task | Axes) -> list[Entry]:
    """The worst value on the segments between waypoints of each plan, and its first place.

    The value is exact for a constraint over a state set (StateSet.segment_argmax), for one that
    says nothing about segments, and for a rate limit: a rate is constant on a segment, and its
    place is the start. For every other constraint it is a lower bound of the maximum.
    """
    exact = part.exact_on_segments
    rows = _values(part.segment_max(_tensor(x)))
    segments = [_first_worst(values) for values in rows]
    shares = None
    places: list[Entry] = [{"segment": None, "time": None, "state": None}] * len(x)
    if exact and all(segment is not None for segment in segments):
        plan, segment = np.arange(len(x)), np.array(segments)
        begin, end = x[plan, segment], x[plan, np.minimum(segment + 1, x.shape[1] - 1)]
        shares = part.segment_argmax(_tensor(np.stack((begin, end), 1)))
    if shares is not None:
        share = shares[:, 0].numpy()
        point = begin + share[:, None] * (end - begin)
        places = [
            {"segment": int(j), "time": _time(j + s, task), "state": _state(task, p)}
            for j, s, p in zip(segment, share, point, strict=True)
        ]
    return [
        {"worst": _largest(values)}
        | place
        | {"exact": exact, "safe": exact and bool((values <= 0).all())}
        for values, place in zip(rows, places, strict=True)
    ]


def _executed(part: TrajectoryConstraint, rollout: Saved | None, task: Task | Axes) -> list[Entry]:
    """The worst row over the executed states of each episode, up to its end."""
    if rollout is None:
        return []
    ends = np.isfinite(rollout.x).all(-1).sum(1)
    worst = [_at_waypoints(part, rollout.x[i : i + 1, :end], task)[0] for i, end in enumerate(ends)]
    return [
        {
            "worst": e["worst"],
            "step": e["tau"],
            "time": e["time"],
            "state": e["state"],
            "safe": e["safe"],
        }
        for e in worst
    ]


def _first_worst(values: Array) -> int | None:
    """Index of the first NaN, else of the first value equal to the largest; None without values.

    A value is equal to the largest if it lies within TIE and on the same side of zero.
    """
    if len(values) == 0:
        return None
    if np.isnan(values).any():
        return int(np.isnan(values).argmax())
    largest = values.max()
    return int(((values >= largest - TIE) & ((values > 0) == (largest > 0))).argmax())


def _waypoint(
    part: TrajectoryConstraint, label: str, row: int, rows: int, horizon: int
) -> int | None:
    """The waypoint of a row, from its label name@tau or name@tau-tau'.

    None if there is not one row per waypoint or step.
    """
    step = re.search(r"@\d+-(\d+)$", label)
    if step is not None:
        return int(step[1])
    single = re.search(r"@(\d+)$", label) if part.support == 1 else None
    return int(single[1]) if single is not None else row if rows == horizon else None


def _largest(values: Array) -> float | None:
    return _number(values.max()) if len(values) else None


def _number(value: Any) -> float | None:
    """A float for JSON; None for NaN and infinity, which JSON lacks."""
    return float(value) if math.isfinite(value) else None


def _time(steps: Any, task: Task | Axes) -> float:
    """Time [s], rounded to nanoseconds: 0.57, not 0.5700000000000001."""
    return round(float(steps) * task.dt, 9)


def _state(task: Task | Axes, point: Array) -> dict[str, float | None]:
    return {name: _number(value) for name, value in zip(task.layout, point, strict=True)}


def _tensor(x: Array) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(x, dtype=np.float64))


def _values(rows: torch.Tensor) -> Array:
    return np.asarray(rows.detach().numpy())


def certify(g: Constraint, x: Array, axes: Axes) -> tuple[dict[str, int | None], list[Entry]]:
    """Counts and entries of trajectories x [n, horizon, dim] that no run directory holds."""
    entries = _entries(axes, g, Saved(x, range(len(x)), ""), None)
    return _counts(entries, len(x), len(g.parts), executed=False), entries
