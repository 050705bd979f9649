"""A whole `cdiff compare`: the rows of a folder, summed up, tested and printed."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import typer
from rich.console import Console

from cdiff_cli.commands.run_directory import merge_kinds
from cdiff_cli.errors import CdiffError, suggestion
from cdiff_cli.evaluation import tables
from cdiff_cli.evaluation.columns import (
    CONTROL_TABLE,
    PAPER_TABLE,
    PLAN_TABLE,
    ROLLOUT_TABLE,
    SAFETY_TABLE,
    Row,
)
from cdiff_cli.evaluation.comparison import compare, differences
from cdiff_cli.evaluation.statistics import Test
from cdiff_cli.paths import home

TESTS = {
    "wilcoxon": "Wilcoxon's signed ranks (McNemar's test of rates)",
    "t": "Student's t (McNemar's test of rates)",
}
MARKS = {"latex": "% ", "markdown": "- "}
CAPTION = "mean ± standard error over n seeds, the newest row of each; a preset with * was changed by an option"


def print_comparison(
    folder: Path,
    out: Console,
    *,
    style: str,
    paper: bool,
    intervals: bool,
    against: str | None,
    test: Any,
    task: str | None,
) -> None:
    """Print the comparison of the runs in a folder on stdout; of csv the notes go to stderr."""
    if style not in tables.FORMATS:
        raise CdiffError(
            f'no format "{style}"{suggestion(style, tables.FORMATS)}; choose from {", ".join(tables.FORMATS)}'
        )
    if test not in get_args(Test):
        raise CdiffError(f"--test: expected {' or '.join(get_args(Test))}, found {test}")
    plans, rollouts = read(folder, task)
    methods = sorted({row["method"] for row in (*plans, *rollouts)})
    if against is not None and against not in methods:
        known = ", ".join(methods)
        raise CdiffError(
            f'--against: no runs of "{against}"{suggestion(against, methods)} here; there are {known}'
        )
    values = tables.read_paper(home() / "runs" / "reference" / "paper.csv") if paper else None
    objects: dict[str, Any] = {}
    acted = [row for row in rollouts if "plan_violation" in row]
    followed = [row for row in rollouts if "plan_violation" not in row]
    for title, rows, table in (
        ("plans", plans, PAPER_TABLE if paper else PLAN_TABLE),
        ("rollouts", followed, tuple(dict.fromkeys((*SAFETY_TABLE, *ROLLOUT_TABLE)))),
        ("closed loop", acted, CONTROL_TABLE),
    ):
        if not rows:
            continue
        groups, beside = (
            compare(rows, intervals=intervals),
            values if title != "rollouts" or style == "json" else None,
        )
        shown = [(title, tables.render(groups, table, style, beside, title))]
        if against is not None:
            heading = f"{title} against {against}"
            found = differences(rows, against, table, test)
            shown.append(
                (
                    heading,
                    tables.render_differences(
                        found, style, f"{heading}: {TESTS[test]}, paired by seed"
                    ),
                )
            )
        said = tables.notes(groups, table) if paper and title != "rollouts" else []
        if style == "json":
            objects |= {name: json.loads(text) for name, text in shown} | (
                {"notes": said} if said else {}
            )
        else:
            _print([text for _, text in shown], said, style, out)
    if style == "json":
        typer.echo(json.dumps(objects, indent=2))
    if style == "rich":
        bounds = (
            "; in brackets 95 % intervals: bootstrap (BCa) of means, Clopper-Pearson of rates"
            if intervals
            else ""
        )
        out.print(CAPTION + bounds, style="dim")


def read(folder: Path, task: str | None) -> tuple[list[Row], list[Row]]:
    """(rows of plans, rows of rollouts) of a folder's runs, of one task where asked; CdiffError where there are none."""
    if not folder.is_dir():
        raise CdiffError(f"{folder}: no such folder; make a run first: cdiff plan --method alm")
    plans, rollouts = (
        ([r for r in rows if task in (None, r["task"])]) for rows in merge_kinds(folder)
    )
    if not plans and not rollouts:
        raise CdiffError(
            f"{folder}: no runs{f' of {task}' if task else ''} here; make one first: cdiff plan --method alm"
        )
    return plans, rollouts


def _print(texts: Sequence[Any], notes: Sequence[str], style: str, out: Console) -> None:
    for text in texts:
        if style == "rich":
            out.print(text)
        else:
            typer.echo(text)
    for note in notes:
        typer.echo(MARKS.get(style, "note: ") + note, err=style == "csv")
