"""The command line: parse, call one function, print. Heavy imports stay inside the commands, so --help is quick."""

import functools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from cdiff_cli.errors import CdiffError
from cdiff_cli.evaluation.comparison import METHOD_ORDER
from cdiff_cli.progress import err, progress, training_progress

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",  # in rich's own, a default in brackets would vanish
    help="Safe planning with diffusion models: constraints as YAML in, trajectories that obey them out.",
    epilog="Start with: cdiff plan --method alm",
)
out = Console(width=None if sys.stdout.isatty() else 160)  # a pipe has no width of its own
RUNS = Path("runs")
TaskName = Annotated[
    str,
    typer.Option(
        "--task", help="maze2d-umaze, maze2d-large, ball-run, hopper, swimmer, gaussian2d"
    ),
]
MethodName = Annotated[str, typer.Option("--method", help=", ".join(METHOD_ORDER))]
PresetName = Annotated[
    str,
    typer.Option(
        "--preset", help="recommended (ours), paper (as printed), released (the authors' code)"
    ),
]
ConstraintFile = Annotated[
    Path | None,
    typer.Option("--constraints", help="YAML file of constraints [default: the task's own]"),
]
CheckpointFile = Annotated[
    Path | None,
    typer.Option("--checkpoint", help="a .safetensors checkpoint [default: the shipped one]"),
]
Start = Annotated[
    str | None,
    typer.Option("--start", help="start position, metres, as 0.3,-1.2 [default: the paper's]"),
]
Goal = Annotated[
    str | None,
    typer.Option("--goal", help="goal position, metres, as 0.1,0.9 [default: the paper's]"),
]
Kernel = Annotated[
    str | None,
    typer.Option("--kernel", help="ddpm, ddim, dpm++2m or langevin [default: the preset's]"),
]
Steps = Annotated[
    int | None,
    typer.Option(
        "--steps",
        help="diffusion steps, at most as trained; few go best with --kernel dpm++2m [default: the preset's]",
    ),
]
ExtraSteps = Annotated[
    int | None,
    typer.Option(
        "--extra-steps", help="further steps with t frozen and no noise [default: the preset's]"
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="a method's constant, as rho=0.05; may be repeated"),
]
Count = Annotated[int, typer.Option("--n", "--episodes", help="number of plans, one seed each")]
Seed = Annotated[int, typer.Option("--seed", help="first seed; plans use seed, seed + 1, ...")]
Device = Annotated[str, typer.Option("--device", help="auto, cpu, cuda")]
Random = Annotated[
    bool, typer.Option("--random", help="a random feasible start and goal for each plan")
]
NoDynamics = Annotated[
    bool,
    typer.Option("--no-dynamics", help="do not obey the fitted dynamics, whatever the preset says"),
]
AsJson = Annotated[bool, typer.Option("--json", help="print one JSON object instead of the table")]
Execute = Annotated[
    int | None, typer.Option(help="control: environment steps a plan is followed [default: 1]")
]
Warm = Annotated[
    float | None,
    typer.Option(
        help="control: share of the diffusion steps redone on the last plan [default: from noise]"
    ),
]
MarginSize = Annotated[
    float | None,
    typer.Option(
        "--margin", help="control: tighten each h by this [default: the calibrated margins]"
    ),
]
ActionNoise = Annotated[
    float, typer.Option(help="control: disturb each input, standard deviation over half its range")
]
Env = Annotated[
    list[str] | None,
    typer.Option(help="control: an option of the environment, as pattern=chaser; may be repeated"),
]
Calibrate = Annotated[
    bool,
    typer.Option(
        "--calibrate", help="control: measure how far execution leaves the plans, write the margins"
    ),
]
Confidence = Annotated[
    float | None,
    typer.Option(
        "--level",
        help="--calibrate: share of episodes that the margins are to cover [default: 0.95]",
    ),
]
RunsFolder = Annotated[Path, typer.Option("--runs", help="where runs are kept")]


def reported(command: Callable[..., Any]) -> Callable[..., Any]:
    """Errors of the user as one line on stderr and exit code 2; Ctrl-C as exit code 130."""

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


