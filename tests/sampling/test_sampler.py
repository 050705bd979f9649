"""The schedule, the kernels against a Gaussian whose denoiser is exact, the sampling loop and its
noise.
"""

import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.projection.project import project
from cdiff_cli.sampling import KERNELS, load_kernel
from cdiff_cli.sampling.baselines import Unconstrained
from cdiff_cli.sampling.clean_methods import (
    CleanAugmentedLagrangian,
    CleanPrimalDual,
    CleanProjected,
)
from cdiff_cli.sampling.kernels import ddim, ddpm, dpmpp_2m, half_log_snr, langevin
from cdiff_cli.sampling.methods import AugmentedLagrangian, Projected
from cdiff_cli.sampling.noise import Noise
from cdiff_cli.sampling.sampler import sample
from cdiff_cli.training.loss import Weighing, training_loss
from tests.problems import (
    F64,
    draws,
    gaussian_denoiser,
    generator,
    half_space,
    normal,
    pin,
    vec,
    waypoints,
)

FREE = Constraint(())
MEAN, STD = 0.5, 0.1
N = 8000  # standard errors: 0.0011 of the mean, 0.8 percent of the std


def _gaussian(kernel, n_steps, n=N):
    schedule = Schedule.cosine(n_steps)
    pins = Pins.none(torch.zeros(n, 1, 1, dtype=F64))
    denoiser = gaussian_denoiser(schedule, MEAN, STD)
    return sample(
        denoiser, schedule, Unconstrained(), FREE, pins, draws(0, n, 1, 1), kernel=kernel
    ).x


# known answers ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kernel", "n_steps"), [(ddpm, 1000), (ddim, 200)])
def test_ddpm_and_ddim_reproduce_a_gaussian_with_its_exact_denoiser(kernel, n_steps):
    x = _gaussian(kernel, n_steps)
    # discretisation narrows in 1 / n_steps: 3 to 4 percent here (ddpm has 6.7 at 200 steps); the
    # rest is sampling
    assert float(x.mean()) == pytest.approx(MEAN, abs=0.005)
    assert float(x.std()) == pytest.approx(STD, rel=0.06)


@pytest.mark.parametrize("n_steps", [200, 1000])
def test_printed_langevin_step_does_not_reproduce_the_gaussian(n_steps):
    assert (
        0.2 < float(_gaussian(langevin, n_steps, 2000).std()) < 0.28
    )  # twice too wide, at any number of steps


def test_ddpm_narrows_to_the_true_std_with_more_steps():
    gaps = [abs(float(_gaussian(ddpm, n).std()) - STD) for n in (20, 80, 320)]
    assert (
        gaps[0] > 2 * gaps[2]
    )  # first order in 1 / n_steps, seen through a sampling error of 0.0008


def test_kernel_table_names_every_kernel():
    assert {"ddpm": ddpm, "ddim": ddim, "dpm++2m": dpmpp_2m, "langevin": langevin} == {
        name: load_kernel(name) for name in KERNELS
    }


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), i=st.integers(2, 50))
def test_ddpm_moments_equal_bayes_rule(seed, i):
    """x_{t-1} of the prior N(sqrt(b) x0, 1 - b) and the likelihood N(x_t; sqrt(1 - beta) x_{t-1},
    beta).
    """
    schedule = Schedule.cosine(50)
    a, b, beta = schedule.alpha_bar[i], schedule.alpha_bar[i - 1], schedule.beta(i)
    x, x0 = normal(seed, 1, 1, 1), normal(seed + 1, 1, 1, 1)
    precision = 1 / (1 - b) + (1 - beta) / beta
    mean = (math.sqrt(b) * x0 / (1 - b) + math.sqrt(1 - beta) * x / beta) / precision
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    torch.testing.assert_close(
        ddpm(x, x0, zero, a, b), mean, atol=1e-10, rtol=1e-10
    )  # the same algebra, float64
    std = float(ddpm(x, x0, one, a, b) - ddpm(x, x0, zero, a, b))
    assert std == pytest.approx(precision**-0.5, rel=1e-9, abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), i=st.integers(1, 50))
