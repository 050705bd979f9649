"""Rows of tangent planes in the place of parts that go round balls, and planes chosen anew beside
what moved.
"""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint, stack
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.projection.segments import (
    MAX_CHOICES,
    project_segments,
    tangent_half_spaces,
    with_tangent_planes,
)
from cdiff_cli.projection.solvers.half_spaces import nearest_in_half_spaces
from tests.problems import F64, ball, half_space, normal, pin, waypoints
from tests.projection.test_segments import outside, pushed_out, quick, random_path, seeds, segments


@quick
@given(seed=seeds, horizon=st.integers(1, 6), radius=st.sampled_from([0.3, 0.7]))
def test_tangent_rows_hold_only_where_the_segments_are_safe_and_have_unit_slope(
    seed, horizon, radius
):
    """A half-space that keeps both ends on its side keeps the segment; in metres, as f of a ball
    is.
    """
    z = normal(seed, 3, horizon, 2)
    g = segments(outside(2, radius))
    flat = with_tangent_planes(g, z, Pins.none(z))
    x = z + 0.3 * normal(seed + 1, 3, horizon, 2)
    rows, _, size = flat.linearise(x)
    assert rows.shape == (3, 2 * horizon)
    missing = torch.zeros(2 * horizon, dtype=torch.bool)
    missing[[0, -1]] = True  # before the first waypoint, after the last
    torch.testing.assert_close(
        rows[:, missing], torch.full((3, int(missing.sum())), -1.0, dtype=F64)
    )
    torch.testing.assert_close(
        size[:, ~missing], torch.full_like(size[:, ~missing], 2.0)
    )  # |df/dx|^2 = 1, two parts
    before, after = rows[:, 1:horizon], rows[:, horizon:-1]
    assert bool((g(x) <= torch.maximum(before, after) + 1e-9).all())


def test_tangent_planes_leave_other_parts_unchanged():
    wall, inside = AtWaypoints("w", half_space()), AtWaypoints("i", ball("inside"))
    others, z = Constraint((wall, inside)), normal(3, 2, 5, 2)
    flat = with_tangent_planes(
        Constraint((wall, *segments(ball("outside")).parts, inside)), z, Pins.none(z)
    )
    assert flat.rest == others
    rows, _, size = flat.linearise(z)
    assert torch.equal(rows[:, :10], others(z))
    torch.testing.assert_close(
        size[:, :10], 2 * others.linearise(z)[2]
    )  # four kinds of rows at each waypoint instead of two
    assert with_tangent_planes(others, z, Pins.none(z)) is others


@quick
@given(seed=seeds, horizon=st.integers(1, 6))
def test_pull_of_tangent_rows_is_their_gradient(seed, horizon):
    """The rows are affine, so a difference is a derivative, to rounding."""
    z = normal(seed, 2, horizon, 2)
    flat = with_tangent_planes(
        stack([waypoints(half_space()), segments(ball("outside"))]), z, Pins.none(z)
    )
    x, d, w = (normal(seed + k, 2, horizon, 2) for k in (1, 2, 3))
    rows, pull, _ = flat.linearise(x)
    w = normal(seed + 3, *rows.shape)
    along = ((flat(x + d) - rows) * w).sum()
    torch.testing.assert_close((pull(w) * d).sum(), along, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("horizon", [2, 3, 12, 40])
@quick
@given(seed=seeds, kind=st.sampled_from(["rough", "smooth", "straight"]), held=st.booleans())
def test_project_segments_equals_choosing_all_half_spaces_at_each_result(horizon, seed, kind, held):
    """Two discs and a wall that hold together, so that each choice of planes leaves a feasible
    point.
    """
    g = stack(
        [
            segments(outside(2, 0.4)),
            segments(ball("outside", centre=(3.0, 0.0), radius=0.3), "b"),
            waypoints(half_space(), "w"),
        ]
    )
    z = random_path(kind, seed, 3, horizon, 2)
    z = pushed_out(z, 0.4, 0.05, 0, -1) if held else z
    pins = pin(z, 0, horizon - 1) if held else Pins.none(z)
    x = z
    for _ in range(MAX_CHOICES):
        x = nearest_in_half_spaces(z, tangent_half_spaces(g.parts, x, pins), pins.held)
    close = project_segments(g.parts, z, pins, MAX_CHOICES)
    safe = (g(x) <= 1e-9).all(1)  # three rows at one waypoint can leave less than they promise
    torch.testing.assert_close(close[safe], x[safe], atol=1e-8, rtol=1e-8)
