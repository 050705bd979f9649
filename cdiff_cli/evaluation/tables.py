"""Comparison groups as text: for a terminal, as markdown, LaTeX, CSV and JSON."""

import csv
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cdiff_cli.evaluation.columns import COLUMNS, KEYS
from cdiff_cli.evaluation.comparison import Cell, Difference, Group
from cdiff_cli.evaluation.layout import TextTable, comma_separated, latex, markdown, terminal

Paper = dict[tuple[str, str], dict[str, str]]
"""The paper's values by (task, method): metric -> text as printed."""


def read_paper(path: Path) -> Paper:
    """The paper's values from runs/reference/paper.csv."""
    with path.open(newline="") as file:
        return {
            (row.pop("task"), row.pop("method")): {k: v for k, v in row.items() if v}
            for row in csv.DictReader(file)
        }


def text_table(
    groups: Sequence[Group], metrics: Sequence[str], paper: Paper | None = None
) -> TextTable:
    """One line per group; a metric that the paper has too gets its values in a column beside it."""
    shown = [name for name in metrics if any(name in group.cells for group in groups)]
    printed = {name for values in (paper or {}).values() for name in values}
    header, together = [*KEYS, "n"], []
    for name in shown:
        first = len(header)
        header += [COLUMNS[name].title, *(["paper"] if name in printed else [])]
        together.append(range(first, len(header)))
    lines = []
    for group in groups:
        line = [*group.key, str(group.n)]
        for name in shown:
            cell = group.cells.get(name)
            fewer = f" (n = {cell.n})" if cell and cell.n != group.n else ""
            line.append(cell.text(COLUMNS[name].digits) + fewer if cell else "")
            if paper and name in printed:
                line.append(paper.get((group.key[0], group.key[2]), {}).get(name, ""))
        lines.append(line)
    return TextTable(header, lines, len(KEYS), len(KEYS) + 1, (0, 1), together, (3,))


def differences_table(differences: Sequence[Difference]) -> TextTable:
    """One line per test of a method against the reference method."""
    header = [*KEYS, "metric", "n", "difference", "95 % interval", "p", "p (Holm)"]
    lines = []
    for one in differences:
        digits = COLUMNS[one.metric].digits
        bounds = ", ".join(f"{bound:+.{digits}f}" for bound in one.interval or ())
        difference = f"{one.mean:+.{digits}f}"
        what = (*one.key, COLUMNS[one.metric].title, str(one.n))
        lines.append([*what, difference, bounds and f"[{bounds}]", _p(one.p), _p(one.holm)])
    keys = len(KEYS) + 2
    return TextTable(
        header, lines, keys - 1, keys, (4, 0, 1), [range(keys, len(header))], narrow_sections=(3,)
    )


def render(
    groups: Sequence[Group],
    metrics: Sequence[str],
    style: str,
    paper: Paper | None = None,
    title: str = "",
) -> Any:
    """The table in one of FORMATS: a rich renderable, or a string."""
    if style == "json":
        return json.dumps([_record(group, metrics, paper) for group in groups], indent=2)
    if style == "csv":
        return csv_table([(title, groups, metrics)], paper)
    return _in_style(text_table(groups, metrics, paper), style, title)


def render_differences(differences: Sequence[Difference], style: str, title: str) -> Any:
    """Paired differences from the reference method in one of FORMATS, one line per test."""
    if style == "json":
        return json.dumps([_difference(one) for one in differences], indent=2)
    table = differences_table(differences)
    return (
        comma_separated(table.header, table.lines)
        if style == "csv"
        else _in_style(table, style, title)
    )


def _in_style(table: TextTable, style: str, title: str) -> Any:
    if style == "markdown":
        return markdown(table)
    if style == "latex":
        return latex(table)
    return terminal(table, title)[0]


