"""`cdiff rollout`: plan, act, measure, and leave a run directory behind.

Whole plans are followed by a tracking controller; control tasks plan anew at every step.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np

from cdiff_cli import machine
from cdiff_cli.arrays import Array
from cdiff_cli.commands.experiment import Experiment
from cdiff_cli.commands.plan import (
    PACKAGES,
    Finished,
    Tick,
    plan_both,
    plan_pictures,
    plan_rows,
    run_name,
    write_certificate,
    write_plans,
)
from cdiff_cli.commands.run_directory import new_run, write_rows, write_yaml
from cdiff_cli.errors import CdiffError, suggestion
from cdiff_cli.evaluation import metrics
from cdiff_cli.evaluation.certificate import summary
from cdiff_cli.evaluation.columns import Row
from cdiff_cli.evaluation.figures import episodes as episode_figures
from cdiff_cli.evaluation.figures import plans as plan_figures
from cdiff_cli.planning.episodes import Episodes
from cdiff_cli.planning.execution import Rollout, follow
from cdiff_cli.planning.receding_horizon import Controller, rollout
from cdiff_cli.tasks.protocol import Brakes, ControlTask, HasEnvOptions, Task, Tracks

# Whole plans --------------------------------------------------------------------------------------


def rollout_run(
    experiment: Experiment,
    root: Path,
    tick: Tick,
    video: str | None = None,
    hold: int = 100,
    *,
    name: str | None = None,
    pictures: bool = True,
) -> Finished:
    """Plan, follow each plan in its environment, measure both.

    Writes runs/<stamp>-rollout-TASK-METHOD-PRESET/, or <stamp>-<name>/.

    hold   steps at the last waypoint after the plan's end
    """
    task, g = experiment.task, experiment.declared
    if not isinstance(task, Tracks):
        raise CdiffError(
            f"{task.name} has no environment to roll out in; "
            f"plan it with `cdiff plan --task {task.name}`"
        )
    plans, free = plan_both(experiment, tick)
    n = len(plans.x)
    executed = follow(
        task, plans.x, experiment.seeds, hold, lambda k: tick("roll out", k, n), plans.u
    )
    measured = metrics.rollout_metrics(
        g, executed.x, executed.reward, executed.success, executed.goal_distance
    )
    planned = plan_rows(experiment, plans, free)
    rows = [row | more for row, more in zip(planned, measured, strict=True)]
    with new_run(root, name or run_name("rollout", experiment)) as run:
        write_plans(run.path, experiment, plans, free, rows)
        _write_executed(run.path, experiment, executed)
        counts = write_certificate(run.path, experiment, plans.x, executed.x)
        if pictures:
            plan_pictures(run.path, experiment, plans, free)
            title = f"{task.name}, {experiment.request.method}: executed over planned"
            plan_figures.plan_picture(
                run.path / "rollout.png", experiment.task, g, executed.x, plans.x, title
            )
        if video:
            tick("video", 0, 1)
            file = run.path / f"rollout.{video}"
            plan_figures.rollout_video(file, experiment.task, g, executed.x, plans.x)
            tick("video", 1, 1)
    verdict = f"certificate  {summary(counts)}"
    return Finished(run.path, rows, run.path / "rollout.png", counts, verdict)


def _write_executed(path: Path, experiment: Experiment, executed: Rollout) -> None:
    layout, seeds = np.array(experiment.task.layout), np.array(experiment.seeds)
    arrays: Any = asdict(executed) | {"layout": layout, "seed": seeds}
    np.savez_compressed(path / "rollout.npz", **arrays)


# Control tasks ------------------------------------------------------------------------------------


def control_run(
    experiment: Experiment,
    root: Path,
    tick: Tick,
    video: str | None = None,
    *,
    name: str | None = None,
    pictures: bool = True,
) -> Finished:
    """Act for one episode per seed, planning anew as the preset says; measure.

    Writes runs/<stamp>-rollout-TASK-METHOD-PRESET/, or <stamp>-<name>/.
    """
    acting, request = controller(experiment), experiment.request
    task, g = cast(ControlTask, experiment.task), experiment.declared
    env = parse_env(task, experiment.preset.control.env) | ({"render": True} if video else {})
    with new_run(root, name or run_name("rollout", experiment)) as run:
        recorder = None
        if video:
            recorder = episode_figures.Recorder(run.path / f"rollout.{video}", task, g)
        done = rollout(
            acting,
            task,
            experiment.seeds,
            env,
            on_step=lambda k, n: tick("control", k, n),
            on_frame=recorder,
        )
        levels = metrics.executed_levels(g, done.x, done.observed, task.dt)
        rows = _control_rows(experiment, done, levels)
        _write_episodes(run.path, experiment, done, rows)
        if pictures:
            title = f"{request.task}, {request.method} ({request.preset}), n = {len(rows)}"
            episode_figures.levels_picture(run.path / "rollout.png", task, g, done, levels, title)
        if recorder:
            recorder.write(done, levels)
    warning = (
        f"{diverged_text(done)}; what they did until then is kept" if done.diverged.any() else ""
    )
    safe = int(sum(row["safe_executed"] for row in rows))
    return Finished(
        run.path,
        rows,
        run.path / "rollout.png",
        {"episodes": len(rows), "safe_executed": safe},
        f"executed     {safe} of {len(rows)} episodes safe at every step",
        notes=(experiment.note,) if experiment.note else (),
        warning=warning,
    )


def diverged_text(done: Episodes) -> str:
    """How many episodes diverged."""
    return (
        f"{int(done.diverged.sum())} of {len(done.x)} episodes diverged "
        "(a plan or a state was no longer finite) and were stopped"
    )


def controller(experiment: Experiment) -> Controller:
    """The controller of a control task."""
    task, checkpoint = experiment.task, experiment.checkpoint
    if checkpoint is None or experiment.planner.inverse_dynamics is None:
        raise CdiffError(
            f"{task.name}: the checkpoint holds no inverse dynamics; "
            "train it with this version of cdiff"
        )
    trained = experiment.recipe.train[checkpoint.card.recipe].inverse
    return Controller(
        planner=experiment.planner,
        declared=experiment.declared,
        method=experiment.method,
        enforced=experiment.problem.enforced,
        sampler=experiment.preset.sampler,
        control=experiment.preset.control,
        fallback_action=task.brake if isinstance(task, Brakes) else None,
        ahead=1 if trained is None else trained.ahead,
    )


def parse_env(task: Task, pairs: tuple[str, ...]) -> dict[str, Any]:
    """["pattern=chaser"] as options of the task's environment.

    Raises CdiffError where the task has no such option or value.
    """
    known = task.env_options if isinstance(task, HasEnvOptions) else {}
    options = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals and name in known:
            example = f"{name}={next(iter(known[name]))}"
            raise CdiffError(f'--env: expected name=value such as {example}, found "{pair}"')
        if name in options:
            raise CdiffError(f"--env {name}: given twice; it has one value per episode")
        if name not in known:
            has = ", ".join(known) or "none"
            raise CdiffError(
                f'--env: {task.name} has no option "{name}"{suggestion(name, known)}; '
                f"its options are: {has}"
            )
        values = {str(value).lower(): value for value in known[name]}
        if text.lower() not in values:
            raise CdiffError(
                f"--env {name}: expected one of {', '.join(values)}, "
                f'found "{text}"{suggestion(text, values)}'
            )
        options[name] = values[text.lower()]
    return options


def _control_rows(experiment: Experiment, done: Episodes, levels: Array) -> list[Row]:
    """One row of rows.csv per episode."""
    space = experiment.task.make_env().action_space
    bounds = (space.low.astype(float), space.high.astype(float))
    measured = metrics.control_metrics(done, levels, bounds)
    row = experiment.row()
    # The obstacle that was met is part of what was asked.
    options = experiment.request.env or experiment.preset.control.env
    row["constraints"] = " ".join((row["constraints"], *options))
    return [
        row | {"seed": seed} | values
        for seed, values in zip(experiment.seeds, measured, strict=True)
    ]


def _write_episodes(path: Path, experiment: Experiment, done: Episodes, rows: list[Row]) -> None:
    """run.yaml, rollout.npz and rows.csv."""
    packages = (*PACKAGES, "pybullet")
    record = machine.record(
        experiment.problem.planner.device, float(done.latency_s.sum()), packages
    )
    write_yaml(path / "run.yaml", record | experiment.record())
    arrays: dict[str, Any] = {
        name: value for name, value in asdict(done).items() if name not in ("observed", "info")
    }
    arrays |= done.observed | {f"info.{name}": value for name, value in done.info.items()}
    arrays["layout"] = np.array(experiment.task.layout)
    arrays["parts"] = np.array([part.name for part in experiment.declared.parts])
    np.savez_compressed(path / "rollout.npz", **arrays, seed=np.array(experiment.seeds))
    write_rows(path / "rows.csv", rows)
