"""What `cdiff plan`, `rollout` and `rerun` print of a finished run."""

import json
from collections.abc import Sequence
from typing import Any

import typer
from rich.console import Console

from cdiff_cli.evaluation.columns import (
    COLUMNS,
    CONTROL_TABLE,
    QUALITY_TABLE,
    ROLLOUT_TABLE,
    SAFETY_TABLE,
)
from cdiff_cli.evaluation.comparison import Group, compare
from cdiff_cli.evaluation.layout import plain_table
from cdiff_cli.evaluation.tables import render


def rollout_table(acts: bool) -> tuple[str, ...]:
    """The metrics printed of a rollout; acts: of a control task."""
    if acts:
        return CONTROL_TABLE
    return tuple(dict.fromkeys((*SAFETY_TABLE, *ROLLOUT_TABLE, *QUALITY_TABLE)))


def print_run(finished: Any, metrics: Sequence[str], as_json: bool, out: Console) -> None:
    """Print a run's table, directory, picture and certificate; exit code 1 where it has a warning.

    finished   what plan_run, rollout_run or control_run returns
    """
    groups = compare(
        [
            {k: float(v) if isinstance(v, int) and k != "seed" else v for k, v in row.items()}
            for row in finished.rows
        ]
    )
    if as_json:
        record = {
            "run": str(finished.path),
            "summary": json.loads(render(groups, metrics, "json")),
            "certificate": finished.counts,
            "notes": list(finished.notes),
        }
        typer.echo(json.dumps(record))
    else:
        _print_group(groups[0], metrics, out)
        for note in finished.notes:
            typer.echo(note)
        typer.echo(f"run          {finished.path}")
        typer.echo(f"picture      {finished.picture}")
        typer.echo(finished.verdict)
    if finished.warning:
        typer.echo(f"warning: {finished.warning}", err=True)
        raise typer.Exit(1)


def _print_group(group: Group, metrics: Sequence[str], out: Console) -> None:
    """One line per metric: heading, mean ± standard error, definition."""
    from rich.markup import escape

    title = f"{', '.join(dict.fromkeys(group.key))}, n = {group.n}"
    out.print(title, style="italic", highlight=False, markup=False)
    table = plain_table()
    table.add_column("metric", no_wrap=True)
    table.add_column("mean ± standard error", justify="right", no_wrap=True)
    table.add_column("meaning", style="dim")
    for name in metrics:
        if name in group.cells:
            column = COLUMNS[name]
            value = group.cells[name].text(column.digits)
            table.add_row(column.title, value, escape(column.meaning))
    out.print(table, highlight=False)
    out.print()
