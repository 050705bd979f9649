"""Linear-quadratic tracking by pieces against the same problem written out as one dense system."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.projection.solvers.lq_tracking import PIECE, tracking
from tests.problems import F64, normal

WEIGHT = (1.0, 0.5, 0.02)
seeds = st.integers(0, 10_000)


def system(seed):
    """Three states, two inputs, with a drift."""
    return (
        torch.eye(3, dtype=F64) + 0.1 * normal(seed, 3, 3),
        normal(seed + 1, 3, 2),
        0.1 * normal(seed + 2, 3),
    )


def numbers(A, B, c):
    return tuple(tuple(v.flatten().tolist()) for v in (A, B, c))


def dense(A, B, c, steps, ends, x0, e, z, f):
    """The minimiser w by the optimality conditions of all states, inputs and multipliers at once."""
    n, m = B.shape
    width = n + m
    rows, right = [], []
    for tau in range(steps):
        row = torch.zeros(n, steps, width, dtype=F64)
        row[:, tau, :n], row[:, tau, n:] = torch.eye(n, dtype=F64), -B
        if tau:
            row[:, tau - 1, :n] = -A
        rows.append(row.flatten(1))
        right.append(c + (A @ x0 if tau == 0 else 0))
    if ends:
        last = torch.zeros(n, steps, width, dtype=F64)
        last[:, -1, :n] = torch.eye(n, dtype=F64)
        rows.append(last.flatten(1))
        right.append(e)
    E, h = torch.cat(rows), torch.cat(right)
    W = torch.tensor([*WEIGHT, *(0.0 for _ in range(m))], dtype=F64).repeat(steps)
    pull = f.clone()
    pull[:, :n] += torch.tensor(WEIGHT, dtype=F64) * z
    size = steps * width
    kkt = torch.zeros(size + len(E), size + len(E), dtype=F64)
    kkt[:size, :size], kkt[:size, size:], kkt[size:, :size] = torch.diag(W), E.T, E
    return torch.linalg.solve(kkt, torch.cat((pull.flatten(), h)))[:size].view(steps, width)


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize(
    "steps", [2, 5, PIECE, PIECE + 1, 2 * PIECE + 3]
)  # within a piece, whole pieces, and parts of them
def test_the_solution_is_that_of_the_dense_system(steps, ends):
    A, B, c = system(steps)
    z, f = normal(1, 2, steps + 1, 3), 0.1 * normal(2, 2, steps, 5)
    w = tracking(numbers(A, B, c), WEIGHT, steps, ends, z.device).solve(z, f)
    for k in range(2):
        expected = dense(A, B, c, steps, ends, z[k, 0], z[k, -1], z[k, 1:], f[k])
        torch.testing.assert_close(
            w[k], expected, atol=1e-6, rtol=1e-6
        )  # the ridge on the inputs is 1e-9 of their weight


@settings(max_examples=10, deadline=None)
@given(seed=seeds, steps=st.integers(3, 2 * PIECE + 5), ends=st.booleans())
def test_every_response_satisfies_the_dynamics_and_keeps_a_pinned_end(seed, steps, ends):
    A, B, c = system(seed)
    f = normal(seed + 3, 2, steps, 5)
    w = tracking(numbers(A, B, c), WEIGHT, steps, ends, f.device).respond(f)
    x, u = torch.cat((torch.zeros(2, 1, 3, dtype=F64), w[..., :3]), 1), w[..., 3:]
    scale = float(w.abs().max())
    torch.testing.assert_close(x[:, 1:], x[:, :-1] @ A.T + u @ B.T, atol=1e-9 * scale, rtol=0)
    assert not ends or float(x[:, -1].abs().max()) <= 1e-8 * scale


@pytest.mark.parametrize("ends", [False, True])
def test_products_between_rows_equal_the_dense_matrix_and_are_symmetric(ends):
    A, B, c = system(7)
    steps = 2 * PIECE + 5
    track = tracking(numbers(A, B, c), WEIGHT, steps, ends, A.device)
    K = track.respond(torch.eye(steps * 5, dtype=F64).view(-1, steps, 5)).flatten(1)
    scale = float(K.abs().max())
    torch.testing.assert_close(K, K.T, atol=1e-10 * scale, rtol=0)
    step = torch.randint(steps, (3, 6, 1), generator=torch.Generator().manual_seed(0))
    at, weight = step * 5 + torch.tensor([0, 3]), normal(8, 3, 6, 2)
    C = torch.zeros(3, 6, steps * 5, dtype=F64).scatter_add_(2, at, weight)
    torch.testing.assert_close(
        track.between(at.movedim(2, 0), weight.movedim(2, 0)),
        C @ K @ C.mT,
        atol=1e-10 * scale,
        rtol=0,
    )
    alone = track.between(at[None, ..., 0], weight[None, ..., 0])
    C = torch.zeros_like(C).scatter_add_(2, at[..., :1], weight[..., :1])
    torch.testing.assert_close(alone, C @ K @ C.mT, atol=1e-10 * scale, rtol=0)


def test_coordinate_that_no_input_moves_follows_the_dynamics():
    """The third coordinate halves at each step; its pinned end elsewhere is missed, the other two
    are met.
    """
    A = torch.diag(torch.tensor([1.0, 1.0, 0.5], dtype=F64))
    B = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]], dtype=F64)
    z = normal(0, 1, 5, 3)
    w = tracking(numbers(A, B, torch.zeros(3, dtype=F64)), WEIGHT, 4, True, z.device).solve(
        z, torch.zeros(1, 4, 5, dtype=F64)
    )
    torch.testing.assert_close(w[0, -1, :2], z[0, -1, :2], atol=1e-9, rtol=0)
    torch.testing.assert_close(
        w[0, :, 2], z[0, 0, 2] * 0.5 ** torch.arange(1, 5, dtype=F64), atol=1e-9, rtol=0
    )


def test_two_inputs_with_the_same_effect_share_it_equally():
    A, B = torch.eye(1, dtype=F64), torch.ones(1, 2, dtype=F64)
    z = normal(0, 1, 4, 1)
    w = tracking(numbers(A, B, torch.zeros(1, dtype=F64)), (1.0,), 3, False, z.device).solve(
        z, torch.zeros(1, 3, 3, dtype=F64)
    )
    torch.testing.assert_close(w[0, :, 0], z[0, 1:, 0], atol=1e-6, rtol=0)
    torch.testing.assert_close(w[0, :, 1], w[0, :, 2], atol=1e-6, rtol=0)
