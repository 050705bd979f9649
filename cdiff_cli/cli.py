"""The command line: parse, call one function, print.

Heavy imports stay inside the commands, so that help and refusals are quick.
"""

import functools
import json
import os
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
from rich.console import Console

from cdiff_cli import __version__
from cdiff_cli.commands import options as o
from cdiff_cli.commands.names import check_names, check_sweep, check_train
from cdiff_cli.commands.options import RUNS
from cdiff_cli.errors import CdiffError
from cdiff_cli.progress import err, progress

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode="markdown",  # rich's own markup would swallow a default in brackets
    help="Safe planning with diffusion models: constraints as YAML in, trajectories that satisfy "
    "them out.",
    epilog="Example: `cdiff plan --method alm`",
)
PIPE_WIDTH = 160  # columns of a table where stdout is no terminal and COLUMNS is not set
out = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else PIPE_WIDTH)


def reported(command: Callable[..., Any]) -> Callable[..., Any]:
    """Report the user's errors as one line on stderr, exit code 2; Ctrl-C has exit code 130."""

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> Any:
        try:
            return command(*args, **kwargs)
        except CdiffError as error:
            typer.echo(f"error: {error}", err=True)
            raise typer.Exit(2) from None
        except KeyboardInterrupt:
            typer.echo("interrupted", err=True)
            raise typer.Exit(130) from None

    return run


def print_version(requested: bool) -> None:
    if requested:
        typer.echo(f"cdiff {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            help="Show the version and exit.",
            metavar="",
            callback=print_version,
            is_eager=True,
        ),
    ] = False,
) -> None:
    pass


def experiment(values: dict[str, Any]) -> Any:
    """The checked Experiment of plan and rollout from a command's local variables."""
    check_names(values["task"], values["method"], values["preset"], values["kernel"])

    from cdiff_cli.commands.experiment import Request
    from cdiff_cli.commands.resolve import resolve

    return resolve(Request.from_options(values))


def warn_of_speed(resolved: Any) -> None:
    from cdiff_cli.commands.resolve import needed_speed

    speed = needed_speed(resolved)
    if speed and speed[0] > speed[1]:
        typer.echo(
            f"warning: the shortest path needs {speed[0]:.2f} m/s over the horizon, 95 % of the "
            f"data's windows stay below {speed[1]:.2f} m/s: expect jumps; choose a closer goal",
            err=True,
        )


@app.command(epilog="Example: `cdiff plan --method alm --constraints mine.yaml --n 4`")
@reported
def plan(
    task: o.TaskName = "maze2d-umaze",
    checkpoint: o.CheckpointFile = None,
    start: o.Start = None,
    goal: o.Goal = None,
    random: o.Random = False,
    constraints: o.ConstraintFile = None,
    no_dynamics: o.NoDynamics = False,
    method: o.MethodName = "alm",
    preset: o.PresetName = "recommended",
    kernel: o.Kernel = None,
    steps: o.Steps = None,
    extra_steps: o.ExtraSteps = None,
    settings: o.Settings = None,
    n: o.Count = 10,
    seed: o.Seed = 0,
    device: o.Device = "auto",
    runs: o.RunsFolder = RUNS,
    as_json: o.AsJson = False,
) -> None:
    """Plan trajectories that satisfy the constraints.

    It writes a run directory with the plans, their certificate and pictures, and prints a table.
    """
    resolved = experiment(locals())
    from cdiff_cli.commands.plan import plan_run
    from cdiff_cli.commands.summary import print_run
    from cdiff_cli.evaluation.columns import PLAN_TABLE

    warn_of_speed(resolved)
    with progress() as tick:
        finished = plan_run(resolved, runs, tick)
    print_run(finished, PLAN_TABLE, as_json, out)


