"""`cdiff verify`: recompute the certificate of a run from its saved arrays, with no model loaded, and hold it against the file."""

import hashlib
import io
import json
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, create_model
from rich.markup import escape
from rich.table import Table

from cdiff_cli.constraints.spec.load import file_model
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.errors import CdiffError, suggestion
from cdiff_cli.evaluation.certificate import FORMAT, Entry, Saved, certificate, summary
from cdiff_cli.tasks import load_task
from cdiff_cli.tasks.protocol import Task
from cdiff_cli.yaml_files import Document

FILES = ("run.yaml", "plan.npz", "certificate.json")
VALUE_TOLERANCE = (
    1e-9  # of values and coordinates, relative above 1: another processor sums in another order
)
PLACE_TOLERANCE = (
    1e-6  # of the point on a segment, which a flat maximum leaves open to the root of that
)


@dataclass(frozen=True)
class Verified:
    """A run whose certificate was recomputed.

    found      the certificate of what lies there now
    mismatch   why certificate.json is not it
    notes      what is worth knowing and changes nothing
    """

    path: Path
    found: Entry
    mismatch: tuple[str, ...]
    notes: tuple[str, ...]

    def holds(self, waypoints_only: bool) -> bool:
        """Whether the certificate is true and every plan is safe: at its waypoints, and unless told otherwise between them."""
        return not self.mismatch and all(
            _passes(entry, waypoints_only) for entry in self.found["entries"]
        )

    def verdict(self, waypoints_only: bool) -> str:
        word = "certified" if self.holds(waypoints_only) else "NOT certified"
        said = "; ".join(self.mismatch) or "certificate.json and its arrays agree"
        scope = " (waypoints only)" if waypoints_only else ""
        return f"{word:13}  {self.path}{scope}: {summary(self.found['counts'])}; {said}"

    def report(self, waypoints_only: bool) -> dict[str, Any]:
        """For machines."""
        return {
            "run": str(self.path),
            "certified": self.holds(waypoints_only),
            "matches": not self.mismatch,
            "mismatch": list(self.mismatch),
            "notes": list(self.notes),
            "counts": self.found["counts"],
            "constraints": _by_constraint(self.found, waypoints_only),
        }


def verify_runs(
    places: Sequence[Path], tick: Callable[[str, int, int], None]
) -> tuple[list[Verified], list[str]]:
    """All runs at these places, and a line for each that cannot be read."""
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


def find_runs(place: Path) -> list[Path]:
    """The run that this is, or the runs directly in this folder, unfinished ones left out; raises CdiffError."""

    def is_run(path: Path) -> bool:
        return any((path / name).exists() for name in FILES)

    try:
        if not place.exists():
            raise CdiffError(f"{place}: no such run; make one first: cdiff plan --method alm")
        if not place.is_dir():
            raise CdiffError(f"{place}: not a folder; name the run directory")
        if is_run(place):
            return [place]
        runs = sorted(
            path
            for path in place.iterdir()
            if path.is_dir() and not path.name.startswith(".") and is_run(path)
        )
    except OSError as error:
        raise CdiffError(f"{place}: cannot be read: {error.strerror}") from None
    if not runs:
        raise CdiffError(
            f"{place}: no run here, which would have {', '.join(FILES)}; make one first: cdiff plan --method alm"
        )
    return runs


def verify_run(path: Path) -> Verified:
    """Recompute a run's certificate from run.yaml, plan.npz and rollout.npz; raises CdiffError where one cannot be read."""
    if (path / "rollout.npz").exists() and not any((path / name).exists() for name in FILES[1:]):
        raise CdiffError(
            f"{path}: a closed-loop run, planned anew at every step; certificates are of whole plans: what it executed is scored "
            "in its rows.csv, see `cdiff compare`"
        )
    for name in FILES:
        if not (path / name).is_file():
            raise CdiffError(f"{path}: {name} is missing; plan again, or restore it")
    stored = _read_certificate(path / "certificate.json")
    task, recorded, g = _read_problem(path / "run.yaml")
    plan = read_saved(path / "plan.npz", task)
    rollout = None
    if (path / "rollout.npz").exists():
        rollout = read_saved(path / "rollout.npz", task, may_end=True)
        if list(rollout.seeds) != list(plan.seeds):
            raise CdiffError(
                f"{path / 'rollout.npz'}: its seeds are not those of plan.npz; the two are of different runs"
            )
    elif stored["rollout_sha256"] is not None:
        raise CdiffError(
            f"{path}: rollout.npz is missing, which certificate.json speaks of; roll out again, or restore it"
        )
    found = certificate(task, recorded, g, plan, rollout)
    return Verified(path, found, tuple(_mismatch(stored, found)), tuple(_notes(path, recorded)))


# reading --------------------------------------------------------------------------------------------------------------


