"""Multipliers carried from one plan to the next: each lands on the row that it belonged to, moved
on by the steps executed.
"""

import numpy as np
import pytest
import torch

from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.planning.warm_start import carry, select
from cdiff_cli.projection.segments import with_tangent_planes
from cdiff_cli.sampling import make_method
from cdiff_cli.sampling.clean_methods import CleanPrimalDual, CleanProjected
from cdiff_cli.sampling.methods import AlmState
from cdiff_cli.sampling.sampler import Step
from tests.problems import F64, ball, half_space, normal

H = 5
G = Constraint(
    (OnSegments("ball", ball("outside")), AtWaypoints("wall", half_space()))
)  # 4 segments, 5 waypoints
NOISY = {"expected": [101, 102, 103, 0, *(105, 106, 107, 108, 0)], "n": 9}  # in the order of g
PLANES = {
    "expected": [101, 102, 103, 104, 0, *(106, 107, 108, 109, 0), *(111, 112, 113, 114, 0)],
    "n": 15,
}
"""The wall; then of the ball the segments before each waypoint, and those after it."""


def carried(method, last, steps=1):
    """The multipliers that a plan begins with, after one that ended with `last`."""
    x = torch.zeros(1, H, 2, dtype=F64)
    state = method.init(x, G)
    ended = AlmState(last, 0.9) if isinstance(state, AlmState) else last
    begun = carry(method, ended, G, x, steps)
    if isinstance(begun, AlmState):
        assert begun.rho == method.rho
        return begun.lam
    return begun


@pytest.mark.parametrize("name", ["primal-dual", "alm"])
@pytest.mark.parametrize(
    ("on", "known"), [("noisy", NOISY), ("estimate", PLANES), ("clean", PLANES)]
)
def test_one_step_executed_moves_each_block_of_rows_by_one(name, on, known):
    last = 100 + torch.arange(known["n"], dtype=F64)[None]
    assert carried(make_method(name, {"on": on}), last)[0].tolist() == known["expected"]


@pytest.mark.parametrize("steps", [0, 2, 9])
def test_other_numbers_of_steps(steps):
    last = 1 + torch.arange(15, dtype=F64)[None]
    blocks = [block[steps:] + min(steps, H) * [0.0] for block in last.view(3, H).tolist()]
    assert carried(CleanPrimalDual(), last, steps).view(3, H).tolist() == blocks


def test_without_a_last_plan_the_multipliers_begin_at_zero():
    x = torch.zeros(2, H, 2, dtype=F64)
    assert carry(CleanPrimalDual(), None, G, x, 1).tolist() == [15 * [0.0]] * 2
    assert carry(CleanProjected(), None, G, x, 1) is None


def test_multipliers_of_another_number_of_plans_are_dropped():
    x = torch.zeros(2, H, 2, dtype=F64)
    assert not carry(CleanPrimalDual(), torch.ones(3, 15, dtype=F64), G, x, 1).any()


def test_selected_plans_keep_their_own_multipliers_and_shared_ones_are_kept_whole():
    lam, which = torch.tensor([[1.0], [2.0], [3.0]]), np.array([True, False, True])
    assert select(lam, which).tolist() == [[1.0], [3.0]]
    kept = select(AlmState(lam, 0.9), which)
    assert kept.lam.tolist() == [[1.0], [3.0]]
    assert kept.rho == 0.9
    assert select(torch.tensor([[4.0]]), which).tolist() == [[4.0]]
    assert select(None, which) is None


@pytest.mark.parametrize("name", ["primal-dual", "alm"])
@pytest.mark.parametrize("on", ["noisy", "clean"])
def test_a_carried_multiplier_pushes_the_waypoints_that_it_pushed_before(name, on):
    """The wall's multiplier of waypoint 3 alone: a step later waypoint 2 alone is pushed, and along
    the wall's normal.
    """
    x = normal(0, 1, H, 2) * 0.1 + torch.tensor(
        [0.3, 3.0], dtype=F64
    )  # far from the ball, within the wall
    g = with_tangent_planes(G, x, Pins.none(x)) if on == "clean" else G
    at = (4 if on == "noisy" else 0) + 3
    last = torch.zeros(1, g(x).shape[1], dtype=F64)
    last[0, at] = 100.0
    method = make_method(name, {"on": on})
    lam = carried(method, last)
    pull = g.linearise(x)[1](lam)
    assert pull.abs().sum(-1).nonzero()[:, 1].tolist() == [2]
    torch.testing.assert_close(pull[0, 2], torch.tensor([100.0, -100.0], dtype=F64))
    state = AlmState(lam, 1.0) if name == "alm" else lam
    step = Step(x, x, 0.1, 1.0, lambda clean: clean, Pins.none(x), False)
    moved = (method.step(step, G, state)[0] - x).abs().sum(-1)
    assert moved[0].argmax() == 2
    assert float(moved[0, 2]) > 1.0
    assert float(moved[0, [0, 1, 3, 4]].max()) <= 1e-9
