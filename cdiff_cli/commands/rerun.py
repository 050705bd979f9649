"""`cdiff rerun`: make a run again from its run.yaml, and say what is not as it was."""

import contextlib
import hashlib
import platform
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from importlib import metadata
from pathlib import Path
from typing import Any, cast

import typer
import yaml
from pydantic import create_model

from cdiff_cli.commands.names import check_names
from cdiff_cli.errors import CdiffError
from cdiff_cli.models.recipe import load_recipe
from cdiff_cli.paths import home, shown
from cdiff_cli.yaml_files import Document, Dumper, Loader

DECIDES = ("preset", "dynamics", "margins", "horizon", "start", "goal")
"""What run.yaml records besides options, constraints and checkpoints that decides a result."""


def run_again(
    run: Path, runs: Path, tick: Callable[[str, int, int], None], allow_changed: bool
) -> tuple[Any, tuple[str, ...]]:
    """Make a run again into a new directory below runs; the finished run and its table.

    A run with a rollout.npz is executed again, any other is planned again. It works on as many CPU
    threads as the recorded run, on which the last digits depend. What differs from the recorded
    run is noted on stderr, one line each.

    allow_changed   go on where the constraint file has changed; else that raises CdiffError
    """
    document = read_record(run)
    record = document.value
    options = record["options"]
    check_names(options["task"], options["method"], options["preset"], options.get("kernel"))
    changed = changed_constraints(record)
    if changed and not allow_changed:
        raise CdiffError(f"{run}: {changed}; restore the file, or add --allow-changed")
    from cdiff_cli.commands.experiment import Request
    from cdiff_cli.commands.plan import plan_run
    from cdiff_cli.commands.resolve import resolve
    from cdiff_cli.commands.rollout import control_run, rollout_run
    from cdiff_cli.commands.summary import rollout_table
    from cdiff_cli.evaluation.columns import PLAN_TABLE

    for name in options:
        if name not in {field.name for field in fields(Request)}:
            raise document.error(("options", name), f'no option "{name}" in this version of cdiff')
    request = cast(Any, document.read(create_model("Run", options=(Request, ...)))).options
    with _threads(record.get("device")):
        experiment = resolve(request)
        for note in (*filter(None, [changed]), *changes(record, experiment)):
            typer.echo(f"note: {note}", err=True)
        if not (run / "rollout.npz").exists():
            return plan_run(experiment, runs, tick), PLAN_TABLE
        execute = control_run if experiment.replans else rollout_run
        return execute(experiment, runs, tick), rollout_table(experiment.replans)


def read_record(run: Path) -> Document:
    """The run.yaml of a run; raises CdiffError where it is missing or says not what it should."""
    if not run.is_dir():
        raise CdiffError(f"{run}: no such run directory")
    document = Document(run / "run.yaml")
    record = document.value
    for keys in (
        *(("options", name) for name in ("task", "method", "preset")),
        ("constraints", "sha256"),
    ):
        value: Any = record
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        if not isinstance(value, str):
            raise document.error((), f"not the run.yaml of a run: it lacks {'.'.join(keys)}")
    return document


def changed_constraints(record: Mapping[str, Any]) -> str | None:
    """What to say of a constraint file that is not the recorded one; None where it is."""
    options = record["options"]
    file = options.get("constraints")
    if isinstance(file, str):
        path = Path(file)
    else:
        path = shown(home() / "constraints" / load_recipe(options["task"]).constraints)
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise CdiffError(f"--constraints: {path} cannot be read: {error.strerror}") from None
    recorded = record["constraints"]["sha256"]
    if digest == recorded:
        return None
    return f"{path} has changed: sha256 was {recorded[:12]}, is {digest[:12]}"


def changes(record: Mapping[str, Any], experiment: Any) -> Iterator[str]:
    """One line for each difference between the recorded run and the experiment at hand."""
    from cdiff_cli.machine import device_name, git_commit

    versions = record.get("versions")
    for name, version in versions.items() if isinstance(versions, dict) else ():
        with contextlib.suppress(metadata.PackageNotFoundError):
            yield from _change(name, version, metadata.version(name))
    yield from _change("python", record.get("python"), platform.python_version())
    yield from _change("commit", record.get("commit"), git_commit())
    yield from _change("device", record.get("device"), device_name(experiment.planner.device))
    config = yaml.load(yaml.dump(experiment.record(), Dumper=Dumper), Loader=Loader)
    for planner in ("checkpoint", "conditional"):
        hashes = [(side.get(planner) or {}).get("weights_sha256") for side in (record, config)]
        yield from _change(planner, *(value and value[:12] for value in hashes))
    for name in DECIDES:
        if name in record and name in config:
            yield from _change(name, record[name], config[name])


def _change(name: str, recorded: Any, present: Any) -> Iterator[str]:
    if isinstance(recorded, dict) and isinstance(present, dict):
        for key in dict.fromkeys((*recorded, *present)):
            yield from _change(f"{name}.{key}", recorded.get(key), present.get(key))
    elif recorded != present:
        yield f"{name} was {str(recorded)[:60]}, is {str(present)[:60]}"


@contextlib.contextmanager
def _threads(device: Any) -> Iterator[None]:
    """As many CPU threads as "cpu (2 threads)" says."""
    import torch

    before = torch.get_num_threads()
    recorded = re.fullmatch(r"cpu \(([1-9]\d{0,3}) threads\)", str(device))
    torch.set_num_threads(int(recorded[1]) if recorded else before)
    try:
        yield
    finally:
        torch.set_num_threads(before)
