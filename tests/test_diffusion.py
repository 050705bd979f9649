"""The schedule, the kernels against a Gaussian whose denoiser is exact, the sampling loop and its noise."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from cdiff_cli.constraint import Constraint, Pins
from cdiff_cli.diffusion import KERNELS, Noise, Schedule, Weighing, ddim, ddpm, langevin, sample, training_loss
from cdiff_cli.methods import AugmentedLagrangian, Projected, Unconstrained
from tests.problems import F64, draws, gaussian_denoiser, generator, half_space, normal, pin, vec, waypoints

FREE = Constraint(())
MEAN, STD = 0.5, 0.1
N = 8000  # standard errors: 0.0011 of the mean, 0.8 percent of the std


def _gaussian(kernel, n_steps, n=N):
    schedule = Schedule.cosine(n_steps)
    pins = Pins.none(torch.zeros(n, 1, 1, dtype=F64))
    denoiser = gaussian_denoiser(schedule, MEAN, STD)
    return sample(denoiser, schedule, Unconstrained(), FREE, pins, draws(0, n, 1, 1), kernel=kernel)


# known answers --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kernel", "n_steps"), [(ddpm, 1000), (ddim, 200)])
def test_ddpm_and_ddim_reproduce_a_gaussian_with_its_exact_denoiser(kernel, n_steps):
    x = _gaussian(kernel, n_steps)
    # discretisation narrows in 1 / n_steps: 3 to 4 percent here (ddpm has 6.7 at 200 steps); the rest is sampling
    assert float(x.mean()) == pytest.approx(MEAN, abs=0.005)
    assert float(x.std()) == pytest.approx(STD, rel=0.06)


@pytest.mark.parametrize("n_steps", [200, 1000])
def test_the_printed_langevin_step_does_not_reproduce_it(n_steps):
    assert 0.2 < float(_gaussian(langevin, n_steps, 2000).std()) < 0.28  # twice too wide, at any number of steps


def test_ddpm_narrows_to_the_true_std_with_more_steps():
    gaps = [abs(float(_gaussian(ddpm, n).std()) - STD) for n in (20, 80, 320)]
    assert gaps[0] > 2 * gaps[2]  # first order in 1 / n_steps, seen through a sampling error of 0.0008


def test_all_kernels_are_named():
    assert {"ddpm": ddpm, "ddim": ddim, "langevin": langevin} == KERNELS


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), i=st.integers(2, 50))
def test_ddpm_moments_are_bayes_rule(seed, i):
    """x_{t-1} of the prior N(sqrt(b) x0, 1 - b) and the likelihood N(x_t; sqrt(1 - beta) x_{t-1}, beta)."""
    schedule = Schedule.cosine(50)
    a, b, beta = schedule.alpha_bar[i], schedule.alpha_bar[i - 1], schedule.beta(i)
    x, x0 = normal(seed, 1, 1, 1), normal(seed + 1, 1, 1, 1)
    precision = 1 / (1 - b) + (1 - beta) / beta
    mean = (math.sqrt(b) * x0 / (1 - b) + math.sqrt(1 - beta) * x / beta) / precision
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    torch.testing.assert_close(ddpm(x, x0, zero, a, b), mean, atol=1e-10, rtol=1e-10)  # the same algebra, float64
    std = float(ddpm(x, x0, one, a, b) - ddpm(x, x0, zero, a, b))
    assert std == pytest.approx(precision**-0.5, rel=1e-9, abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), i=st.integers(1, 50))
def test_ddim_keeps_the_noise_direction_it_sees(seed, i):
    schedule = Schedule.cosine(50)
    a, b = schedule.alpha_bar[i], schedule.alpha_bar[i - 1]
    x0, e = normal(seed, 1, 2, 2), normal(seed + 1, 1, 2, 2)
    x = math.sqrt(a) * x0 + math.sqrt(1 - a) * e
    torch.testing.assert_close(ddim(x, x0, 0 * x, a, b), math.sqrt(b) * x0 + math.sqrt(1 - b) * e, atol=1e-10, rtol=0)  # float64


@pytest.mark.parametrize("kernel", [ddpm, ddim])
def test_the_last_step_is_the_clean_estimate(kernel):
    x, x0 = normal(0, 2, 3, 2), normal(1, 2, 3, 2)
    out = kernel(x, x0, torch.zeros_like(x), Schedule.cosine(50).alpha_bar[1], 1.0)
    torch.testing.assert_close(out, x0, atol=1e-12, rtol=0)  # rounding of 1 - alpha_bar_1


def test_cosine_schedule_falls_from_clean_to_noise():
    schedule = Schedule.cosine(100)
    assert schedule.n_steps == 100
    assert schedule.alpha_bar[0] == 1.0
    assert schedule.alpha_bar[-1] < 1e-3
    assert all(0 < schedule.beta(i) <= 0.999 + 1e-12 for i in range(1, 101))  # rounding of the cap
    assert schedule.alpha_bar[50] == pytest.approx(
        math.cos((0.5 + 0.008) / 1.008 * math.pi / 2) ** 2 / math.cos(0.008 / 1.008 * math.pi / 2) ** 2, rel=1e-12
    )


@pytest.mark.parametrize("n_steps", [1, 7, 10, 100])
def test_respacing_keeps_the_ends_and_the_levels_of_the_kept_steps(n_steps):
    full = Schedule.cosine(100)
    few = full.respaced(n_steps)
    assert (few.n_steps, few.t[0], few.t[-1]) == (n_steps, 0, 100)
    assert few.alpha_bar == tuple(full.alpha_bar[t] for t in few.t)
    assert sorted(set(few.t)) == list(few.t)


def test_respacing_to_all_steps_changes_nothing():
    assert Schedule.cosine(30).respaced(30) == Schedule.cosine(30)


# the loop -------------------------------------------------------------------------------------------------------------


def _record(extra_steps, method=None):
    schedule, calls, seen = Schedule.cosine(12), [], []
    inner = gaussian_denoiser(schedule, MEAN, STD)

    def denoiser(x, t):
        calls.append(t)
        return inner(x, t)

    pins = Pins.none(torch.zeros(2, 3, 2, dtype=F64))
    x = sample(
        denoiser,
        schedule,
        method or Unconstrained(),
        waypoints(half_space()),
        pins,
        draws(1, 2, 3, 2),
        extra_steps=extra_steps,
        on_step=lambda call, step, out: seen.append((call, step, out)),
    )
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


def test_on_step_sees_the_plan_that_is_returned():
    x, _, seen = _record(2)
    assert torch.equal(seen[-1][2], x)


def test_frozen_steps_let_the_multipliers_finish():
    def violation(extra_steps):
        return float(waypoints(half_space())(_record(extra_steps, AugmentedLagrangian(rho=0.1))[0]).clamp_min(0).sum())

    assert violation(40) <= violation(0)
    assert violation(40) < 1e-6  # 0.9^40 of what a first penalty step leaves, and rho grows


@pytest.mark.parametrize("kernel", list(KERNELS))
@pytest.mark.parametrize("method", [Unconstrained(), Projected(), Projected(on="noisy"), AugmentedLagrangian(on="noisy")])
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
        kernel=KERNELS[kernel],
        extra_steps=2,
        on_step=check,
    )


def test_ddim_needs_no_noise_but_the_first():
    schedule, pins = Schedule.cosine(10), Pins.none(torch.zeros(1, 1, 1, dtype=F64))
    first = normal(0, 1, 1, 1)
    outs = []
    for seed in (1, 2):
        noise = _first_then(first, draws(seed, 1, 1, 1))
        outs.append(sample(gaussian_denoiser(schedule, MEAN, STD), schedule, Unconstrained(), FREE, pins, noise, kernel=ddim))
    assert torch.equal(*outs)


def _first_then(first, later):
    queue = [first]
    return lambda: queue.pop() if queue else later()


# noise ----------------------------------------------------------------------------------------------------------------


def test_the_draws_of_a_seed_do_not_depend_on_its_neighbours():
    alone, among = Noise([7], (3, 2)), Noise([1, 7, 4], (3, 2))
    for _ in range(3):
        assert torch.equal(alone()[0], among()[1])


def test_the_plan_of_a_seed_does_not_depend_on_its_neighbours():
    schedule = Schedule.cosine(10)

    def plans(seeds):
        like = torch.zeros(len(seeds), 3, 2)
        g = waypoints(half_space()).to(like)
        return sample(
            gaussian_denoiser(schedule, MEAN, STD), schedule, AugmentedLagrangian(), g, Pins.none(like), Noise(seeds, (3, 2))
        )

    assert torch.equal(plans([7])[0], plans([1, 7, 4])[1])


def test_noise_of_no_seeds_is_an_empty_batch():
    assert Noise([], (3, 2))().shape == (0, 3, 2)


def test_noise_is_standard_normal():
    x = Noise(range(400), (10, 4))()
    assert float(x.mean()) == pytest.approx(0, abs=0.03)  # 16000 draws: 4 standard errors
    assert float(x.std()) == pytest.approx(1, abs=0.03)


# training -------------------------------------------------------------------------------------------------------------


class _Constant(nn.Module):
    def __init__(self, value):
        nn.Module.__init__(self)
        self.value = value

    def estimates(self, x, _):
        return [torch.full_like(x, self.value)]


def test_training_loss_of_a_constant_error_is_its_square_without_pins():
    x0, none = torch.zeros(8, 5, 2), torch.zeros(5, 2, dtype=torch.bool)
    loss, mse = training_loss(_Constant(3.0), Schedule.cosine(10), x0, none, Weighing(100.0), generator(0), False)
    assert float(loss) == float(mse) == 9.0  # a constant error has no jitter


def test_training_loss_counts_no_pinned_coordinate_and_weighs_jitter():
    x0, pinned = torch.zeros(8, 4, 1), torch.zeros(4, 1, dtype=torch.bool)
    pinned[0] = True
    loss, mse = training_loss(_Constant(1.0), Schedule.cosine(10), x0, pinned, Weighing(10.0), generator(0), False)
    assert float(mse) == pytest.approx(0.75)  # error (0, 1, 1, 1)
    assert float(loss) == pytest.approx(0.75 + 10 / 3, rel=1e-6)  # one jump among three, float32
