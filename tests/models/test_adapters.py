"""Networks trained elsewhere as denoisers: every parametrisation of a Gaussian's exact score."""

import math
from types import SimpleNamespace

import pytest
import torch

from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.models.adapters import (
    batched,
    clipped,
    from_clean,
    from_diffusers,
    from_epsilon,
    from_sigma,
    from_velocity,
)
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.sampling.baselines import Unconstrained
from cdiff_cli.sampling.sampler import sample
from tests.problems import F64, draws, gaussian_denoiser, normal

MEAN, STD = 0.4, 0.3
SCHEDULE = Schedule.cosine(20)
LEVELS = SCHEDULE.alpha_bar[1:]
EXACT = gaussian_denoiser(SCHEDULE, MEAN, STD)
STEPS = (1, 7, 20)


def levels_of(t):
    """alpha_bar of the steps that a network is given, 0 for the least noise [n, 1, 1]."""
    return torch.tensor(LEVELS, dtype=F64)[t][:, None, None]


def gaussian_mean(x, a):
    """E[x_0 | x_t] of N(MEAN, STD^2)."""
    gain = STD**2 * a.sqrt() / (a * STD**2 + 1 - a)
    return MEAN + gain * (x - a.sqrt() * MEAN)


def predicts_clean(x, t):
    return gaussian_mean(x, levels_of(t))


def predicts_noise(x, t):
    """E[noise | x_t] = -sqrt(1 - a) * score, the score of N(sqrt(a) MEAN, a STD^2 + 1 - a)."""
    a = levels_of(t)
    return (1 - a).sqrt() * (x - a.sqrt() * MEAN) / (a * STD**2 + 1 - a)


def predicts_velocity(x, t):
    a = levels_of(t)
    return a.sqrt() * predicts_noise(x, t) - (1 - a).sqrt() * predicts_clean(x, t)


def takes_sigma(x, sigma):
    """E[x_0 | x_0 + sigma noise]."""
    gain = STD**2 / (STD**2 + sigma[:, None, None].square())
    return MEAN + gain * (x - MEAN)


ADAPTED = {
    "clean": from_clean(predicts_clean),
    "epsilon": from_epsilon(predicts_noise, LEVELS),
    "velocity": from_velocity(predicts_velocity, torch.tensor(LEVELS, dtype=F64)),
    "sigma": from_sigma(takes_sigma, LEVELS),
}


@pytest.mark.parametrize("t", STEPS)
@pytest.mark.parametrize("name", ADAPTED)
def test_every_parametrisation_of_the_exact_score_is_the_exact_denoiser(name, t):
    x = normal(t, 3, 5, 2)
    torch.testing.assert_close(ADAPTED[name](x, t), EXACT(x, t), atol=1e-10, rtol=0)


@pytest.mark.parametrize("name", ADAPTED)
def test_an_adapted_denoiser_keeps_type_and_shape(name):
    def network(x, t):
        assert len(t) == len(x)
        return torch.zeros_like(x)

    made = {
        "clean": from_clean(network),
        "epsilon": from_epsilon(network, LEVELS),
        "velocity": from_velocity(network, LEVELS),
        "sigma": from_sigma(network, LEVELS),
    }[name]
    x = normal(0, 3, 5, 2).float()
    assert (made(x, 4).dtype, made(x, 4).shape) == (torch.float32, x.shape)


def test_a_network_is_given_steps_counted_from_zero_and_a_sigma_of_the_inputs_type():
    steps, sigmas = [], []

    def by_step(x, t):
        steps.append(t)
        return x

    def by_sigma(x, sigma):
        sigmas.append(sigma)
        return x

    x = normal(0, 2, 5, 2).float()
    from_epsilon(by_step, LEVELS)(x, 1)
    from_sigma(by_sigma, LEVELS)(x, 3)
    assert (steps[0].tolist(), steps[0].dtype) == ([0, 0], torch.long)
    a = LEVELS[2]
    torch.testing.assert_close(sigmas[0], torch.full((2,), math.sqrt((1 - a) / a)))


