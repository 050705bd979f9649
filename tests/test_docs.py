"""The tables of the README and docs/results.md are those of runs/reference/."""

import pytest
from readme_tables import MARKED, PAGES, TABLES, filled

from cdiff_cli.runs import COLUMNS


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_table_is_what_its_rows_say(page):
    text = page.read_text()
    assert filled(text) == text, "run `make tables`"


def test_every_table_has_its_place():
    assert sorted(name for page in PAGES for _, name, _ in MARKED.findall(page.read_text())) == sorted(TABLES)


def test_every_column_is_defined():
    text = "".join(page.read_text() for page in PAGES)
    assert [name for name, column in COLUMNS.items() if f"| {column.title} |" not in text] == []
