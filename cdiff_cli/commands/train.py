"""`cdiff train`: demonstrations -> a checkpoint where `cdiff plan` looks for it."""

from pathlib import Path

import typer
from rich.console import Console

from cdiff_cli import machine
from cdiff_cli.models.checkpoint import install
from cdiff_cli.models.recipe import load_recipe
from cdiff_cli.paths import shown
from cdiff_cli.progress import training_progress
from cdiff_cli.tasks import load_task
from cdiff_cli.training import fit
from cdiff_cli.training.labels import ConstraintLabel


def train_planner(
    task: str,
    recipe: str | None,
    conditional: Path | None,
    *,
    dataset: str | None,
    seed: int,
    resume: bool,
    device: str,
    runs: Path,
    out: Console,
) -> None:
    """Train, install the checkpoint, and print where it is.

    recipe        None: small, or conditional where a constraint file is given
    conditional   constraint file that the planner is conditioned on; None: on none
    runs          folder of the training's state, from which `resume` continues
    """
    problem = load_task(task)
    condition = None if conditional is None else ConstraintLabel.read(conditional, problem)
    recipe = recipe or ("conditional" if condition else "small")
    name = f"conditional-{condition.name}" if condition else recipe
    work = runs / f"train-{task}-{name}-{seed}"
    with training_progress() as (on_data, on_step):
        try:
            checkpoint = fit.train(
                problem,
                load_recipe(task),
                recipe,
                seed=seed,
                device=machine.choose_device(device),
                work=work,
                resume=resume,
                dataset=dataset,
                condition=condition,
                on_data=on_data,
                on_step=on_step,
            )
        except KeyboardInterrupt:
            typer.echo(f"interrupted; continue {work}/state.safetensors with --resume", err=True)
            raise typer.Exit(130) from None
    card = checkpoint.card
    target = install(checkpoint)
    out.print(
        f"{card.steps} steps in {card.wall_s / 60:.1f} min on {card.device}: "
        f"mean squared error {card.mse:.5f}"
    )
    out.print(
        f"checkpoint {shown(target)} (the previous one is kept as {name}.previous.safetensors)",
        highlight=False,
    )
