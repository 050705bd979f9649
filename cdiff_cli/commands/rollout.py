"""`cdiff rollout`: plan, act, measure, and leave a run directory behind."""

import platform
import sys
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import numpy as np

from cdiff_cli.commands.plan import (
    Finished,
    Tick,
    _name,
    _plan_both,
    _plan_pictures,
    _plan_rows,
    _write_certificate,
    _write_plans,
)
from cdiff_cli.commands.resolve import Experiment
from cdiff_cli.commands.run_directory import new_run, write_rows, write_yaml
from cdiff_cli.errors import CdiffError, suggestion
from cdiff_cli.evaluation import metrics
from cdiff_cli.evaluation.certificate import summary
from cdiff_cli.evaluation.columns import Row
from cdiff_cli.evaluation.figures import episodes as episode_figures
from cdiff_cli.evaluation.figures import plans as plan_figures
from cdiff_cli.machine import device_name, git_commit
from cdiff_cli.planning.episodes import Episodes
from cdiff_cli.planning.execution import Rollout, follow
from cdiff_cli.planning.receding_horizon import Controller, control
from cdiff_cli.sampling.baselines import BestOf, Unconstrained
from cdiff_cli.tasks.protocol import ControlTask


def control_run(
    resolved: Experiment,
    root: Path,
    tick: Tick,
    video: str | None = None,
    *,
    name: str | None = None,
    pictures: bool = True,
) -> Finished:
    """Act for an episode a seed, replanning as the preset says; measure; write runs/<stamp>-rollout-.../, or <stamp>-<name>"""
    acting, options = controller(resolved), resolved.options
    env_options = parse_env(acting.task, options.env)
    with new_run(root, name or f"rollout-{options.task}-{options.method}-{options.preset}") as run:
        recorder = (
            episode_figures.Recorder(run.path / f"rollout.{video}", acting.task, acting.g)
            if video
            else None
        )
        env = env_options | ({"render": True} if video else {})
        done = control(
            acting,
            resolved.seeds,
            env,
            on_step=lambda k, n: tick("control", k, n),
            on_frame=recorder,
        )
        levels = metrics.executed_levels(acting.g, done.x, done.observed, acting.task.dt)
        rows = _rows(resolved, acting, done, levels)
        _write(run.path, resolved, acting, done, rows)
        title = f"{options.task}, {options.method} ({options.preset}), n = {len(rows)}"
        if pictures:
            episode_figures.levels_picture(
                run.path / "rollout.png", acting.task, acting.g, done, levels, title
            )
        if recorder:
            recorder.write(done, levels)
    warning = (
        f"{_diverged(done)}; what they had done until then is kept" if done.diverged.any() else ""
    )
    counts = {
        "episodes": len(rows),
        "safe_executed": int(sum(row["safe_executed"] for row in rows)),
    }
    verdict = f"executed     {counts['safe_executed']} of {len(rows)} episodes safe at every step"
    notes = (resolved.note,) if resolved.note else ()
    return Finished(
        run.path,
        rows,
        run.path / "rollout.png",
        cast(Any, counts),
        verdict,
        notes=notes,
        warning=warning,
    )


def _diverged(done: Episodes) -> str:
    return f"{int(done.diverged.sum())} of {len(done.x)} episodes diverged (a plan or a state was no longer finite) and were stopped"


def controller(resolved: Experiment) -> Controller:
    """What acting needs."""
    problem, preset, options, checkpoint = (
        resolved.problem,
        resolved.preset,
        resolved.options,
        resolved.checkpoint,
    )
    if checkpoint is None or checkpoint.frame is None or checkpoint.inverse is None:
        raise CdiffError(
            f"{problem.task.name}: the checkpoint holds no inverse dynamics; train it with this version of cdiff"
        )
    execute, warm = resolved.conditions.execute, resolved.conditions.warm
    inverse = resolved.recipe.train[checkpoint.card.recipe].inverse
    ahead = 1 if inverse is None else inverse.ahead
    if not 1 <= execute <= problem.horizon - ahead:
        raise CdiffError(
            f"--execute: expected 1 to {problem.horizon - ahead} steps of a plan of {problem.horizon}, found {execute}"
        )
    if warm is not None and not 0 < warm <= 1:
        raise CdiffError(
            f"--warm: expected a share of the diffusion steps above 0 and at most 1, found {warm:g}"
        )
    return Controller(
        task=cast(ControlTask, problem.task),
        denoiser=resolved.guided or problem.denoiser,
        seeing=resolved.seeing,
        calls_a_step=resolved.calls_a_step,
        schedule=problem.schedule,
        frame=checkpoint.frame,
        inverse=checkpoint.inverse,
        g=problem.g,
        enforced=problem.enforced,
        method=resolved.method,
        device=problem.device,
        kernel=resolved.kernel,
        extra_steps=resolved.conditions.extra_steps,
        polish=preset.polish and not isinstance(resolved.method, Unconstrained | BestOf),
        temperature=preset.temperature,
        ahead=ahead,
        execute=execute,
        warm=warm,
        resume=preset.resume,
        brake=getattr(problem.task, "brake", None),
        action_noise=options.action_noise,
    )


