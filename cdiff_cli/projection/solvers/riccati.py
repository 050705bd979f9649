"""Linear-quadratic problems over the horizon, of other costs at each waypoint and plan: the Riccati recursion over blocks of steps.

    minimise over q = (x, u)   sum over waypoints of q.H q / 2 + g.q   s.t.  x' = A x + B u,  the first state zero

The recursion runs from the last block to the first: of small matrices it is the calls that cost, and blocks save those.
"""

from typing import NamedTuple

import torch
from torch import Tensor

BLOCK = 16  # steps


class Blocks(NamedTuple):
    """A horizon in blocks of steps, filled up at its end.

    within  q of each step of a block by the state where it begins and its inputs   [BLOCK, n + m, n + BLOCK m]
    onward  the state where the next block begins, by the same   [n, n + BLOCK m]
    """

    within: Tensor
    onward: Tensor


class Factors(NamedTuple):
    """Of each block, the first one first: the factor of its inputs' cost, and their feedback [batch, BLOCK m, n]."""

    roots: list[Tensor]
    feedback: list[Tensor]


def blocks(A: Tensor, B: Tensor) -> Blocks:
    n, m = B.shape
    unit = torch.eye(n + BLOCK * m, dtype=A.dtype, device=A.device)
    state, each = unit[:n], []
    for k in range(BLOCK):
        own = unit[n + k * m : n + (k + 1) * m]
        each.append(torch.cat((state, own)))
        state = A @ state + B @ own
    return Blocks(torch.stack(each), state)


def factor(blocks: Blocks, H: Tensor) -> Factors:
    """H [batch, horizon, n + m, n + m], positive definite in the inputs."""
    n, (batch, horizon, width, _) = len(blocks.onward), H.shape
    more = -horizon % BLOCK
    if more:
        idle = torch.eye(width, dtype=H.dtype, device=H.device)
        idle[:n, :n] = 0.0
        H = torch.cat((H, idle.expand(batch, more, -1, -1)), 1)
    inside = H.view(batch, -1, BLOCK, width, width) @ blocks.within
    whole = (blocks.within.flatten(0, 1).T @ inside.flatten(2, 3)).unbind(1)
    P, roots, feedback = H.new_zeros(batch, n, n), [], []
    for block in reversed(whole):
        M = block + blocks.onward.T @ P @ blocks.onward
        roots.append(torch.linalg.cholesky_ex(M[:, n:, n:])[0])
        feedback.append(-torch.cholesky_solve(M[:, n:, :n], roots[-1]))
        P = M[:, :n, :n] + M[:, :n, n:] @ feedback[-1]
    return Factors(roots[::-1], feedback[::-1])


def minimiser(blocks: Blocks, factors: Factors, g: Tensor) -> Tensor:
    """q, for g of its shape [batch, horizon, n + m]."""
    n, (batch, horizon, width) = len(blocks.onward), g.shape
    more = -horizon % BLOCK
    g = torch.nn.functional.pad(g, (0, 0, 0, more)).view(batch, -1, BLOCK * width)
    whole, own, p = (g @ blocks.within.flatten(0, 1)).unbind(1), [], g.new_zeros(batch, n)
    for block, root, feedback in zip(*(reversed(v) for v in (whole, *factors)), strict=True):
        cost = block + p @ blocks.onward
        own.append(-torch.cholesky_solve(cost[:, n:, None], root)[..., 0])
        p = cost[:, :n] + (cost[:, None, n:] @ feedback)[:, 0]
    state, out = torch.zeros_like(p), []
    for push, feedback in zip(reversed(own), factors.feedback, strict=True):
        out.append(torch.cat((state, push + (feedback @ state[..., None])[..., 0]), 1))
        state = out[-1] @ blocks.onward.T
    return (torch.stack(out, 1) @ blocks.within.flatten(0, 1).T).view(batch, -1, width)[:, :horizon]
