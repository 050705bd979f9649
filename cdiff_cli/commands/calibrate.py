"""`cdiff rollout --calibrate`: margins from the errors between plans and execution."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from cdiff_cli.arrays import Array
from cdiff_cli.commands.margins import Calibration, Margin, write_calibration
from cdiff_cli.commands.plan import Tick
from cdiff_cli.commands.resolve import Experiment
from cdiff_cli.commands.rollout import _diverged, controller, parse_env
from cdiff_cli.constraints.spec.load import kinds_sha256
from cdiff_cli.errors import CdiffError
from cdiff_cli.evaluation import metrics
from cdiff_cli.evaluation.conformal import excess, require_enough, tightened, until_covered
from cdiff_cli.paths import shown
from cdiff_cli.planning.receding_horizon import control


def calibrate(resolved: Experiment, tick: Tick, level: float) -> tuple[Path, Calibration]:
    """Fit margins to what was asked for, and write them beside the checkpoint."""
    assert resolved.checkpoint is not None
    found = fit_margins(resolved, tick, level)
    return write_calibration(resolved.checkpoint.path, found), found


def fit_margins(resolved: Experiment, tick: Tick, level: float) -> Calibration:
    """Margins that cover how far execution leaves the plans that keep them; each pass acts on the next n seeds."""
    n, checkpoint = resolved.options.n, resolved.checkpoint
    require_enough(n, level)
    acting = controller(resolved)
    assert checkpoint is not None
    env, names = (
        parse_env(acting.task, resolved.options.env),
        [part.name for part in acting.g.parts],
    )

    def measured(margins: Array, number: int) -> Array:
        seeds = [seed + number * n for seed in resolved.seeds]
        inside = replace(
            acting,
            enforced=tightened(acting.enforced, dict(zip(names, margins.tolist(), strict=True))),
        )
        done = control(inside, seeds, env, on_step=lambda k, steps: tick("control", k, steps))
        if done.diverged.any():
            raise CdiffError(f"{_diverged(done)}: no margin covers that; nothing was written")
        return excess(
            done.foreseen,
            metrics.executed_levels(acting.g, done.x, done.observed, acting.task.dt),
            margins,
        )

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
            name: Margin(
                margin=round(margin, 4),
                median=round(float(np.median(each)), 4),
                largest=round(float(each.max()), 4),
            )
            for name, margin, each in zip(names, margins.tolist(), scores.T, strict=True)
        },
    )


def calibrated_text(path: Path, found: Calibration) -> str:
    """What `cdiff rollout --calibrate` prints."""
    each = "; ".join(
        f"{name} {m.margin:g} (median {m.median:g}, largest {m.largest:g})"
        for name, m in found.margins.items()
    )
    return f"margins at level {found.level:g} from {found.episodes} episodes, pass {found.passes}: {each}\nwritten to {shown(path)}"
