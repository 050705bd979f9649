"""`cdiff plan`: plan, measure, and leave a run directory behind."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cdiff_cli import machine
from cdiff_cli.arrays import Array
from cdiff_cli.commands.experiment import Experiment
from cdiff_cli.commands.run_directory import new_run, write_rows, write_yaml
from cdiff_cli.errors import CdiffError
from cdiff_cli.evaluation import metrics
from cdiff_cli.evaluation.certificate import Saved, certificate, summary
from cdiff_cli.evaluation.columns import Row
from cdiff_cli.evaluation.figures import plans as plan_figures
from cdiff_cli.planning.open_loop import Plans, plan
from cdiff_cli.sampling.baselines import Unconstrained
from cdiff_cli.tasks.protocol import HasExactScore

Tick = Callable[[str, int, int], None]
"""(what, done, of how many)"""

PACKAGES = ("torch", "numpy", "mujoco", "gymnasium", "gymnasium-robotics")
"""Packages whose versions a run of whole plans records."""

BOUNDARY = 0.05
"""How far inside the boundary a sample of the toy problem counts as sitting on it, units of g."""


@dataclass(frozen=True)
class Finished:
    """A run that is on disk, and what the command prints of it.

    verdict   one line; `counts` holds the same in numbers
    warning   what went wrong and was kept: the command prints it on stderr and exits with 1
    """

    path: Path
    rows: list[Row]
    picture: Path
    counts: dict[str, int | None]
    verdict: str
    notes: tuple[str, ...] = ()
    warning: str = ""


def plan_run(
    experiment: Experiment,
    root: Path,
    tick: Tick,
    *,
    name: str | None = None,
    pictures: bool = True,
) -> Finished:
    """Plan, measure, write runs/<stamp>-plan-TASK-METHOD-PRESET/, or <stamp>-<name>/."""
    task = experiment.task
    if task.control == "receding_horizon":
        raise CdiffError(
            f"{task.name} plans anew at every step; act with `cdiff rollout --task {task.name}`"
        )
    plans, free = plan_both(experiment, tick)
    rows = plan_rows(experiment, plans, free)
    notes = []
    with new_run(root, name or run_name("plan", experiment)) as run:
        write_plans(run.path, experiment, plans, free, rows)
        counts = write_certificate(run.path, experiment, plans.x)
        if pictures:
            plan_pictures(run.path, experiment, plans, free)
        if pictures and plans.chain is not None and isinstance(task, HasExactScore):
            notes.append(_chain_figure(run.path, experiment, task, plans, plans.chain))
    verdict = f"certificate  {summary(counts)}"
    return Finished(run.path, rows, run.path / "plan.png", counts, verdict, tuple(notes))


def run_name(command: str, experiment: Experiment) -> str:
    """The name of a run directory without its stamp."""
    request = experiment.request
    return f"{command}-{request.task}-{request.method}-{request.preset}"


def plan_both(experiment: Experiment, tick: Tick) -> tuple[Plans, Plans]:
    """The plans asked for, and the unconstrained ones of the same noise."""
    sampler, method = experiment.preset.sampler, experiment.method
    plain = sampler.model_copy(update={"extra_steps": 0, "polish": False})
    steps = experiment.problem.planner.schedule.n_steps

    def report(name: str, total: int) -> Callable[[int], None]:
        return lambda step: tick(name, step, total)

    seeds = experiment.seeds
    free = plan(experiment.problem, Unconstrained(), seeds, plain, report("diffuser", steps))
    if not (method.enforces or method.polished or sampler.extra_steps):
        return free, free
    total = (steps + sampler.extra_steps) * method.candidates
    on_step = report(experiment.request.method, total)
    return plan(experiment.constrained, method, seeds, sampler, on_step), free


def plan_rows(experiment: Experiment, plans: Plans, free: Plans) -> list[Row]:
    """One row of rows.csv per plan."""
    task, n = experiment.task, len(plans.x)
    units = experiment.recipe.paper_units
    measured = metrics.plan_metrics(task, experiment.declared, plans.x, free.x, units)
    cost = {
        "calls": plans.calls,
        "plan_ms": 1e3 * plans.total_s / n,
        "step_ms": 1e3 * plans.total_s / plans.calls,
        "overhead": metrics.overhead(plans.total_s, plans.network_s),
    }
    checkpoint = experiment.checkpoint
    dynamics = None if checkpoint is None else checkpoint.dynamics
    effort = None if dynamics is None else metrics.effort(dynamics, plans.x)
    rows = []
    for i, (seed, values) in enumerate(zip(experiment.seeds, measured, strict=True)):
        polish = {"polish": float(plans.polish[i])}
        row: Row = experiment.row() | {"seed": seed} | values | polish | cost
        if checkpoint is not None:
            smooth = metrics.smooth(values["jump"], checkpoint.card.data["jump_q999"])
            row["smooth"] = float(smooth)
        if effort is not None:
            row |= {"effort": float(effort[0][i]), "feasible": float(effort[1][i])}
        rows.append(row)
    return rows


def write_plans(
    path: Path, experiment: Experiment, plans: Plans, free: Plans, rows: list[Row]
) -> None:
    """run.yaml, plan.npz, trace.npz and rows.csv."""
    device = experiment.problem.planner.device
    record = machine.record(device, plans.total_s, PACKAGES)
    write_yaml(path / "run.yaml", record | experiment.record())
    inputs: dict[str, Any] = {} if plans.u is None else {"u": plans.u}
    np.savez_compressed(
        path / "plan.npz",
        x=plans.x,
        x_free=free.x,
        layout=np.array(experiment.task.layout),
        seed=np.array(experiment.seeds),
        **inputs,
    )
    np.savez_compressed(
        path / "trace.npz",
        violation=plans.trace,
        violation_free=free.trace,
        axes=np.array(["call", "x_t or clean estimate", "plan"]),
    )
    write_rows(path / "rows.csv", rows)


def write_certificate(
    path: Path, experiment: Experiment, planned: Array, executed: Array | None = None
) -> dict[str, int | None]:
    """certificate.json of the arrays already written; returns its counts."""

    def saved(file: str, x: Array) -> Saved:
        sha256 = hashlib.sha256((path / file).read_bytes()).hexdigest()
        return Saved(x, experiment.seeds, sha256)

    rollout = None if executed is None else saved("rollout.npz", executed)
    proof = certificate(
        experiment.task,
        experiment.constraints_record(),
        experiment.declared,
        saved("plan.npz", planned),
        rollout,
    )
    (path / "certificate.json").write_text(json.dumps(proof, indent=1, allow_nan=False))
    return proof["counts"]


def plan_pictures(path: Path, experiment: Experiment, plans: Plans, free: Plans) -> None:
    """plan.png and convergence.png."""
    task, request = experiment.task, experiment.request
    title = f"{task.name}, {request.method} ({request.preset}), n = {len(plans.x)}"
    x_free = None if plans is free else free.x
    plan_figures.plan_picture(path / "plan.png", task, experiment.declared, plans.x, x_free, title)
    traces = {"diffuser": free.trace}
    if plans is not free:
        traces[request.method] = plans.trace
    plan_figures.convergence_picture(path / "convergence.png", traces)


def _chain_figure(
    path: Path, experiment: Experiment, task: HasExactScore, plans: Plans, chain: Array
) -> str:
    """Figure 1, and its number: the share of samples on the boundary, and the true law's."""
    g, request = experiment.declared, experiment.request
    truth = task.truth(200_000, 0)[:, None]
    allowed = truth[metrics.worst_waypoint(g, truth) <= 0]
    kernel = experiment.preset.sampler.kernel
    title = f"{request.method}, {kernel}: chains (red), last points (blue)"
    plan_figures.chain_picture(path / "chain.png", experiment.task, g, chain, allowed[:, 0], title)
    second_half = chain[len(chain) // 2 :].reshape(-1, 1, chain.shape[-1])
    samples = (plans.x, second_half, allowed)
    last, chains, true = (metrics.boundary_mass(g, x, BOUNDARY) for x in samples)
    return (
        f"boundary mass (share with g >= -{BOUNDARY}): last points {last:.3f}, "
        f"second half of the chains {chains:.3f}, true constrained law {true:.3f}"
    )