def test_ddim_keeps_the_estimated_noise(seed, i):
    schedule = Schedule.cosine(50)
    a, b = schedule.alpha_bar[i], schedule.alpha_bar[i - 1]
    x0, e = normal(seed, 1, 2, 2), normal(seed + 1, 1, 2, 2)
    x = math.sqrt(a) * x0 + math.sqrt(1 - a) * e
    torch.testing.assert_close(
        ddim(x, x0, 0 * x, a, b), math.sqrt(b) * x0 + math.sqrt(1 - b) * e, atol=1e-10, rtol=0
    )  # float64


@pytest.mark.parametrize("kernel", [ddpm, ddim, dpmpp_2m])
def test_last_step_returns_the_clean_estimate(kernel):
    x, x0, before = normal(0, 2, 3, 2), normal(1, 2, 3, 2), normal(2, 2, 3, 2)
    alpha_bar = Schedule.cosine(50).alpha_bar
    out = kernel(x, x0, torch.zeros_like(x), alpha_bar[1], 1.0, (before, alpha_bar[2]))
    torch.testing.assert_close(out, x0, atol=1e-12, rtol=0)  # rounding of 1 - alpha_bar_1


def _flow_error(kernel, schedule, std):
    """Root mean square distance of N(MEAN, std^2) sampled to the exact end of the probability flow
    from the same x_T: along it (x - sqrt(a) mean) / sqrt(a std^2 + 1 - a) is constant.
    """
    x = normal(0, 200, 1, 1)
    start, stop = schedule.alpha_bar[-1], schedule.alpha_bar[0]
    constant = (x - math.sqrt(start) * MEAN) / math.sqrt(start * std**2 + 1 - start)
    exact = math.sqrt(stop) * MEAN + math.sqrt(stop * std**2 + 1 - stop) * constant
    denoiser = gaussian_denoiser(schedule, MEAN, std)
    out = sample(
        denoiser, schedule, Unconstrained(), FREE, Pins.none(x), lambda: x, kernel=kernel
    ).x
    return float((out - exact).square().mean().sqrt())


def _even_in_log_snr(n_steps):
    """Levels of lambda from 2 down to -2, so that neither end is singular."""
    levels = torch.linspace(2, -2, n_steps + 1, dtype=F64)
    return Schedule(tuple(torch.sigmoid(2 * levels).tolist()), tuple(range(n_steps + 1)))


def test_half_log_snr_inverts_its_sigmoid():
    assert [half_log_snr(a) for a in _even_in_log_snr(4).alpha_bar] == pytest.approx(
        [2, 1, 0, -1, -2], abs=1e-12
    )  # rounding


@pytest.mark.parametrize(
    "std", [0.1, 0.5, 0.9]
)  # at 0.3 the leading term of dpm++2m passes through zero over this range
@pytest.mark.parametrize(("kernel", "ratio"), [(ddim, 2.0), (dpmpp_2m, 4.0)])
def test_twice_the_steps_halve_the_error_of_ddim_and_quarter_that_of_dpm_2m(kernel, ratio, std):
    errors = [_flow_error(kernel, _even_in_log_snr(n), std) for n in (64, 128, 256)]
    # the next term of the error is a factor of some units / n below the leading one: measured
    # ratios 3.87 to 4.06, 1.99 to 2.00
    assert errors[0] / errors[1] == pytest.approx(ratio, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(ratio, rel=0.025)


@pytest.mark.parametrize("std", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("n_steps", [5, 8, 16, 32])
def test_few_steps_of_dpm_2m_are_closer_to_the_flow_than_as_many_of_ddim(std, n_steps):
    schedule = Schedule.cosine(64).respaced(n_steps)
    # measured: 0.97 of ddim's at 5 steps of the narrow law, whose last step decides; at most 0.83
    # elsewhere
    assert _flow_error(dpmpp_2m, schedule, std) < _flow_error(ddim, schedule, std)


def test_16_steps_of_dpm_2m_are_closer_than_32_of_ddim():
    full = Schedule.cosine(64)
    for std in (0.1, 0.5, 0.9):
        assert _flow_error(dpmpp_2m, full.respaced(16), std) < _flow_error(
            ddim, full.respaced(32), std
        )


def test_first_step_of_dpm_2m_equals_ddim():
    first, second = (
        [out for _, _, out in _record(0, kernel=kernel)[2]] for kernel in (ddim, dpmpp_2m)
    )
    assert torch.equal(first[0], second[0])
    assert not torch.equal(first[1], second[1])


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), i=st.integers(2, 49))
def test_dpm_2m_equals_the_printed_update(seed, i):
    """x_{t-1} = sigma_b / sigma_a x - alpha_b (e^-h - 1) D, D = (1 + 1 / 2r) x0 - x0_before / 2r, r
    = h_before / h.
    """
    a_before, a, b = (Schedule.cosine(50).alpha_bar[k] for k in (i + 1, i, i - 1))
    x, x0, before = normal(seed, 1, 2, 2), normal(seed + 1, 1, 2, 2), normal(seed + 2, 1, 2, 2)
    log_snr = [math.log(math.sqrt(level / (1 - level))) for level in (a_before, a, b)]
    h_before, h = log_snr[1] - log_snr[0], log_snr[2] - log_snr[1]
    r = h_before / h
    carried = (1 + 1 / (2 * r)) * x0 - before / (2 * r)
    printed = math.sqrt((1 - b) / (1 - a)) * x - math.sqrt(b) * math.expm1(-h) * carried
    out = dpmpp_2m(x, x0, torch.full_like(x, torch.nan), a, b, (before, a_before))
    torch.testing.assert_close(out, printed, atol=1e-10, rtol=1e-10)  # the same algebra, float64


