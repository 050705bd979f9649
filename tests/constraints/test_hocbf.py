"""The barrier of relative degree 2: psi = h + time dh/dt of a ball."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.hocbf import BallHOCBF
from tests.problems import F64, normal, vec

EYE, NONE, ORIGIN = torch.eye(2, dtype=F64), torch.zeros(2, 2, dtype=F64), vec(0.0, 0.0)
seeds = st.integers(0, 10_000)


def barrier(time: float = 0.5, centre=ORIGIN, drift=ORIGIN) -> BallHOCBF:
    """Outside the unit ball, of states (x, y, vx, vy)."""
    return BallHOCBF(
        torch.cat((EYE, NONE), 1),
        centre,
        torch.cat((NONE, EYE), 1),
        drift,
        torch.tensor(1.0, dtype=F64),
        time,
    )


@pytest.mark.parametrize(
    ("state", "psi"),
    [
        (vec(3.0, 0.0, 0.0, 0.0), 2.0),  # at rest: the distance to the ball
        (vec(3.0, 0.0, -2.0, 0.0), 1.0),  # coming: less, by what half a second brings
        (vec(3.0, 0.0, 2.0, 0.0), 3.0),  # leaving: more
        (vec(0.0, 3.0, 5.0, 0.0), 2.0),  # passing: the distance does not change yet
    ],
)
def test_psi_of_known_states(state, psi):
    assert float(-barrier()(state)) == pytest.approx(psi)


def test_psi_of_a_moving_ball_uses_relative_coordinates():
    ball = barrier(centre=vec(1.0, 0.0), drift=vec(1.0, 0.0))
    assert float(-ball(vec(4.0, 0.0, 1.0, 0.0))) == pytest.approx(2.0)
    assert float(-ball(vec(4.0, 0.0, 0.0, 0.0))) == pytest.approx(1.5)


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_gradient_of_psi_equals_autograd(seed):
    x = normal(seed, 3, 5, 4).requires_grad_()
    level = barrier(0.3, vec(0.4, -0.2), vec(1.0, 0.5))
    (found,) = torch.autograd.grad(level(x).sum(), x)
    torch.testing.assert_close(level.gradient(x.detach()), found, atol=1e-9, rtol=1e-7)


@settings(max_examples=30, deadline=None)
@given(seed=seeds)
def test_pulled_back_psi_keeps_its_values(seed):
    z, centre, scale = (
        normal(seed, 3, 5, 4),
        normal(seed + 1, 3, 5, 4),
        normal(seed + 2, 5, 4).abs() + 0.1,
    )
    level = barrier(0.3, vec(0.4, -0.2), vec(1.0, 0.5))
    torch.testing.assert_close(level.pull_back(centre, scale)(z), level(centre + scale * z))


@settings(max_examples=30, deadline=None)
@given(seed=seeds, time=st.floats(0.05, 1.0))
def test_path_with_non_negative_psi_never_enters_the_ball(seed, time):
    """dh/dt >= -h / time along a path in closed loop: radial speed -h / time, any speed across; h
    stays positive.
    """
    x = normal(seed, 2)
    p, dt = (2.0 + float(x[0].abs())) * x / x.norm(), time / 500
    level = barrier(time)
    for _ in range(1500):
        n = p / p.norm()
        v = -(p.norm() - 1) / time * n + 3.0 * torch.stack((-n[1], n[0]))
        assert float(level(torch.cat((p, v)))) <= 1e-9
        p = p + dt * v
    assert float(p.norm()) > 1.0


def test_tightened_barrier_keeps_farther_away():
    x = normal(0, 7, 4)
    torch.testing.assert_close(barrier().tighten(0.2)(x), barrier()(x) + 0.2)