def test_plans_by_noise_and_by_clean_estimate_are_the_same():
    like = torch.zeros(4, 3, 2, dtype=F64)

    def plans(denoiser):
        pins = Pins.none(like)
        noise = draws(5, *like.shape)
        return sample(denoiser, SCHEDULE, Unconstrained(), Constraint(()), pins, noise).x

    torch.testing.assert_close(plans(ADAPTED["epsilon"]), plans(EXACT), atol=1e-8, rtol=0)


# diffusers ----------------------------------------------------------------------------------------

PREDICTIONS = {
    "epsilon": predicts_noise,
    "sample": predicts_clean,
    "v_prediction": predicts_velocity,
}


def unet(network, wrapped):
    """A network with the interface of diffusers' UNet1DModel: channels first, output wrapped."""

    def call(x, t):
        assert x.shape[1:] == (2, 5)
        out = network(x.transpose(1, 2), t).transpose(1, 2)
        return SimpleNamespace(sample=out) if wrapped else out

    return call


def scheduler(kind, **more):
    config = SimpleNamespace(prediction_type=kind, **more)
    return SimpleNamespace(config=config, alphas_cumprod=torch.tensor(LEVELS, dtype=F64))


@pytest.mark.parametrize("wrapped", [True, False])
@pytest.mark.parametrize("kind", PREDICTIONS)
def test_a_model_of_diffusers_is_the_exact_denoiser_and_brings_its_schedule(kind, wrapped):
    denoiser, schedule = from_diffusers(
        unet(PREDICTIONS[kind], wrapped), scheduler(kind, clip_sample=False)
    )
    assert schedule == SCHEDULE
    for t in STEPS:
        x = normal(t, 3, 5, 2)
        torch.testing.assert_close(denoiser(x, t), EXACT(x, t), atol=1e-10, rtol=0)


@pytest.mark.parametrize(("more", "limit"), [({"clip_sample_range": 0.2}, 0.2), ({}, 1.0)])
def test_a_scheduler_that_clips_has_its_estimates_clipped(more, limit):
    settings = scheduler("epsilon", clip_sample=True, **more)
    denoiser, _ = from_diffusers(unet(predicts_noise, True), settings)
    x = 9 * normal(0, 3, 5, 2)
    assert float(EXACT(x, 1).abs().max()) > limit
    torch.testing.assert_close(denoiser(x, 1), EXACT(x, 1).clamp(-limit, limit))


def test_another_prediction_type_is_refused():
    with pytest.raises(
        ValueError, match="expected epsilon, sample or v_prediction, found 'flow_prediction'"
    ):
        from_diffusers(unet(predicts_noise, True), scheduler("flow_prediction"))


# wrappers -----------------------------------------------------------------------------------------


def test_clipped_keeps_what_is_within_the_limit_and_cuts_the_rest():
    x = torch.tensor([[[-3.0, -0.5, 0.5, 3.0]]])
    assert clipped(lambda x, _: x)(x, 1).tolist() == [[[-1.0, -0.5, 0.5, 1.0]]]
    assert clipped(lambda x, _: x, 2.0)(x, 1).tolist() == [[[-2.0, -0.5, 0.5, 2.0]]]


@pytest.mark.parametrize("size", [1, 3, 7, 100])
def test_batched_is_equal_to_the_whole_and_calls_with_no_more_than_its_size(size):
    sizes = []

    def counted(x, t):
        sizes.append(len(x))
        return EXACT(x, t)

    x = normal(0, 7, 5, 2)
    assert torch.equal(batched(counted, size)(x, 7), EXACT(x, 7))
    assert sum(sizes) == 7
    assert max(sizes) == min(size, 7)


# schedules ----------------------------------------------------------------------------------------


def test_a_schedule_of_its_own_levels_is_itself():
    assert Schedule.from_alphas_cumprod(LEVELS) == SCHEDULE
    assert Schedule.from_alphas_cumprod([0.5]) == Schedule((1.0, 0.5), (0, 1))


@pytest.mark.parametrize(
    "levels",
    [[], [1.0, 0.5], [0.5, 0.5], [0.5, 0.6], [0.5, 0.0], [0.5, -0.1], [1.5, 0.5], [0.5, math.nan]],
)
def test_levels_that_do_not_fall_from_below_one_to_above_zero_are_refused(levels):
    with pytest.raises(ValueError, match="alphas_cumprod: expected numbers that fall"):
        Schedule.from_alphas_cumprod(levels)
