"""Relative windows, and the inverse dynamics model."""

import numpy as np
import pytest
import torch

from cdiff_cli.errors import CdiffError
from cdiff_cli.models.networks import ResidualMlp
from cdiff_cli.models.normaliser import Normaliser
from cdiff_cli.models.recipe import InverseSpec
from cdiff_cli.training.inverse_dynamics import fit_inverse
from cdiff_cli.training.windows import Windows, fit_residual_normaliser
from tests.problems import F64, normal

LAYOUT = ("x", "y", "v")
A = np.array([[1.0, 0.0, 0.1], [0.0, 0.9, 0.0], [0.0, 0.0, 0.95]])
B = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.2]])


def episode(seed: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """x' = A x + B u under random inputs, far from the origin."""
    rng = np.random.default_rng(seed)
    x, u = [np.array([100.0, 0.0, 1.0])], rng.uniform(-1, 1, (steps, 2))
    for each in u:
        x.append(A @ x[-1] + B @ each)
    return np.stack(x), u


WINDOWS = Windows.from_episodes([episode(seed, 200)[0] for seed in range(4)], 8)
FRAME = fit_residual_normaliser(WINDOWS, LAYOUT, (("x", "y"),), ("x",))


def windows(n: int = 50) -> torch.Tensor:
    return WINDOWS[torch.arange(0, len(WINDOWS.starts), len(WINDOWS.starts) // n)]


def test_residual_normaliser_decodes_what_it_encodes():
    x = windows()
    torch.testing.assert_close(FRAME.at(x[:, 0]).decode(FRAME.encode(x)), x)


def test_encoded_windows_have_standard_deviation_one_at_every_waypoint():
    z = FRAME.encode(WINDOWS[torch.arange(len(WINDOWS.starts))])[:, 1:]
    torch.testing.assert_close(z.mean(0), torch.zeros(7, 3, dtype=F64), atol=1e-9, rtol=0)
    torch.testing.assert_close(z.std(0)[:, 2], torch.ones(7, dtype=F64))
    torch.testing.assert_close(
        z.std(0)[:, :2].amax(1), torch.ones(7, dtype=F64)
    )  # x and y share a scale, that of the wider one


def test_window_that_follows_from_its_first_state_encodes_to_zero():
    """Windows of a linear system without inputs have no residual."""
    start = normal(3, 40, 3)
    x = [start]
    for _ in range(7):
        x.append(x[-1] @ torch.from_numpy(A).T)
    every = torch.stack(x, 1)
    some = fit_residual_normaliser(
        Windows.from_episodes(list(every[:30].numpy()), 8), LAYOUT, (), ()
    )
    torch.testing.assert_close(some.at(every[30:, 0]).centre[:, 1:], every[30:, 1:])


def test_shift_along_an_invariant_coordinate_does_not_change_the_encoding():
    x = windows()
    torch.testing.assert_close(FRAME.encode(x + torch.tensor([7.0, 0.0, 0.0])), FRAME.encode(x))
    assert bool((FRAME.encode(x)[:, 0, 0] == 0).all())
    assert not torch.allclose(FRAME.encode(x + torch.tensor([0.0, 7.0, 0.0])), FRAME.encode(x))


def test_residual_network_returns_the_present_state():
    x = normal(0, 5, 8, 3).float()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        out = ResidualMlp(3, 8, 32, 2)(x, torch.full((5,), 3.0))
    assert out.shape == x.shape
    assert torch.equal(out[:, 0], x[:, 0])


@pytest.fixture(scope="module")
def fitted():
    """Inverse dynamics fitted to 40 long and 20 short episodes of the linear system."""
    pairs = [episode(seed, 100 if seed < 40 else 5) for seed in range(60)]
    spec = InverseSpec(width=64, steps=400, batch=256, learning_rate=3e-3)
    episodes, inputs = zip(*pairs, strict=True)
    return fit_inverse(episodes, inputs, 16, spec, 0)


def test_inverse_dynamics_of_a_linear_system_are_recovered(fitted):
    assert fitted[1]["windows"] > 0.98
    assert fitted[1]["branches"] > 0.9


def test_predicted_inputs_are_within_the_bounds_of_the_data(fitted):
    u = fitted[0](normal(0, 100, 3).float(), 50 * normal(1, 100, 3).float())
    assert float(u.abs().max()) <= 1.0
    assert float(u.abs().max()) > 0.9


def test_inverse_dynamics_without_inputs_are_an_error():
    with pytest.raises(CdiffError, match="no inputs"):
        fit_inverse([episode(0, 100)[0]], [], 16, InverseSpec(), 0)


def test_single_episode_is_trained_on_and_none_is_held_out():
    x, u = episode(0, 40)
    _, explained = fit_inverse([x], [u], 16, InverseSpec(width=4, steps=1, batch=8), 0)
    assert explained == {}


def test_limits_go_to_minus_one_and_one():
    to = Normaliser.from_limits([-1.0, 0.0], (3.0, 10.0))
    assert to.encode(torch.tensor([[-1.0, 0.0], [3.0, 10.0], [1.0, 5.0]], dtype=F64)).tolist() == [
        [-1.0, -1.0],
        [1.0, 1.0],
        [0.0, 0.0],
    ]
    x = normal(0, 5, 2)
    torch.testing.assert_close(to.decode(to.encode(x)), x)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([0.0, 1.0], [1.0, 1.0]),
        ([0.0, 2.0], [1.0, 1.0]),
        ([0.0], [1.0, 1.0]),
        ([[0.0]], [[1.0]]),
        (0.0, 1.0),
        ([0.0, np.nan], [1.0, 1.0]),
        ([-np.inf], [np.inf]),
    ],
    ids=str,
)
def test_limits_without_width_are_refused(low, high):
    with pytest.raises(ValueError, match="expected low < high for every coordinate"):
        Normaliser.from_limits(low, high)
