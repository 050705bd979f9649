"""`cdiff plan`: plan, measure, and leave a run directory behind."""

import hashlib
import json
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import numpy as np

from cdiff_cli.arrays import Array
from cdiff_cli.commands.resolve import Experiment
from cdiff_cli.commands.run_directory import new_run, write_rows, write_yaml
from cdiff_cli.errors import CdiffError
from cdiff_cli.evaluation import metrics
from cdiff_cli.evaluation.certificate import Saved, certificate, summary
from cdiff_cli.evaluation.columns import Row
from cdiff_cli.evaluation.figures import plans as plan_figures
from cdiff_cli.machine import device_name, git_commit
from cdiff_cli.planning.open_loop import Plans, plan
from cdiff_cli.sampling.baselines import Unconstrained

Tick = Callable[[str, int, int], None]
"""(what, done, of how many)"""


@dataclass(frozen=True)
class Finished:
    """A run that is on disk, and what the command prints of it: its rows, its picture, its verdict in a line and in numbers.

    warning   what went wrong and is kept: the command says so on stderr and exits with 1
    """

    path: Path
    rows: list[Row]
    picture: Path
    counts: dict[str, int | None]
    verdict: str
    notes: tuple[str, ...] = ()
    warning: str = ""


def plan_run(
    resolved: Experiment, root: Path, tick: Tick, *, name: str | None = None, pictures: bool = True
) -> Finished:
    """Plan, measure, write runs/<stamp>-plan-.../, or <stamp>-<name>"""
    name_of_task = resolved.problem.task.name
    if resolved.acts:
        raise CdiffError(
            f"{name_of_task} plans anew at every step; act with `cdiff rollout --task {name_of_task}`"
        )
    plans, free = _plan_both(resolved, tick)
    rows = _plan_rows(resolved, plans, free)
    notes = []
    with new_run(root, name or _name("plan", resolved)) as run:
        _write_plans(run.path, resolved, plans, free, rows)
        counts = _write_certificate(run.path, resolved, plans.x)
        if pictures:
            _plan_pictures(run.path, resolved, plans, free)
        if pictures and plans.chain is not None and resolved.problem.horizon == 1:
            notes.append(_chain_figure(run.path, resolved, plans))
    return Finished(
        run.path,
        rows,
        run.path / "plan.png",
        counts,
        f"certificate  {summary(counts)}",
        tuple(notes),
    )


def _plan_both(resolved: Experiment, tick: Tick) -> tuple[Plans, Plans]:
    """The asked plans, and the unconstrained ones of the same noise."""
    calls = resolved.problem.schedule.n_steps
    free = plan(
        resolved.problem,
        Unconstrained(),
        resolved.seeds,
        kernel=resolved.kernel,
        on_step=lambda call: tick("diffuser", call, calls),
    )
    if isinstance(resolved.method, Unconstrained) and not resolved.conditions.extra_steps:
        return free, free
    total = (calls + resolved.conditions.extra_steps) * getattr(resolved.method, "k", 1)
    problem = replace(resolved.problem, denoiser=resolved.guided or resolved.problem.denoiser)
    plans = plan(
        problem,
        resolved.method,
        resolved.seeds,
        kernel=resolved.kernel,
        extra_steps=resolved.conditions.extra_steps,
        polish=resolved.preset.polish,
        on_step=lambda call: tick(resolved.options.method, call, total),
    )
    return replace(plans, calls=resolved.calls_a_step * plans.calls), free


def _plan_rows(resolved: Experiment, plans: Plans, free: Plans) -> list[Row]:
    task, n = resolved.problem.task, len(plans.x)
    units = resolved.recipe.paper_units
    measured = metrics.plan_metrics(task, resolved.problem.g, plans.x, free.x, units)
    cost = {
        "calls": plans.calls,
        "plan_ms": 1e3 * plans.total_s / n,
        "step_ms": 1e3 * plans.total_s / plans.calls,
        "overhead": metrics.overhead(plans.total_s, plans.network_s),
    }
    dynamics = resolved.checkpoint.dynamics if resolved.checkpoint else None
    effort = None if dynamics is None else metrics.effort(dynamics, plans.x)
    rows = []
    for i, (seed, values) in enumerate(zip(resolved.seeds, measured, strict=True)):
        row: Row = (
            resolved.row() | {"seed": seed} | values | {"polish": float(plans.polish[i])} | cost
        )
        if resolved.checkpoint is not None:
            row["smooth"] = float(
                metrics.smooth(values["jump"], resolved.checkpoint.card.data["jump_q999"])
            )
        if effort is not None:
            row |= {"effort": float(effort[0][i]), "feasible": float(effort[1][i])}
        rows.append(row)
    return rows