@app.command()
@reported
def train(
    task: TaskName = "maze2d-umaze",
    recipe: Annotated[
        str | None,
        typer.Option(
            help="small (minutes on two cores), paper (the paper's size) or conditional [default: small]"
        ),
    ] = None,
    conditional: Annotated[
        Path | None,
        typer.Option(
            help="YAML file of constraints to train a planner for, which --method conditional uses"
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(help="seed of the weights, the noise and the order of the data")
    ] = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="go on from the last saved state of this training")
    ] = False,
    dataset: Annotated[
        str | None,
        typer.Option(help="a local Minari dataset id or a D4RL-style .hdf5 [default: generate]"),
    ] = None,
    device: Device = "auto",
    runs: RunsFolder = RUNS,
) -> None:
    """Train a planner on demonstrations; writes models/TASK/RECIPE.safetensors (or conditional-FILE) and its card."""
    from cdiff_cli import machine
    from cdiff_cli.models.checkpoint import install
    from cdiff_cli.models.recipe import load_recipe
    from cdiff_cli.paths import shown
    from cdiff_cli.tasks import load_task
    from cdiff_cli.training import fit

    problem = load_task(task)
    plan = load_recipe(task)
    condition = None
    if conditional is not None:
        from cdiff_cli.training.labels import ConstraintLabel

        condition = ConstraintLabel.read(conditional, problem)
    recipe = recipe or ("conditional" if condition else "small")
    name = f"conditional-{condition.name}" if condition else recipe
    work = runs / f"train-{task}-{name}-{seed}"
    with training_progress() as (on_data, on_step):
        try:
            checkpoint = fit.train(
                problem,
                plan,
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
            typer.echo(
                f"interrupted; {work}/state.safetensors is kept: go on with --resume", err=True
            )
            raise typer.Exit(130) from None
    card = checkpoint.card
    target = install(checkpoint)
    out.print(
        f"{card.steps} steps in {card.wall_s / 60:.1f} min on {card.device}: mean squared error {card.mse:.5f}"
    )
    out.print(
        f"checkpoint {shown(target)} (the one that stood there is kept as {name}.previous.safetensors)",
        highlight=False,
    )


def finish(finished: Any, table: tuple[str, ...], as_json: bool) -> None:
    """Print a run: its table on stdout, where it lies, its picture, what its certificate says."""
    from cdiff_cli.evaluation.comparison import compare
    from cdiff_cli.evaluation.tables import render

    groups = compare(
        [
            {k: float(v) if isinstance(v, int) and k != "seed" else v for k, v in row.items()}
            for row in finished.rows
        ]
    )
    if as_json:
        found = json.loads(render(groups, table, "json"))
        said = {
            "run": str(finished.path),
            "summary": found,
            "certificate": finished.counts,
            "notes": list(finished.notes),
        }
        typer.echo(json.dumps(said))
    else:
        transposed(groups[0], table)
        for note in finished.notes:
            typer.echo(note)
        typer.echo(f"run          {finished.path}")
        typer.echo(f"picture      {finished.picture}")
        typer.echo(finished.verdict)
    if finished.warning:
        typer.echo(f"warning: {finished.warning}", err=True)
        raise typer.Exit(1)


def transposed(group: Any, names: tuple[str, ...]) -> None:
    """One group as a table with a line a metric: mean, standard error, meaning."""
    from rich.markup import escape
    from rich.table import Table

    from cdiff_cli.evaluation.columns import COLUMNS

    table = Table(title=" · ".join(group.key) + f" · n = {group.n}", title_justify="left")
    table.add_column("metric")
    table.add_column("mean ± standard error", justify="right")
    table.add_column("meaning", style="dim")
    for name in names:
        if name in group.cells:
            table.add_row(
                COLUMNS[name].title,
                group.cells[name].text(COLUMNS[name].digits),
                escape(COLUMNS[name].meaning),
            )
    out.print(table)


def warn_of_speed(resolved: Any) -> None:
    from cdiff_cli.commands.resolve import needed_speed

    speed = needed_speed(resolved)
    if speed and speed[0] > speed[1]:
        typer.echo(
            f"warning: the shortest way asks for {speed[0]:.2f} m/s over the horizon, 95 % of the data's windows stay below "
            f"{speed[1]:.2f} m/s: expect jumps; choose a closer goal",
            err=True,
        )


@app.command()
@reported
def plan(
    task: TaskName = "maze2d-umaze",
    method: MethodName = "alm",
    preset: PresetName = "recommended",
    constraints: ConstraintFile = None,
    checkpoint: CheckpointFile = None,
    start: Start = None,
    goal: Goal = None,
    random: Random = False,
    no_dynamics: NoDynamics = False,
    kernel: Kernel = None,
    steps: Steps = None,
    extra_steps: ExtraSteps = None,
    settings: Settings = None,
    n: Count = 10,
    seed: Seed = 0,
    device: Device = "auto",
    runs: RunsFolder = RUNS,
    as_json: AsJson = False,
) -> None:
    """Plan trajectories that obey the constraints; writes a run directory and prints its table."""
    given = locals()
    from cdiff_cli.commands.experiment import Request
    from cdiff_cli.commands.plan import plan_run
    from cdiff_cli.commands.resolve import resolve
    from cdiff_cli.evaluation.columns import PLAN_TABLE

    resolved = resolve(Request.from_options(given))
    warn_of_speed(resolved)
    with progress() as tick:
        finished = plan_run(resolved, runs, tick)
    finish(finished, PLAN_TABLE, as_json)


@app.command()
@reported
def rollout(
    task: TaskName = "maze2d-umaze",
    method: MethodName = "alm",
    preset: PresetName = "recommended",
    constraints: ConstraintFile = None,
    checkpoint: CheckpointFile = None,
    start: Start = None,
    goal: Goal = None,
    random: Random = False,
    no_dynamics: NoDynamics = False,
    kernel: Kernel = None,
    steps: Steps = None,
    extra_steps: ExtraSteps = None,
    settings: Settings = None,
    n: Count = 10,
    seed: Seed = 0,
    device: Device = "auto",
    execute: Execute = None,
    warm: Warm = None,
    margin: MarginSize = None,
    action_noise: ActionNoise = 0.0,
    env: Env = None,
    calibrate: Calibrate = False,
    level: Confidence = None,
    video: Annotated[str | None, typer.Option(help="gif or mp4 of the first episode")] = None,
    runs: RunsFolder = RUNS,
    as_json: AsJson = False,
) -> None:
    """Plan and execute in the simulator, scoring what was executed against the constraints: mazes follow one plan, control
    tasks (hopper, swimmer, ball-run) plan anew at every step.
    """
    given = locals()
    if video not in (None, "gif", "mp4"):
        raise CdiffError(f"--video: expected gif or mp4, found {video}")
    from cdiff_cli.commands.experiment import Request
    from cdiff_cli.commands.resolve import resolve
    from cdiff_cli.evaluation.columns import (
        CONTROL_TABLE,
        QUALITY_TABLE,
        ROLLOUT_TABLE,
        SAFETY_TABLE,
    )

    if calibrate and video:
        raise CdiffError("--video: --calibrate writes margins and no run; leave it out")
    if level is not None and not calibrate:
        raise CdiffError("--level: belongs to --calibrate; leave it out, or add that")
    resolved = resolve(Request.from_options(given))
    if resolved.task.control == "receding_horizon":
        from cdiff_cli.commands.calibrate import calibrate as fit_margins
        from cdiff_cli.commands.calibrate import calibrated_text
        from cdiff_cli.commands.rollout import control_run

        with progress() as tick:
            if calibrate:
                where, found = fit_margins(resolved, tick, 0.95 if level is None else level)
                said = {"file": str(where)} | found.model_dump(mode="json")
                typer.echo(json.dumps(said) if as_json else calibrated_text(where, found))
                return
            finished = control_run(resolved, runs, tick, video)
        finish(finished, CONTROL_TABLE, as_json)
        return
    from cdiff_cli.commands.rollout import rollout_run

    warn_of_speed(resolved)
    with progress() as tick:
        finished = rollout_run(resolved, runs, tick, video)
    finish(finished, tuple(dict.fromkeys((*SAFETY_TABLE, *ROLLOUT_TABLE, *QUALITY_TABLE))), as_json)


@app.command()
@reported
def verify(
    places: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN", help="run directories, or folders of runs", show_default=False
        ),
    ],
    waypoints: Annotated[
        bool, typer.Option("--waypoints", help="ask for safety at the waypoints only")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Recompute certificates from the saved plans, with no model. Exit code 0: every plan is safe at its waypoints and between
    them, and certificate.json says so; 1: not so; 2: a run cannot be read.
    """
    from cdiff_cli.commands.verify import table, verify_runs

    with progress() as tick:
        verified, errors = verify_runs(places, tick)
    for line in (
        *(f"note: {note}" for run in verified for note in run.notes),
        *(f"error: {error}" for error in errors),
    ):
        typer.echo(line, err=True)
    if as_json:
        typer.echo(
            json.dumps({"runs": [run.report(waypoints) for run in verified], "errors": errors})
        )
    elif verified:
        out.print(table(verified, waypoints))
        for run in verified:
            typer.echo(run.verdict(waypoints))
    raise typer.Exit(2 if errors else 0 if all(run.holds(waypoints) for run in verified) else 1)


@app.command()
@reported
def compare(
    folder: Annotated[Path, typer.Argument(help="a folder of runs")] = RUNS,
    style: Annotated[
        str, typer.Option("--format", help="rich, markdown, latex, csv or json")
    ] = "rich",
    paper: Annotated[
        bool,
        typer.Option("--paper", help="the paper's definitions and units, its values beside ours"),
    ] = False,
    intervals: Annotated[
        bool, typer.Option("--intervals", help="95 %: bootstrap of means, Clopper-Pearson of rates")
    ] = False,
    against: Annotated[
        str | None,
        typer.Option(help="test every method against this one, paired by seed, Holm-corrected"),
    ] = None,
    test: Annotated[
        str, typer.Option(help="of --against: wilcoxon (signed ranks) or t")
    ] = "wilcoxon",
    task: Annotated[str | None, typer.Option(help="only this task")] = None,
) -> None:
    """Compare the runs of a folder: mean ± standard error by task, constraints, method and preset; newest row a seed."""
    from cdiff_cli.commands.compare import print_comparison

    print_comparison(
        folder,
        out,
        style=style,
        paper=paper,
        intervals=intervals,
        against=against,
        test=test,
        task=task,
    )


@app.command()
@reported
def sweep(
    task: Annotated[str, typer.Option(help="tasks, separated by commas")] = "maze2d-umaze",
    methods: Annotated[
        str, typer.Option(help="methods, separated by commas")
    ] = "diffuser,projected,primal-dual,alm",
    presets: Annotated[str, typer.Option(help="presets, separated by commas")] = "recommended",
    constraints: Annotated[
        list[Path] | None,
        typer.Option(help="YAML file of constraints; may be repeated [default: own]"),
    ] = None,
    seeds: Annotated[int, typer.Option(help="number of seeds, a run each")] = 10,
    seed: Seed = 0,
    random: Annotated[
        bool, typer.Option("--random", help="a random feasible start and goal for each seed")
    ] = False,
    rollout: Annotated[
        bool, typer.Option("--rollout", help="follow the plans in the simulator too")
    ] = False,
    jobs: Annotated[int, typer.Option(help="runs at a time, each on one thread of the CPU")] = 1,
    backend: Annotated[
        str, typer.Option(help="local, or a cluster: ray or dask (optional extras)")
    ] = "local",
    address: Annotated[
        str | None, typer.Option(help="of the cluster's head, as 127.0.0.1:6379")
    ] = None,
    runs: RunsFolder = RUNS,
) -> None:
    """Make the missing runs of a matrix (task, constraints, preset, method, seed); start it again and it goes on. Exit code 1 where
    a run failed or diverged. `cdiff compare` then prints the table.
    """
    from cdiff_cli.commands.sweep import Matrix, run_sweep

    tasks, named, asked = (
        [name.strip() for name in text.split(",") if name.strip()]
        for text in (task, methods, presets)
    )
    matrix = Matrix(
        tasks, named, asked, constraints or [None], range(seed, seed + seeds), rollout, random
    )
    troubled = run_sweep(matrix, runs, jobs, err, backend, address)
    for outcome in troubled:
        typer.echo(outcome.trouble, err=True)
    typer.echo(f"compare them with: cdiff compare {runs}")
    raise typer.Exit(1 if troubled else 0)


@app.command()
@reported
def check(
    file: Annotated[Path | None, typer.Argument(help="a constraint file")] = None,
    schema: Annotated[
        bool,
        typer.Option("--schema", help="print the JSON schema of constraint files, for editors"),
    ] = False,
    picture: Annotated[
        Path | None,
        typer.Option(help="where to draw the constraints [default: runs/check-NAME.png]"),
    ] = None,
) -> None:
    """Validate a constraint file, say what it means, and draw it over the demonstrations."""
    from cdiff_cli.constraints.spec import load

    if schema:
        typer.echo(json.dumps(load.json_schema(), indent=2))
        return
    if file is None:
        raise CdiffError(
            "name a constraint file, as in `cdiff check constraints/maze2d-umaze.yaml`, or ask for --schema"
        )
    from cdiff_cli.commands.check import check

    check(file, picture or RUNS / f"check-{file.stem}.png", out)
