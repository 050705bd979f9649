"""Rows of many runs in groups: means, standard errors, paired differences."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace

from cdiff_cli.evaluation.columns import COLUMNS, COSTS, KEYS, Row, torn
from cdiff_cli.evaluation.statistics import Interval, Test, bootstrap, holm, interval, paired_p
from cdiff_cli.sampling import METHOD_ORDER


@dataclass(frozen=True)
class Cell:
    """Mean and standard error of one metric of one group.

    error      sample standard deviation over sqrt(n); NaN for one value
    interval   95 %; None unless requested
    """

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
        """ "1.23 ± 0.06", with its interval in brackets; no error where all values are equal."""
        mean = _number(self.mean, digits)
        one = self.error == 0 != self.mean  # one value for the whole batch: times, calls
        if math.isfinite(self.error) and not one:
            mean = f"{mean} ± {self.error:.{digits}f}"
        if self.interval is None:
            return mean
        return f"{mean} [{_number(self.interval[0], digits)}, {_number(self.interval[1], digits)}]"


@dataclass(frozen=True)
class Group:
    """All rows of one task, constraint file, method and preset, the newest row per seed.

    key   task, constraints, method, preset
    n     number of seeds
    """

    key: tuple[str, ...]
    n: int
    cells: dict[str, Cell]


def newest(rows: Sequence[Row]) -> dict[tuple[str, ...], dict[str, Row]]:
    """The rows of each group by seed; of several rows of one seed the last wins.

    Groups are in order of task, constraints, preset and method.
    """
    groups: dict[tuple[str, ...], dict[str, Row]] = {}
    for row in rows:
        derived = {"torn": torn(row["smooth"])} if isinstance(row.get("smooth"), float) else {}
        key = tuple(str(row[name]) for name in KEYS)
        groups.setdefault(key, {})[str(row.get("seed"))] = row | derived

    def position(key: tuple[str, ...]) -> tuple[str, str, tuple[int, str], tuple[int, str]]:
        task, constraints, method, preset = key
        return task, constraints, _order(PRESET_ORDER, preset), _order(METHOD_ORDER, method)

    return {key: groups[key] for key in sorted(groups, key=position)}


def compare(
    rows: Sequence[Row], metrics: Sequence[str] | None = None, intervals: bool = False
) -> list[Group]:
    """The groups of `newest` with a cell per metric, with 95 % intervals where requested."""
    groups = []
    for key, by_seed in newest(rows).items():
        members = list(by_seed.values())
        names = metrics or [name for name in COLUMNS if any(_has(row, name) for row in members)]
        values = {name: [row[name] for row in members if _has(row, name)] for name in names}
        bounds = {
            name: interval(v, COLUMNS[name].share)
            for name, v in values.items()
            if intervals and name not in COSTS
        }
        cells = {name: Cell.from_values(v, bounds.get(name)) for name, v in values.items() if v}
        groups.append(Group(key, len(members), cells))
    return groups


@dataclass(frozen=True)
class Difference:
    """One metric of one method against the reference method.

    Values are paired by seed within the same task, constraints and preset.

    mean       method minus reference
    interval   95 %, bootstrap
    p          two-sided
    holm       p corrected for all tests of this metric
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
    """Every other method against the reference where both have rows of the same seeds.

    A metric without any difference is left out.
    """
    groups, results = newest(rows), []
    for name in metrics:
        family = []
        for key, by_seed in groups.items():
            task, constraints, method, preset = key
            of_reference = groups.get((task, constraints, reference, preset), {})
            both = [seed for seed in by_seed if _has(by_seed[seed], name)]
            both = [seed for seed in both if _has(of_reference.get(seed, {}), name)]
            d = [by_seed[seed][name] - of_reference[seed][name] for seed in both]
            if method != reference and d and name not in COSTS:
                p = paired_p(d, test, COLUMNS[name].share)
                family.append(
                    Difference(key, name, len(d), statistics.fmean(d), bootstrap(d), p, p)
                )
        if all(result.mean == 0 and result.p == 1 for result in family):
            continue
        corrected = holm([result.p for result in family])
        results += [replace(one, holm=p) for one, p in zip(family, corrected, strict=True)]
    return results


def _has(row: Row, name: str) -> bool:
    """Whether the metric has a value; an episode that diverged at once has none for some."""
    return isinstance(row.get(name), float) and not math.isnan(row[name])


def _number(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if float(text) == 0 else text


PRESET_ORDER = ("paper", "released", "recommended")


def _order(known: Sequence[str], name: str) -> tuple[int, str]:
    return (known.index(name) if name in known else len(known), name)