def csv_table(
    parts: Sequence[tuple[str, Sequence[Group], Sequence[str]]],
    paper: Paper | None = None,
    differences: Sequence[tuple[str, Difference]] = (),
) -> str:
    """All groups as data: one header, one line per group and metric, every number in its own cell.

    parts         (kind of run, groups, metrics)
    paper         adds the columns paper and paper_error
    differences   (kind of run, difference); adds the columns of the tests against a method
    """
    bounded = any(
        cell.interval for _, groups, _ in parts for group in groups for cell in group.cells.values()
    )
    header = ["kind", *KEYS, "metric", "n", "mean", "standard_error"]
    header += ["low", "high"] if bounded else []
    header += ["paper", "paper_error"] if paper else []
    header += [*TEST_COLUMNS] if differences else []
    tests = {(kind, one.key, one.metric): one for kind, one in differences}
    lines = []
    for kind, groups, metrics in parts:
        for group in groups:
            for name in metrics:
                if name not in group.cells:
                    continue
                cell = group.cells[name]
                line = [kind, *group.key, name, cell.n, cell.mean, _or_empty(cell.error)]
                line += (cell.interval or ("", "")) if bounded else ()
                if paper:
                    printed = paper.get((group.key[0], group.key[2]), {}).get(name, "")
                    mean, _, error = printed.partition(" ± ")
                    line += [mean, error]
                if differences:
                    line += _test_cells(tests.get((kind, group.key, name)))
                lines.append(line)
    return comma_separated(header, lines)


TEST_COLUMNS = ("pairs", "difference", "difference_low", "difference_high", "p", "p_holm")


def _test_cells(one: Difference | None) -> list[Any]:
    if one is None:
        return [""] * len(TEST_COLUMNS)
    return [one.n, one.mean, *(one.interval or ("", "")), _or_empty(one.p), _or_empty(one.holm)]


def _or_empty(value: float) -> float | str:
    return "" if math.isnan(value) else value


def notes(groups: Sequence[Group], metrics: Sequence[str]) -> list[str]:
    """What a reader must know to lay our numbers beside the paper's, per metric and method."""
    shown = {name for name in metrics if any(name in group.cells for group in groups)}
    shown |= {group.key[2] for group in groups} | {group.key[3].rstrip("*") for group in groups}
    return [note for name, note in PAPER_NOTES.items() if name in shown or not name]


PAPER_NOTES = {
    "": "±: ours is the standard error over n seeds; the paper's, over 10, "
    "reads like a standard deviation",
    "distance": "distance / m: to the unconstrained plan of the same noise; distance (paper): to "
    "the mean unconstrained plan, as released, which takes runs of several seeds (a sweep's have "
    "one)",
    "violation_paper": "violation (paper): at the waypoints, in the paper's units; a plan can be "
    "unsafe between them all the same",
    "step_ms": "step / ms: wall time of the whole batch over its network calls; the paper's: a "
    "diffusion step on an RTX 4060",
    "reward": "return: the paper's experts are others, and its obstacle in the ball run is not "
    "described",
    "plan_violation": "plan violation: mean over the plans of an episode, in rad/s or m; the paper "
    "does not say its units",
    "guidance": "guidance: what the released maze code calls Conditional, a push of constant "
    "weight on the unconditional planner",
    "conditional": "conditional: our planner, trained further with labels of this constraint file; "
    "two network calls per step",
    "safediffuser": "safediffuser: RoS unless set otherwise, rows from the compiled g; the paper "
    "does not say which variant it ran",
    "best-of-k": "best-of-k, final-projection, terminal: baselines that the paper does not have",
    "released": "released: frozen steps after the last (U-maze 100, large maze 200, "
    "SafeDiffuser 50) count as calls",
    "recommended": "recommended: a final exact projection follows every method but diffuser and "
    "best-of-k",
}


def _record(group: Group, metrics: Sequence[str], paper: Paper | None) -> dict[str, Any]:
    """A group as JSON, which knows neither NaN nor inf: they become null."""

    def cell(value: Cell) -> dict[str, Any]:
        mean, error = (x if math.isfinite(x) else None for x in (value.mean, value.error))
        record = {"mean": mean, "standard_error": error, "n": value.n}
        return record if value.interval is None else record | {"interval": list(value.interval)}

    record: dict[str, Any] = dict(zip(KEYS, group.key, strict=True)) | {"n": group.n}
    record |= {name: cell(group.cells[name]) for name in metrics if name in group.cells}
    if paper and (group.key[0], group.key[2]) in paper:
        record["paper"] = paper[group.key[0], group.key[2]]
    return record


def _difference(one: Difference) -> dict[str, Any]:
    p, corrected = (None if math.isnan(p) else p for p in (one.p, one.holm))
    return dict(zip(KEYS, one.key, strict=True)) | {
        "metric": one.metric,
        "n": one.n,
        "difference": one.mean,
        "interval": one.interval and list(one.interval),
        "p": p,
        "p_holm": corrected,
    }


def _p(p: float) -> str:
    return "" if math.isnan(p) else f"{p:.3f}" if p >= 0.001 else f"{p:.0e}"
