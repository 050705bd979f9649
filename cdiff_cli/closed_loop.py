"""`cdiff rollout` on control tasks: act, measure, leave a run directory behind; and the calibration of margins."""

import platform
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import numpy as np

from cdiff_cli import control_figures, metrics
from cdiff_cli.baselines import BestOf
from cdiff_cli.calibrations import Calibration, Margin, write_calibration
from cdiff_cli.control import Controller, control
from cdiff_cli.episodes import Episodes
from cdiff_cli.errors import CdiffError, suggestion
from cdiff_cli.experiment import Finished, Tick
from cdiff_cli.margins import Array, excess, require_enough, tightened, until_covered
from cdiff_cli.methods import Unconstrained
from cdiff_cli.recipe import shown
from cdiff_cli.request import Resolved
from cdiff_cli.runs import Row, new_run, write_rows, write_yaml
from cdiff_cli.spec import kinds_sha256
from cdiff_cli.tasks import ControlTask
from cdiff_cli.training import device_name, git_commit


def control_run(
    resolved: Resolved, root: Path, tick: Tick, video: str | None = None, *, name: str | None = None, pictures: bool = True
) -> Finished:
    """Act for an episode a seed, replanning as the preset says; measure; write runs/<stamp>-rollout-.../, or <stamp>-<name>"""
    acting, options = controller(resolved), resolved.options
    env_options = parse_env(acting.task, options.env)
    with new_run(root, name or f"rollout-{options.task}-{options.method}-{options.preset}") as run:
        recorder = control_figures.Recorder(run.path / f"rollout.{video}", acting.task, acting.g) if video else None
        env = env_options | ({"render": True} if video else {})
        done = control(acting, resolved.seeds, env, on_step=lambda k, n: tick("control", k, n), on_frame=recorder)
        levels = metrics.executed_levels(acting.g, done.x, done.observed, acting.task.dt)
        rows = _rows(resolved, acting, done, levels)
        _write(run.path, resolved, acting, done, rows)
        title = f"{options.task}, {options.method} ({options.preset}), n = {len(rows)}"
        if pictures:
            control_figures.levels_picture(run.path / "rollout.png", acting.task, acting.g, done, levels, title)
        if recorder:
            recorder.write(done, levels)
    warning = f"{_diverged(done)}; what they had done until then is kept" if done.diverged.any() else ""
    counts = {"episodes": len(rows), "safe_executed": int(sum(row["safe_executed"] for row in rows))}
    verdict = f"executed     {counts['safe_executed']} of {len(rows)} episodes safe at every step"
    notes = (resolved.note,) if resolved.note else ()
    return Finished(run.path, rows, run.path / "rollout.png", cast(Any, counts), verdict, notes=notes, warning=warning)


def calibrate(resolved: Resolved, tick: Tick, level: float) -> tuple[Path, Calibration]:
    """Fit margins to what was asked for, and write them beside the checkpoint."""
    assert resolved.checkpoint is not None
    found = fit_margins(resolved, tick, level)
    return write_calibration(resolved.checkpoint.path, found), found


def fit_margins(resolved: Resolved, tick: Tick, level: float) -> Calibration:
    """Margins that cover how far execution leaves the plans that keep them; each pass acts on the next n seeds."""
    n, checkpoint = resolved.options.n, resolved.checkpoint
    require_enough(n, level)
    acting = controller(resolved)
    assert checkpoint is not None
    env, names = parse_env(acting.task, resolved.options.env), [part.name for part in acting.g.parts]

    def measured(margins: Array, number: int) -> Array:
        seeds = [seed + number * n for seed in resolved.seeds]
        inside = replace(acting, enforced=tightened(acting.enforced, dict(zip(names, margins.tolist(), strict=True))))
        done = control(inside, seeds, env, on_step=lambda k, steps: tick("control", k, steps))
        if done.diverged.any():
            raise CdiffError(f"{_diverged(done)}: no margin covers that; nothing was written")
        return excess(done.foreseen, metrics.executed_levels(acting.g, done.x, done.observed, acting.task.dt), margins)

    margins, scores, passes = until_covered(measured, len(names), level)
    return Calibration(
        stem=resolved.constraints_path.stem,
        content=kinds_sha256(resolved.kinds),
        constraints={kind.name: kind.describe() for kind in resolved.kinds},
        conditions=resolved.conditions,
        level=level,
        episodes=n,
        passes=passes,
        seed=resolved.options.seed,
        weights_sha256=checkpoint.card.weights_sha256,
        margins={
            name: Margin(margin=round(margin, 4), median=round(float(np.median(each)), 4), largest=round(float(each.max()), 4))
            for name, margin, each in zip(names, margins.tolist(), scores.T, strict=True)
        },
    )