def parse_env(task: ControlTask, pairs: tuple[str, ...]) -> dict[str, Any]:
    """["pattern=chaser"] as options of the task's environment; CdiffError where it has no such option or value."""
    known: Mapping[str, tuple[Any, ...]] = getattr(task, "env_options", {})
    found = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals and name in known:
            raise CdiffError(
                f'--env: expected name=value such as {name}={next(iter(known[name]))}, found "{pair}"'
            )
        if name in found:
            raise CdiffError(f"--env {name}: given twice; it has one value an episode")
        if name not in known:
            has = ", ".join(known) or "none"
            raise CdiffError(
                f'--env: {task.name} has no option "{name}"{suggestion(name, known)}; its options are: {has}'
            )
        values = {str(value).lower(): value for value in known[name]}
        if text.lower() not in values:
            raise CdiffError(
                f'--env {name}: expected one of {", ".join(values)}, found "{text}"{suggestion(text, values)}'
            )
        found[name] = values[text.lower()]
    return found


def _rows(resolved: Experiment, acting: Controller, done: Episodes, levels: Any) -> list[Row]:
    space = acting.task.make_env().action_space
    measured = metrics.control_metrics(
        done, levels, (space.low.astype(float), space.high.astype(float))
    )
    told = resolved.row()
    told["constraints"] = " ".join(
        (told["constraints"], *resolved.options.env)
    )  # what was met is part of what was asked
    return [
        told | {"seed": seed} | values
        for seed, values in zip(resolved.seeds, measured, strict=True)
    ]


def _write(
    path: Path, resolved: Experiment, acting: Controller, done: Episodes, rows: list[Row]
) -> None:
    about = {
        "command": ["cdiff", *sys.argv[1:]],
        "commit": git_commit(),
        "versions": {
            name: version(name) for name in ("torch", "numpy", "mujoco", "gymnasium", "pybullet")
        },
        "python": platform.python_version(),
        "device": device_name(acting.device),
        "wall_s": round(float(done.latency_s.sum()), 3),
        "execute": acting.execute,
        "warm": acting.warm,
        "temperature": acting.temperature,
    }
    write_yaml(path / "run.yaml", about | resolved.config())
    arrays: dict[str, Any] = {
        name: value for name, value in asdict(done).items() if name not in ("observed", "info")
    }
    arrays |= done.observed | {f"info.{name}": value for name, value in done.info.items()}
    layout: Any = {
        "layout": np.array(acting.task.layout),
        "parts": np.array([part.name for part in acting.g.parts]),
    }
    np.savez_compressed(path / "rollout.npz", **arrays, **layout, seed=np.array(resolved.seeds))
    write_rows(path / "rows.csv", rows)


def rollout_run(
    resolved: Experiment,
    root: Path,
    tick: Tick,
    video: str | None = None,
    hold: int = 100,
    *,
    name: str | None = None,
    pictures: bool = True,
) -> Finished:
    """Plan, follow each plan in its environment, measure both, write runs/<stamp>-rollout-.../, or <stamp>-<name>"""
    task = resolved.problem.task
    if not hasattr(task, "track"):
        raise CdiffError(
            f"{task.name} has no environment to roll out in; plan it with `cdiff plan --task {task.name}`"
        )
    plans, free = _plan_both(resolved, tick)
    n = len(plans.x)
    done = follow(task, plans.x, resolved.seeds, hold, lambda k: tick("roll out", k, n), plans.u)
    measured = metrics.rollout_metrics(
        resolved.problem.g, done.x, done.reward, done.success, done.goal_distance
    )
    rows = [
        row | more for row, more in zip(_plan_rows(resolved, plans, free), measured, strict=True)
    ]
    with new_run(root, name or _name("rollout", resolved)) as run:
        _write_plans(run.path, resolved, plans, free, rows)
        _write_rollout(run.path, resolved, done)
        counts = _write_certificate(run.path, resolved, plans.x, done.x)
        if pictures:
            _plan_pictures(run.path, resolved, plans, free)
            title = f"{task.name}, {resolved.options.method}: executed over planned"
            plan_figures.plan_picture(
                run.path / "rollout.png", task, resolved.problem.g, done.x, plans.x, title
            )
        if video:
            tick("video", 0, 1)
            plan_figures.rollout_video(
                run.path / f"rollout.{video}", task, resolved.problem.g, done.x, plans.x
            )
            tick("video", 1, 1)
    return Finished(
        run.path, rows, run.path / "rollout.png", counts, f"certificate  {summary(counts)}"
    )


def _write_rollout(path: Path, resolved: Experiment, done: Rollout) -> None:
    layout = np.array(resolved.problem.task.layout)
    arrays: Any = asdict(done) | {"layout": layout, "seed": np.array(resolved.seeds)}
    np.savez_compressed(path / "rollout.npz", **arrays)