def read_saved(path: Path, task: Task, may_end: bool = False) -> Saved:
    """The trajectories of plan.npz or, where episodes may end early, of rollout.npz; raises CdiffError."""

    def refuse(why: str) -> NoReturn:
        raise CdiffError(f"{path}: {why}")

    try:
        content = path.read_bytes()  # once: what is hashed is what is read
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            lacking = [name for name in ("x", "layout", "seed") if name not in arrays]
            if lacking:
                refuse(f"lacks {', '.join(lacking)}; it is not of this version of cdiff")
            x, layout, seeds = (np.asarray(arrays[name]) for name in ("x", "layout", "seed"))
    except (
        OSError,
        ValueError,
        TypeError,
        EOFError,
        KeyError,
        RuntimeError,
        MemoryError,
        zipfile.BadZipFile,
        zlib.error,
    ):
        refuse("damaged, cannot be read as numpy arrays; plan again, or restore it")
    if layout.shape != (len(task.layout),) or [str(name) for name in layout] != list(task.layout):
        refuse(
            f"expected the coordinates {', '.join(task.layout)} of {task.name}, found {', '.join(map(str, np.ravel(layout)))}"
        )
    if x.ndim != 3 or 0 in x.shape or x.shape[2] != len(layout) or x.dtype.kind not in "fiu":
        refuse(
            f"expected x as numbers [plans, steps, {len(layout)}], found {x.dtype} {list(x.shape)}"
        )
    if seeds.shape != x.shape[:1] or seeds.dtype.kind not in "iu":
        refuse(
            f"expected a whole-numbered seed for each of {len(x)} plans, found {seeds.dtype} {list(seeds.shape)}"
        )
    x = x.astype(np.float64)
    lost = _lost(x, may_end)
    if lost.any():
        refuse(
            f"the state of seed {int(seeds[lost.argmax()])} is not finite; no certificate can be given of it"
        )
    return Saved(x, [int(seed) for seed in seeds], hashlib.sha256(content).hexdigest())


def _lost(x: NDArray[np.float64], may_end: bool) -> NDArray[np.bool_]:
    """Which trajectories hold NaN or inf, other than as the rest after an episode's end."""
    finite = np.asarray(np.isfinite(x).all(-1))
    if not may_end:
        return np.asarray(~finite.all(1))
    after_the_end = (finite[:, 1:] & ~finite[:, :-1]).any(1)
    return ~finite[:, 0] | after_the_end | (~finite[..., None] & ~np.isnan(x)).any((1, 2))


def _read_certificate(path: Path) -> Entry:
    def constant(name: str) -> NoReturn:
        raise ValueError(name)

    try:
        stored = json.loads(path.read_text(encoding="utf-8"), parse_constant=constant)
    except (OSError, ValueError, RecursionError) as error:
        said = str(error).splitlines()[0]
        raise CdiffError(
            f"{path}: damaged, cannot be read as JSON ({said}); plan again, or restore it"
        ) from None
    if (
        not isinstance(stored, dict)
        or stored.get("format") != FORMAT
        or "rollout_sha256" not in stored
    ):
        found = stored.get("format", "none") if isinstance(stored, dict) else "none"
        raise CdiffError(
            f"{path}: expected a certificate of format {FORMAT}, found format {found}; plan again with this version"
        )
    return stored


def _read_problem(path: Path) -> tuple[Task, dict[str, Any], Constraint]:
    """The task of a run, its constraints as recorded, and those compiled; raises CdiffError."""
    document = Document(path)
    run = cast(Any, document.read(_run_model()))
    try:
        task: Task = load_task(run.options.task)
    except CdiffError as error:
        raise document.error(("options", "task"), str(error)) from None
    for i, spec in enumerate(run.constraints.content):
        for location, name in spec.coordinates():
            if name not in task.layout:
                known = ", ".join(task.layout)
                raise document.error(
                    ("constraints", "content", i, *location),
                    f'no coordinate "{name}" in {task.name}{suggestion(name, task.layout)}; it has {known}',
                )
    g = Constraint(tuple(spec.compile(task.layout) for spec in run.constraints.content))
    return task, cast(Any, document.value)["constraints"], g


def _run_model() -> type[BaseModel]:
    """What is read of run.yaml: the task, the constraints by the kinds of their own file."""
    kinds = file_model().model_fields["constraints"]
    content: Any = (Annotated[kinds.annotation, BeforeValidator(_as_written)], kinds)
    constraints = create_model("Constraints", file=(str, ...), sha256=(str, ...), content=content)
    options = create_model("Options", task=(str, ...))
    return create_model("Run", options=(options, ...), constraints=(constraints, ...))


def _as_written(content: Any) -> Any:
    """run.yaml records the defaults too; `form: distance` beside P is one that a constraint file may not say."""
    if isinstance(content, list):
        return [_as_written(item) for item in content]
    if isinstance(content, dict):
        moot = "P" in content and content.get("form") == "distance"
        return {
            key: _as_written(value)
            for key, value in content.items()
            if not (moot and key == "form")
        }
    return content


