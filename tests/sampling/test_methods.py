"""The methods' known answers, their algebra, and their construction from a name and settings."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import CdiffError
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.sampling import FORMS, METHODS, complete_settings, make_method
from cdiff_cli.sampling.baselines import (
    BestOf,
    Conditional,
    FinalProjection,
    Guidance,
    Unconstrained,
)
from cdiff_cli.sampling.clean_methods import (
    CleanAugmentedLagrangian,
    CleanPrimalDual,
    CleanProjected,
    EstimateAugmentedLagrangian,
    EstimatePrimalDual,
)
from cdiff_cli.sampling.methods import AugmentedLagrangian, PrimalDual, Projected
from cdiff_cli.sampling.multipliers import multiplier, slack
from cdiff_cli.sampling.noise import Noise
from cdiff_cli.sampling.safediffuser import SafeDiffuser
from cdiff_cli.sampling.sampler import Step, sample
from tests.problems import (
    F64,
    KINDS,
    UNIT_MEAN_SHIFT,
    ball,
    draws,
    gaussian_denoiser,
    half_space,
    langevin_chain,
    normal,
    num,
    pin,
    vec,
    waypoints,
)

SCHEDULE = Schedule.cosine(30)


def _step(x, x0=None, beta=0.1, pins=None):
    """A step whose reverse is the identity, so that the method's own change is all that is seen."""
    return Step(
        x, x if x0 is None else x0, beta, 1.0, lambda clean: clean, pins or Pins.none(x), False
    )


def _unit_mean_shift(method):
    x, states = langevin_chain(method, UNIT_MEAN_SHIFT, steps=1200, batch=2000, beta=0.1, seed=0)
    lam = torch.stack([getattr(state, "lam", state) for state in states[400:]]).mean()
    # The unadjusted chain's std is 1 / sqrt(1 - beta / 4) = 1.0128; standard errors of 2000 draws:
    # std 0.016, mean 0.022. The multiplier is a time average over 800 steps, 20 relaxation times of
    # such means: standard error below 0.01.
    assert float(lam) == pytest.approx(1.0, abs=0.03)
    assert float(x.mean()) == pytest.approx(1.0, abs=0.1)
    assert float(x.std()) == pytest.approx(1.0128, abs=0.06)


def test_primal_dual_multiplier_of_unit_mean_shift_is_one():
    _unit_mean_shift(PrimalDual(eta=0.05, expectation="batch_mean"))


def test_alm_multiplier_of_unit_mean_shift_is_one():
    _unit_mean_shift(AugmentedLagrangian(rho=0.05, c=1.0, expectation="batch_mean"))


def test_multiplier_of_a_slack_mean_constraint_is_zero():
    g = waypoints(HalfSpace(vec(1.0), num(1.0)))  # E x <= 1 already holds for N(0, 1)
    _, states = langevin_chain(
        PrimalDual(eta=0.05, expectation="batch_mean"),
        g,
        steps=100,
        batch=500,
        beta=0.1,
        seed=1,
    )
    assert (
        float(torch.stack(states).max()) == 0.0
    )  # the mean is 22 standard errors below 1: never a positive push


def test_printed_primal_dual_step_equals_the_papers_equations():
    x = vec(0.0, 3.0).reshape(2, 1, 1)
    out, lam = PrimalDual(eta=0.5).step(
        _step(x, beta=0.2), UNIT_MEAN_SHIFT, vec(2.0, 0.4).reshape(2, 1)
    )
    # x - (beta / 2) lam dg with dg = -1; [lam + eta (1 - x)]_+
    torch.testing.assert_close(out.flatten(), vec(0.2, 3.04))
    torch.testing.assert_close(lam.flatten(), vec(2.5, 0.0))


def test_printed_alm_step_equals_the_papers_equations():
    x = vec(0.0, 3.0).reshape(2, 1, 1)
    method = AugmentedLagrangian(rho=0.5, c=1.1)
    init = method.init(x, UNIT_MEAN_SHIFT)._replace(lam=vec(2.0, 1.4).reshape(2, 1))
    out, state = method.step(_step(x, beta=0.2), UNIT_MEAN_SHIFT, init)
    torch.testing.assert_close(
        out.flatten(), vec(0.25, 3.04)
    )  # m = [lam + rho (1 - x)]_+ = 2.5 and 0.4
    torch.testing.assert_close(state.lam.flatten(), vec(2.5, 0.4))
    assert state.rho == pytest.approx(0.55)


def test_coefficient_one_does_not_scale_the_push_by_beta():
    x = vec(0.0).reshape(1, 1, 1)
    out, _ = PrimalDual(coefficient="one").step(
        _step(x, beta=0.2), UNIT_MEAN_SHIFT, vec(2.0).reshape(1, 1)
    )
    assert float(out) == pytest.approx(2.0)


