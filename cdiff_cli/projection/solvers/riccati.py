"""Linear-quadratic problems with costs that differ by waypoint and plan, by a Riccati recursion.

    minimise over q = (x, u)   sum over waypoints of q.H q / 2 + g.q
    s.t.   x' = A x + B u,   the first state zero

The recursion runs backwards over blocks of BLOCK steps. With matrices this small the cost is the
number of calls, not the arithmetic.
"""

from typing import NamedTuple

import torch
from torch import Tensor

BLOCK = 16  # steps per block


class Blocks(NamedTuple):
    """A horizon in blocks of steps, padded at its end.

    Both are matrices on the state where a block begins and the inputs of the block.

    within  q of each step of the block            [BLOCK, n + m, n + BLOCK m]
    onward  the state where the next block begins  [n, n + BLOCK m]
    """

    within: Tensor
    onward: Tensor


class Factors(NamedTuple):
    """Per block, in order: the Cholesky factor of the cost of its inputs, and their feedback.

    [batch, BLOCK m, BLOCK m] and [batch, BLOCK m, n]
    """

    roots: list[Tensor]
    feedback: list[Tensor]


def blocks(A: Tensor, B: Tensor) -> Blocks:
    """The matrices of a block of x' = A x + B u."""
    n, m = B.shape
    unit = torch.eye(n + BLOCK * m, dtype=A.dtype, device=A.device)
    state, within = unit[:n], []
    for k in range(BLOCK):
        inputs = unit[n + k * m : n + (k + 1) * m]
        within.append(torch.cat((state, inputs)))
        state = A @ state + B @ inputs
    return Blocks(torch.stack(within), state)


def factor(blocks: Blocks, H: Tensor) -> Factors:
    """The factors of the costs H [batch, horizon, n + m, n + m], positive definite in u."""
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
    """The minimiser q for the costs g, both [batch, horizon, n + m]."""
    n, (batch, horizon, width) = len(blocks.onward), g.shape
    more = -horizon % BLOCK
    g = torch.nn.functional.pad(g, (0, 0, 0, more)).view(batch, -1, BLOCK * width)
    whole, pushes, p = (g @ blocks.within.flatten(0, 1)).unbind(1), [], g.new_zeros(batch, n)
    for block, root, feedback in zip(*(reversed(v) for v in (whole, *factors)), strict=True):
        cost = block + p @ blocks.onward
        pushes.append(-torch.cholesky_solve(cost[:, n:, None], root)[..., 0])
        p = cost[:, :n] + (cost[:, None, n:] @ feedback)[:, 0]
    state, out = torch.zeros_like(p), []
    for push, feedback in zip(reversed(pushes), factors.feedback, strict=True):
        out.append(torch.cat((state, push + (feedback @ state[..., None])[..., 0]), 1))
        state = out[-1] @ blocks.onward.T
    return (torch.stack(out, 1) @ blocks.within.flatten(0, 1).T).view(batch, -1, width)[:, :horizon]