@app.command(epilog="Example: `cdiff rollout --task hopper --method alm --episodes 10`")
@reported
def rollout(
    task: o.TaskName = "maze2d-umaze",
    checkpoint: o.CheckpointFile = None,
    start: o.Start = None,
    goal: o.Goal = None,
    random: o.Random = False,
    env: o.Env = None,
    constraints: o.ConstraintFile = None,
    no_dynamics: o.NoDynamics = False,
    margin: o.MarginSize = None,
    calibrate: o.Calibrate = False,
    level: o.Confidence = None,
    method: o.MethodName = "alm",
    preset: o.PresetName = "recommended",
    kernel: o.Kernel = None,
    steps: o.Steps = None,
    extra_steps: o.ExtraSteps = None,
    settings: o.Settings = None,
    warm: o.Warm = None,
    n: o.Count = 10,
    seed: o.Seed = 0,
    execute: o.Execute = None,
    action_noise: o.ActionNoise = 0.0,
    device: o.Device = "auto",
    video: o.Video = None,
    runs: o.RunsFolder = RUNS,
    as_json: o.AsJson = False,
) -> None:
    """Plan and execute in the simulator, and score the executed states.

    In the mazes a controller follows one plan. The control tasks (hopper, swimmer, ball-run) plan
    anew at every step.
    """
    values = locals()
    if video not in (None, "gif", "mp4"):
        raise CdiffError(f"--video: expected gif or mp4, found {video}")
    if calibrate and video:
        raise CdiffError("--video: --calibrate writes margins and no run; leave it out")
    if level is not None and not calibrate:
        raise CdiffError("--level: belongs to --calibrate; leave it out, or add that")
    resolved = experiment(values)
    from cdiff_cli.commands.summary import print_run, rollout_table

    if resolved.replans and calibrate:
        from cdiff_cli.commands.calibrate import calibrate as fit_margins
        from cdiff_cli.commands.calibrate import calibrated_text

        with progress() as tick:
            file, margins = fit_margins(resolved, tick, 0.95 if level is None else level)
        record = {"file": str(file)} | margins.model_dump(mode="json")
        typer.echo(json.dumps(record) if as_json else calibrated_text(file, margins))
        return
    from cdiff_cli.commands.rollout import control_run, rollout_run

    if not resolved.replans:
        warn_of_speed(resolved)
    with progress() as tick:
        run = control_run if resolved.replans else rollout_run
        finished = run(resolved, runs, tick, video)
    print_run(finished, rollout_table(resolved.replans), as_json, out)


@app.command(epilog="Example: `cdiff verify runs`")
@reported
def verify(
    places: o.RunPlaces,
    waypoints: o.WaypointsOnly = False,
    as_json: o.AsJson = False,
) -> None:
    """Recompute certificates from the saved plans, with no model.

    Exit code 0: every plan is safe at its waypoints and between them, and certificate.json says
    so. 1: one is not, or the file says otherwise. 2: a run cannot be read.
    """
    from cdiff_cli.commands.verify import print_verified

    raise typer.Exit(print_verified(places, waypoints, as_json, out))


@app.command(epilog="Example: `cdiff compare --against alm --intervals`")
@reported
def compare(
    folder: o.Folder = RUNS,
    task: o.OnlyTask = None,
    columns: o.Columns = None,
    wide: o.Wide = False,
    style: o.Format = "rich",
    paper: o.Paper = False,
    intervals: o.Intervals = False,
    against: o.Against = None,
    test: o.Test = "wilcoxon",
) -> None:
    """Compare the runs of a folder.

    Each cell is mean ± standard error over the seeds of one task, constraint file, method and
    preset. Of several rows of one seed the newest counts.
    """
    from cdiff_cli.commands.compare import Selection, print_comparison

    print_comparison(
        folder,
        out,
        Selection.read(columns, wide, paper),
        style=style,
        intervals=intervals,
        against=against,
        test=test,
        task=task,
    )


