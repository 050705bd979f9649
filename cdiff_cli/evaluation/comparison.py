"""Rows of many runs in groups: means, standard errors, paired differences."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace

from cdiff_cli.evaluation.columns import COLUMNS, COSTS, KEYS, Row, torn
from cdiff_cli.evaluation.statistics import Interval, Test, bootstrap, holm, interval, paired_p


@dataclass(frozen=True)
class Cell:
    """Mean and standard error (sample standard deviation over sqrt(n)) of one metric of one group; its interval where asked for."""

    mean: float
    error: float
    n: int
    interval: Interval | None = None

    @classmethod
    def from_values(cls, values: Sequence[float], interval: Interval | None = None) -> "Cell":
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


def newest(rows: Sequence[Row]) -> dict[tuple[str, ...], dict[str, Row]]:
    """The rows of each group by seed, in order of task, constraints, preset and method; the last given of a seed wins."""
    found: dict[tuple[str, ...], dict[str, Row]] = {}
    for row in rows:
        more = {"torn": torn(row["smooth"])} if isinstance(row.get("smooth"), float) else {}
        found.setdefault(tuple(str(row[key]) for key in KEYS), {})[str(row.get("seed"))] = (
            row | more
        )
    return {
        key: found[key]
        for key in sorted(
            found,
            key=lambda k: (k[0], k[1], _order(PRESET_ORDER, k[3]), _order(METHOD_ORDER, k[2])),
        )
    }


def compare(
    rows: Sequence[Row], metrics: Sequence[str] | None = None, intervals: bool = False
) -> list[Group]:
    """The groups of `newest`, summed up; with 95 % intervals where asked for."""
    groups = []
    for key, by_seed in newest(rows).items():
        mine = list(by_seed.values())
        names = metrics or [name for name in COLUMNS if any(_has(row, name) for row in mine)]
        values = {name: [row[name] for row in mine if _has(row, name)] for name in names}
        bounds = {
            name: interval(v, COLUMNS[name].share)
            for name, v in values.items()
            if intervals and name not in COSTS
        }
        groups.append(
            Group(
                key,
                len(mine),
                {name: Cell.from_values(v, bounds.get(name)) for name, v in values.items() if v},
            )
        )
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


def differences(
    rows: Sequence[Row], reference: str, metrics: Sequence[str], test: Test = "wilcoxon"
) -> list[Difference]:
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
                family.append(
                    Difference(key, name, len(d), statistics.fmean(d), bootstrap(d), p, p)
                )
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
