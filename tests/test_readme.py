"""The README's tables are those of runs/reference/."""

from readme_tables import MARKED, ROOT, TABLES, filled

README = (ROOT / "README.md").read_text()


def test_every_table_of_the_readme_is_what_its_rows_say():
    assert filled(README) == README, "run `make tables`"


def test_every_table_has_its_place_in_the_readme():
    assert sorted(name for _, name, _ in MARKED.findall(README)) == sorted(TABLES)
