"""A run is a directory: written under a temporary name, renamed when whole. Rows of many runs make the comparison."""

import contextlib
import csv
import math
import shutil
import statistics
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from cdiff_cli.config import Dumper
from cdiff_cli.errors import CdiffError
from cdiff_cli.inference import Interval, Test, bootstrap, holm, interval, paired_p

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
    "distance": Column("distance / m", 2, "sum over waypoints of |p - p_free|, p_free the unconstrained plan of the same noise"),
    "violation": Column("violation / g", 4, "sum over waypoints and constraints of [g]_+, in the constraints' own units"),
    "worst_waypoint": Column("worst waypoint / g", 4, "largest g at a waypoint; positive is unsafe"),
    "worst_segment": Column("worst segment / g", 4, "largest g on the straight segments between waypoints"),
    "jump": Column("jump / m", 4, "largest distance between neighbouring waypoints"),
    "mean_speed": Column("speed / m/s", 2, "mean speed the plan asks for: its length over its duration"),
    "residual": Column("residual / m", 5, "mean of |p' - p - v' dt|: positions against velocities"),
    "acceleration": Column("acceleration / m/s^2", 1, "largest |v' - v| / dt"),
    "smooth": Column("smooth", 2, "share of plans whose largest jump is at most 1.2 times the data's 99.9 % quantile"),
    "torn": Column("torn", 2, "share of plans that are not smooth (the trap rate): they jump across what they should go round"),
    "wall": Column("in wall", 2, "share of plans with a waypoint or segment inside a wall"),
    "safe_waypoints": Column("safe at waypoints", 2, "share of plans with no g above 1e-6 at a waypoint"),
    "safe_segments": Column("safe between", 2, "share of plans with no g above 1e-6 at or between the waypoints"),
    "unsafe_segments": Column("unsafe segments", 1, "number of segments between waypoints on which some g exceeds 1e-6"),
    "feasible": Column("feasible", 2, "share of plans whose every step the fitted dynamics make with inputs within their bounds"),
    "effort": Column("effort", 2, "largest input that a step of the plan asks for, over its bound; above 1 no actuator follows"),
    "polish": Column("polish / m", 5, "largest displacement by the final exact projection"),
    "calls": Column("calls", 0, "network calls a plan"),
    "plan_ms": Column("plan / ms", 1, "wall time of the batch over its number of plans"),
    "step_ms": Column("step / ms", 2, "wall time of the batch over its network calls"),
    "overhead": Column("overhead / %", 1, "time outside the network over time inside it"),
    "violation_paper": Column("violation (paper)", 4, "violation in the paper's units"),
    "distance_paper": Column("distance (paper)", 2, "the paper's definition: distance to the mean unconstrained plan"),
    "reward": Column("return", 1, "sum of rewards"),
    "safe_executed": Column("safe executed", 2, "share of episodes with no unsafe state, g > 1e-6"),
    "executed_violation": Column("executed violation / g", 4, "sum over executed states of [g]_+"),
    "executed_worst": Column("executed worst / g", 4, "largest g of an executed state"),
    "violation_rate": Column("violation rate / %", 2, "share of executed states that are unsafe"),
    "plan_violation": Column("plan violation / g", 4, "violation of a plan, mean over those of the episode"),
    "safe_plans": Column("safe plans", 3, "share of the episode's plans with no g above 1e-6 at a waypoint"),
    "fell": Column("fell", 2, "share of episodes that the environment ended early"),
    "diverged": Column("diverged", 2, "share of episodes whose plans or states were no longer finite"),
    "contacts": Column("contacts", 2, "environment steps in contact with the obstacle"),
    "braked": Column("braked / %", 1, "share of steps at which no plan obeyed and the agent braked instead"),
    "saturation": Column("saturation / %", 1, "share of executed inputs that are at their bounds"),
    "latency_ms": Column("latency / ms", 2, "median wall time of planning at a control step, all episodes at once"),
    "latency_p95": Column("latency 95 % / ms", 2, "its 95 % quantile"),
    "steps": Column("steps", 0, "environment steps"),
    "success": Column("success", 2, "share of episodes that end within the environment's success radius of the goal"),
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
QUALITY_TABLE = ("wall", "smooth", "jump", "residual", "acceleration", "mean_speed", "success", "goal_distance")
ROLLOUT_TABLE = ("success", "executed_violation", "executed_worst", "violation_rate", "goal_distance", "reward", "steps")
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


class NewRun:
    """A run being written: `path` is the temporary directory, and the final one once the `new_run` block has ended."""

    def __init__(self, path: Path) -> None:
        self.path = path


