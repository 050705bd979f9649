"""Gradients, pull-back, tightening and segment bounds of every kind of constraint."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.protocol import segment_max
from cdiff_cli.constraints.spec.kinds import Dcbf
from cdiff_cli.constraints.spec.sets import Linear, Quadratic
from cdiff_cli.constraints.state_sets import Quadric
from cdiff_cli.constraints.trajectory import Constraint, pull_back, stack
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import InfeasibleError
from tests.problems import (
    F64,
    KINDS,
    LAYOUT,
    LEVELS,
    ball,
    chain,
    ellipsoid,
    half_space,
    normal,
    num,
    pin,
    vec,
    waypoints,
)

seeds = st.integers(0, 10_000)
quick = settings(max_examples=30, deadline=None)

# known answers ------------------------------------------------------------------------------------


def test_ball_outside_is_radius_minus_distance():
    g = waypoints(ball("outside", centre=(0.0, 0.0), radius=2.0))
    x = vec(3.0, 4.0, 0.0, 1.0).reshape(1, 2, 2)
    torch.testing.assert_close(g(x), vec(-3.0, 1.0)[None])


def test_ball_inside_is_distance_minus_radius():
    g = waypoints(ball("inside", centre=(0.0, 0.0), radius=2.0))
    x = vec(3.0, 4.0, 0.0, 1.0).reshape(1, 2, 2)
    torch.testing.assert_close(g(x), vec(3.0, -1.0)[None])


def test_squared_form_of_a_ball_is_square_metres():
    part = Quadratic(
        kind="quadratic",
        name="s",
        side="outside",
        centre={"x": 0.0, "y": 0.0},
        radius=2.0,
        form="squared",
    )
    x = vec(3.0, 4.0, 9.0, 9.0).reshape(1, 1, 4)
    torch.testing.assert_close(part.compile(LAYOUT)(x), vec(-21.0)[None])  # 2^2 - 5^2


def test_linear_reads_coordinates_by_name():
    part = Linear(kind="linear", name="l", a={"y": 2.0, "vx": -1.0}, b=0.5).compile(LAYOUT)
    torch.testing.assert_close(part(vec(9.0, 1.0, 3.0, 9.0).reshape(1, 1, 4)), vec(-1.5)[None])


@pytest.mark.parametrize(("side", "value"), [("inside", 1.0), ("outside", -1.0)])
def test_general_quadric_changes_sign_with_its_side(side, value):
    spec = Quadratic(
        kind="quadratic", name="p", side=side, P={"x": {"x": 1.0, "y": 2.0}}, q={"y": -1.0}, r=3.0
    )
    x = vec(1.0, 3.0, 0.0, 0.0).reshape(1, 1, 4)
    torch.testing.assert_close(spec.compile(LAYOUT)(x), vec(value)[None])  # 1 + 2 * 3 - 3 - 3


def test_dcbf_row_is_the_share_of_h_kept_less_the_next_h():
    barrier = Linear(kind="linear", a={"x": 1.0}, b=1.0)  # h = 1 - x
    part = Dcbf(kind="dcbf", name="d", alpha=0.25, barrier=barrier).compile(LAYOUT)
    x = torch.zeros(1, 3, 4, dtype=F64)
    x[0, :, 0] = vec(0.0, 0.5, 0.5)
    torch.testing.assert_close(
        part(x), vec(0.25, -0.125)[None]
    )  # 0.75 * 1 - 0.5,  0.75 * 0.5 - 0.5


def test_labels_name_the_part_and_its_waypoints():
    assert waypoints(half_space(), "wall").labels(2) == ["wall@0", "wall@1"]
    assert chain(half_space(), 0.5, "speed").labels(3) == ["speed@0-1", "speed@1-2"]


def test_stack_concatenates_rows_and_labels():
    a, b = waypoints(half_space(), "a"), chain(ball("outside"), 0.5, "b")
    both, x = stack([a, b]), normal(0, 3, 4, 2)
    assert torch.equal(both(x), torch.cat((a(x), b(x)), 1))
    assert both.labels(4) == a.labels(4) + b.labels(4)


def test_no_parts_give_no_rows():
    x = normal(0, 3, 4, 2)
    rows, pull, size = Constraint(()).linearise(x)
    assert Constraint(())(x).shape == rows.shape == size.shape == (3, 0)
    assert torch.equal(pull(rows), torch.zeros_like(x))


def test_pins_paint_their_values_and_free_nothing_else():
    x, other = normal(0, 2, 3, 2), normal(1, 2, 3, 2)
    pins = pin(x, 0)
    assert torch.equal(pins.paint(other)[:, 0], x[:, 0])
    assert torch.equal(pins.paint(other)[:, 1:], other[:, 1:])
    assert torch.equal(pins.free(other)[:, 0], torch.zeros(2, 2, dtype=F64))
    assert torch.equal(Pins.none(x).paint(other), other)


def test_a_segment_through_a_ball_is_unsafe_though_both_its_ends_are_safe():
    part = AtWaypoints("b", ball("outside", centre=(0.0, 0.0), radius=1.0))
    x = vec(-3.0, 0.5, 3.0, 0.5).reshape(1, 2, 2)
    assert float(part(x).max()) < 0
    assert float(part.segment_max(x)) == pytest.approx(
        0.5, abs=1e-12
    )  # rounding: it passes 0.5 from the centre


def test_tightening_an_inside_ball_by_more_than_its_radius_is_infeasible():
    with pytest.raises(InfeasibleError, match="relax"):
        waypoints(ball("inside", radius=0.7)).tighten(0.8)


# gradients ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", list(KINDS))
def test_g_passes_gradcheck(kind):
    x = normal(1, 2, 4, 2).requires_grad_()
    assert torch.autograd.gradcheck(KINDS[kind], (x,))  # its own float64 tolerances


@pytest.mark.parametrize("kind", list(KINDS))
@settings(max_examples=10, deadline=None)
@given(seed=seeds, horizon=st.integers(2, 5))
def test_written_pulls_equal_autograd(kind, seed, horizon):
    g, x = KINDS[kind], normal(seed, 3, horizon, 2)
    rows, pull, _ = g.linearise(x)
    w = normal(seed + 1, *rows.shape)
    leaf = x.clone().requires_grad_()
    (expected,) = torch.autograd.grad(g(leaf), leaf, w)
    assert torch.equal(rows, g(x))
    torch.testing.assert_close(
        pull(w), expected, atol=1e-10, rtol=1e-10
    )  # float64, a few operations; near a centre 1 / r is large


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "opaque"])
@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_row_sizes_bound_the_largest_eigenvalue_of_the_scaled_jacobian(kind, seed):
    g, x = KINDS[kind], normal(seed, 1, 5, 2)
    rows, _, size = g.linearise(x)
    J = torch.autograd.functional.jacobian(lambda v: g(v.reshape(x.shape))[0], x.flatten())
    scaled = J / size[0].clamp_min(1e-12).sqrt()[:, None]
    assert rows.shape == size.shape
    # dual step 1 is stable below 2 / lambda_max; neighbouring rows of a chain differ in size,
    # hence 2 rather than 1
    assert float(torch.linalg.eigvalsh(scaled @ scaled.T).max()) < 2.0


# pull-back, tighten, segments ---------------------------------------------------------------------


@pytest.mark.parametrize("kind", list(KINDS))
@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_pull_back_commutes_with_evaluation(kind, seed):
    g, z = KINDS[kind], normal(seed, 2, 4, 2)
    centre, scale = normal(seed + 1, 2), normal(seed + 2, 2).abs() + 0.1
    torch.testing.assert_close(
        pull_back(g, centre, scale)(z), g(centre + scale * z), atol=1e-10, rtol=1e-10
    )  # float64 rounding


@pytest.mark.parametrize("kind", list(KINDS))
@settings(max_examples=10, deadline=None)
@given(seed=seeds, margin=st.floats(0, 0.1))
def test_tighten_allows_exactly_where_g_is_at_most_minus_the_margin(kind, seed, margin):
    g, x = KINDS[kind], normal(seed, 2, 4, 2)
    torch.testing.assert_close(
        g.tighten(margin)(x), g(x) + margin, atol=1e-12, rtol=1e-12
    )  # float64 rounding


@pytest.mark.parametrize("name", list(LEVELS))
@settings(max_examples=15, deadline=None)
@given(seed=seeds)
def test_segment_max_bounds_every_point_of_the_segment_and_is_attained(name, seed):
    level = LEVELS[name]
    x0, x1 = normal(seed, 6, 2, scale=1.5), normal(seed + 1, 6, 2, scale=1.5)
    bound = segment_max(level, torch.stack((x0, x1), 1))[:, 0]
    best, width = torch.full((6,), 0.5, dtype=F64), 0.5
    for _ in range(4):  # look closer around the largest value so far: points 5e-9 apart in the end
        s = (best + width * torch.linspace(-1, 1, 201, dtype=F64)[:, None]).clamp(0, 1)
        dense = level(x0 + s[..., None] * (x1 - x0))
        assert bool((bound >= dense - 1e-12).all())  # rounding
        best, width = s.gather(0, dense.argmax(0, keepdim=True))[0], width / 100
    assert (
        float((bound - dense.amax(0)).max()) < 1e-6
    )  # slopes of about 10 at the cusp of a centre, times 5e-9


@quick
@given(seed=seeds, alpha=st.floats(0.01, 1.0))
def test_segment_max_of_a_barrier_is_minus_h(seed, alpha):
    x = normal(seed, 2, 4, 2)
    assert torch.equal(
        DiscreteBarrier("c", ball("outside"), alpha).segment_max(x),
        AtWaypoints("w", ball("outside")).segment_max(x),
    )


def test_to_moves_dtype_and_keeps_values():
    g = waypoints(ball("outside")).to(torch.zeros(1))
    assert g(torch.zeros(1, 1, 2)).dtype == torch.float32
    torch.testing.assert_close(
        g(torch.zeros(1, 1, 2)).double(),
        waypoints(ball("outside"))(torch.zeros(1, 1, 2, dtype=F64)),
        atol=1e-6,
        rtol=0,
    )


def test_segment_max_of_a_single_waypoint_is_its_value():
    x = normal(0, 2, 1, 2)
    assert torch.equal(AtWaypoints("w", half_space()).segment_max(x), half_space()(x))
    assert torch.equal(DiscreteBarrier("c", half_space(), 0.5).segment_max(x), half_space()(x))


# quadrics that are ellipsoids ---------------------------------------------------------------------


def test_quadric_is_converted_to_the_ellipsoid_whose_outside_it_is():
    for level in (
        ball("outside"),
        ball("outside", centre=(0.4, -1.0, 2.0), radius=0.3, dim=5),
        ellipsoid("outside"),
    ):
        found = level.quadric().ball()
        for name in ("which", "centre", "axes", "m"):
            torch.testing.assert_close(
                getattr(found, name), getattr(level, name), atol=1e-12, rtol=0
            )
        assert found.side == "outside"


@pytest.mark.parametrize("name", ["inside ball squared", "general quadric"])
def test_quadric_that_is_no_outside_of_an_ellipsoid_is_not_converted(name):
    assert LEVELS[name].ball() is None


def test_quadric_that_excludes_nothing_or_is_a_paraboloid_is_not_converted():
    P = torch.diag(vec(-1.0, 0.0))
    assert Quadric(P, vec(0.0, 0.0), num(1.0)).ball() is None  # -x^2 <= 1 always
    assert Quadric(P, vec(0.0, 1.0), num(-1.0)).ball() is None  # y <= x^2 - 1
