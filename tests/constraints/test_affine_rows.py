"""Affine rows as one matrix: what they are read off is what they give back."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.constraints.waypoints import AtWaypoints
from tests.problems import F64, ball, chain, vec, waypoints

H = 6


@settings(deadline=None)
@given(st.integers(0, 2**31), st.floats(0.05, 1.0), st.booleans())
def test_condensed_rows_equal_the_rows_of_the_parts_about_any_centre(seed, alpha, high_order):
    """float64: a hundred additions of numbers of size one stay within 1e-12."""
    draw = torch.Generator().manual_seed(seed)
    a, b = torch.randn(2, 3, generator=draw, dtype=F64), torch.randn(2, generator=draw, dtype=F64)
    g = Constraint(
        (
            AtWaypoints("w", HalfSpace(a[0], b[0])),
            DiscreteBarrier("c", HalfSpace(a[1], b[1]), alpha, alpha if high_order else None),
        )
    )
    rows = g.condense(H, 3)
    assert rows is not None
    centre, y = torch.randn(2, 4, H, 3, generator=draw, dtype=F64)
    plain = pull_back(g, centre, torch.ones(3, dtype=F64))
    fast = rows.about(centre, y)
    values, pull, size = plain.linearise(y)
    again, fast_pull, fast_size = fast.linearise(y)
    w = torch.randn(values.shape, generator=draw, dtype=F64)
    torch.testing.assert_close(again, values, atol=1e-12, rtol=1e-12)
    torch.testing.assert_close(fast_pull(w), pull(w), atol=1e-12, rtol=1e-12)
    torch.testing.assert_close(fast_size.expand_as(size), size)


def test_constraint_with_a_part_that_is_not_affine_is_not_condensed():
    assert Constraint(()).condense(H, 2) is None
    assert waypoints(ball("outside")).condense(H, 2) is None
    both = Constraint(
        (
            *chain(HalfSpace(vec(0.0, 1.0), vec(0.75).squeeze()), 0.5).parts,
            *waypoints(ball("outside")).parts,
        )
    )
    assert both.condense(H, 2) is None
