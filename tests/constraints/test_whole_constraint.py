"""What a whole constraint says of a trajectory between its waypoints."""

import pytest
import torch

from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.trajectory import Constraint, stack
from tests.problems import KINDS, ball, chain, half_space, normal, vec, waypoints

UNIT_DISC = ball("outside", centre=(0.0, 0.0), radius=1.0)
PAST = vec(-2.0, 0.5, 2.0, 0.5).reshape(1, 2, 2)  # a segment that passes 0.5 from the centre


def worst(values):
    """The largest g per trajectory, which comes as numpy, as a tensor."""
    return torch.from_numpy(values)


def test_worst_counts_the_points_between_waypoints():
    g = waypoints(UNIT_DISC)
    assert float(g(PAST).max()) < -1.0  # both waypoints are more than 1 outside
    torch.testing.assert_close(worst(g.worst(PAST)), vec(0.5))


def test_worst_of_a_barrier_counts_its_rows_and_its_value_between_waypoints():
    slow = chain(half_space((1.0, 0.0), 1.0), 0.1)  # 0.9 (1 - x) - (1 - x') <= 0
    x = vec(0.0, 0.0, 0.8, 0.0).reshape(1, 2, 2)
    torch.testing.assert_close(worst(slow.worst(x)), vec(0.7))
    torch.testing.assert_close(worst(chain(UNIT_DISC, 1.0).worst(PAST)), vec(0.5))


def test_worst_is_one_value_per_trajectory_and_the_largest_over_parts():
    x = normal(3, 6, 7, 2)
    parts = [waypoints(half_space()), waypoints(UNIT_DISC)]
    each = torch.stack([worst(g.worst(x)) for g in parts])
    torch.testing.assert_close(worst(stack(parts).worst(x)), each.amax(0))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("horizon", [1, 2, 9])
def test_worst_is_at_least_every_row(kind, horizon):
    x = normal(4, 5, horizon, 2)
    g = KINDS[kind]
    found = worst(g.worst(x))
    assert found.shape == (5,)
    assert bool((g(x) <= found[:, None]).all())
    assert bool((g.on_segments()(x) <= found[:, None] + 1e-12).all())


def test_worst_of_an_empty_constraint_is_minus_infinity():
    assert worst(Constraint(()).worst(normal(0, 2, 3, 2))).tolist() == [-torch.inf, -torch.inf]


def test_on_segments_replaces_non_convex_parts_and_keeps_convex_ones():
    wall, disc = waypoints(half_space()), waypoints(UNIT_DISC)
    whole = stack([wall, disc]).on_segments()
    assert whole.parts[0] is wall.parts[0]
    assert isinstance(whole.parts[1], OnSegments)
    torch.testing.assert_close(whole(PAST)[:, -1], vec(0.5))


def test_on_segments_adds_the_barrier_of_an_obstacle_to_its_discrete_barrier():
    assert len(chain(UNIT_DISC, 0.3).on_segments().parts) == 2
