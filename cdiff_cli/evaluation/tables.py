"""Comparison groups as text: rich, markdown, latex, csv, json."""

import csv
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from cdiff_cli.evaluation.columns import COLUMNS, KEYS
from cdiff_cli.evaluation.comparison import Cell, Difference, Group

FORMATS = ("rich", "markdown", "latex", "csv", "json")
Paper = dict[tuple[str, str], dict[str, str]]


def read_paper(path: Path) -> Paper:
    """The paper's values by (task, method), each metric as printed there."""
    with path.open(newline="") as file:
        return {
            (row.pop("task"), row.pop("method")): {k: v for k, v in row.items() if v}
            for row in csv.DictReader(file)
        }


def header_and_lines(
    groups: Sequence[Group], metrics: Sequence[str], paper: Paper | None
) -> tuple[list[str], list[list[str]]]:
    """Heading and cells as text; with paper each of its metrics gets a column beside ours."""
    shown = [name for name in metrics if any(name in group.cells for group in groups)]
    header = [*KEYS, "n"]
    for name in shown:
        header.append(COLUMNS[name].title)
        if paper and any(name in values for values in paper.values()):
            header.append("paper")
    lines = []
    for group in groups:
        line = [*group.key, str(group.n)]
        for name in shown:
            cell = group.cells.get(name)
            fewer = f" (n = {cell.n})" if cell and cell.n != group.n else ""
            line.append(cell.text(COLUMNS[name].digits) + fewer if cell else "")
            if paper and any(name in values for values in paper.values()):
                line.append(paper.get((group.key[0], group.key[2]), {}).get(name, ""))
        lines.append(line)
    return header, lines


def render(
    groups: Sequence[Group],
    metrics: Sequence[str],
    style: str,
    paper: Paper | None = None,
    title: str = "",
) -> Any:
    """The table in one of FORMATS: a rich Table, or a string."""
    if style == "json":
        return json.dumps([_record(group, metrics, paper) for group in groups], indent=2)
    header, lines = header_and_lines(groups, metrics, paper)
    return tabulate(header, lines, style, len(KEYS), title)


def render_differences(differences: Sequence[Difference], style: str, title: str) -> Any:
    """Paired differences from the reference method, a line a test."""
    if style == "json":
        return json.dumps([_difference(each) for each in differences], indent=2)
    header = [*KEYS, "metric", "n", "difference", "95 % interval", "p", "p (Holm)"]
    lines = []
    for each in differences:
        digits = COLUMNS[each.metric].digits
        bounds = (
            ""
            if each.interval is None
            else ", ".join(f"{bound:+.{digits}f}" for bound in each.interval)
        )
        line = [
            *each.key,
            COLUMNS[each.metric].title,
            str(each.n),
            f"{each.mean:+.{digits}f}",
            bounds and f"[{bounds}]",
        ]
        lines.append([*line, _p(each.p), _p(each.holm)])
    return tabulate(header, lines, style, len(KEYS) + 1, title)


def notes(groups: Sequence[Group], metrics: Sequence[str]) -> list[str]:
    """What must be known to read our numbers beside the paper's, of the metrics and methods shown."""
    shown = {name for name in metrics if any(name in group.cells for group in groups)}
    shown |= {group.key[2] for group in groups} | {group.key[3].rstrip("*") for group in groups}
    return [note for name, note in PAPER_NOTES.items() if name in shown or not name]


PAPER_NOTES = {
    "": "±: ours is the standard error over n seeds; the paper's, over 10, reads like a standard deviation",
    "distance": "distance / m: to the unconstrained plan of the same noise; distance (paper): to the mean unconstrained plan, as "
    "released; it takes runs of several seeds, and a sweep's have one",
    "violation_paper": "violation (paper): at the waypoints, in the paper's units; a plan can be unsafe between them all the same",
    "step_ms": "step / ms: wall time of the whole batch over its network calls; the paper's: a diffusion step, RTX 4060",
    "reward": "return: the paper's experts are others, and its ball run's obstacle is not described",
    "plan_violation": "plan violation: mean over the plans of an episode, in rad/s or m; the paper does not say its units",
    "guidance": "guidance: what the released maze code calls Conditional, a push of constant weight on the unconditional planner",
    "conditional": "conditional: our planner, trained on with labels of this constraint file; two network calls a step",
    "safediffuser": "safediffuser: RoS unless set otherwise, rows from the compiled g; the paper does not say which variant it ran",
    "best-of-k": "best-of-k, final-projection, terminal: rivals that the paper does not have",
    "released": "released: frozen steps after the last (U-maze 100, large maze 200, SafeDiffuser 50) count as calls",
    "recommended": "recommended: a last exact projection follows every method but diffuser and best-of-k",
}


def tabulate(
    header: Sequence[str], lines: Sequence[Sequence[str]], style: str, names: int, title: str = ""
) -> Any:
    """A table of text in rich, csv, markdown or latex, the first `names` columns left aligned."""
    if style == "csv":
        text = io.StringIO()
        csv.writer(text).writerows([header, *lines])
        return text.getvalue().rstrip()
    if style == "markdown":
        rule = ["---"] * names + ["---:"] * (len(header) - names)
        return "\n".join("| " + " | ".join(line) + " |" for line in [header, rule, *lines])
    if style == "latex":
        body = [" & ".join(_latex(cell) for cell in line) + r" \\" for line in lines]
        columns = "l" * names + "r" * (len(header) - names)
        heading = " & ".join(_latex(cell) for cell in header) + r" \\"
        top = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", heading, r"\midrule"]
        return "\n".join([*top, *body, r"\bottomrule", r"\end{tabular}"])
    same = [i for i in range(names) if len({line[i] for line in lines}) == 1]
    common = ", ".join(lines[0][i] for i in same) if lines else ""
    table = Table(title=" · ".join(part for part in (title, common) if part), title_justify="left")
    for i, name in enumerate(header):
        if i not in same:
            table.add_column(name, justify="left" if i < names else "right", overflow="fold")
    for line in lines:
        table.add_row(*(cell for i, cell in enumerate(line) if i not in same))
    return table


def _record(group: Group, metrics: Sequence[str], paper: Paper | None) -> dict[str, Any]:
    def cell(value: Cell) -> dict[str, Any]:
        mean, error = (
            number if math.isfinite(number) else None for number in (value.mean, value.error)
        )  # JSON has no others
        found = {"mean": mean, "standard_error": error, "n": value.n}
        return found if value.interval is None else found | {"interval": list(value.interval)}

    record: dict[str, Any] = dict(zip(KEYS, group.key, strict=True)) | {"n": group.n}
    record |= {name: cell(group.cells[name]) for name in metrics if name in group.cells}
    if paper and (group.key[0], group.key[2]) in paper:
        record["paper"] = paper[group.key[0], group.key[2]]
    return record


def _difference(each: Difference) -> dict[str, Any]:
    found: dict[str, Any] = dict(zip(KEYS, each.key, strict=True)) | {
        "metric": each.metric,
        "n": each.n,
        "difference": each.mean,
    }
    found |= {"interval": each.interval and list(each.interval)}
    return found | {
        name: None if math.isnan(p) else p for name, p in (("p", each.p), ("p_holm", each.holm))
    }


def _p(p: float) -> str:
    return "" if math.isnan(p) else f"{p:.3f}" if p >= 0.001 else f"{p:.0e}"


def _latex(cell: str) -> str:
    for plain, escaped in (("±", r"$\pm$"), ("%", r"\%"), ("_", r"\_"), ("^2", r"$^2$")):
        cell = cell.replace(plain, escaped)
    return cell
