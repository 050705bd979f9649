"""What a run can promise: for each plan and constraint the worst value, where it is, and whether that settles the matter.

Pure, from saved arrays, float64 and environment units. The tolerance is 0: a value above zero is unsafe, however small.
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
TIE = 1e-9  # values this close are a tie, and its first place is named: rounding must not choose among waypoints on a boundary
SAFE = "safe"
UNSAFE_AT_WAYPOINTS = "unsafe at waypoints"
UNSAFE_BETWEEN = "unsafe between waypoints"
UNKNOWN_BETWEEN = (
    "unknown between waypoints"  # no value above zero was found there, and none is ruled out
)


class Saved(NamedTuple):
    """The trajectories of a .npz file: x [n, steps, dim], NaN after an episode's end; a seed each; the file's sha256."""

    x: Array
    seeds: Sequence[int]
    sha256: str


def certificate(
    task: Task,
    constraints: Mapping[str, Any],
    g: Constraint,
    plan: Saved,
    rollout: Saved | None = None,
) -> Entry:
    """The certificate of a run, ready for JSON.

    constraints   file and content as in run.yaml
    g             the same content compiled, environment units
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
    """sha256 of the constraints themselves: of their JSON with sorted keys and no spaces."""
    return hashlib.sha256(
        json.dumps(content, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()


def summary(counts: Mapping[str, Any]) -> str:
    """'10 of 10 plans safe at the waypoints, 9 of 10 between them', and how many stayed safe when executed."""
    n = counts["plans"]
    line = f"{counts['safe_at_waypoints']} of {n} plans safe at the waypoints, {counts['safe_on_segments']} of {n} between them"
    return (
        line
        if counts["safe_executed"] is None
        else f"{line}, {counts['safe_executed']} of {n} as executed"
    )


def _entries(task: Task, g: Constraint, plan: Saved, rollout: Saved | None) -> list[Entry]:
    """An entry a plan and constraint, plan by plan."""
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
    return (
        UNKNOWN_BETWEEN
        if not on["exact"] and on["worst"] is not None and on["worst"] <= 0
        else UNSAFE_BETWEEN
    )


def _counts(entries: Sequence[Entry], n: int, parts: int, executed: bool) -> dict[str, int | None]:
    def count(what: str) -> int:
        return sum(
            all(entry[what]["safe"] for entry in entries[i * parts : (i + 1) * parts])
            for i in range(n)
        )

    return {
        "plans": n,
        "safe_at_waypoints": count("waypoints"),
        "safe_on_segments": count("segments"),
        "safe_executed": count("executed") if executed else None,
    }


def _at_waypoints(part: TrajectoryConstraint, x: Array, task: Task) -> list[Entry]:
    """The worst row of each plan: its label, the waypoint tau it judges (of a step, the one it leads to), the state there."""
    rows, labels = _values(part(_tensor(x))), part.labels(x.shape[1])
    found = []
    for i, values in enumerate(rows):
        row = _first_worst(values)
        label = None if row is None else labels[row]
        tau = (
            None
            if row is None or label is None
            else _waypoint(part, label, row, len(values), x.shape[1])
        )
        found.append(
            {
                "worst": _largest(values),
                "label": label,
                "tau": tau,
                "time": None if tau is None else _time(tau, task),
                "state": None if tau is None else _state(task, x[i, tau]),
                "safe": bool((values <= 0).all()),
            }
        )
    return found


def _on_segments(part: TrajectoryConstraint, x: Array, task: Task) -> list[Entry]:
    """The worst value on the straight segments between the waypoints of each plan, and the first point that has it.

    A part over a level has the exact maximum (StateSet.segment_argmax), one that asks nothing between waypoints its own values, a rate is the
    same all along a segment, whose beginning is named; of any other it is only what was found, and no promise.
    """
    exact = part.exact_on_segments
    rows = _values(part.segment_max(_tensor(x)))
    at = [_first_worst(values) for values in rows]
    shares = None
    places: list[Entry] = [{"segment": None, "time": None, "state": None}] * len(x)
    if exact and all(segment is not None for segment in at):
        plan, segment = np.arange(len(x)), np.array(at)
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


def _executed(part: TrajectoryConstraint, rollout: Saved | None, task: Task) -> list[Entry]:
    """The worst row over the executed states of each episode, up to its end."""
    if rollout is None:
        return []
    ends = np.isfinite(rollout.x).all(-1).sum(1)
    alone = [_at_waypoints(part, rollout.x[i : i + 1, :end], task)[0] for i, end in enumerate(ends)]
    return [
        {
            "worst": e["worst"],
            "step": e["tau"],
            "time": e["time"],
            "state": e["state"],
            "safe": e["safe"],
        }
        for e in alone
    ]


def _first_worst(values: Array) -> int | None:
    """The first index of a value within TIE of the largest and on its side of zero, or of what is no number at all."""
    if len(values) == 0:
        return None
    if np.isnan(values).any():
        return int(np.isnan(values).argmax())
    largest = values.max()
    return int(((values >= largest - TIE) & ((values > 0) == (largest > 0))).argmax())


def _waypoint(
    part: TrajectoryConstraint, label: str, row: int, rows: int, horizon: int
) -> int | None:
    """The waypoint of a row by its label, name@tau or name@tau-tau'; None where the rows are not one a waypoint or step."""
    step = re.search(r"@\d+-(\d+)$", label)
    if step is not None:
        return int(step[1])
    single = re.search(r"@(\d+)$", label) if part.support == 1 else None
    return int(single[1]) if single is not None else row if rows == horizon else None


def _largest(values: Array) -> float | None:
    return _number(values.max()) if len(values) else None


def _number(value: Any) -> float | None:
    """A float for JSON, which knows no NaN and no inf."""
    return float(value) if math.isfinite(value) else None


def _time(steps: Any, task: Task) -> float:
    """Seconds, to the nanosecond: 0.57, not 0.5700000000000001."""
    return round(float(steps) * task.dt, 9)


def _state(task: Task, point: Array) -> dict[str, float | None]:
    return {name: _number(value) for name, value in zip(task.layout, point, strict=True)}


def _tensor(x: Array) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(x, dtype=np.float64))


def _values(rows: torch.Tensor) -> Array:
    return np.asarray(rows.detach().numpy())
