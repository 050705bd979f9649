"""`cdiff list`: the names that exist, one line about each. It loads no torch."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.table import Table

from cdiff_cli.commands.names import (
    ABOUT_TASKS,
    KERNELS,
    LISTS,
    METHODS,
    PRESETS,
    check_choice,
)
from cdiff_cli.evaluation.columns import COLUMNS
from cdiff_cli.models.recipe import Card, load_recipe
from cdiff_cli.paths import home, shown
from cdiff_cli.tasks import TASKS
from cdiff_cli.yaml_files import Document, load

Entry = dict[str, Any]
"""name and about (one line); further facts for --json."""


def print_names(kind: str, as_json: bool, out: Console) -> None:
    """Print one list; raises CdiffError where there is none of that kind."""
    check_choice("list", kind, LISTS)
    listed = entries(kind)
    if as_json:
        typer.echo(json.dumps(listed, indent=2))
        return
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True, style="bold")
    table.add_column()
    for entry in listed:
        table.add_row(entry["name"], entry["about"])
    out.print(table, highlight=False, markup=False)


def entries(kind: str) -> list[Entry]:
    """The entries of one of LISTS, in the order that help and tables use."""
    if kind == "tasks":
        return _described(ABOUT_TASKS)
    if kind == "methods":
        return _described(METHODS)
    if kind == "kernels":
        return _described(KERNELS)
    if kind == "columns":
        return [
            {"name": name, "about": f"{column.title}: {column.meaning}"}
            for name, column in COLUMNS.items()
        ]
    if kind == "presets":
        return presets()
    return constraint_files() if kind == "constraints" else models()


def _described(about: Mapping[str, str]) -> list[Entry]:
    return [{"name": name, "about": line} for name, line in about.items()]


def presets() -> list[Entry]:
    """Every preset of a recipe, with the tasks that have it."""
    tasks: dict[str, list[str]] = {name: [] for name in PRESETS}
    for task in TASKS:
        for name in load_recipe(task).presets:
            tasks.setdefault(name, []).append(task)

    def about(name: str, of: list[str]) -> str:
        some = f" ({', '.join(of)})" if len(of) < len(TASKS) else ""
        return PRESETS.get(name, "of a recipe") + some

    return [{"name": name, "about": about(name, of), "tasks": of} for name, of in tasks.items()]


def constraint_files() -> list[Entry]:
    """Every shipped constraint file: its task, and the name and kind of each constraint."""
    own = {load_recipe(task).constraints for task in TASKS}
    listed = []
    for path in sorted((home() / "constraints").glob("*.yaml")):
        document = Document(path)
        content = document.value
        if not isinstance(content, dict) or not isinstance(content.get("constraints"), list):
            raise document.error((), "expected `task: NAME` and a list `constraints:`")
        parts = [
            {"name": part.get("name", f"{part.get('kind')}-{i}"), "kind": part.get("kind")}
            for i, part in enumerate(content["constraints"])
            if isinstance(part, dict)
        ]
        named = ", ".join(f"{part['name']} ({part['kind']})" for part in parts)
        default = path.name in own
        listed.append(
            {
                "name": str(shown(path)),
                "about": f"{content.get('task')}: {named}" + "; the task's own" * default,
                "task": content.get("task"),
                "constraints": parts,
                "default": default,
            }
        )
    return listed


def models() -> list[Entry]:
    """Every checkpoint beside a recipe, by the facts on its card."""
    return [_model(path) for path in sorted((home() / "models").glob("*/*.card.yaml"))]


def _model(path: Path) -> Entry:
    card = load(path, Card)
    weights = path.with_name(path.name.removesuffix(".card.yaml") + ".safetensors")
    about = (
        f"horizon {card.horizon}, {card.n_steps} steps, {card.parameters / 1e6:.1f} M parameters"
    )
    return {
        "name": f"{card.task}/{weights.stem}",
        "about": about + "; the weights are missing" * (not weights.exists()),
        "file": str(shown(weights)),
        "task": card.task,
        "recipe": card.recipe,
        "horizon": card.horizon,
        "n_steps": card.n_steps,
        "parameters": card.parameters,
        "trained_steps": card.steps,
        "bytes": weights.stat().st_size if weights.exists() else None,
    }