def test_batch_mean_has_one_multiplier_vector_for_all_plans():
    x = normal(0, 5, 3, 2)
    assert CleanPrimalDual(expectation="batch_mean").init(x, waypoints(half_space())).shape == (
        1,
        3,
    )
    assert CleanPrimalDual(expectation="per_sample").init(x, waypoints(half_space())).shape == (
        5,
        3,
    )


@settings(max_examples=30, deadline=None)
@given(g=st.floats(-10, 10), lam=st.floats(0, 10), rho=st.floats(1e-3, 10))
def test_slack_form_of_the_alm_multiplier_is_its_positive_part(g, lam, rho):
    g, lam = vec(g), vec(lam)
    with_slack = lam + rho * (g + slack(g, lam, rho))
    torch.testing.assert_close(
        with_slack, multiplier(g, lam, rho), atol=1e-12, rtol=0
    )  # a few roundings of numbers <= 110


@settings(max_examples=30, deadline=None)
@given(g=st.floats(-10, 10), lam=st.floats(0, 10), rho=st.floats(1e-3, 10))
def test_slack_is_never_negative_and_closes_g_only_where_the_multiplier_vanishes(g, lam, rho):
    s = slack(vec(g), vec(lam), rho)
    assert float(s) >= 0
    if float(s) > 1e-9:
        assert float(multiplier(vec(g), vec(lam), rho)) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    "method", [CleanPrimalDual(), CleanAugmentedLagrangian(rho=1.0)], ids=["primal-dual", "alm"]
)
def test_clean_multiplier_of_one_half_space_is_exact_after_one_step(method):
    x = normal(2, 6, 4, 2, scale=2.0)
    g = waypoints(half_space(b=0.1))
    _, state = method.step(_step(x), g, method.init(x, g))
    out, _ = method.step(_step(x), g, state)
    exact, _ = CleanProjected().step(_step(x), g, None)
    torch.testing.assert_close(out, exact, atol=1e-12, rtol=0)  # the same formula up to rounding


@pytest.mark.parametrize(
    "method",
    [CleanPrimalDual(), PrimalDual(), CleanAugmentedLagrangian(), AugmentedLagrangian()],
)
def test_dual_methods_do_not_move_pinned_waypoints(method):
    x = normal(3, 4, 5, 2, scale=2.0)
    g, pins = waypoints(half_space(b=-3.0)), pin(x, 0, -1)
    state = method.init(x, g)
    for _ in range(3):
        out, state = method.step(_step(x, pins=pins), g, state)
    assert torch.equal(out[:, [0, -1]], x[:, [0, -1]])
    assert not torch.equal(out[:, 1:-1], x[:, 1:-1])


def _plan(method, g, n=16, horizon=4, dim=2, **keywords):
    like = torch.zeros(n, horizon, dim, dtype=F64)
    denoiser = gaussian_denoiser(SCHEDULE, 0.5, 0.1)
    return sample(
        denoiser, SCHEDULE, method, g, Pins.none(like), draws(7, n, horizon, dim), **keywords
    ).x


def test_unconstrained_ignores_g():
    assert torch.equal(
        _plan(Unconstrained(), waypoints(half_space(b=-9.0))),
        _plan(Unconstrained(), waypoints(half_space(b=9.0))),
    )


@pytest.mark.parametrize(
    "kind",
    ["half-space", "outside ball", "inside ellipsoid", "general quadric", "dcbf over outside ball"],
)
@pytest.mark.parametrize("on", ["clean", "noisy"])
def test_projected_plans_satisfy_g(kind, on):
    out = _plan(make_method("projected", {"on": on}), KINDS[kind], n=4)
    assert (
        float(KINDS[kind](out).max()) <= 1e-6
    )  # the sequential and the secular solver stop at 1e-9; others are exact


@pytest.mark.parametrize(
    ("method", "extra_steps", "most"),
    [
        (CleanProjected(), 0, 1e-12),  # exact
        (
            CleanAugmentedLagrangian(rho=1.0),
            0,
            1e-12,
        ),  # exact: the penalty step solves one half-space
        (
            CleanAugmentedLagrangian(),
            10,
            1e-6,
        ),  # the penalty halves what is left at each frozen step: 0.02 / 2^10 and less
        (
            CleanPrimalDual(),
            60,
            1e-3,
        ),  # the push lags the multiplier by a step, so plans oscillate before they settle
    ],
    ids=["projected", "alm exact penalty", "alm", "primal-dual"],
)
def test_clean_methods_end_on_the_half_space(method, extra_steps, most):
    g = waypoints(
        HalfSpace(vec(1.0, 1.0), num(0.8))
    )  # the plans' x + y ~ N(1, 0.14^2): nearly all of them violate
    assert float(g(_plan(Unconstrained(), g)).max()) > 0.2
    assert float(g(_plan(method, g, extra_steps=extra_steps)).max()) <= most


