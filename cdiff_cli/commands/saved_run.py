"""A saved run as `cdiff verify` reads it, with no model: where it is, its problem, its arrays."""

import hashlib
import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Annotated, Any, NoReturn, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, create_model

from cdiff_cli.constraints.spec.load import file_model
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.errors import CdiffError, suggestion
from cdiff_cli.evaluation.certificate import FORMAT, Entry, Saved
from cdiff_cli.tasks import load_task
from cdiff_cli.tasks.protocol import Task
from cdiff_cli.yaml_files import Document

FILES = ("run.yaml", "plan.npz", "certificate.json")
UNREADABLE = (
    *(OSError, ValueError, TypeError, EOFError, KeyError, RuntimeError, MemoryError),
    *(zipfile.BadZipFile, zlib.error),
)
"""What numpy raises for a damaged .npz."""


def find_runs(place: Path) -> list[Path]:
    """The run that this folder is, or the runs directly in it; raises CdiffError.

    Unfinished runs, whose names begin with a dot, are left out.
    """

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
            f"{place}: no run here, which would have {', '.join(FILES)}; "
            "make one first: cdiff plan --method alm"
        )
    return runs


def read_saved(path: Path, task: Task, may_end: bool = False) -> Saved:
    """The trajectories of plan.npz or rollout.npz; raises CdiffError.

    may_end   episodes may end early, with NaN for the rest
    """

    def refuse(why: str) -> NoReturn:
        raise CdiffError(f"{path}: {why}")

    try:
        content = path.read_bytes()  # read once: what is hashed is what is parsed
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            lacking = [name for name in ("x", "layout", "seed") if name not in arrays]
            if lacking:
                refuse(f"lacks {', '.join(lacking)}; it is not of this version of cdiff")
            x, layout, seeds = (np.asarray(arrays[name]) for name in ("x", "layout", "seed"))
    except UNREADABLE:
        refuse("damaged, cannot be read as numpy arrays; plan again, or restore it")
    if layout.shape != (len(task.layout),) or [str(name) for name in layout] != list(task.layout):
        refuse(
            f"expected the coordinates {', '.join(task.layout)} of {task.name}, "
            f"found {', '.join(map(str, np.ravel(layout)))}"
        )
    if x.ndim != 3 or 0 in x.shape or x.shape[2] != len(layout) or x.dtype.kind not in "fiu":
        refuse(
            f"expected x as numbers [plans, steps, {len(layout)}], found {x.dtype} {list(x.shape)}"
        )
    if seeds.shape != x.shape[:1] or seeds.dtype.kind not in "iu":
        refuse(
            f"expected a whole-numbered seed for each of {len(x)} plans, "
            f"found {seeds.dtype} {list(seeds.shape)}"
        )
    x = x.astype(np.float64)
    lost = _not_finite(x, may_end)
    if lost.any():
        refuse(
            f"the state of seed {int(seeds[lost.argmax()])} is not finite; "
            "no certificate can be given of it"
        )
    return Saved(x, [int(seed) for seed in seeds], hashlib.sha256(content).hexdigest())


def _not_finite(x: NDArray[np.float64], may_end: bool) -> NDArray[np.bool_]:
    """Which trajectories hold NaN or inf, other than NaN after the end of an episode."""
    finite = np.asarray(np.isfinite(x).all(-1))
    if not may_end:
        return np.asarray(~finite.all(1))
    after_the_end = (finite[:, 1:] & ~finite[:, :-1]).any(1)
    return ~finite[:, 0] | after_the_end | (~finite[..., None] & ~np.isnan(x)).any((1, 2))


def read_certificate(path: Path) -> Entry:
    """The content of certificate.json; raises CdiffError where it is no certificate of FORMAT."""

    def refuse_constant(name: str) -> NoReturn:
        raise ValueError(name)

    try:
        stored = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse_constant)
    except (OSError, ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0]
        raise CdiffError(
            f"{path}: damaged, cannot be read as JSON ({reason}); plan again, or restore it"
        ) from None
    known = isinstance(stored, dict)
    if not known or stored.get("format") != FORMAT or "rollout_sha256" not in stored:
        version = stored.get("format", "none") if known else "none"
        raise CdiffError(
            f"{path}: expected a certificate of format {FORMAT}, found format {version}; "
            "plan again with this version"
        )
    return cast(Entry, stored)


def read_problem(path: Path) -> tuple[Task, dict[str, Any], Constraint]:
    """From run.yaml: the task, the constraints as recorded, and the compiled g(x) <= 0.

    Raises CdiffError.
    """
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
                    f'no coordinate "{name}" in {task.name}{suggestion(name, task.layout)}; '
                    f"it has {known}",
                )
    g = Constraint(tuple(spec.compile(task.layout) for spec in run.constraints.content))
    return task, cast(Any, document.value)["constraints"], g


def _run_model() -> type[BaseModel]:
    """What is read of run.yaml: the task, and the constraints by the kinds of their own file."""
    kinds = file_model().model_fields["constraints"]
    content: Any = (Annotated[kinds.annotation, BeforeValidator(_as_written)], kinds)
    constraints = create_model("Constraints", file=(str, ...), sha256=(str, ...), content=content)
    options = create_model("Options", task=(str, ...))
    return create_model("Run", options=(options, ...), constraints=(constraints, ...))


def _as_written(content: Any) -> Any:
    """The constraints as their file may state them.

    run.yaml records the defaults too, and a file may not state `form: distance` beside P.
    """
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
