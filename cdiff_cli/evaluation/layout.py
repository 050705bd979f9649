"""Tables of text in four formats: for a terminal of some width, as markdown, as LaTeX, as CSV."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.cells import cell_len
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

GAP = 2  # columns of the terminal between two columns of a table


@dataclass(frozen=True)
class TextTable:
    """Cells as text, and how they may be arranged.

    left       number of leading columns that are left aligned
    keys       number of leading columns that say what a row is about
    sections   columns of the keys that become headings over groups of rows where they vary
    together   the columns after the keys, in groups that stay in one table of a terminal
    narrow_sections   further sections where the width is scarce
    """

    header: Sequence[str]
    lines: Sequence[Sequence[str]]
    left: int
    keys: int
    sections: Sequence[int] = ()
    together: Sequence[Sequence[int]] = ()
    narrow_sections: Sequence[int] = ()


def plain_table() -> Table:
    """A rich table with GAP between its columns and one line below the headings."""
    return Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, GAP - 1, 0, 0))


def markdown(table: TextTable) -> str:
    rule = ["---"] * table.left + ["---:"] * (len(table.header) - table.left)
    return "\n".join("| " + " | ".join(line) + " |" for line in [table.header, rule, *table.lines])


def latex(table: TextTable) -> str:
    body = [" & ".join(_latex(cell) for cell in line) + r" \\" for line in table.lines]
    columns = "l" * table.left + "r" * (len(table.header) - table.left)
    heading = " & ".join(_latex(cell) for cell in table.header) + r" \\"
    top = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", heading, r"\midrule"]
    return "\n".join([*top, *body, r"\bottomrule", r"\end{tabular}"])


def comma_separated(header: Sequence[str], lines: Sequence[Sequence[Any]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *lines])
    return text.getvalue().rstrip("\n")


def terminal(
    table: TextTable, title: str, width: int | None = None, drop: bool = False
) -> tuple[RenderableType, list[str]]:
    """The table for a terminal, and the headings that it leaves out.

    A key that all rows share stands in the title. No heading is wrapped: columns that do not fit
    into the width are left out where drop is set, else they follow in a further table below.

    width   columns of the terminal; None: as many as it takes
    """
    same = [i for i in range(table.keys) if len({line[i] for line in table.lines}) == 1]
    sections = [i for i in table.sections if i not in same]
    inline = [i for i in range(table.keys) if i not in same and i not in sections]
    blocks, left_out = _packed(table, inline, width, drop)
    further = [i for i in table.narrow_sections if i in inline]
    scarce = left_out or len(blocks) > 1 or not _fits(table, [*inline, *blocks[0]], width)
    if further and scarce:
        headings = len({tuple(line[i] for i in (*sections, *further)) for line in table.lines})
        if 2 * headings <= len(table.lines):
            sections += further
            inline = [i for i in inline if i not in further]
            blocks, left_out = _packed(table, inline, width, drop)
    common = dict.fromkeys(_key(table, i, table.lines[0]) for i in same)
    heading = " · ".join(part for part in (title, ", ".join(common)) if part)
    parts: list[RenderableType] = [Text(heading, style="italic")] if heading else []
    for block in blocks:
        columns = [*inline, *block]
        parts += _sections(table, sections, columns, _fits(table, columns, width))
    return Group(*parts), [table.header[i] for i in left_out]


def _key(table: TextTable, i: int, line: Sequence[str]) -> str:
    return f"n = {line[i]}" if table.header[i] == "n" else line[i]


def _width(table: TextTable, i: int) -> int:
    return max(cell_len(text) for text in (table.header[i], *(line[i] for line in table.lines)))


def _fits(table: TextTable, columns: Sequence[int], width: int | None) -> bool:
    return width is None or sum(_width(table, i) + GAP for i in columns) - GAP <= width


def _packed(
    table: TextTable, inline: Sequence[int], width: int | None, drop: bool
) -> tuple[list[list[int]], list[int]]:
    """The columns after the keys in as few tables as the width allows, and those left out."""
    units = table.together or [[i] for i in range(table.keys, len(table.header))]
    taken = sum(_width(table, i) + GAP for i in inline)
    room = float("inf") if width is None else width + GAP - taken
    blocks: list[list[int]] = [[]]
    left_out: list[int] = []
    left = room
    for unit in units:
        needed = sum(_width(table, i) + GAP for i in unit)
        if needed > left and blocks[-1]:
            if drop:
                left_out += unit
                continue
            blocks.append([])
            left = room
        blocks[-1] += unit
        left -= needed
    return blocks, left_out


def _sections(
    table: TextTable, sections: Sequence[int], columns: Sequence[int], aligned: bool
) -> list[RenderableType]:
    """One table per section, all with equal column widths where they are aligned."""
    parts: list[RenderableType] = []
    by_section: dict[tuple[str, ...], list[Sequence[str]]] = {}
    for line in table.lines:
        by_section.setdefault(tuple(line[i] for i in sections), []).append(line)
    for section, lines in by_section.items():
        if section:
            parts.append(Text("\n" + ", ".join(dict.fromkeys(section)), style="bold"))
        shown = plain_table()
        for i in columns:
            shown.add_column(
                table.header[i],
                justify="left" if i < table.left else "right",
                min_width=_width(table, i) if aligned else None,
                overflow="fold",
            )
        for line in lines:
            shown.add_row(*(line[i] for i in columns))
        parts.append(shown)
    return parts


def _latex(cell: str) -> str:
    for plain, escaped in (("±", r"$\pm$"), ("%", r"\%"), ("_", r"\_"), ("^2", r"$^2$")):
        cell = cell.replace(plain, escaped)
    return cell