@contextlib.contextmanager
def new_run(root: Path, name: str) -> Iterator[NewRun]:
    """A directory to write a run into; it appears below root only when the block ends without an error."""
    root.mkdir(parents=True, exist_ok=True)
    stem = f"{time.strftime('%Y%m%d-%H%M%S')}-{name}"
    partial = Path(tempfile.mkdtemp(prefix=f".{stem}-", dir=root))
    run = NewRun(partial)
    try:
        yield run
        partial.chmod(0o755)
        run.path, number = root / stem, 1
        while run.path.exists():
            run.path, number = root / f"{stem}-{number}", number + 1
        partial.rename(run.path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def find_rows(root: Path) -> list[Path]:
    """All rows.csv below root, those of unfinished runs left out."""
    return sorted(p for p in root.glob("*/rows.csv") if not p.parent.name.startswith("."))


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows(rows)


def read_rows(path: Path) -> list[Row]:
    """Rows with their metrics as numbers; CdiffError where the file is not one of ours."""
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            numbered = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CdiffError(f"{path}: cannot be read: {error}") from None
    for number, row in numbered:
        if any(row.get(key) is None for key in KEYS):
            raise CdiffError(f"{path}:{number}: not a row of a run: it lacks {', '.join(k for k in KEYS if row.get(k) is None)}")
        for name in row:
            if name in COLUMNS and row[name] not in ("", None):
                try:
                    row[name] = float(row[name])
                except ValueError:
                    raise CdiffError(f"{path}:{number}: {name} is not a number: {row[name]!r}") from None
    return [row for _, row in numbered]


def write_yaml(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(yaml.dump(dict(content), Dumper=Dumper, sort_keys=False, allow_unicode=True))


# the comparison -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cell:
    """Mean and standard error (sample standard deviation over sqrt(n)) of one metric of one group; its interval where asked for."""

    mean: float
    error: float
    n: int
    interval: Interval | None = None

    @classmethod
    def of(cls, values: Sequence[float], interval: Interval | None = None) -> "Cell":
        n = len(values)
        finite = all(map(math.isfinite, values))
        error = statistics.stdev(values) / math.sqrt(n) if n > 1 and finite else math.nan
        return cls(statistics.fmean(values), error, n, interval)

    def text(self, digits: int) -> str:
        mean = _number(self.mean, digits)
        one = self.error == 0 != self.mean  # for the whole batch: times, calls
        if math.isfinite(self.error) and not one:
            mean = f"{mean} ± {self.error:.{digits}f}"
        if self.interval is None:
            return mean
        return f"{mean} [{_number(self.interval[0], digits)}, {_number(self.interval[1], digits)}]"


@dataclass(frozen=True)
class Group:
    """All rows of one task, constraint file, method and preset, the newest row for each seed."""

    key: tuple[str, ...]
    n: int
    cells: dict[str, Cell]


def torn(smooth: float) -> float:
    """1 where a plan is not smooth, else 0: told at comparison, from the saved column."""
    return 1.0 - smooth


def newest(rows: Sequence[Row]) -> dict[tuple[str, ...], dict[str, Row]]:
    """The rows of each group by seed, in order of task, constraints, preset and method; the last given of a seed wins."""
    found: dict[tuple[str, ...], dict[str, Row]] = {}
    for row in rows:
        more = {"torn": torn(row["smooth"])} if isinstance(row.get("smooth"), float) else {}
        found.setdefault(tuple(str(row[key]) for key in KEYS), {})[str(row.get("seed"))] = row | more
    return {
        key: found[key] for key in sorted(found, key=lambda k: (k[0], k[1], _order(PRESET_ORDER, k[3]), _order(METHOD_ORDER, k[2])))
    }


def compare(rows: Sequence[Row], metrics: Sequence[str] | None = None, intervals: bool = False) -> list[Group]:
    """The groups of `newest`, summed up; with 95 % intervals where asked for."""
    groups = []
    for key, by_seed in newest(rows).items():
        mine = list(by_seed.values())
        names = metrics or [name for name in COLUMNS if any(_has(row, name) for row in mine)]
        values = {name: [row[name] for row in mine if _has(row, name)] for name in names}
        bounds = {name: interval(v, COLUMNS[name].share) for name, v in values.items() if intervals and name not in COSTS}
        groups.append(Group(key, len(mine), {name: Cell.of(v, bounds.get(name)) for name, v in values.items() if v}))
    return groups


@dataclass(frozen=True)
class Difference:
    """One metric of one method against the reference method, paired by seed within the same task, constraints and preset.

    mean       of the differences, method minus reference; interval: 95 %, bootstrap
    p, holm    two-sided, as tested and corrected for all tests of this metric
    """

    key: tuple[str, ...]
    metric: str
    n: int
    mean: float
    interval: Interval | None
    p: float
    holm: float


def differences(rows: Sequence[Row], reference: str, metrics: Sequence[str], test: Test = "wilcoxon") -> list[Difference]:
    """Every other method against the reference where both have rows of the same seeds; metrics that nowhere differ are left out."""
    groups, found = newest(rows), []
    for name in metrics:
        family = []
        for key, mine in groups.items():
            task, constraints, method, preset = key
            theirs = groups.get((task, constraints, reference, preset), {})
            both = [seed for seed in mine if _has(mine[seed], name)]
            both = [seed for seed in both if _has(theirs.get(seed, {}), name)]
            d = [mine[seed][name] - theirs[seed][name] for seed in both]
            if method != reference and d and name not in COSTS:
                p = paired_p(d, test, COLUMNS[name].share)
                family.append(Difference(key, name, len(d), statistics.fmean(d), bootstrap(d), p, p))
        if all(each.mean == 0 and each.p == 1 for each in family):
            continue
        corrected = holm([each.p for each in family])
        found += [replace(each, holm=p) for each, p in zip(family, corrected, strict=True)]
    return found


def _has(row: Row, name: str) -> bool:
    """Whether the metric has a value: of an episode that diverged at once, or never acted, some have none."""
    return isinstance(row.get(name), float) and not math.isnan(row[name])


def _number(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if float(text) == 0 else text


METHOD_ORDER = (
    "diffuser",
    "guidance",
    "conditional",
    "best-of-k",
    "final-projection",
    "terminal",
    "safediffuser",
    "projected",
    "primal-dual",
    "alm",
)
PRESET_ORDER = ("paper", "released", "recommended")


def _order(known: Sequence[str], name: str) -> tuple[int, str]:
    return (known.index(name) if name in known else len(known), name)


def merge_kinds(root: Path) -> tuple[list[Row], list[Row]]:
    """(rows of plans, rows of rollouts) of all runs below root, oldest first."""
    plans: list[Row] = []
    rollouts: list[Row] = []
    for path in find_rows(root):
        rows = read_rows(path)
        (rollouts if rows and "violation_rate" in rows[0] else plans).extend(rows)
    return plans, rollouts