def test_cosine_schedule_falls_from_clean_to_noise():
    schedule = Schedule.cosine(100)
    assert schedule.n_steps == 100
    assert schedule.alpha_bar[0] == 1.0
    assert schedule.alpha_bar[-1] < 1e-3
    assert all(0 < schedule.beta(i) <= 0.999 + 1e-12 for i in range(1, 101))  # rounding of the cap
    assert schedule.alpha_bar[50] == pytest.approx(
        math.cos((0.5 + 0.008) / 1.008 * math.pi / 2) ** 2
        / math.cos(0.008 / 1.008 * math.pi / 2) ** 2,
        rel=1e-12,
    )


@pytest.mark.parametrize("n_steps", [1, 7, 10, 100])
def test_respacing_keeps_the_ends_and_the_levels_of_the_kept_steps(n_steps):
    full = Schedule.cosine(100)
    few = full.respaced(n_steps)
    assert (few.n_steps, few.t[0], few.t[-1]) == (n_steps, 0, 100)
    assert few.alpha_bar == tuple(full.alpha_bar[t] for t in few.t)
    assert sorted(set(few.t)) == list(few.t)


@settings(max_examples=50, deadline=None)
@given(n=st.integers(1, 300), share=st.floats(0, 1))
def test_respacing_takes_that_many_steps_each_once_and_no_longer_ones_nearer_the_data(n, share):
    few = 1 + round(share * (n - 1))
    t = Schedule.cosine(n).respaced(few).t
    assert (len(t), t[0], t[-1]) == (few + 1, 0, n)
    lengths = [after - before for before, after in pairwise(t)]
    assert min(lengths) >= 1
    assert all(late <= early + 1 for late, early in pairwise(lengths))  # each t is rounded by half


def test_respacing_to_all_steps_changes_nothing():
    assert Schedule.cosine(30).respaced(30) == Schedule.cosine(30)