def _through_a_disc(method, offset=0.02, horizon=96):
    """Plans whose law is a straight line through a disc of radius 0.5, ends pinned, and the disc as
    the segments see it.
    """
    s = torch.linspace(-2, 2, horizon, dtype=F64)
    line = torch.stack((s, torch.full_like(s, offset)), -1)[None]
    g = Constraint((OnSegments("disc", ball("outside", centre=(0.0, 0.0), radius=0.5)),))
    noise = draws(11, 1, horizon, 2)
    return sample(
        gaussian_denoiser(SCHEDULE, line, 1e-3),
        SCHEDULE,
        method,
        g,
        pin(line, 0, -1),
        noise,
        extra_steps=20,
    ).x, g


@pytest.mark.parametrize(
    "method",
    [CleanProjected(), CleanPrimalDual(), CleanAugmentedLagrangian()],
    ids=["projected", "primal-dual", "alm"],
)
def test_clean_methods_lead_a_path_around_a_disc_without_tearing(method):
    x, g = _through_a_disc(method)
    assert (
        float(x[0].diff(dim=0).norm(dim=-1).max()) <= 4 * 4 / 95
    )  # an even line stretches to about thrice
    assert float(g(x).max()) <= 1e-2  # the multipliers are still settling; radius 0.5


@pytest.mark.parametrize("on", ["noisy", "estimate", "clean"])
@pytest.mark.parametrize("expectation", ["per_sample", "batch_mean"])
@pytest.mark.parametrize("name", ["primal-dual", "alm"])
def test_multipliers_of_segments_keep_their_number_and_pins_stay(name, on, expectation):
    x = torch.linspace(-1, 1, 12, dtype=F64)[None, :, None] + 0.1 * normal(8, 3, 12, 2)
    g = Constraint(
        (
            AtWaypoints("wall", half_space()),
            OnSegments("disc", ball("outside", centre=(0.0, 0.0), radius=0.5)),
        )
    )
    method = make_method(name, {"on": on, "expectation": expectation})
    pins = pin(x, 0, -1)
    state, sizes = method.init(x, g), set()
    for _ in range(4):
        sizes.add(getattr(state, "lam", state).shape)
        out, state = method.step(_step(x, pins=pins), g, state)
    plans = 1 if expectation == "batch_mean" else 3
    assert sizes == {
        (plans, 12 + 11 if on == "noisy" else 12 + 2 * 12)
    }  # g's own rows: the paper's
    assert bool(getattr(state, "lam", state).isfinite().all())
    assert torch.equal(out[:, [0, -1]], x[:, [0, -1]])
    assert not torch.equal(out, x)


@pytest.mark.parametrize(
    "method", [CleanPrimalDual(), CleanAugmentedLagrangian(c=1.5)], ids=["primal-dual", "alm"]
)
def test_clean_dual_methods_do_not_change_safe_plans(method):
    g = waypoints(half_space(b=50.0))
    assert torch.equal(_plan(method, g), _plan(Unconstrained(), g))


def test_every_method_gets_the_same_noise():
    g, seen = waypoints(half_space(b=50.0)), []
    for method in (
        Unconstrained(),
        CleanProjected(),
        Projected(),
        PrimalDual(),
        AugmentedLagrangian(),
    ):
        noise = Noise([3, 4], (4, 2))
        like = torch.zeros(2, 4, 2)
        g32 = g.to(like)
        seen.append(
            sample(
                gaussian_denoiser(SCHEDULE, 0.5, 0.1), SCHEDULE, method, g32, Pins.none(like), noise
            ).x
        )
    for other in seen[1:]:
        assert torch.equal(other, seen[0])


def test_silu_replaces_g_by_its_smooth_positive_part_and_its_slope():
    x = normal(4, 3, 2, 2)
    g = waypoints(ball("outside"))
    lam = normal(5, 3, 2).abs()
    leaf = x.clone().requires_grad_()
    smooth = torch.nn.functional.silu(g(leaf))
    (push,) = torch.autograd.grad(smooth, leaf, lam)
    out, after = PrimalDual(eta=0.3, positive="silu", coefficient="one").step(_step(x), g, lam)
    torch.testing.assert_close(
        out, x - push, atol=1e-12, rtol=0
    )  # the written-out slope against autograd, float64
    torch.testing.assert_close(
        after, (lam + 0.3 * smooth.detach()).clamp_min(0), atol=1e-12, rtol=0
    )


