"""Options of the commands as Typer types, and the panel of the help that each stands in."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from cdiff_cli.commands.names import KERNELS, LISTS, METHODS, PRESETS
from cdiff_cli.evaluation.columns import FORMATS
from cdiff_cli.tasks import TASKS

RUNS = Path("runs")
TASK, CONSTRAINT, SAMPLING = "Task", "Constraint", "Sampling"
EXECUTION, OUTPUT, STATISTICS = "Execution", "Output", "Statistics"


def option(panel: str, flags: str, text: str, metavar: str = "", names: Iterable[str] = ()) -> Any:
    """A Typer option.

    panel     heading of its box in the help
    flags     as typed, "--n --episodes"
    text      the help
    metavar   stands for the value in the help; empty for a switch
    names     values that the shell completes
    """
    known = list(names)
    return typer.Option(
        *flags.split(),
        help=text,
        metavar=metavar,
        rich_help_panel=panel,
        autocompletion=(lambda: known) if known else None,
    )


# plan and rollout

TaskName = Annotated[str, option(TASK, "--task", ", ".join(TASKS), "NAME", TASKS)]
CheckpointFile = Annotated[
    Path | None,
    option(TASK, "--checkpoint", "a .safetensors planner [default: the shipped one]", "FILE"),
]
Start = Annotated[
    str | None,
    option(TASK, "--start", "start in metres, as 0.3,-1.2 (mazes) [default: the paper's]", "X,Y"),
]
Goal = Annotated[
    str | None,
    option(TASK, "--goal", "goal in metres, as 0.1,0.9 (mazes) [default: the paper's]", "X,Y"),
]
Random = Annotated[
    bool, option(TASK, "--random", "draw a feasible start and goal for each seed (mazes)")
]
Env = Annotated[
    list[str] | None,
    option(
        TASK,
        "--env",
        "an option of the environment, as pattern=chaser; repeatable (control)",
        "NAME=VALUE",
    ),
]

ConstraintFile = Annotated[
    Path | None,
    option(
        CONSTRAINT, "--constraints", "YAML file of constraints [default: the task's own]", "FILE"
    ),
]
NoDynamics = Annotated[
    bool,
    option(
        CONSTRAINT, "--no-dynamics", "do not enforce the fitted dynamics, whatever the preset says"
    ),
]
MarginSize = Annotated[
    float | None,
    option(
        CONSTRAINT,
        "--margin",
        "tighten each h by this (control) [default: the calibrated margins]",
        "H",
    ),
]
Calibrate = Annotated[
    bool,
    option(
        CONSTRAINT,
        "--calibrate",
        "measure how far execution leaves the plans, and write the margins (control)",
    ),
]
Confidence = Annotated[
    float | None,
    option(
        CONSTRAINT,
        "--level",
        "share of episodes that --calibrate is to cover [default: 0.95]",
        "SHARE",
    ),
]

MethodName = Annotated[str, option(SAMPLING, "--method", ", ".join(METHODS), "NAME", METHODS)]
PresetName = Annotated[
    str,
    option(
        SAMPLING,
        "--preset",
        "recommended, fast (ours), paper (as printed), released (the authors' code)",
        "NAME",
        PRESETS,
    ),
]
Kernel = Annotated[
    str | None,
    option(
        SAMPLING,
        "--kernel",
        f"{', '.join(KERNELS)} [default: the preset's]",
        "NAME",
        KERNELS,
    ),
]
Steps = Annotated[
    int | None,
    option(
        SAMPLING,
        "--steps",
        "diffusion steps, at most as trained; few are best with --kernel dpm++2m "
        "[default: the preset's]",
        "N",
    ),
]
ExtraSteps = Annotated[
    int | None,
    option(
        SAMPLING,
        "--extra-steps",
        "further steps with t frozen and no noise [default: the preset's]",
        "N",
    ),
]
Settings = Annotated[
    list[str] | None,
    option(SAMPLING, "--set", "a constant of the method, as rho=0.05; repeatable", "NAME=VALUE"),
]
Warm = Annotated[
    float | None,
    option(
        SAMPLING,
        "--warm",
        "warm start: share of the steps repeated from the last plan (control) "
        "[default: from noise]",
        "SHARE",
    ),
]

Count = Annotated[
    int, option(EXECUTION, "--n --episodes", "number of plans or episodes, one seed each", "N")
]
Seed = Annotated[int, option(EXECUTION, "--seed", "first seed; the next are seed + 1, ...", "N")]
Execute = Annotated[
    int | None,
    option(
        EXECUTION, "--execute", "environment steps to follow a plan (control) [default: 1]", "N"
    ),
]
ActionNoise = Annotated[
    float,
    option(
        EXECUTION,
        "--action-noise",
        "noise on each input: standard deviation over half its range (control)",
        "SHARE",
    ),
]
Device = Annotated[
    str, option(EXECUTION, "--device", "auto, cpu, cuda", "NAME", ("auto", "cpu", "cuda"))
]

RunsFolder = Annotated[Path, option(OUTPUT, "--runs", "folder of the run directories", "FOLDER")]
Video = Annotated[
    str | None,
    option(OUTPUT, "--video", "gif or mp4 of the first episode", "FORMAT", ("gif", "mp4")),
]
AsJson = Annotated[bool, option(OUTPUT, "--json", "print JSON instead of the table")]

# verify and rerun

RunPlaces = Annotated[
    list[Path],
    typer.Argument(metavar="RUN", help="run directories, or folders of runs", show_default=False),
]
WaypointsOnly = Annotated[
    bool, option(CONSTRAINT, "--waypoints", "require safety at the waypoints only")
]
RunDirectory = Annotated[
    Path, typer.Argument(metavar="RUN", help="a run directory", show_default=False)
]
AllowChanged = Annotated[
    bool, option(CONSTRAINT, "--allow-changed", "run although the constraint file has changed")
]

# compare

Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="a folder of runs")]
OnlyTask = Annotated[str | None, option(TASK, "--task", "runs of this task only", "NAME", TASKS)]
Columns = Annotated[
    str | None,
    option(
        OUTPUT,
        "--columns",
        "columns to show, separated by commas; `cdiff list columns` names them",
        "NAMES",
    ),
]
Wide = Annotated[bool, option(OUTPUT, "--wide", "all columns of each kind of run")]
Format = Annotated[str, option(OUTPUT, "--format", ", ".join(FORMATS), "NAME", FORMATS)]
Paper = Annotated[
    bool,
    option(OUTPUT, "--paper", "the paper's definitions and units, its values beside ours"),
]
Intervals = Annotated[
    bool,
    option(
        STATISTICS,
        "--intervals",
        "95 % intervals: bootstrap of means, Clopper-Pearson of rates",
    ),
]
Against = Annotated[
    str | None,
    option(
        STATISTICS,
        "--against",
        "test every method against this one, paired by seed, Holm-corrected",
        "METHOD",
        METHODS,
    ),
]
Test = Annotated[
    str,
    option(
        STATISTICS,
        "--test",
        "test of --against: wilcoxon (signed ranks) or t",
        "NAME",
        ("wilcoxon", "t"),
    ),
]

# sweep

TaskNames = Annotated[str, option(TASK, "--task", "tasks, separated by commas", "NAMES")]
ConstraintFiles = Annotated[
    list[Path] | None,
    option(
        CONSTRAINT,
        "--constraints",
        "YAML file of constraints; repeatable [default: the task's own]",
        "FILE",
    ),
]
MethodNames = Annotated[str, option(SAMPLING, "--methods", "methods, separated by commas", "NAMES")]
PresetNames = Annotated[str, option(SAMPLING, "--presets", "presets, separated by commas", "NAMES")]
AlsoRollout = Annotated[bool, option(EXECUTION, "--rollout", "execute in the simulator too")]
SeedCount = Annotated[int, option(EXECUTION, "--seeds", "number of seeds, one run each", "N")]
Jobs = Annotated[int, option(EXECUTION, "--jobs", "runs at a time, one CPU thread each", "N")]
Backend = Annotated[
    str,
    option(
        EXECUTION,
        "--backend",
        "local, or a cluster: ray or dask (optional extras)",
        "NAME",
        ("local", "ray", "dask"),
    ),
]
Address = Annotated[
    str | None,
    option(EXECUTION, "--address", "address of the cluster, as 127.0.0.1:6379", "HOST:PORT"),
]

# check and list

CheckedFile = Annotated[
    Path | None, typer.Argument(metavar="FILE", help="a YAML file of constraints")
]
Schema = Annotated[
    bool, option(OUTPUT, "--schema", "print the JSON schema of constraint files, for editors")
]
Picture = Annotated[
    Path | None,
    option(OUTPUT, "--picture", "file of the picture [default: runs/check-NAME.png]", "FILE"),
]
ListKind = Annotated[
    str,
    typer.Argument(
        metavar="KIND",
        help=", ".join(LISTS),
        autocompletion=lambda: list(LISTS),
        show_default=False,
    ),
]

# train

Dataset = Annotated[
    str | None,
    option(
        TASK,
        "--dataset",
        "a local Minari dataset id or a D4RL-style .hdf5 [default: generate]",
        "NAME",
    ),
]
Conditional = Annotated[
    Path | None,
    option(
        CONSTRAINT,
        "--conditional",
        "YAML file of constraints to train a planner for, used by --method conditional",
        "FILE",
    ),
]
RecipeName = Annotated[
    str | None,
    option(
        EXECUTION,
        "--recipe",
        "small (minutes on two cores), paper (the paper's size) or conditional [default: small]",
        "NAME",
    ),
]
TrainSeed = Annotated[
    int, option(EXECUTION, "--seed", "seed of the weights, the noise and the data order", "N")
]
Resume = Annotated[
    bool, option(EXECUTION, "--resume", "continue from the last saved state of this training")
]
