"""Small quadratic programs over non-negative multipliers, a batch at once, exactly."""

import torch
from torch import Tensor

FLIPS = 1000  # changes of the active set; a handful is usual


def nonnegative_least(
    M: Tensor, d: Tensor, rounding: Tensor, least: Tensor | float = 0.0
) -> Tensor:
    """argmin over lam >= 0 of lam.M lam / 2 - d.lam for positive definite M [n, n] or [batch, n, n] and d [batch, n]:

        lam >= 0,   M lam >= d,   lam (M lam - d) = 0

    Principal pivoting (Judice and Pires, 1994): given the set of rows where M lam = d, elsewhere lam = 0, all rows of a wrong
    sign change sides at once; where that has not helped three times in a row, the last of them alone, which ends for certain
    (Murty's rule).

    rounding   by how much a row may fall short of d [batch, 1];  least: by how much a multiplier may be negative, then cut to 0
    """
    one = torch.eye(d.shape[1], dtype=M.dtype, device=M.device)
    active = d > rounding
    best, left = torch.full_like(d[:, :1], d.shape[1] + 1), torch.full_like(d[:, :1], 3)
    lam = torch.zeros_like(d)
    for _ in range(FLIPS):
        both = active[:, :, None] & active[:, None, :]
        lam = torch.linalg.solve(torch.where(both, M, one), torch.where(active, d, 0.0))
        made = lam @ M if M.ndim == 2 else (lam[:, None] @ M)[:, 0]
        wrong = torch.where(active, lam < -least, made - d < -rounding)
        if not bool(wrong.any()):
            break
        count = wrong.sum(1, keepdim=True)
        left = torch.where(count < best, 3.0, left - 1)
        best = torch.minimum(best, count.to(best))
        last = wrong & (wrong.flip(1).cumsum(1).flip(1) == 1)
        active = active ^ torch.where(left < 0, last, wrong)
    return lam.clamp_min(0)
