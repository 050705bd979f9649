"""Which coordinates are fixed, and to what."""

import pytest
import torch

from cdiff_cli.constraints.pins import Pins
from tests.problems import normal


def test_pinned_ends_fix_the_first_and_the_last_state_alone():
    x, other = normal(0, 3, 5, 2), normal(1, 3, 5, 2)
    pins = Pins.ends(x)
    painted = pins.paint(other)
    torch.testing.assert_close(painted[:, [0, -1]], x[:, [0, -1]])
    torch.testing.assert_close(painted[:, 1:-1], other[:, 1:-1])
    assert pins.whole
    assert pins.loose == (1, 4)


@pytest.mark.parametrize("horizon", [1, 2])
def test_pinned_ends_of_a_trajectory_without_interior_fix_all_of_it(horizon):
    x = normal(0, 2, horizon, 3)
    assert bool(Pins.ends(x).mask.all())
