"""Comparison groups as text: rich, markdown, latex, csv, json."""

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from cdiff_cli.runs import COLUMNS, KEYS, Cell, Group

FORMATS = ("rich", "markdown", "latex", "csv", "json")
Paper = dict[tuple[str, str], dict[str, str]]


def read_paper(path: Path) -> Paper:
    """The paper's values by (task, method), each metric as printed there."""
    with path.open(newline="") as file:
        return {(row.pop("task"), row.pop("method")): {k: v for k, v in row.items() if v} for row in csv.DictReader(file)}


def header_and_lines(groups: Sequence[Group], metrics: Sequence[str], paper: Paper | None) -> tuple[list[str], list[list[str]]]:
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
            line.append(group.cells[name].text(COLUMNS[name].digits) if name in group.cells else "")
            if paper and any(name in values for values in paper.values()):
                line.append(paper.get((group.key[0], group.key[2]), {}).get(name, ""))
        lines.append(line)
    return header, lines


def render(groups: Sequence[Group], metrics: Sequence[str], style: str, paper: Paper | None = None, title: str = "") -> Any:
    """The table in one of FORMATS: a rich Table, or a string."""
    if style == "json":
        return json.dumps([_record(group, metrics, paper) for group in groups], indent=2)
    header, lines = header_and_lines(groups, metrics, paper)
    if style == "csv":
        text = io.StringIO()
        csv.writer(text).writerows([header, *lines])
        return text.getvalue().rstrip()
    if style == "markdown":
        rule = ["---"] * len(KEYS) + ["---:"] * (len(header) - len(KEYS))
        return "\n".join("| " + " | ".join(line) + " |" for line in [header, rule, *lines])
    if style == "latex":
        body = [" & ".join(_latex(cell) for cell in line) + r" \\" for line in lines]
        columns = "l" * len(KEYS) + "r" * (len(header) - len(KEYS))
        heading = " & ".join(_latex(cell) for cell in header) + r" \\"
        top = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", heading, r"\midrule"]
        return "\n".join([*top, *body, r"\bottomrule", r"\end{tabular}"])
    same = [i for i in range(len(KEYS)) if len({line[i] for line in lines}) == 1]
    common = ", ".join(lines[0][i] for i in same) if lines else ""
    table = Table(title=" · ".join(part for part in (title, common) if part), title_justify="left")
    for i, name in enumerate(header):
        if i not in same:
            table.add_column(name, justify="left" if i < len(KEYS) else "right", overflow="fold")
    for line in lines:
        table.add_row(*(cell for i, cell in enumerate(line) if i not in same))
    return table


def _record(group: Group, metrics: Sequence[str], paper: Paper | None) -> dict[str, Any]:
    def cell(value: Cell) -> dict[str, Any]:
        return {"mean": value.mean, "standard_error": value.error if value.n > 1 else None, "n": value.n}

    record: dict[str, Any] = dict(zip(KEYS, group.key, strict=True)) | {"n": group.n}
    record |= {name: cell(group.cells[name]) for name in metrics if name in group.cells}
    if paper and (group.key[0], group.key[2]) in paper:
        record["paper"] = paper[group.key[0], group.key[2]]
    return record


def _latex(cell: str) -> str:
    for plain, escaped in (("±", r"$\pm$"), ("%", r"\%"), ("_", r"\_"), ("^2", r"$^2$")):
        cell = cell.replace(plain, escaped)
    return cell
