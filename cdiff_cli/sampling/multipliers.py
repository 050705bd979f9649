"""Multipliers of the rows of g, and the formulas that all dual methods share."""

from typing import Literal

import torch
from torch.nn import functional as F

from cdiff_cli.arrays import Pull, Rows, Traj
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.projection.segments import TangentPlanes, crossed, row_blocks, split_excluded
from cdiff_cli.sampling.sampler import Step

Expectation = Literal["per_sample", "batch_mean"]
"""E g: the rows and multipliers of each plan, or the batch mean and shared multipliers (paper)."""
Positive = Literal["none", "silu"]
"""none: E g <= 0;  silu: E g / (1 + e^-g) <= 0, the smooth positive part of g (paper, Remark 1)."""
Coefficient = Literal["beta/2", "one"]
"""Factor c_t of the push: beta_t / 2 (the paper) or 1 (its released code)."""


def zeros(x: Traj, g: Constraint, expectation: Expectation, *, tangent_planes: bool) -> Rows:
    """Multipliers zero, one per row of g in the order of row_blocks()   [batch or 1, n].

    tangent_planes   of the rows of with_tangent_planes(g), else of g itself
    """
    blocks = row_blocks(g, x.shape[1], tangent_planes)
    n = blocks[-1].stop if blocks else 0
    return x.new_zeros(1 if expectation == "batch_mean" else len(x), n)


def linearise(
    g: Constraint | TangentPlanes, x: Traj, positive: Positive
) -> tuple[Rows, Pull, Rows]:
    """Values g(x), their pull w -> w^T dg/dx, and row sizes |dg/dx|^2.

    With `positive` silu the values and the pull are those of the smooth positive part
    g / (1 + e^-g), and the row sizes stay those of g.
    """
    rows, pull, size = g.linearise(x)
    if positive == "none":
        return rows, pull, size
    gate = torch.sigmoid(rows)
    slope = gate * (1 + rows * (1 - gate))
    return F.silu(rows), lambda w: pull(w * slope), size


def expect(rows: Rows, expectation: Expectation) -> Rows:
    """E g: the rows themselves [batch, n], or their mean over the batch [1, n]."""
    return rows if expectation == "per_sample" else rows.mean(0, keepdim=True)


def spread(lam: Rows, rows: Rows) -> Rows:
    """Multipliers of every plan [batch, n], from those of every plan or from shared ones [1, n]."""
    return lam.expand_as(rows)


def weight(coefficient: Coefficient, step: Step) -> float:
    """The factor c_t of the push."""
    return step.beta / 2 if coefficient == "beta/2" else 1.0


def slack(g: Rows, lam: Rows, rho: float) -> Rows:
    """Slack that closes g + s = 0 for the rows that g already satisfies.

    s_t = [-E g(x_t) - lam_t / rho_t]_+                       (paper, Eq. alm_slack)

    g     E g(x_t), environment units, negative where satisfied   [batch, n]
    lam   multipliers, 1 / units of g, never negative             [batch, n]
    rho   penalty weight, > 0
    """
    return (-g - lam / rho).clamp_min(0)


def multiplier(g: Rows, lam: Rows, rho: float) -> Rows:
    """lam + rho (g + s) with the slack s = slack(g, lam, rho), which equals [lam + rho g]_+."""
    return (lam + rho * g).clamp_min(0)


def idle(g: Constraint, step: Step, lam: Rows) -> bool:
    """Whether a dual step on the clean estimate changes nothing: the estimate satisfies g and all
    multipliers are zero.
    """
    if _any_positive(lam):
        return False
    excluded, others = split_excluded(g)
    if excluded and bool(crossed(excluded, step.x0).any()):
        return False
    return not _any_positive(others(step.x0))


def _any_positive(rows: Rows) -> bool:
    """Whether an entry is positive or not a number."""
    return rows.numel() > 0 and not float(rows.amax()) <= 0
