"""`cdiff check`: what a constraint file means, as a table and a picture."""

from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cdiff_cli.constraints.spec.load import load_constraints
from cdiff_cli.evaluation.figures import plans as plan_figures
from cdiff_cli.evaluation.layout import plain_table
from cdiff_cli.models.checkpoint import load_checkpoint
from cdiff_cli.models.recipe import load_recipe
from cdiff_cli.paths import home
from cdiff_cli.projection.projectors import projection_method
from cdiff_cli.tasks import load_task
from cdiff_cli.yaml_files import Document


def check(file: Path, picture: Path, out: Console) -> None:
    """Print what the constraints of a file mean, and draw them over the demonstrations.

    Per constraint: rows, coordinates with units, projection, share of demonstrations that
    satisfy it.
    """
    document = Document(file)
    name = document.value.get("task") if isinstance(document.value, dict) else None
    if not isinstance(name, str):
        raise document.error((), "the file must begin with `task: NAME` and a list `constraints:`")
    task, recipe = load_task(name), load_recipe(name)
    shipped = home() / "models" / name / "small.safetensors"
    checkpoint = load_checkpoint(shipped, name) if shipped.exists() else None
    fitted, observable = (
        checkpoint.dynamics if checkpoint else None,
        getattr(task, "observable", ()),
    )
    kinds, g = load_constraints(
        file, name, task.layout, fitted, observable, getattr(task, "dt", None)
    )
    demonstrations = checkpoint.demonstrations.double() if checkpoint else None
    unit = dict(zip(task.layout, task.units, strict=True))
    count = "1 constraint" if len(kinds) == 1 else f"{len(kinds)} constraints, all of them at once,"
    out.print(f"{file}: {count} on {name}", highlight=False, markup=False, style="italic")
    meanings = Table.grid(padding=(0, 2))
    meanings.add_column(no_wrap=True, style="bold")
    meanings.add_column()
    table = plain_table()
    for heading in ("name", "kind"):
        table.add_column(heading, no_wrap=True)
    table.add_column("rows", justify="right")
    table.add_column("coordinates", overflow="fold")
    table.add_column("projection")
    table.add_column("demonstrations", justify="right")
    forms = g.example(recipe.horizon).parts
    for spec, part, form in zip(kinds, g.parts, forms, strict=True):
        used = dict.fromkeys(coordinate for _, coordinate in spec.coordinates())
        obey = (
            ""
            if demonstrations is None or form is not part
            else f"{float((part(demonstrations) <= 0).all(1).double().mean()):.0%} satisfy it"
        )
        meanings.add_row(escape(spec.name), escape(spec.describe()))
        table.add_row(
            escape(spec.name),
            spec.kind,
            str(len(form.labels(recipe.horizon))),
            escape(", ".join(f"{c} [{unit[c]}]" if unit[c] else c for c in used)),
            projection_method(form),
            obey,
        )
    out.print(meanings, highlight=False)
    out.print()
    out.print(table, highlight=False)
    out.print()
    fixed = g.known()
    if len(task.positions) != 2:
        out.print(
            f"picture  none: the states of {name} have no place in the plane; "
            "`cdiff rollout` draws h over time"
        )
        return
    if not fixed.parts:
        out.print(
            "picture  none: where these constraints lie is observed only while acting; "
            "`cdiff rollout` draws them"
        )
        return
    picture.parent.mkdir(parents=True, exist_ok=True)
    sample = None if demonstrations is None else demonstrations.to(torch.float64).numpy()
    plan_figures.plan_picture(
        picture, task, fixed, np.empty((0, 2, len(task.layout))), sample, file.stem
    )
    out.print(f"picture  {picture}", highlight=False, soft_wrap=True)