@pytest.mark.parametrize("name", ["primal-dual", "alm"])
def test_silu_keeps_multipliers_finite_through_a_whole_plan(name):
    out = _plan(
        make_method(name, {"positive": "silu"}), waypoints(HalfSpace(vec(1.0, 1.0), num(0.8)))
    )
    assert bool(out.isfinite().all())


def test_clean_alm_penalty_stops_growing_at_one():
    x = normal(6, 2, 2, 2)
    g, method = waypoints(half_space()), CleanAugmentedLagrangian(c=3.0)
    state = method.init(x, g)
    for _ in range(5):
        _, state = method.step(_step(x), g, state)
    assert state.rho == 1.0


def test_make_method_builds_every_method_with_its_defaults():
    assert {name: make_method(name, {}) for name in METHODS} == {
        "diffuser": Unconstrained(),
        "guidance": Guidance(),
        "conditional": Conditional(),
        "best-of-k": BestOf(),
        "final-projection": FinalProjection(),
        "terminal": CleanProjected(correction="latent"),
        "safediffuser": SafeDiffuser(),
        "projected": CleanProjected(),
        "primal-dual": CleanPrimalDual(),
        "alm": CleanAugmentedLagrangian(),
    }


def test_the_setting_on_picks_the_form_of_a_method():
    assert {(name, on): make_method(name, {"on": on}) for name in FORMS for on in FORMS[name]} == {
        ("projected", "noisy"): Projected(),
        ("projected", "clean"): CleanProjected(),
        ("primal-dual", "noisy"): PrimalDual(),
        ("primal-dual", "estimate"): EstimatePrimalDual(),
        ("primal-dual", "clean"): CleanPrimalDual(),
        ("alm", "noisy"): AugmentedLagrangian(),
        ("alm", "estimate"): EstimateAugmentedLagrangian(),
        ("alm", "clean"): CleanAugmentedLagrangian(),
    }
    for name, forms in FORMS.items():
        for on in forms:
            assert make_method(name, {"on": on}).on == on


def test_all_forms_of_a_method_have_the_same_defaults():
    for name, forms in FORMS.items():
        defaults = complete_settings(name, {})
        for on in forms:
            assert vars(make_method(name, {"on": on})).items() <= defaults.items()


def test_complete_settings_have_the_fields_of_all_forms():
    assert complete_settings("projected", {"on": "noisy", "correction": "latent"}) == {
        "on": "noisy",
        "correction": "latent",
    }
    assert complete_settings("alm", {"rho": "2"}) == {
        "on": "clean",
        "rho": 2.0,
        "c": 1.02,
        "coefficient": "beta/2",
        "expectation": "per_sample",
        "positive": "none",
    }
    assert list(complete_settings("primal-dual", {})) == [
        "on",
        "eta",
        "coefficient",
        "expectation",
        "positive",
    ]
    assert complete_settings("terminal", {}) == {}


def test_make_method_reads_numbers_written_as_strings():
    assert make_method("alm", {"rho": "0.25", "on": "noisy"}) == AugmentedLagrangian(rho=0.25)


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("primal_dual", {}, 'no method "primal_dual".*did you mean "primal-dual"'),
        ("zzz", {}, 'no method "zzz"; choose from diffuser'),
        ("alm", {"rhoo": 1}, 'alm has no setting "rhoo".*did you mean "rho"'),
        ("diffuser", {"eta": 1}, "its settings are: none"),
        ("alm", {"on": "Noisy"}, "alm.on: expected one of noisy, estimate, clean, found 'Noisy'"),
        ("primal-dual", {"eta": "much"}, "primal-dual.eta: expected a number, found 'much'"),
        ("primal-dual", {"eta": None}, "expected a number"),
        ("primal-dual", {"eta": -1}, "expected a positive number"),
        ("primal-dual", {"eta": float("nan")}, "expected a positive number"),
        ("best-of-k", {"k": 1.5}, "expected a positive whole number"),
        ("alm", {"inner": 1}, 'alm has no setting "inner"'),
    ],
)
def test_make_method_says_what_is_wrong(name, values, message):
    with pytest.raises(CdiffError, match=message):
        make_method(name, values)


def test_latent_correction_moves_the_sample_by_the_whole_projection():
    """x_{t-1} = reverse(x0) + level (P(x0) - x0), by hand: x0 = 2 projected onto x <= 1, reverse
    halves, level 0.8.
    """
    x = torch.full((1, 1, 1), 2.0)
    step = Step(x, x, 0.1, 0.8, lambda clean: clean / 2, Pins.none(x), False)
    g = waypoints(HalfSpace(torch.ones(1), torch.ones(())))
    kernel, _ = CleanProjected().step(step, g, None)
    latent, _ = CleanProjected(correction="latent").step(step, g, None)
    assert float(kernel) == pytest.approx(0.5)
    assert float(latent) == pytest.approx(1.0 - 0.8)