def _diverged(done: Episodes) -> str:
    return (
        f"{int(done.diverged.sum())} of {len(done.x)} episodes diverged (a plan or a state was no longer finite) and were stopped"
    )


def controller(resolved: Resolved) -> Controller:
    """What acting needs."""
    problem, preset, options, checkpoint = resolved.problem, resolved.preset, resolved.options, resolved.checkpoint
    if checkpoint is None or checkpoint.frame is None or checkpoint.inverse is None:
        raise CdiffError(f"{problem.task.name}: the checkpoint holds no inverse dynamics; train it with this version of cdiff")
    execute, warm = resolved.conditions.execute, resolved.conditions.warm
    inverse = resolved.recipe.train[checkpoint.card.recipe].inverse
    ahead = 1 if inverse is None else inverse.ahead
    if not 1 <= execute <= problem.horizon - ahead:
        raise CdiffError(
            f"--execute: expected 1 to {problem.horizon - ahead} steps of a plan of {problem.horizon}, found {execute}"
        )
    if warm is not None and not 0 < warm <= 1:
        raise CdiffError(f"--warm: expected a share of the diffusion steps above 0 and at most 1, found {warm:g}")
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
            raise CdiffError(f'--env: expected name=value such as {name}={next(iter(known[name]))}, found "{pair}"')
        if name in found:
            raise CdiffError(f"--env {name}: given twice; it has one value an episode")
        if name not in known:
            has = ", ".join(known) or "none"
            raise CdiffError(f'--env: {task.name} has no option "{name}"{suggestion(name, known)}; its options are: {has}')
        values = {str(value).lower(): value for value in known[name]}
        if text.lower() not in values:
            raise CdiffError(f'--env {name}: expected one of {", ".join(values)}, found "{text}"{suggestion(text, values)}')
        found[name] = values[text.lower()]
    return found


def _rows(resolved: Resolved, acting: Controller, done: Episodes, levels: Any) -> list[Row]:
    space = acting.task.make_env().action_space
    measured = metrics.control_metrics(done, levels, (space.low.astype(float), space.high.astype(float)))
    told = resolved.row()
    told["constraints"] = " ".join((told["constraints"], *resolved.options.env))  # what was met is part of what was asked
    return [told | {"seed": seed} | values for seed, values in zip(resolved.seeds, measured, strict=True)]


def _write(path: Path, resolved: Resolved, acting: Controller, done: Episodes, rows: list[Row]) -> None:
    about = {
        "command": ["cdiff", *sys.argv[1:]],
        "commit": git_commit(),
        "versions": {name: version(name) for name in ("torch", "numpy", "mujoco", "gymnasium", "pybullet")},
        "python": platform.python_version(),
        "device": device_name(acting.device),
        "wall_s": round(float(done.latency_s.sum()), 3),
        "execute": acting.execute,
        "warm": acting.warm,
        "temperature": acting.temperature,
    }
    write_yaml(path / "run.yaml", about | resolved.config())
    arrays: dict[str, Any] = {name: value for name, value in asdict(done).items() if name not in ("observed", "info")}
    arrays |= done.observed | {f"info.{name}": value for name, value in done.info.items()}
    layout: Any = {"layout": np.array(acting.task.layout), "parts": np.array([part.name for part in acting.g.parts])}
    np.savez_compressed(path / "rollout.npz", **arrays, **layout, seed=np.array(resolved.seeds))
    write_rows(path / "rows.csv", rows)


def calibrated_text(path: Path, found: Calibration) -> str:
    """What `cdiff rollout --calibrate` prints."""
    each = "; ".join(f"{name} {m.margin:g} (median {m.median:g}, largest {m.largest:g})" for name, m in found.margins.items())
    return f"margins at level {found.level:g} from {found.episodes} episodes, pass {found.passes}: {each}\nwritten to {shown(path)}"
