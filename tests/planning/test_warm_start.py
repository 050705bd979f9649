"""Multipliers carried from one plan to the next: each lands on the row that it belonged to, moved on by the steps executed."""

import pytest
import torch

from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.planning.warm_start import CarriedMultipliers
from cdiff_cli.projection.segments import with_tangent_planes
from cdiff_cli.sampling.methods import AlmState, AugmentedLagrangian, PrimalDual
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
    state = method.init(torch.zeros(1, H, 2, dtype=F64), G)
    ended = AlmState(last, 0.9) if isinstance(state, AlmState) else last
    begun = CarriedMultipliers(method, steps, ended).init(torch.zeros(1, H, 2, dtype=F64), G)
    if isinstance(begun, AlmState):
        assert begun.rho == method.rho
        return begun.lam
    return begun


@pytest.mark.parametrize("kind", [PrimalDual, AugmentedLagrangian])
@pytest.mark.parametrize(
    ("on", "known"), [("noisy", NOISY), ("estimate", PLANES), ("clean", PLANES)]
)
def test_one_step_executed_moves_each_block_of_rows_by_one(kind, on, known):
    last = 100 + torch.arange(known["n"], dtype=F64)[None]
    assert carried(kind(on=on), last)[0].tolist() == known["expected"]


@pytest.mark.parametrize("steps", [0, 2, 9])
def test_other_numbers_of_steps(steps):
    last = 1 + torch.arange(15, dtype=F64)[None]
    blocks = [block[steps:] + min(steps, H) * [0.0] for block in last.view(3, H).tolist()]
    assert carried(PrimalDual(), last, steps).view(3, H).tolist() == blocks


@pytest.mark.parametrize("kind", [PrimalDual, AugmentedLagrangian])
@pytest.mark.parametrize("on", ["noisy", "clean"])
def test_a_carried_multiplier_pushes_the_waypoints_that_it_pushed_before(kind, on):
    """The wall's multiplier of waypoint 3 alone: a step later waypoint 2 alone is pushed, and along the wall's normal."""
    x = normal(0, 1, H, 2) * 0.1 + torch.tensor(
        [0.3, 3.0], dtype=F64
    )  # far from the ball, within the wall
    g = with_tangent_planes(G, x, Pins.none(x)) if on == "clean" else G
    at = (4 if on == "noisy" else 0) + 3
    last = torch.zeros(1, g(x).shape[1], dtype=F64)
    last[0, at] = 100.0
    method = kind(on=on)
    lam = carried(method, last)
    pull = g.linearise(x)[1](lam)
    assert pull.abs().sum(-1).nonzero()[:, 1].tolist() == [2]
    torch.testing.assert_close(pull[0, 2], torch.tensor([100.0, -100.0], dtype=F64))
    state = AlmState(lam, 1.0) if kind is AugmentedLagrangian else lam
    step = Step(x, x, 0.1, 1.0, lambda clean: clean, Pins.none(x), False)
    moved = (method.step(step, G, state)[0] - x).abs().sum(-1)
    assert moved[0].argmax() == 2
    assert float(moved[0, 2]) > 1.0
    assert float(moved[0, [0, 1, 3, 4]].max()) <= 1e-9
