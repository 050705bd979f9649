"""Linear-quadratic tracking: the matrix that maps linear costs on a trajectory to its minimiser.

    minimise over w = (x, u)   sum |x - z|^2_W / 2 - f.w
    s.t.   x' = A x + B u + c,   x^0 given,   the last state given or free

The solution is affine in z, f and the pinned states. K = dw / df depends on the dynamics, W and the
horizon alone, and is shared by the batch. K is also the covariance of the closed loop that the
Riccati recursion gives, driven by noise (Rauch, Tung and Striebel, 1965, in reverse). It therefore
has low rank between any two stretches of the horizon: the past acts on the future through the state
where they meet. K is stored as one dense block per PIECE steps and a low-rank part between pieces,
so a product with it is linear in the horizon.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

PIECE = 32  # steps per dense block
RIDGE = 1e-9  # relative cost of the inputs; of inputs with the same effect the smallest are taken
UNREACHABLE = (
    1e-10  # share of the largest variance of the last state below which inputs do not reach
)


class Tracking(NamedTuple):
    """K = blockdiag(near) + far link far^T, over w = (x^{tau+1}, u^tau) per step tau.

    w is padded to whole pieces, and p = PIECE * (n + m).

    near                   [pieces, p, p]
    far                    [pieces, p, 2 n]
    link                   [pieces * 2 n, pieces * 2 n]
    from_start, from_end   a trajectory of the dynamics per pinned state   [steps * (n + m), n]
    offset                 contribution of c to that trajectory            [steps * (n + m)]
    weight                 weight of w in the cost                         [n + m]
    """

    near: Tensor
    far: Tensor
    link: Tensor
    from_start: Tensor
    from_end: Tensor
    offset: Tensor
    weight: Tensor

    def solve(self, z: Tensor, f: Tensor) -> Tensor:
        """The solution w [batch, steps, n + m].

        z   targets [batch, horizon, n];  f  linear costs [batch, steps, n + m]
        """
        start = (z[:, 0] @ self.from_start.T + z[:, -1] @ self.from_end.T + self.offset).view(
            f.shape
        )
        n = z.shape[2]
        pull = f - self.weight * start
        pull[..., :n] += self.weight[:n] * z[:, 1:]
        return start + self.respond(pull)

    def respond(self, f: Tensor) -> Tensor:
        """The product K f [batch, steps, n + m]."""
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
        """The products c_i K c_j of k rows c per plan [batch, k, k].

        Row c is the sum over l of weight[l] times the unit vector of entry at[l] of w. All entries
        of a row belong to one step.

        at, weight   [l, batch, k]
        """
        (pieces, p, rank), (_, batch, k) = self.far.shape, at.shape
        piece = at[0] // p
        rows, ends = (
            _weighted_sum(
                [v.flatten(0, 1).index_select(0, one.flatten()).view(batch, k, -1) for one in at],
                weight[..., None],
            )
            for v in (self.near, self.far)
        )
        columns = (at - piece * p)[:, :, None].expand(-1, -1, k, -1)
        inside = _weighted_sum([rows.gather(2, one) for one in columns], weight[:, :, None])
        inside = torch.where(piece[:, :, None] == piece[:, None], inside, 0.0)
        spread = ends.new_zeros(batch, k, pieces, rank)
        spread.scatter_(2, piece[..., None, None].expand(-1, -1, 1, rank), ends[:, :, None])
        spread = spread.flatten(2)
        return inside + spread @ self.link @ spread.mT


def _weighted_sum(terms: Sequence[Tensor], weight: Tensor) -> Tensor:
    """The sum of the terms, each times its weight."""
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
    """The shared matrix in float64.

    numbers   A, B, c, each flattened
    weight    weight per coordinate
    ends      whether the last state is given
    """
    n = len(weight)
    A, B, c = (torch.tensor(values, dtype=torch.float64) for values in numbers)
    A, B, W = A.view(n, n), B.view(n, -1), torch.diag(torch.tensor(weight, dtype=torch.float64))
    largest = float((B.T @ W @ B).diagonal().max().clamp_min(1e-30))
    ridge = RIDGE * largest * torch.eye(B.shape[1], dtype=torch.float64)
    loops, roots = _closed_loop(A, B, W, ridge, steps)
    from_start, offset = _mean(A, B, c, loops)
    pieces = _pieces(A, B, loops, roots)
    link, from_end = _links(pieces.through), torch.zeros_like(from_start)
    if ends:
        link, from_end = _given_end(pieces, link, len(from_start))
        last = slice(len(from_start) - n - B.shape[1], len(from_start) - B.shape[1])
        offset = offset - from_end @ offset[last]
        from_start = from_start - from_end @ from_start[last]
    far = torch.cat((pieces.enter, pieces.leave), 2)
    weights = torch.cat((W.diagonal(), ridge.diagonal()))
    matrices = (pieces.near, far, link, from_start, from_end, offset, weights)
    return Tracking(*(v.to(device) for v in matrices))


def _mean(A: Tensor, B: Tensor, c: Tensor, loops: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """w by the first state [steps * (n + m), n], and the contribution of c [steps * (n + m)]."""
    n = len(A)
    state, constant = torch.eye(n, dtype=torch.float64), torch.zeros(n, dtype=torch.float64)
    by_state, by_constant = [], []
    for loop in loops:
        u_state, u_constant = -loop @ state, -loop @ constant
        state, constant = A @ state + B @ u_state, A @ constant + B @ u_constant + c
        by_state += [state, u_state]
        by_constant += [constant, u_constant]
    return torch.cat(by_state), torch.cat(by_constant)


class Pieces(NamedTuple):
    """The closed loop, piece by piece.

    near      covariance of w within a piece                          [pieces, p, p]
    enter     w by the state where its piece begins                   [pieces, p, n]
    leave     covariance of w and the state where its piece ends      [pieces, p, n]
    through   the state where a piece ends by that where it begins    [pieces, n, n]
    spread    variance of the last state                              [n, n]
    """

    near: Tensor
    enter: Tensor
    leave: Tensor
    through: Tensor
    spread: Tensor


def _pieces(A: Tensor, B: Tensor, loops: Sequence[Tensor], roots: Sequence[Tensor]) -> Pieces:
    """The closed loop of the feedback `loops`, driven by noise with variance root root^T."""
    (n, m), steps = B.shape, len(loops)
    count, p = -(-steps // PIECE), PIECE * (n + m)
    near = torch.zeros(count, p, p, dtype=torch.float64)
    enter, leave = torch.zeros(2, count, p, n, dtype=torch.float64)
    through = torch.zeros(count, n, n, dtype=torch.float64)
    spread = torch.zeros(n, n, dtype=torch.float64)  # variance of the state where a piece begins
    for i in range(count):
        steps_of_piece = slice(i * PIECE, (i + 1) * PIECE)
        arrive, driven = _piece(A, B, loops[steps_of_piece], roots[steps_of_piece])
        rows = len(arrive)
        enter[i, :rows] = arrive
        noise = torch.zeros(p, driven.shape[1], dtype=torch.float64)
        noise[:rows] = driven
        near[i] = enter[i] @ spread @ enter[i].T + noise @ noise.T
        end = slice(rows - n - m, rows - m)
        leave[i], spread, through[i] = near[i][:, end], near[i][end, end], enter[i][end]
    return Pieces(near, enter, leave, through, spread)


def _piece(
    A: Tensor, B: Tensor, loops: Sequence[Tensor], roots: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """w by the state where the piece begins, and by the noise of each step of the piece."""
    n, m = B.shape
    noise = torch.zeros(n, len(loops) * m, dtype=torch.float64)
    arrive = torch.eye(n, dtype=torch.float64)
    arrivals, driven = [], []
    for j, (loop, root) in enumerate(zip(loops, roots, strict=True)):
        u_noise, u_arrive = -loop @ noise, -loop @ arrive
        u_noise[:, j * m : (j + 1) * m] += root
        noise, arrive = A @ noise + B @ u_noise, A @ arrive + B @ u_arrive
        arrivals += [arrive, u_arrive]
        driven += [noise, u_noise]
    return torch.cat(arrivals), torch.cat(driven)


def _given_end(pieces: Pieces, link: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """The link conditioned on a given last state, and w by that state [size, n]."""
    count, n, _ = pieces.through.shape
    to_end = torch.zeros(
        count, n, n, dtype=torch.float64
    )  # the last state by that of a piece's end
    to_end[-1] = torch.eye(n, dtype=torch.float64)
    for i in reversed(range(count - 1)):
        to_end[i] = to_end[i + 1] @ pieces.through[i + 1]
    precision = torch.linalg.pinv(pieces.spread, hermitian=True, rtol=UNREACHABLE)
    effect = to_end.transpose(1, 2).reshape(count * n, n)
    blocks = link.view(count, 2, n, count, 2, n)
    blocks[:, 1, :, :, 1] -= (effect @ precision @ effect.T).view(count, n, count, n)
    from_end = (pieces.leave @ to_end.transpose(1, 2) @ precision).flatten(0, 1)
    return link, from_end[:size]


def _closed_loop(
    A: Tensor, B: Tensor, W: Tensor, ridge: Tensor, steps: int
) -> tuple[list[Tensor], list[Tensor]]:
    """The feedback u = -loop x per step, and a root of the variance of the inputs."""
    P, loops, roots = W, [], []
    for _ in range(steps):
        factor = torch.linalg.cholesky(B.T @ P @ B + ridge)
        loops.append(torch.cholesky_solve(B.T @ P @ A, factor))
        one = torch.eye(len(factor), dtype=factor.dtype)
        roots.append(torch.linalg.solve_triangular(factor, one, upper=False).T)
        closed = A - B @ loops[-1]
        P = W + closed.T @ P @ closed + loops[-1].T @ ridge @ loops[-1]
    return loops[::-1], roots[::-1]


def _links(through: Tensor) -> Tensor:
    """The transitions from each piece to all later ones, and their transposes since K is symmetric.

    Per piece, the state that enters it comes first, then the state that leaves it.
    """
    pieces, n, _ = through.shape
    link = torch.zeros(pieces, 2, n, pieces, 2, n, dtype=through.dtype)
    for j in range(pieces):
        transition = torch.eye(n, dtype=through.dtype)
        for i in range(j + 1, pieces):
            link[i, 0, :, j, 1] = transition
            link[j, 1, :, i, 0] = transition.T
            transition = through[i] @ transition
    return link.view(pieces * 2 * n, -1)
