"""`cdiff rollout --calibrate`: margins from the errors between plans and execution."""

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np

from cdiff_cli.arrays import Array
from cdiff_cli.commands.experiment import Experiment
from cdiff_cli.commands.margins import Calibration, Margin, write_calibration
from cdiff_cli.commands.plan import Tick
from cdiff_cli.commands.rollout import controller, diverged_text, parse_env
from cdiff_cli.constraints.spec.load import kinds_sha256
from cdiff_cli.errors import CdiffError
from cdiff_cli.evaluation import metrics
from cdiff_cli.evaluation.conformal import excess, require_enough, tightened, until_covered
from cdiff_cli.models.checkpoint import Checkpoint
from cdiff_cli.paths import shown
from cdiff_cli.planning.receding_horizon import rollout
from cdiff_cli.tasks.protocol import ControlTask


def calibrate(experiment: Experiment, tick: Tick, level: float) -> tuple[Path, Calibration]:
    """Fit margins for the experiment, and write them beside its checkpoint.

    level   probability that an episode stays within the margins, in (0, 1)
    Raises CdiffError where an episode diverges or there are too few for the level.
    """
    calibration = fit_margins(experiment, tick, level)
    return write_calibration(_checkpoint(experiment).path, calibration), calibration


def fit_margins(experiment: Experiment, tick: Tick, level: float) -> Calibration:
    """Margins that cover how far execution leaves the plans that keep them.

    Each pass acts on the next n seeds.
    """
    request, n = experiment.request, experiment.request.n
    require_enough(n, level)
    acting, task = controller(experiment), cast(ControlTask, experiment.task)
    declared, env = experiment.declared, parse_env(task, experiment.preset.control.env)
    names = [part.name for part in declared.parts]

    def measured(margins: Array, number: int) -> Array:
        seeds = [seed + number * n for seed in experiment.seeds]
        by_name = dict(zip(names, margins.tolist(), strict=True))
        inside = replace(acting, enforced=tightened(acting.satisfied, by_name))
        done = rollout(inside, task, seeds, env, on_step=lambda k, steps: tick("control", k, steps))
        if done.diverged.any():
            raise CdiffError(f"{diverged_text(done)}: no margin covers that; nothing was written")
        executed = metrics.executed_levels(declared, done.x, done.observed, task.dt)
        return excess(done.predicted_levels, executed, margins)

    margins, scores, passes = until_covered(measured, len(names), level)
    return Calibration(
        stem=experiment.constraints_path.stem,
        content=kinds_sha256(experiment.kinds),
        constraints={kind.name: kind.describe() for kind in experiment.kinds},
        method=request.method,
        preset=experiment.preset,
        level=level,
        episodes=n,
        passes=passes,
        seed=request.seed,
        weights_sha256=_checkpoint(experiment).card.weights_sha256,
        margins={
            name: Margin(
                margin=round(margin, 4),
                median=round(float(np.median(errors)), 4),
                largest=round(float(errors.max()), 4),
            )
            for name, margin, errors in zip(names, margins.tolist(), scores.T, strict=True)
        },
    )


def _checkpoint(experiment: Experiment) -> Checkpoint:
    if experiment.checkpoint is None:
        raise CdiffError(f"{experiment.task.name}: margins belong to a checkpoint, here is none")
    return experiment.checkpoint


def calibrated_text(path: Path, calibration: Calibration) -> str:
    """What `cdiff rollout --calibrate` prints."""
    margins = "; ".join(
        f"{name} {m.margin:g} (median {m.median:g}, largest {m.largest:g})"
        for name, m in calibration.margins.items()
    )
    return (
        f"margins at level {calibration.level:g} from {calibration.episodes} episodes, "
        f"pass {calibration.passes}: {margins}\nwritten to {shown(path)}"
    )
