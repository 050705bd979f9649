"""Linear-quadratic tracking by pieces: the matrix that turns linear costs on a trajectory into the trajectory they ask for.

    minimise over w = (x, u)   sum |x - z|^2_W / 2 - f.w    s.t.  x' = A x + B u + c,  x^0 given,  the last state given or free

Its solution is affine in z, f and the pinned states; K = dw / df depends on the dynamics, W and the horizon alone and is shared by
the batch. K is also the covariance of the closed loop that the Riccati recursion gives, driven by noise (Rauch, Tung and Striebel,
1965, in reverse), and so has low rank between any two stretches of the horizon: the past acts on the future through the state
where they meet. Held as one dense block per PIECE steps and what passes between pieces, a product with it is linear in the horizon.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

PIECE = 32  # steps in a dense block
RIDGE = 1e-9  # on the inputs, relative: where several inputs have the same effect the smallest are taken
UNREACHED = 1e-10  # share of the largest variance of the last state below which a direction counts as out of the inputs' reach


class Tracking(NamedTuple):
    """K = blockdiag(near) + far link far^T, over w = (x^{tau+1}, u^tau) for each step tau, padded to whole pieces.

    near [pieces, p, p], far [pieces, p, 2 n], link [pieces * 2 n, pieces * 2 n], p = PIECE * (n + m)
    from_start, from_end   a trajectory that the dynamics make, by the pinned states   [steps * (n + m), n]
    offset                 what c adds to it   [steps * (n + m)]
    weight                 of w in the cost   [n + m]
    """

    near: Tensor
    far: Tensor
    link: Tensor
    from_start: Tensor
    from_end: Tensor
    offset: Tensor
    weight: Tensor

    def solve(self, z: Tensor, f: Tensor) -> Tensor:
        """The solution for targets z [batch, horizon, n] and costs f [batch, steps, n + m]: w, [batch, steps, n + m]."""
        start = (z[:, 0] @ self.from_start.T + z[:, -1] @ self.from_end.T + self.offset).view(
            f.shape
        )
        n = z.shape[2]
        pull = f - self.weight * start
        pull[..., :n] += self.weight[:n] * z[:, 1:]
        return start + self.respond(pull)

    def respond(self, f: Tensor) -> Tensor:
        """K f, [batch, steps, n + m]."""
        (pieces, p, _), (batch, steps, width) = self.near.shape, f.shape
        g = f.reshape(batch, -1)
        if pieces * p > steps * width:
            g = torch.nn.functional.pad(g, (0, pieces * p - steps * width))
        g = g.view(batch, pieces, p).transpose(0, 1)
        passed = torch.bmm(g, self.far).transpose(0, 1).reshape(batch, -1) @ self.link
        out = torch.bmm(g, self.near)
        out.baddbmm_(passed.view(batch, pieces, -1).transpose(0, 1), self.far.mT)
        return out.transpose(0, 1).reshape(batch, -1)[:, : steps * width].view(f.shape)

    def between(self, at: Tensor, weight: Tensor) -> Tensor:
        """c_i K c_j for rows c = sum over l of weight[l] times the unit vector of entry at[l] of w, all of one row at one step:
        at, weight [l, batch, k] -> [batch, k, k].
        """
        (pieces, p, rank), (_, batch, k) = self.far.shape, at.shape
        piece = at[0] // p
        rows, ends = (
            _weighed(
                [v.flatten(0, 1).index_select(0, one.flatten()).view(batch, k, -1) for one in at],
                weight[..., None],
            )
            for v in (self.near, self.far)
        )
        columns = (at - piece * p)[:, :, None].expand(-1, -1, k, -1)
        inside = _weighed([rows.gather(2, one) for one in columns], weight[:, :, None])
        inside = torch.where(piece[:, :, None] == piece[:, None], inside, 0.0)
        spread = ends.new_zeros(batch, k, pieces, rank)
        spread.scatter_(2, piece[..., None, None].expand(-1, -1, 1, rank), ends[:, :, None])
        spread = spread.flatten(2)
        return inside + spread @ self.link @ spread.mT


def _weighed(terms: Sequence[Tensor], weight: Tensor) -> Tensor:
    """The sum of terms, each times its weight."""
    out = terms[0] * weight[0]
    for term, by in zip(terms[1:], weight[1:], strict=True):
        out.addcmul_(term, by)
    return out


@lru_cache(maxsize=8)
def tracking(
    numbers: tuple[tuple[float, ...], ...],
    weight: tuple[float, ...],
    steps: int,
    ends: bool,
    device: torch.device,
) -> Tracking:
    """For A, B, c, each flattened, and the weight of each coordinate. In float64."""
    n = len(weight)
    A, B, c = (torch.tensor(values, dtype=torch.float64) for values in numbers)
    A, B, W = A.view(n, n), B.view(n, -1), torch.diag(torch.tensor(weight, dtype=torch.float64))
    m = B.shape[1]
    ridge = (
        RIDGE
        * float((B.T @ W @ B).diagonal().max().clamp_min(1e-30))
        * torch.eye(m, dtype=torch.float64)
    )
    loops, roots = _closed_loop(A, B, W, ridge, steps)
    pieces, p = -(-steps // PIECE), PIECE * (n + m)
    near = torch.zeros(pieces, p, p, dtype=torch.float64)
    enter, leave = torch.zeros(2, pieces, p, n, dtype=torch.float64)
    through = torch.zeros(pieces, n, n, dtype=torch.float64)
    spread = torch.zeros(n, n, dtype=torch.float64)  # variance of the state where a piece begins
    free, offset = (
        torch.zeros(steps * (n + m), n, dtype=torch.float64),
        torch.zeros(steps * (n + m), dtype=torch.float64),
    )
    state, constant = torch.eye(n, dtype=torch.float64), torch.zeros(n, dtype=torch.float64)
    for i in range(pieces):
        some = range(i * PIECE, min(steps, (i + 1) * PIECE))
        noise = torch.zeros(
            n, len(some) * m, dtype=torch.float64
        )  # of the state, by each step's noise
        arrive = torch.eye(
            n, dtype=torch.float64
        )  # of the state, by the state where the piece begins
        driven = torch.zeros(p, len(some) * m, dtype=torch.float64)
        for j, tau in enumerate(some):
            row, own = j * (n + m), slice(j * m, (j + 1) * m)
            u_noise, u_arrive, u_state, u_constant = (
                -loops[tau] @ v for v in (noise, arrive, state, constant)
            )
            u_noise[:, own] += roots[tau]
            noise, arrive, state = (
                A @ noise + B @ u_noise,
                A @ arrive + B @ u_arrive,
                A @ state + B @ u_state,
            )
            constant = A @ constant + B @ u_constant + c
            driven[row : row + n + m] = torch.cat((noise, u_noise))
            enter[i, row : row + n + m] = torch.cat((arrive, u_arrive))
            free[tau * (n + m) : (tau + 1) * (n + m)] = torch.cat((state, u_state))
            offset[tau * (n + m) : (tau + 1) * (n + m)] = torch.cat((constant, u_constant))
        near[i] = enter[i] @ spread @ enter[i].T + driven @ driven.T
        leave[i] = near[i][:, row : row + n]
        spread = near[i][row : row + n, row : row + n]
        through[i] = arrive
    link, from_end = _links(through), torch.zeros_like(free)
    if ends:
        to_end = torch.zeros(
            pieces, n, n, dtype=torch.float64
        )  # of the last state, by the state where each piece ends
        to_end[-1] = torch.eye(n, dtype=torch.float64)
        for i in reversed(range(pieces - 1)):
            to_end[i] = to_end[i + 1] @ through[i + 1]
        known = torch.linalg.pinv(spread, hermitian=True, rtol=UNREACHED)
        shown = to_end.transpose(1, 2).reshape(pieces * n, n)
        blocks = link.view(pieces, 2, n, pieces, 2, n)
        blocks[:, 1, :, :, 1] -= (shown @ known @ shown.T).view(pieces, n, pieces, n)
        from_end = (leave @ to_end.transpose(1, 2) @ known).flatten(0, 1)[: len(free)]
        last = slice(len(free) - n - m, len(free) - m)
        offset = offset - from_end @ offset[last]
        free = free - from_end @ free[last]
    far = torch.cat((enter, leave), 2)
    heavy = torch.cat((W.diagonal(), ridge.diagonal()))
    return Tracking(*(v.to(device) for v in (near, far, link, free, from_end, offset, heavy)))


def _closed_loop(
    A: Tensor, B: Tensor, W: Tensor, ridge: Tensor, steps: int
) -> tuple[list[Tensor], list[Tensor]]:
    """Feedback u = -loop x of each step by the Riccati recursion, and a root of each input's variance around it."""
    P, loops, roots = W, [], []
    for _ in range(steps):
        factor = torch.linalg.cholesky(B.T @ P @ B + ridge)
        loops.append(torch.cholesky_solve(B.T @ P @ A, factor))
        roots.append(
            torch.linalg.solve_triangular(
                factor, torch.eye(len(factor), dtype=factor.dtype), upper=False
            ).T
        )
        closed = A - B @ loops[-1]
        P = W + closed.T @ P @ closed + loops[-1].T @ ridge @ loops[-1]
    return loops[::-1], roots[::-1]


def _links(through: Tensor) -> Tensor:
    """What each piece passes to later ones and, K being symmetric, they to it: in a row the state that enters, then leaves."""
    pieces, n, _ = through.shape
    link = torch.zeros(pieces, 2, n, pieces, 2, n, dtype=through.dtype)
    for j in range(pieces):
        on = torch.eye(n, dtype=through.dtype)
        for i in range(j + 1, pieces):
            link[i, 0, :, j, 1] = on
            link[j, 1, :, i, 0] = on.T
            on = through[i] @ on
    return link.view(pieces * 2 * n, -1)
