"""Run directories: a run appears only when it is whole. Its rows.csv and run.yaml."""

import contextlib
import csv
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from cdiff_cli.errors import CdiffError
from cdiff_cli.evaluation.columns import COLUMNS, KEYS, Row
from cdiff_cli.yaml_files import Dumper


class NewRun:
    """A run being written.

    path   the temporary directory; after the `new_run` block the final one
    """

    def __init__(self, path: Path) -> None:
        self.path = path


@contextlib.contextmanager
def new_run(root: Path, name: str) -> Iterator[NewRun]:
    """A directory to write a run into.

    It appears below root, as <time>-<name>, only when the block ends without an error.
    """
    root.mkdir(parents=True, exist_ok=True)
    stem = f"{time.strftime('%Y%m%d-%H%M%S')}-{name}"
    partial = Path(tempfile.mkdtemp(prefix=f".{stem}-", dir=root))
    run = NewRun(partial)
    try:
        yield run
        partial.chmod(0o755)
        run.path, number = root / stem, 1
        while run.path.exists():
            run.path, number = root / f"{stem}-{number}", number + 1
        partial.rename(run.path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def find_rows(root: Path) -> list[Path]:
    """All rows.csv of the finished runs in a folder."""
    return sorted(p for p in root.glob("*/rows.csv") if not p.parent.name.startswith("."))


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]) if rows else [])
        writer.writeheader()
        writer.writerows(rows)


def read_rows(path: Path) -> list[Row]:
    """Rows with their metrics as numbers; raises CdiffError where the file holds no rows."""
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            numbered = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CdiffError(f"{path}: cannot be read: {error}") from None
    for number, row in numbered:
        if any(row.get(key) is None for key in KEYS):
            lacking = ", ".join(key for key in KEYS if row.get(key) is None)
            raise CdiffError(f"{path}:{number}: not a row of a run: it lacks {lacking}")
        for name in row:
            if name in COLUMNS and row[name] not in ("", None):
                try:
                    row[name] = float(row[name])
                except ValueError:
                    raise CdiffError(
                        f"{path}:{number}: {name} is not a number: {row[name]!r}"
                    ) from None
    return [row for _, row in numbered]


def write_yaml(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(yaml.dump(dict(content), Dumper=Dumper, sort_keys=False, allow_unicode=True))


def merge_kinds(root: Path) -> tuple[list[Row], list[Row]]:
    """The rows of plans and the rows of rollouts of all runs in a folder, oldest run first."""
    plans: list[Row] = []
    rollouts: list[Row] = []
    for path in find_rows(root):
        rows = read_rows(path)
        (rollouts if rows and "violation_rate" in rows[0] else plans).extend(rows)
    return plans, rollouts
