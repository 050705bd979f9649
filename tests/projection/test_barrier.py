"""The nearest values with v_{k+1} >= gamma v_k: known answers, a QP solver, multipliers, underflow."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.projection.project import project
from cdiff_cli.projection.solvers.isotonic import pool_violators
from tests.problems import F64, chain, nearest_chain, normal, num, pin, qp_project, vec

QP = 1e-6  # accuracy of ProxQP: 1e-9 per constraint, less for many coupled ones


def _fixed(n, *ends):
    """No index but these is fixed [n]."""
    return torch.zeros(n, dtype=torch.bool).index_fill_(
        0, torch.tensor(ends, dtype=torch.long) % n, True
    )


@pytest.mark.parametrize(
    ("gamma", "h", "weight", "ends", "v"),
    [
        (0.5, (2.0, 0.0), (1.0, 3.0), (), (8 / 7, 4 / 7)),  # minimise (a - 2)^2 + 3 (a / 2)^2
        (
            0.5,
            (4.0, 3.0, 0.0),
            (1.0, 1.0, 1.0),
            (),
            (4.0, 2.4, 1.2),
        ),  # the last two: b = 3 / (1 + 1 / 4)
        (
            0.5,
            (4.0, 2.2, 0.0),
            (1.0, 1.0, 1.0),
            (),
            (136 / 35, 68 / 35, 34 / 35),
        ),  # b = 1.76 < 4 / 2 pulls in the first
        (0.5, (2.0, 0.0, 3.0), (1.0, 1.0, 1.0), (0,), (2.0, 1.0, 3.0)),
        (0.5, (4.5, 4.0, 1.0), (1.0, 1.0, 1.0), (-1,), (4.0, 2.0, 1.0)),
        (0.5, (1.0, 0.0, 9.0, 1.0), (1.0, 1.0, 1.0, 1.0), (0, -1), (1.0, 0.5, 2.0, 1.0)),
        (
            0.5,
            (3.0, -1.0, 0.0),
            (1.0, 1.0, 1.0),
            (-1,),
            (0.0, -0.0, 0.0),
        ),  # nothing above 0 ever reaches 0
        (
            0.0,
            (-1.0, -2.0, 3.0),
            (1.0, 1.0, 1.0),
            (),
            (-1.0, 0.0, 3.0),
        ),  # alpha = 1 clips all but the first
        (0.5, (4.0, 2.0, 1.0), (1.0, 1.0, 1.0), (), (4.0, 2.0, 1.0)),
    ],
)
def test_nearest_barrier_values_match_hand_calculation(gamma, h, weight, ends, v):
    found = nearest_chain(vec(*h)[None], gamma, vec(*weight), _fixed(len(h), *ends))
    torch.testing.assert_close(found[0], vec(*v), atol=1e-15, rtol=1e-15)  # rounding


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    n=st.integers(1, 60),
    alpha=st.floats(1e-3, 1.0),
    ends=st.sets(st.sampled_from([0, -1])),
)
def test_weighted_nearest_barrier_values_agree_with_proxqp(seed, n, alpha, ends):
    h, w, fixed = normal(seed, 2, n), normal(seed + 1, n).abs() + 0.2, _fixed(n, *ends)
    h[:, 0], h[:, -1] = 0.5, 1.0  # a chain between these two is always possible
    v = nearest_chain(h, 1 - alpha, w, fixed)
    assert torch.equal(v[:, fixed], h[:, fixed])
    if n == 1:
        assert torch.equal(v, h)
        return
    A, root = (1 - alpha) * np.eye(n)[:-1] - np.eye(n)[1:], w.sqrt().numpy()
    for one, mine in zip(h.numpy(), v.numpy(), strict=True):
        expected = (
            qp_project(A / root, np.zeros(n - 1), root * one, fixed.numpy()) / root
        )  # y = sqrt(w) v makes it a projection
        np.testing.assert_allclose(mine, expected, atol=QP)


@pytest.mark.parametrize("alpha", [1e-3, 0.05, 0.85, 1.0])
@pytest.mark.parametrize("n", [384, 1536])
@pytest.mark.parametrize("start", ["free", "start fixed"])
def test_nearest_values_of_long_barriers_are_optimal_and_idempotent(n, alpha, start):
    """Stationarity  w_k (v_k - h_k) + gamma lam_k - lam_{k-1} = 0,  lam >= 0 only where v_{k+1} =
    gamma v_k.
    """
    gamma, w, fixed = (
        1 - alpha,
        normal(n, n).abs() + 0.2,
        _fixed(n, *([] if start == "free" else [0])),
    )
    rise, fall = torch.linspace(0, 9, n, dtype=F64), torch.linspace(1, 0, n, dtype=F64)
    rise[-1] = -40.0  # takes in many neighbours
    h = torch.stack((normal(1, n), normal(2, n).cumsum(0), 1 + (12 * fall).sin(), fall, rise))
    v = nearest_chain(h, gamma, w, fixed)
    gap, push = v[:, 1:] - gamma * v[:, :-1], w * (v - h)
    back = [torch.zeros_like(v[:, 0])]
    for k in range(n - 1, -1, -1):
        back.append(push[:, k] + gamma * back[-1])
    lam, unbalanced = torch.stack(back[-2:0:-1], 1), back[-1]
    rounding = 1e-15 * n * float(h.abs().max())  # of a sum of n such terms; nothing else is lost
    assert float(gap.min()) >= -rounding
    assert float(lam.min()) >= -rounding
    assert float((lam * gap).abs().max()) <= rounding * (1 + float(lam.max()) + float(gap.max()))
    assert start != "free" or float(unbalanced.abs().max()) <= rounding
    torch.testing.assert_close(nearest_chain(v, gamma, w, fixed), v, atol=rounding, rtol=0)


def _pooled_one_by_one(h, gamma, w):
    """The stack of pooled adjacent violators, one index after the other: (N, D, length) of each
    block.
    """
    blocks = []
    for value, weight in zip(h.tolist(), w.tolist(), strict=True):
        blocks.append((weight * value, weight, 1))
        while (
            len(blocks) > 1
            and blocks[-1][0] / blocks[-1][1]
            < gamma ** blocks[-2][2] * blocks[-2][0] / blocks[-2][1]
        ):
            (N, D, n), (N2, D2, n2) = blocks[-2:]
            blocks[-2:] = [(N + gamma**n * N2, D + gamma ** (2 * n) * D2, n + n2)]
    return vec(*(N / D * gamma**k for N, D, n in blocks for k in range(n)))


def _wave(seed, n):
    s = torch.linspace(0, 1, n, dtype=F64)
    return (
        1
        + (
            20 * torch.rand(1, generator=torch.Generator().manual_seed(seed), dtype=F64) * s + seed
        ).sin()
    )


KINDS = {
    "noise": normal,
    "walk": lambda seed, n: normal(seed, n).cumsum(0),
    "wave": _wave,
    "wave and noise": lambda seed, n: _wave(seed, n) + normal(seed, n, scale=1e-3),
    "ties": lambda seed, n: normal(seed, n).round(),
    "drop in a rise": lambda seed, n: torch.linspace(0, 9, n, dtype=F64).index_fill(
        0, torch.tensor(seed % n), -1e3
    ),
    "peak in a rise": lambda seed, n: torch.linspace(0, 9, n, dtype=F64).index_fill(
        0, torch.tensor(seed % n), 1e3
    ),
    "steps": lambda seed, n: (torch.linspace(0, 8, n, dtype=F64).floor() - 4) * normal(seed, 1),
}


@settings(max_examples=60, deadline=None)
@given(
    kinds=st.lists(st.sampled_from(sorted(KINDS)), min_size=1, max_size=6),
    seed=st.integers(0, 10_000),
    n=st.integers(2, 200),
    alpha=st.sampled_from([1e-3, 0.05, 0.5, 0.85, 1.0]),
    spread=st.sampled_from([0.0, 1.0, 3.0]),
)
def test_merging_in_windows_equals_merging_one_by_one(kinds, seed, n, alpha, spread):
    h = torch.stack([KINDS[kind](seed + at, n) for at, kind in enumerate(kinds)])
    w = (spread * normal(seed, len(kinds), n)).exp()
    v, _ = pool_violators(h, 1 - alpha, w)
    expected = torch.stack(
        [_pooled_one_by_one(*one) for one in zip(h, [1 - alpha] * len(h), w, strict=True)]
    )
    torch.testing.assert_close(
        v, expected, atol=1e-15 * n * float(h.abs().max()), rtol=0
    )  # rounding of a sum of n terms


def test_block_with_a_large_weight_takes_in_no_neighbour_that_does_not_fall():
    """The first 60 values are one block, whose weight hides what is pooled with it.

    The pooled value changes by less than rounding, so the test looks at the block itself.
    """
    h = torch.linspace(0, 1, 120, dtype=F64).repeat(8, 1)
    h[:, :60] = -torch.linspace(1, 3, 8, dtype=F64)[:, None]
    h[:, 60:71] = vec(0.7, 1.25, 0.87, 0.22, -0.7, 0.1, -0.15, 1.5, 0.4, 0.02, -1.4)
    v, _ = pool_violators(h, 0.15, torch.ones_like(h))
    expected = torch.stack([_pooled_one_by_one(one, 0.15, torch.ones(120)) for one in h])
    torch.testing.assert_close(v, expected, atol=1e-15, rtol=0)  # rounding
    assert bool((v[:, 61] == 1.25).all())


@pytest.mark.parametrize(("end", "value"), [(-1, -1e3), (0, 1e3)])
@pytest.mark.parametrize(
    ("alpha", "rounds"), [(0.05, 1), (1e-3, 20)]
)  # one neighbour a round would take 96 to 383
def test_single_value_takes_in_a_whole_rise_in_few_rounds(end, value, alpha, rounds):
    h = torch.linspace(0, 1, 384, dtype=F64).repeat(10, 1)
    h[:, end] = value
    assert pool_violators(h, 1 - alpha, torch.ones_like(h[0]))[1] <= rounds


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("alpha", [1e-3, 0.05, 0.85, 1.0])
@pytest.mark.parametrize("n", [384, 1536])
@pytest.mark.parametrize("end", [0.0, 2.0])
def test_underflowing_powers_of_gamma_do_not_affect_long_barriers(dtype, alpha, n, end):
    h = normal(3, 2, n, scale=0.5).to(dtype)
    h[:, 0], h[:, -1] = 0.0, end
    v = nearest_chain(h, 1 - alpha, torch.ones_like(h[0]), _fixed(n, 0, -1))
    assert v.dtype == dtype
    assert bool(torch.isfinite(v).all())
    assert float(((1 - alpha) * v[:, :-1] - v[:, 1:]).max()) <= torch.finfo(dtype).eps * float(
        v.abs().max()
    )  # rounding


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_pinned_end_below_zero_that_cannot_be_reached_is_refused(dtype):
    z = torch.ones(1, 384, 1, dtype=dtype)
    z[0, -1] = -1.0  # h = x: the start would have to lie below -0.15^-383
    with pytest.raises(InfeasibleError):
        project(chain(HalfSpace(vec(-1.0), num(0.0)), 0.85).to(z), z, pin(z, -1))


def test_one_block_may_be_longer_than_the_representable_powers_of_gamma():
    h = torch.full((1, 2000), -1.0, dtype=F64)
    h[0, 0] = 3.0
    v = nearest_chain(h, 0.5, torch.ones_like(h[0]), _fixed(2000))
    expected = 1.5 * 0.5 ** torch.arange(2000).to(
        F64
    )  # N = 3 - 1/2 - 1/4 - ... = 2, D = 1 + 1/4 + 1/16 + ... = 4/3
    torch.testing.assert_close(v[0], expected, atol=1e-15, rtol=0)  # rounding


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_nearest_barrier_values_of_a_batch_equal_those_of_each_plan(dtype):
    line = torch.arange(50.0).to(F64)
    h, w = (
        torch.stack((normal(1, 50), normal(2, 50).cumsum(0), line, -line)).to(dtype),
        normal(3, 50).abs().to(dtype) + 0.2,
    )
    alone = torch.cat([nearest_chain(one[None], 0.9, w, _fixed(50)) for one in h])
    torch.testing.assert_close(
        nearest_chain(h, 0.9, w, _fixed(50)), alone, atol=1e-14, rtol=0
    )  # a value of its own is w h / w
    assert nearest_chain(h[:0], 0.9, w, _fixed(50)).shape == (0, 50)


def test_float32_result_is_the_rounded_float64_result():
    h, w = normal(4, 3, 200).cumsum(1).float(), normal(5, 200).abs().float() + 0.2
    exact = nearest_chain(h.double(), 0.95, w.double(), _fixed(200))
    assert torch.equal(nearest_chain(h, 0.95, w, _fixed(200)), exact.float())