@pytest.mark.parametrize("kernel", [ddim, dpmpp_2m])
@pytest.mark.parametrize("n_steps", [8, 16, 32])
def test_shorter_steps_near_the_data_are_closer_to_a_narrow_law_than_even_ones(kernel, n_steps):
    full = Schedule.cosine(64)
    even = range(0, 65, 64 // n_steps)
    assert _flow_error(
        kernel, full.respaced(n_steps), 0.1
    ) < 0.7 * _flow_error(  # measured 0.13 to 0.56
        kernel, Schedule(tuple(full.alpha_bar[i] for i in even), tuple(even)), 0.1
    )


# the loop -----------------------------------------------------------------------------------------


def _record(extra_steps, method=None, kernel=ddpm, b=0.2, n_steps=12):
    schedule, calls, seen = Schedule.cosine(12).respaced(n_steps), [], []
    inner = gaussian_denoiser(schedule, MEAN, STD)

    def denoiser(x, t):
        calls.append(t)
        return inner(x, t)

    pins = Pins.none(torch.zeros(2, 3, 2, dtype=F64))
    x = sample(
        denoiser,
        schedule,
        method or Unconstrained(),
        waypoints(half_space(b=b)),
        pins,
        draws(1, 2, 3, 2),
        kernel=kernel,
        extra_steps=extra_steps,
        on_step=lambda call, step, out: seen.append((call, step, out)),
    ).x
    return x, calls, seen


def test_each_step_costs_one_call_and_frozen_steps_cost_one_more_each():
    _, calls, seen = _record(0)
    assert calls == list(range(12, 0, -1))
    assert [call for call, _, _ in seen] == list(range(1, 13))
    _, calls, seen = _record(5)
    assert calls == [*range(12, 0, -1), 1, 1, 1, 1, 1]
    assert seen[-1][0] == 17


def test_only_steps_at_t_one_are_without_noise():
    _, _, seen = _record(3)
    assert [step.last for _, step, _ in seen] == [False] * 11 + [True] * 4


def test_on_step_gets_the_returned_plan_last():
    x, _, seen = _record(2)
    assert torch.equal(seen[-1][2], x)


def test_frozen_steps_let_the_multipliers_converge():
    def violation(extra_steps):
        return float(
            waypoints(half_space())(_record(extra_steps, CleanAugmentedLagrangian(rho=0.1))[0])
            .clamp_min(0)
            .sum()
        )

    assert violation(40) <= violation(0)
    assert violation(40) < 1e-6  # 0.9^40 of what a first penalty step leaves, and rho grows


@pytest.mark.parametrize("kernel", list(KERNELS))
@pytest.mark.parametrize(
    "method", [Unconstrained(), CleanProjected(), Projected(), AugmentedLagrangian()]
)
def test_pins_hold_exactly_at_every_step(kernel, method):
    schedule = Schedule.cosine(10)
    values = torch.zeros(2, 4, 2, dtype=F64)
    values[:, 0], values[:, -1] = vec(-0.3, 0.4), vec(0.1, 0.7)
    pins = pin(values, 0, -1)

    def check(call, step, out):
        for x in (step.x, step.x0, out):
            assert torch.equal(x[:, [0, -1]], values[:, [0, -1]])

    denoiser = gaussian_denoiser(schedule, MEAN, STD)
    sample(
        denoiser,
        schedule,
        method,
        waypoints(half_space()),
        pins,
        draws(2, 2, 4, 2),
        kernel=load_kernel(kernel),
        extra_steps=2,
        on_step=check,
    )


@pytest.mark.parametrize(
    "method", [CleanProjected(), CleanPrimalDual(), CleanAugmentedLagrangian()]
)
def test_kernel_gets_the_estimate_that_the_previous_step_used(method):
    given = []

    def kernel(x, x0, z, a, b, previous):
        given.append((x0, a, previous))
        return dpmpp_2m(x, x0, z, a, b, previous)

    _, _, seen = _record(2, method, kernel, b=-0.3)
    assert given[0][2] is None
    for (x0, a, _), (_, _, (before, a_before)) in pairwise(given):
        assert before is x0
        assert a_before == a
    moved = [
        not torch.equal(x0, step.x0) for (x0, _, _), (_, step, _) in zip(given, seen, strict=True)
    ]
    assert (
        sum(moved) >= 13
    )  # the law's mean is outside; primal-dual knows no multiplier in its first step


@pytest.mark.parametrize("n_steps", [1, 2, 12])
def test_frozen_steps_of_dpm_2m_return_safe_clean_estimates(n_steps):
    g = waypoints(half_space(b=-0.3))
    _, calls, seen = _record(3, CleanProjected(), dpmpp_2m, b=-0.3, n_steps=n_steps)
    assert len(calls) == n_steps + 3
    for _, step, out in seen[n_steps - 1 :]:
        torch.testing.assert_close(
            out, project(g, step.x0, step.pins), atol=1e-12, rtol=0
        )  # rounding of 1 - alpha_bar_1
        assert float(g(out).max()) < 1e-9  # rounding


@pytest.mark.parametrize("kernel", [ddim, dpmpp_2m])
def test_deterministic_kernels_use_only_the_first_noise(kernel):
    schedule, pins = Schedule.cosine(10), Pins.none(torch.zeros(1, 1, 1, dtype=F64))
    first = normal(0, 1, 1, 1)
    outs = []
    for seed in (1, 2):
        noise = _first_then(first, draws(seed, 1, 1, 1))
        outs.append(
            sample(
                gaussian_denoiser(schedule, MEAN, STD),
                schedule,
                Unconstrained(),
                FREE,
                pins,
                noise,
                kernel=kernel,
            ).x
        )
    assert torch.equal(*outs)


def _first_then(first, later):
    queue = [first]
    return lambda: queue.pop() if queue else later()


def test_sampling_resumed_from_a_state_equals_sampling_at_once():
    """Frozen steps alone: 3 + 4 of them, begun where the first 3 ended, are 7."""
    schedule, like = Schedule.cosine(1), torch.zeros(2, 3, 2, dtype=F64)
    denoiser = gaussian_denoiser(schedule, MEAN, STD)
    method, g, x = CleanPrimalDual(eta=0.3), waypoints(half_space(b=-1.0)), normal(3, 2, 3, 2)

    def go(first, frozen, state=None):
        return sample(
            denoiser,
            schedule,
            method,
            g,
            Pins.none(like),
            lambda: like,
            kernel=ddim,
            extra_steps=frozen,
            first=first,
            state=state,
        )

    whole, half = go(x, 6), go(x, 2)
    rest = go(half.x, 3, half.state)
    assert torch.equal(rest.x, whole.x)
    assert torch.equal(rest.state, whole.state)
    assert not torch.equal(go(half.x, 3).x, whole.x)


# noise --------------------------------------------------------------------------------------------


def test_noise_of_a_seed_does_not_depend_on_other_seeds():
    alone, among = Noise([7], (3, 2)), Noise([1, 7, 4], (3, 2))
    for _ in range(3):
        assert torch.equal(alone()[0], among()[1])


def test_plan_of_a_seed_does_not_depend_on_other_seeds():
    schedule = Schedule.cosine(10)

    def plans(seeds):
        like = torch.zeros(len(seeds), 3, 2)
        g = waypoints(half_space()).to(like)
        return sample(
            gaussian_denoiser(schedule, MEAN, STD),
            schedule,
            CleanAugmentedLagrangian(),
            g,
            Pins.none(like),
            Noise(seeds, (3, 2)),
        ).x

    assert torch.equal(plans([7])[0], plans([1, 7, 4])[1])


def test_noise_of_no_seeds_is_an_empty_batch():
    assert Noise([], (3, 2))().shape == (0, 3, 2)


def test_noise_is_standard_normal():
    x = Noise(range(400), (10, 4))()
    assert float(x.mean()) == pytest.approx(0, abs=0.03)  # 16000 draws: 4 standard errors
    assert float(x.std()) == pytest.approx(1, abs=0.03)


# training -----------------------------------------------------------------------------------------


class _Constant(nn.Module):
    def __init__(self, value):
        nn.Module.__init__(self)
        self.value = value

    def estimates(self, x, _):
        return [torch.full_like(x, self.value)]


def test_training_loss_of_a_constant_error_is_its_square_without_pins():
    x0, none = torch.zeros(8, 5, 2), torch.zeros(5, 2, dtype=torch.bool)
    loss, mse = training_loss(
        _Constant(3.0), Schedule.cosine(10), x0, none, Weighing(100.0), generator(0), False
    )
    assert float(loss) == float(mse) == 9.0  # a constant error has no jitter


def test_training_loss_counts_no_pinned_coordinate_and_weighs_jitter():
    x0, pinned = torch.zeros(8, 4, 1), torch.zeros(4, 1, dtype=torch.bool)
    pinned[0] = True
    loss, mse = training_loss(
        _Constant(1.0), Schedule.cosine(10), x0, pinned, Weighing(10.0), generator(0), False
    )
    assert float(mse) == pytest.approx(0.75)  # error (0, 1, 1, 1)
    assert float(loss) == pytest.approx(0.75 + 10 / 3, rel=1e-6)  # one jump among three, float32
