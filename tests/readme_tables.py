"""The tables of the README and docs/results.md, made from the rows in runs/reference/: `make tables` writes them, a test fails when
they drift.

A table stands between `<!-- table NAME -->` and `<!-- end -->`.
"""

import re
import sys
from collections.abc import Callable
from pathlib import Path

from cdiff_cli.commands import run_directory
from cdiff_cli.evaluation import columns, comparison, tables

ROOT = Path(__file__).parent.parent
REFERENCE = ROOT / "runs" / "reference"
PAGES = (ROOT / "README.md", ROOT / "docs" / "results.md")
MARKED = re.compile(r"(<!-- table (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)

PAPER = (
    *(
        "distance",
        "distance_paper",
        "violation",
        "violation_paper",
        "worst_segment",
        "unsafe_segments",
    ),
    *("jump", "torn", "wall", "calls"),
)
FEW = ("distance", "wall", "residual", "effort", "safe_segments", "safe_executed", "success")
SAFETY = (*columns.SAFETY_TABLE[:-2], "torn", "distance")
BRIEF = ("distance", "violation_paper", "unsafe_segments", "torn", "wall")
IN_BRIEF = ("reward", "violation_rate", "executed_violation", "safe_executed", "fell")
CONTROL = (
    "reward",
    "plan_violation",
    "violation_rate",
    "executed_violation",
    "executed_worst",
    "safe_executed",
    "fell",
    "calls",
)
BALL = (
    "reward",
    "violation_rate",
    "executed_violation",
    "executed_worst",
    "safe_executed",
    "contacts",
    "braked",
    "calls",
)
QUALITY = (
    "wall",
    "smooth",
    "success",
    "jump",
    "residual",
    "acceleration",
    "effort",
    "goal_distance",
)


def of_rows(name: str, columns: tuple[str, ...], paper: bool = False) -> str:
    """A comparison of the rows in runs/reference/NAME/rows.csv."""
    values = tables.read_paper(REFERENCE / "paper.csv") if paper else None
    return tables.render(
        comparison.compare(run_directory.read_rows(REFERENCE / name / "rows.csv")),
        columns,
        "markdown",
        values,
    )


def in_short(
    names: tuple[str, ...],
    columns: tuple[str, ...],
    shown: tuple[tuple[str, str], ...],
    paper: bool = False,
) -> str:
    """The same of several, one (method, preset) of `shown` after the other for each constraint file."""
    values = tables.read_paper(REFERENCE / "paper.csv") if paper else None
    groups = [
        group
        for name in names
        for group in comparison.compare(run_directory.read_rows(REFERENCE / name / "rows.csv"))
    ]
    found = {group.key: group for group in groups}
    asked = [
        (*files, *pair)
        for files in dict.fromkeys(group.key[:2] for group in groups)
        for pair in shown
    ]
    return tables.render([found[key] for key in asked if key in found], columns, "markdown", values)


def of_metrics() -> str:
    """What each column means."""
    lines = [
        f"| {column.title} | {column.meaning.replace('|', '&#124;')} |"
        for column in columns.COLUMNS.values()
    ]
    return "\n".join(["| column | definition |", "| --- | --- |", *lines])


MAZES = (
    *(
        ("diffuser", "paper"),
        ("conditional", "paper"),
        ("safediffuser", "paper"),
        ("projected", "paper"),
    ),
    *(
        ("primal-dual", "released"),
        ("alm", "released"),
        ("projected", "recommended"),
        ("alm", "recommended"),
    ),
)
THREE = (("diffuser", "recommended"), ("projected", "paper"), ("alm", "recommended"))
ACTING = (
    *(("diffuser", "recommended"), ("conditional", "paper"), ("projected", "paper")),
    *(("alm", "released"), ("alm", "recommended")),
)

TABLES: dict[str, Callable[[], str]] = {
    "safety-short": lambda: in_short(
        ("safety-umaze", "safety-large"), (*SAFETY[:4], "distance"), THREE
    ),
    "table1-short": lambda: in_short(("table1-umaze", "table1-large"), BRIEF, MAZES, paper=True),
    "table2-short": lambda: in_short(
        ("table2-hopper", "table2-swimmer"), IN_BRIEF, ACTING, paper=True
    ),
    "table1-umaze": lambda: of_rows("table1-umaze", PAPER, paper=True),
    "table1-large": lambda: of_rows("table1-large", PAPER, paper=True),
    "safety-umaze": lambda: of_rows("safety-umaze", SAFETY),
    "safety-large": lambda: of_rows("safety-large", SAFETY),
    "table2-hopper": lambda: of_rows("table2-hopper", CONTROL, paper=True),
    "table2-swimmer": lambda: of_rows("table2-swimmer", CONTROL, paper=True),
    "table3": lambda: of_rows("table3", BALL, paper=True),
    "few-steps": lambda: of_rows("few-steps", FEW),
    "fresh": lambda: of_rows("fresh", IN_BRIEF),
    "quality": lambda: of_rows("quality", QUALITY),
    "metrics": of_metrics,
}


def filled(text: str) -> str:
    """The text with every marked table made anew."""
    return MARKED.sub(lambda found: f"{found[1]}{TABLES[found[2]]()}\n{found[3]}", text)


if __name__ == "__main__":
    for page in PAGES:
        old = page.read_text()
        page.write_text(filled(old))
        sys.stderr.write(
            f"{page.name}: its tables are up to date\n"
            if filled(old) == old
            else f"{page.name}: tables rewritten\n"
        )
