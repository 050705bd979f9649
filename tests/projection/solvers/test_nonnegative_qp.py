"""Principal pivoting of a batch of small programs: known answers, the optimality conditions, and a
solver's own.
"""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from cdiff_cli.projection.solvers.nonnegative_qp import nonnegative_least
from tests.problems import F64, normal, vec

NONE = torch.zeros(1, 1, dtype=F64)


def test_known_answers():
    """Alone each row takes lam = d / M; of two rows that press on each other, the one that asks for
    more.
    """
    assert nonnegative_least(torch.diag(vec(2.0, 4.0)), vec(1.0, -1.0)[None], NONE).tolist() == [
        [0.5, 0.0]
    ]
    M = torch.tensor([[1.0, 0.9], [0.9, 1.0]], dtype=F64)
    torch.testing.assert_close(
        nonnegative_least(M, vec(1.0, 0.5)[None], NONE), vec(1.0, 0.0)[None], atol=1e-12, rtol=0
    )
    assert nonnegative_least(M, vec(-1.0, -0.5)[None], NONE).tolist() == [[0.0, 0.0]]


@settings(max_examples=40, deadline=None)
@given(n=st.integers(1, 40), seed=st.integers(0, 10_000), shared=st.booleans())
def test_random_problems_agree_with_lawson_and_hanson(n, seed, shared):
    """With M = A^T A, lam is the least |A lam - c| over lam >= 0, where d = A^T c."""
    A, c = normal(seed, 3, n + 3, n), normal(seed + 1, 3, n + 3)
    A = A[:1] if shared else A
    d = (c[:, None] @ A)[:, 0]
    M = A.mT @ A
    lam = nonnegative_least(M[0] if shared else M, d, 1e-12 * (1 + d.abs().amax(1, keepdim=True)))
    for own, b, found in zip(A.expand(3, -1, -1), c, lam, strict=True):
        torch.testing.assert_close(
            found, torch.from_numpy(nnls(own.numpy(), b.numpy())[0]), atol=1e-7, rtol=1e-6
        )


@pytest.mark.parametrize("n", [1, 7])
def test_program_of_a_batch_is_solved_as_alone(n):
    A, d = normal(0, 5, n, n + 2), normal(1, 5, n)
    M = A @ A.mT
    alone = torch.cat(
        [nonnegative_least(M[i : i + 1], d[i : i + 1], NONE + 1e-12) for i in range(5)]
    )
    torch.testing.assert_close(nonnegative_least(M, d, NONE + 1e-12), alone, atol=1e-9, rtol=1e-9)
