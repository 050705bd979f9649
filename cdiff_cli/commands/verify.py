"""`cdiff verify`: recompute the certificate of a run from its saved arrays, with no model."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cdiff_cli.commands.saved_run import (
    FILES,
    find_runs,
    read_certificate,
    read_problem,
    read_saved,
)
from cdiff_cli.errors import CdiffError
from cdiff_cli.evaluation.certificate import Entry, certificate, summary
from cdiff_cli.evaluation.layout import plain_table
from cdiff_cli.progress import progress

VALUE_TOLERANCE = 1e-9  # on values, relative above 1: another processor sums in another order
PLACE_TOLERANCE = 1e-6  # on the point of a segment, where a flat maximum is at
AS_RECORDED = "verified were the constraints as recorded in run.yaml"


@dataclass(frozen=True)
class Verified:
    """A run whose certificate was recomputed.

    recomputed   certificate of the arrays as they are
    mismatch     why certificate.json is not that
    notes        what is worth knowing and changes nothing
    """

    path: Path
    recomputed: Entry
    mismatch: tuple[str, ...]
    notes: tuple[str, ...]

    def holds(self, waypoints_only: bool) -> bool:
        """Whether the certificate is true and every plan safe.

        waypoints_only   safe at the waypoints; else between them too
        """
        return not self.mismatch and all(
            _passes(entry, waypoints_only) for entry in self.recomputed["entries"]
        )

    def verdict(self, waypoints_only: bool) -> str:
        """One line: certified or not, the run, its counts, its mismatch."""
        word = "certified" if self.holds(waypoints_only) else "NOT certified"
        reason = "; ".join(self.mismatch) or "certificate.json and its arrays agree"
        scope = " (waypoints only)" if waypoints_only else ""
        return f"{word:13}  {self.path}{scope}: {summary(self.recomputed['counts'])}; {reason}"

    def report(self, waypoints_only: bool) -> dict[str, Any]:
        """The same for programs."""
        return {
            "run": str(self.path),
            "certified": self.holds(waypoints_only),
            "matches": not self.mismatch,
            "mismatch": list(self.mismatch),
            "notes": list(self.notes),
            "counts": self.recomputed["counts"],
            "constraints": _by_constraint(self.recomputed, waypoints_only),
        }


def print_verified(
    places: Sequence[Path], waypoints_only: bool, as_json: bool, out: Console
) -> int:
    """Verify all runs at these places, print the results and return the exit code.

    0: every certificate is true and every plan safe; 1: not so; 2: a run cannot be read
    """
    with progress() as tick:
        verified, errors = verify_runs(places, tick)
    for run in verified:
        for note in run.notes:
            typer.echo(f"note: {note}", err=True)
    for error in errors:
        typer.echo(f"error: {error}", err=True)
    if as_json:
        reports = [run.report(waypoints_only) for run in verified]
        typer.echo(json.dumps({"runs": reports, "errors": errors}))
    elif verified:
        out.print("largest g over all plans, positive is unsafe", style="italic")
        out.print(table(verified, waypoints_only), highlight=False)
        out.print()
        for run in verified:
            typer.echo(run.verdict(waypoints_only))
    if errors:
        return 2
    return 0 if all(run.holds(waypoints_only) for run in verified) else 1


def verify_runs(
    places: Sequence[Path], tick: Callable[[str, int, int], None]
) -> tuple[list[Verified], list[str]]:
    """All runs at these places, and one line for each that cannot be read."""
    verified, errors, paths = [], [], []
    for place in places:
        try:
            paths += find_runs(place)
        except CdiffError as error:
            errors.append(str(error))
    for done, path in enumerate(dict.fromkeys(paths)):
        tick("verify", done, len(paths))
        try:
            verified.append(verify_run(path))
        except CdiffError as error:
            errors.append(str(error))
    return verified, errors


def verify_run(path: Path) -> Verified:
    """Recompute a run's certificate from run.yaml, plan.npz and rollout.npz.

    Raises CdiffError where one of them cannot be read.
    """
    if (path / "rollout.npz").exists() and not any((path / name).exists() for name in FILES[1:]):
        raise CdiffError(
            f"{path}: a closed-loop run, planned anew at every step; certificates are of whole "
            "plans: what it executed is scored in its rows.csv, see `cdiff compare`"
        )
    for name in FILES:
        if not (path / name).is_file():
            raise CdiffError(f"{path}: {name} is missing; plan again, or restore it")
    stored = read_certificate(path / "certificate.json")
    task, recorded, g = read_problem(path / "run.yaml")
    plan = read_saved(path / "plan.npz", task)
    rollout = None
    if (path / "rollout.npz").exists():
        rollout = read_saved(path / "rollout.npz", task, may_end=True)
        if list(rollout.seeds) != list(plan.seeds):
            raise CdiffError(
                f"{path / 'rollout.npz'}: its seeds are not those of plan.npz; "
                "the two are of different runs"
            )
    elif stored["rollout_sha256"] is not None:
        raise CdiffError(
            f"{path}: rollout.npz is missing, which certificate.json speaks of; "
            "roll out again, or restore it"
        )
    recomputed = certificate(task, recorded, g, plan, rollout)
    mismatch = tuple(_mismatch(stored, recomputed))
    return Verified(path, recomputed, mismatch, tuple(_notes(path, recorded)))


def _mismatch(stored: Mapping[str, Any], recomputed: Mapping[str, Any]) -> Iterator[str]:
    """Why the stored certificate is not the recomputed one.

    Altered files are named, then the first entry that differs.
    """
    if stored.get("plan_sha256") != recomputed["plan_sha256"]:
        yield "plan.npz was altered after its certificate was written (sha256)"
    if stored.get("rollout_sha256") != recomputed["rollout_sha256"]:
        yield "rollout.npz was altered after its certificate was written (sha256)"
    if stored.get("constraints") != recomputed["constraints"]:
        yield "the constraints in run.yaml are not those of the certificate"
    hashed = ("plan_sha256", "rollout_sha256", "constraints")
    stored_entries, entries = (
        {key: value for key, value in side.items() if key not in hashed}
        for side in (stored, recomputed)
    )
    difference = next(_differences(stored_entries, entries, ""), None)
    if difference:
        yield f"certificate.json is not what its arrays give: {difference}"


def _differences(
    stored: Any, recomputed: Any, where: str, tolerance: float = VALUE_TOLERANCE
) -> Iterator[str]:
    if isinstance(stored, dict) and isinstance(recomputed, dict):
        for key in dict.fromkeys((*recomputed, *stored)):
            inner = f"{where}.{key}" if where else str(key)
            if key not in stored or key not in recomputed:
                yield f"{inner} {'is missing' if key not in stored else 'is not of a certificate'}"
            else:
                loose = where.endswith("segments") and key in ("time", "state")
                yield from _differences(
                    stored[key], recomputed[key], inner, PLACE_TOLERANCE if loose else tolerance
                )
    elif isinstance(stored, list) and isinstance(recomputed, list):
        if len(stored) != len(recomputed):
            yield f"{where} has {len(stored)}, recomputed {len(recomputed)}"
        for i, (one, other) in enumerate(zip(stored, recomputed, strict=False)):
            yield from _differences(one, other, f"{where}[{i}]", tolerance)
    elif not _equal(stored, recomputed, tolerance):
        yield f"{where} says {json.dumps(stored)[:60]}, recomputed {json.dumps(recomputed)[:60]}"


def _equal(stored: Any, recomputed: Any, tolerance: float) -> bool:
    number = isinstance(stored, int | float) and not isinstance(stored, bool)
    if isinstance(recomputed, float) and number:
        slack = tolerance * max(1.0, abs(recomputed))
        return abs(stored) < 1e300 and abs(stored - recomputed) <= slack
    return type(stored) is type(recomputed) and bool(stored == recomputed)


def _notes(path: Path, recorded: Mapping[str, Any]) -> Iterator[str]:
    file = Path(recorded["file"])
    try:
        same = hashlib.sha256(file.read_bytes()).hexdigest() == recorded["sha256"]
    except OSError:
        yield f"{path}: {file} cannot be read from here; {AS_RECORDED}"
        return
    if not same:
        yield f"{path}: {file} has changed since; {AS_RECORDED}"


def table(verified: Sequence[Verified], waypoints_only: bool) -> Table:
    """One row per constraint: worst values over all plans, where they are, number of safe plans."""
    several = len(verified) > 1
    shown = plain_table()
    headings = ("constraint", "worst waypoint", "worst segment", "executed", "exact")
    for heading in (*(("run",) if several else ()), *headings):
        shown.add_column(heading, overflow="fold")
    shown.add_column("plans safe", justify="right")
    for run in verified:
        for row in _by_constraint(run.recomputed, waypoints_only):
            cells = [_cell(row[what]) for what in ("waypoints", "segments", "executed")]
            count = f"{row['safe']} of {row['plans']}"
            name = (escape(run.path.name),) if several else ()
            exact = "yes" if row["exact"] else "no"
            shown.add_row(*name, escape(row["constraint"]), *cells, exact, count)
    return shown


def _by_constraint(recomputed: Entry, waypoints_only: bool) -> list[Entry]:
    """Per constraint: the worst over all plans, its seed, and the number of safe plans."""
    rows = []
    for name in dict.fromkeys(entry["constraint"] for entry in recomputed["entries"]):
        entries = [entry for entry in recomputed["entries"] if entry["constraint"] == name]
        worst = {what: _worst(entries, what) for what in ("waypoints", "segments", "executed")}
        rows.append(
            {"constraint": name}
            | worst
            | {
                "exact": all(entry["segments"]["exact"] for entry in entries),
                "safe": sum(_passes(entry, waypoints_only) for entry in entries),
                "plans": len(entries),
            }
        )
    return rows


def _passes(entry: Entry, waypoints_only: bool) -> bool:
    return bool(entry["waypoints"]["safe"] and (waypoints_only or entry["segments"]["safe"]))


def _worst(entries: Sequence[Entry], what: str) -> Entry | None:
    """The worst of these entries; None where none has a value (no rows, no rollout).

    A value that is not a number counts as the worst.
    """
    judged = [
        entry
        for entry in entries
        if what in entry and (entry[what]["worst"] is not None or not entry[what]["safe"])
    ]
    if not judged:
        return None
    worst = max(
        judged,
        key=lambda entry: float("inf") if entry[what]["worst"] is None else entry[what]["worst"],
    )
    return {"seed": worst["seed"], "worst": worst[what]["worst"], "time": worst[what]["time"]}


def _cell(worst: Entry | None) -> str:
    if worst is None:
        return "-"
    value = "not a number" if worst["worst"] is None else f"{worst['worst']:.4g}"
    at = "" if worst["time"] is None else f" at {worst['time']:.4g} s"
    return f"{value}{at}, seed {worst['seed']}"