@app.command(epilog="Example: `cdiff sweep --methods diffuser,alm --seeds 10 --jobs 2`")
@reported
def sweep(
    task: o.TaskNames = "maze2d-umaze",
    random: o.Random = False,
    constraints: o.ConstraintFiles = None,
    methods: o.MethodNames = "diffuser,projected,primal-dual,alm",
    presets: o.PresetNames = "recommended",
    rollout: o.AlsoRollout = False,
    seeds: o.SeedCount = 10,
    seed: o.Seed = 0,
    jobs: o.Jobs = 1,
    backend: o.Backend = "local",
    address: o.Address = None,
    runs: o.RunsFolder = RUNS,
) -> None:
    """Make the missing runs of a matrix of tasks, methods and seeds.

    Interrupted, it continues when started again. Exit code 1: a run failed or diverged.
    `cdiff compare` prints the table.
    """
    task_names, method_names, preset_names = (
        [name.strip() for name in text.split(",") if name.strip()]
        for text in (task, methods, presets)
    )
    check_sweep(task_names, method_names, preset_names)
    from cdiff_cli.commands.sweep import Matrix, run_sweep

    matrix = Matrix(
        task_names,
        method_names,
        preset_names,
        constraints or [None],
        range(seed, seed + seeds),
        rollout,
        random,
    )
    troubled = run_sweep(matrix, runs, jobs, err, backend, address)
    for outcome in troubled:
        typer.echo(outcome.trouble, err=True)
    typer.echo(f"compare them with: cdiff compare {runs}")
    raise typer.Exit(1 if troubled else 0)


@app.command(epilog="Example: `cdiff rerun runs/20261127-205335-plan-maze2d-umaze-alm-fast`")
@reported
def rerun(
    run: o.RunDirectory,
    allow_changed: o.AllowChanged = False,
    runs: o.RunsFolder = RUNS,
    as_json: o.AsJson = False,
) -> None:
    """Make a run again from its run.yaml, into a new run directory.

    It notes on stderr what is not as it was: versions, commit, device, checkpoint. Videos are not
    made again.
    """
    from cdiff_cli.commands.rerun import run_again
    from cdiff_cli.commands.summary import print_run

    with progress() as tick:
        finished, table = run_again(run, runs, tick, allow_changed)
    print_run(finished, table, as_json, out)


@app.command(epilog="Example: `cdiff check mine.yaml`")
@reported
def check(
    file: o.CheckedFile = None,
    schema: o.Schema = False,
    picture: o.Picture = None,
) -> None:
    """Validate and explain a constraint file.

    It prints what each constraint means and draws them over the demonstrations.
    """
    from cdiff_cli.constraints.spec import load

    if schema:
        typer.echo(json.dumps(load.json_schema(), indent=2))
        return
    if file is None:
        raise CdiffError(
            "name a constraint file, as in `cdiff check constraints/maze2d-umaze.yaml`, "
            "or use --schema"
        )
    from cdiff_cli.commands.check import check

    check(file, picture or RUNS / f"check-{file.stem}.png", out)


@app.command("list", epilog="Example: `cdiff list tasks`")
@reported
def list_(
    kind: o.ListKind,
    as_json: o.AsJson = False,
) -> None:
    """List tasks, constraints, methods, presets, models and other names."""
    from cdiff_cli.commands.list_names import print_names

    print_names(kind, as_json, out)


@app.command(epilog="Example: `cdiff train --task maze2d-umaze --recipe small`")
@reported
def train(
    task: o.TaskName = "maze2d-umaze",
    dataset: o.Dataset = None,
    conditional: o.Conditional = None,
    recipe: o.RecipeName = None,
    seed: o.TrainSeed = 0,
    resume: o.Resume = False,
    device: o.Device = "auto",
    runs: o.RunsFolder = RUNS,
) -> None:
    """Train a planner on demonstrations.

    It writes models/TASK/RECIPE.safetensors (or conditional-FILE.safetensors) and its card.
    """
    check_train(task, recipe)
    from cdiff_cli.commands.train import train_planner

    train_planner(
        task,
        recipe,
        conditional,
        dataset=dataset,
        seed=seed,
        resume=resume,
        device=device,
        runs=runs,
        out=out,
    )