# comparing ------------------------------------------------------------------------------------------------------------


def _mismatch(stored: Mapping[str, Any], found: Mapping[str, Any]) -> Iterator[str]:
    """Why the stored certificate is not the one found: altered files by name, else the first entry that differs."""
    if stored.get("plan_sha256") != found["plan_sha256"]:
        yield "plan.npz was altered after its certificate was written (sha256)"
    if stored.get("rollout_sha256") != found["rollout_sha256"]:
        yield "rollout.npz was altered after its certificate was written (sha256)"
    if stored.get("constraints") != found["constraints"]:
        yield "the constraints in run.yaml are not those of the certificate"
    hashed = ("plan_sha256", "rollout_sha256", "constraints")
    said, gives = (
        {key: value for key, value in side.items() if key not in hashed} for side in (stored, found)
    )
    difference = next(_differences(said, gives, ""), None)
    if difference:
        yield f"certificate.json is not what its arrays give: {difference}"


def _differences(
    stored: Any, found: Any, where: str, tolerance: float = VALUE_TOLERANCE
) -> Iterator[str]:
    if isinstance(stored, dict) and isinstance(found, dict):
        for key in dict.fromkeys((*found, *stored)):
            inner = f"{where}.{key}" if where else str(key)
            if key not in stored or key not in found:
                yield f"{inner} {'is missing' if key not in stored else 'is not of a certificate'}"
            else:
                loose = where.endswith("segments") and key in ("time", "state")
                yield from _differences(
                    stored[key], found[key], inner, PLACE_TOLERANCE if loose else tolerance
                )
    elif isinstance(stored, list) and isinstance(found, list):
        if len(stored) != len(found):
            yield f"{where} has {len(stored)}, recomputed {len(found)}"
        for i, (one, other) in enumerate(zip(stored, found, strict=False)):
            yield from _differences(one, other, f"{where}[{i}]", tolerance)
    elif not _equal(stored, found, tolerance):
        yield f"{where} says {json.dumps(stored)[:60]}, recomputed {json.dumps(found)[:60]}"


def _equal(stored: Any, found: Any, tolerance: float) -> bool:
    if (
        isinstance(found, float)
        and isinstance(stored, int | float)
        and not isinstance(stored, bool)
    ):
        return abs(stored) < 1e300 and abs(stored - found) <= tolerance * max(1.0, abs(found))
    return type(stored) is type(found) and bool(stored == found)


def _notes(path: Path, recorded: Mapping[str, Any]) -> Iterator[str]:
    file = Path(recorded["file"])
    try:
        same = hashlib.sha256(file.read_bytes()).hexdigest() == recorded["sha256"]
    except OSError:
        yield f"{path}: {file} cannot be read from here; verified were the constraints as recorded in run.yaml"
        return
    if not same:
        yield f"{path}: {file} has changed since; verified were the constraints as recorded in run.yaml"


# showing --------------------------------------------------------------------------------------------------------------


def table(verified: Sequence[Verified], waypoints_only: bool) -> Table:
    """A row a constraint: its worst values over all plans, where they are, how many plans are safe."""
    several = len(verified) > 1
    shown = Table(title="largest g over all plans, positive is unsafe", title_justify="left")
    for heading in (("run",) if several else ()) + (
        "constraint",
        "worst waypoint",
        "worst segment",
        "executed",
        "exact",
    ):
        shown.add_column(heading, overflow="fold")
    shown.add_column("plans safe", justify="right")
    for run in verified:
        for row in _by_constraint(run.found, waypoints_only):
            cells = [_cell(row[what]) for what in ("waypoints", "segments", "executed")]
            count = f"{row['safe']} of {row['plans']}"
            name = (escape(run.path.name),) if several else ()
            shown.add_row(
                *name, escape(row["constraint"]), *cells, "yes" if row["exact"] else "no", count
            )
    return shown


def _by_constraint(found: Entry, waypoints_only: bool) -> list[Entry]:
    """For each constraint the worst over all plans, with the seed it belongs to, and how many plans are safe."""
    rows = []
    for name in dict.fromkeys(entry["constraint"] for entry in found["entries"]):
        mine = [entry for entry in found["entries"] if entry["constraint"] == name]
        worst = {what: _worst(mine, what) for what in ("waypoints", "segments", "executed")}
        rows.append(
            {"constraint": name}
            | worst
            | {
                "exact": all(entry["segments"]["exact"] for entry in mine),
                "safe": sum(_passes(entry, waypoints_only) for entry in mine),
                "plans": len(mine),
            }
        )
    return rows


def _passes(entry: Entry, waypoints_only: bool) -> bool:
    return bool(entry["waypoints"]["safe"] and (waypoints_only or entry["segments"]["safe"]))


def _worst(entries: Sequence[Entry], what: str) -> Entry | None:
    """The worst of these entries; None where none has a value (no rows, no rollout). A value beyond all numbers comes first."""
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
