"""Small quadratic programs over non-negative multipliers, all of a batch at once, exactly."""

import torch
from torch import Tensor

MAX_CHANGES = 1000  # changes of the active set; a few are usual


def nonnegative_least(
    M: Tensor, d: Tensor, rounding: Tensor, least: Tensor | float = 0.0
) -> Tensor:
    """argmin over lam >= 0 of lam.M lam / 2 - d.lam for positive definite M.

        lam >= 0,   M lam >= d,   lam (M lam - d) = 0

    Principal pivoting (Judice and Pires, 1994): active rows have M lam = d, all others lam = 0. All
    rows of a wrong sign change at once. After three changes without progress only the last of them
    changes, which is certain to end (Murty's rule).

    M          [n, n] or [batch, n, n]
    d          [batch, n]
    rounding   by how much a row may fall short of d [batch, 1]
    least      by how much a multiplier may be negative before it is set to 0
    """
    one = torch.eye(d.shape[1], dtype=M.dtype, device=M.device)
    active = d > rounding
    best, left = torch.full_like(d[:, :1], d.shape[1] + 1), torch.full_like(d[:, :1], 3)
    lam = torch.zeros_like(d)
    for _ in range(MAX_CHANGES):
        both = active[:, :, None] & active[:, None, :]
        lam = torch.linalg.solve(torch.where(both, M, one), torch.where(active, d, 0.0))
        product = lam @ M if M.ndim == 2 else (lam[:, None] @ M)[:, 0]
        wrong = torch.where(active, lam < -least, product - d < -rounding)
        if not bool(wrong.any()):
            break
        count = wrong.sum(1, keepdim=True)
        left = torch.where(count < best, 3.0, left - 1)
        best = torch.minimum(best, count.to(best))
        last = wrong & (wrong.flip(1).cumsum(1).flip(1) == 1)
        active = active ^ torch.where(left < 0, last, wrong)
    return lam.clamp_min(0)
