"""`cdiff compare`: the rows of a folder's runs, averaged, tested and printed."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import typer
from rich.console import Console

from cdiff_cli.commands.names import check_choice
from cdiff_cli.commands.run_directory import merge_kinds
from cdiff_cli.errors import CdiffError, suggestion
from cdiff_cli.evaluation import columns as c
from cdiff_cli.evaluation import tables
from cdiff_cli.evaluation.comparison import Difference, Group, compare, differences
from cdiff_cli.evaluation.layout import TextTable, latex, markdown, terminal
from cdiff_cli.evaluation.statistics import Test
from cdiff_cli.paths import home

TESTS = {
    "wilcoxon": "Wilcoxon's signed ranks (McNemar's test of rates)",
    "t": "Student's t (McNemar's test of rates)",
}
MARKS = {"latex": "% ", "markdown": "- "}  # what begins the line of a note
CAPTION = (
    "mean ± standard error over n seeds, the newest row of each; "
    "* marks a preset that an option changed"
)
WIDE = {
    "plans": c.PLAN_TABLE,
    "rollouts": tuple(dict.fromkeys((*c.SAFETY_TABLE, *c.ROLLOUT_TABLE))),
    "closed loop": c.CONTROL_TABLE,
}
SHORT = {
    "plans": c.PLAN_SHORT_TABLE,
    "rollouts": c.ROLLOUT_SHORT_TABLE,
    "closed loop": c.CONTROL_SHORT_TABLE,
}


@dataclass(frozen=True)
class Selection:
    """Which columns a table shows: those of --columns, all of --wide, or the few that matter."""

    columns: tuple[str, ...] = ()
    wide: bool = False
    paper: bool = False

    @classmethod
    def read(cls, columns: str | None, wide: bool, paper: bool) -> "Selection":
        """The selection of the command line; raises CdiffError where a column is unknown."""
        if columns is None:
            return cls((), wide, paper)
        if wide:
            raise CdiffError("--columns and --wide: choose one of them")
        names = tuple(name.strip() for name in columns.split(",") if name.strip())
        for name in names:
            if name not in c.COLUMNS:
                raise CdiffError(
                    f'--columns: no column "{name}"{suggestion(name, c.COLUMNS)}; '
                    "`cdiff list columns` names them"
                )
        if not names:
            raise CdiffError("--columns: expected names such as violation,torn, found none")
        return cls(names, wide, paper)

    def metrics(self, kind: str, style: str) -> tuple[str, ...]:
        """Columns of the runs of a kind; csv and json, read by programs, hold all of them."""
        if self.columns:
            return self.columns
        if self.paper and kind == "plans":
            return c.PAPER_TABLE
        if self.wide or style in ("csv", "json"):
            return WIDE[kind]
        if self.paper and kind == "closed loop":
            return c.PAPER_CONTROL_SHORT_TABLE
        return SHORT[kind]

    @property
    def may_drop(self) -> bool:
        """Whether columns that do not fit may be left out: nobody named them."""
        return not (self.columns or self.wide or self.paper)


@dataclass(frozen=True)
class Part:
    """The comparison of the runs of one kind."""

    kind: str
    groups: Sequence[Group]
    metrics: Sequence[str]
    paper: tables.Paper | None
    tested: Sequence[Difference]


def print_comparison(
    folder: Path,
    out: Console,
    selection: Selection,
    *,
    style: str,
    intervals: bool,
    against: str | None,
    test: Any,
    task: str | None,
) -> None:
    """Print the comparison of the runs in a folder on stdout.

    style       one of FORMATS; with csv the notes go to stderr
    intervals   add 95 % intervals
    against     method that all others are tested against; None: no tests
    test        "wilcoxon" or "t"
    task        compare the runs of this task only
    """
    check_choice("format", style, c.FORMATS)
    if test not in get_args(Test):
        raise CdiffError(f"--test: expected {' or '.join(get_args(Test))}, found {test}")
    rows = read(folder, task)
    methods = sorted({row["method"] for some in rows.values() for row in some})
    if against is not None and against not in methods:
        raise CdiffError(
            f'--against: no runs of "{against}"{suggestion(against, methods)} here; '
            f"there are {', '.join(methods)}"
        )
    paper = tables.read_paper(home() / "runs" / "reference" / "paper.csv")
    parts = []
    for kind, some in rows.items():
        metrics = selection.metrics(kind, style)
        groups = compare(some, intervals=intervals)
        if not any(name in group.cells for group in groups for name in metrics):
            continue
        beside = paper if selection.paper and (kind != "rollouts" or style == "json") else None
        tested = [] if against is None else differences(some, against, metrics, test)
        parts.append(Part(kind, groups, metrics, beside, tested))
    if not parts:
        raise CdiffError(f"--columns: no run here has {' or '.join(selection.columns)}")
    notes = [
        tables.notes(part.groups, part.metrics) if part.paper and part.kind != "rollouts" else []
        for part in parts
    ]
    if style == "json":
        _print_json(parts, notes, against)
    elif style == "csv":
        _print_csv(parts, notes)
    else:
        drop = selection.may_drop and not intervals
        _print_tables(parts, notes, style, against, TESTS[test], out, drop)
    if style == "rich":
        bounds = (
            "; in brackets 95 % intervals: bootstrap (BCa) of means, Clopper-Pearson of rates"
            if intervals
            else ""
        )
        out.print(CAPTION + bounds, style="dim", highlight=False)


def read(folder: Path, task: str | None) -> dict[str, list[c.Row]]:
    """Rows of the runs in a folder, by kind of run: plans, rollouts, closed loop.

    task   only rows of this task; None: of all
    """
    if not folder.is_dir():
        raise CdiffError(f"{folder}: no such folder; make a run first: cdiff plan --method alm")
    plans, rollouts = (
        [row for row in rows if task in (None, row["task"])] for rows in merge_kinds(folder)
    )
    if not plans and not rollouts:
        of_task = f" of {task}" if task else ""
        raise CdiffError(
            f"{folder}: no runs{of_task} here; make one first: cdiff plan --method alm"
        )
    by_kind = {
        "plans": plans,
        "rollouts": [row for row in rollouts if "plan_violation" not in row],
        "closed loop": [row for row in rollouts if "plan_violation" in row],
    }
    return {kind: rows for kind, rows in by_kind.items() if rows}


def _print_json(parts: Sequence[Part], notes: Sequence[Sequence[str]], against: str | None) -> None:
    objects: dict[str, Any] = {}
    for part, said in zip(parts, notes, strict=True):
        objects[part.kind] = json.loads(
            tables.render(part.groups, part.metrics, "json", part.paper)
        )
        if against is not None:
            objects[f"{part.kind} against {against}"] = json.loads(
                tables.render_differences(part.tested, "json", "")
            )
        objects |= {"notes": said} if said else {}
    typer.echo(json.dumps(objects, indent=2))


def _print_csv(parts: Sequence[Part], notes: Sequence[Sequence[str]]) -> None:
    paper = next((part.paper for part in parts if part.paper), None)
    tested = [(part.kind, one) for part in parts for one in part.tested]
    compared = [(part.kind, part.groups, part.metrics) for part in parts]
    typer.echo(tables.csv_table(compared, paper, tested))
    for said in notes:
        for note in said:
            typer.echo(f"note: {note}", err=True)


def _print_tables(
    parts: Sequence[Part],
    notes: Sequence[Sequence[str]],
    style: str,
    against: str | None,
    test: str,
    out: Console,
    drop: bool,
) -> None:
    for part, said in zip(parts, notes, strict=True):
        _print_table(
            tables.text_table(part.groups, part.metrics, part.paper), part.kind, style, out, drop
        )
        if against is not None:
            title = f"{part.kind} against {against}: {test}, paired by seed"
            _print_table(tables.differences_table(part.tested), title, style, out, False)
        for note in said:
            typer.echo(MARKS.get(style, "note: ") + note)


def _print_table(table: TextTable, title: str, style: str, out: Console, drop: bool) -> None:
    if style != "rich":
        typer.echo(markdown(table) if style == "markdown" else latex(table))
        return
    shown, left_out = terminal(table, title, out.width, drop)
    out.print(shown, highlight=False)
    if left_out:
        names = ", ".join(left_out)
        out.print(f"left out for want of width: {names}; --wide shows all", style="dim")
    out.print()