def _write_plans(
    path: Path, resolved: Experiment, plans: Plans, free: Plans, rows: list[Row]
) -> None:
    write_yaml(
        path / "run.yaml",
        {
            "command": ["cdiff", *sys.argv[1:]],
            "commit": git_commit(),
            "versions": {
                name: version(name)
                for name in ("torch", "numpy", "mujoco", "gymnasium", "gymnasium-robotics")
            },
            "python": platform.python_version(),
            "device": device_name(resolved.problem.device),
            "wall_s": round(plans.total_s, 3),
        }
        | resolved.config(),
    )
    layout = np.array(resolved.problem.task.layout)
    inputs: dict[str, Any] = {} if plans.u is None else {"u": plans.u}
    np.savez_compressed(
        path / "plan.npz",
        x=plans.x,
        x_free=free.x,
        layout=layout,
        seed=np.array(resolved.seeds),
        **inputs,
    )
    trace = path / "trace.npz"
    np.savez_compressed(
        trace,
        violation=plans.trace,
        violation_free=free.trace,
        axes=np.array(["call", "x_t or clean estimate", "plan"]),
    )
    write_rows(path / "rows.csv", rows)


def _write_certificate(
    path: Path, resolved: Experiment, planned: Array, executed: Array | None = None
) -> dict[str, int | None]:
    """certificate.json of the arrays already written; its counts."""

    def saved(file: str, x: Array) -> Saved:
        return Saved(x, resolved.seeds, hashlib.sha256((path / file).read_bytes()).hexdigest())

    rollout = None if executed is None else saved("rollout.npz", executed)
    constraints = resolved.config()["constraints"]
    proof = certificate(
        resolved.problem.task, constraints, resolved.problem.g, saved("plan.npz", planned), rollout
    )
    (path / "certificate.json").write_text(json.dumps(proof, indent=1, allow_nan=False))
    return proof["counts"]


def _plan_pictures(path: Path, resolved: Experiment, plans: Plans, free: Plans) -> None:
    task, options = resolved.problem.task, resolved.options
    title = f"{task.name}, {options.method} ({options.preset}), n = {len(plans.x)}"
    x_free = None if isinstance(resolved.method, Unconstrained) else free.x
    plan_figures.plan_picture(path / "plan.png", task, resolved.problem.g, plans.x, x_free, title)
    traces = {"diffuser": free.trace} | ({} if x_free is None else {options.method: plans.trace})
    plan_figures.convergence_picture(path / "convergence.png", traces)


def _chain_figure(path: Path, resolved: Experiment, plans: Plans) -> str:
    """Figure 1 and its number: the share of samples that sit on the boundary, beside the true constrained law's."""
    task, g, within = cast(Any, resolved.problem.task), resolved.problem.g, 0.05
    assert plans.chain is not None
    truth = task.truth(200_000, 0)[:, None]
    allowed = truth[metrics.worst_waypoint(g, truth) <= 0]
    title = f"{resolved.options.method}, {resolved.kernel}: chains (red), last points (blue)"
    plan_figures.chain_picture(path / "chain.png", task, g, plans.chain, allowed[:, 0], title)
    along = plans.chain[len(plans.chain) // 2 :].reshape(-1, 1, len(task.layout))
    last, chain, true = (metrics.boundary_mass(g, x, within) for x in (plans.x, along, allowed))
    return (
        f"boundary mass (share with g >= -{within}): last points {last:.3f}, second half of the chains {chain:.3f}, "
        f"true constrained law {true:.3f}"
    )


def _name(command: str, resolved: Experiment) -> str:
    options = resolved.options
    return f"{command}-{options.task}-{options.method}-{options.preset}"
