"""Constrained sampling where the truth is known, with exact denoisers and rejection samples."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.evaluation import metrics
from cdiff_cli.models.preset import SamplerSettings
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.sampling import load_kernel
from cdiff_cli.sampling.clean_methods import CleanProjected
from cdiff_cli.sampling.sampler import Step
from tests.problems import generator, normal
from tests.sampling.oracle import (
    CONSTRAINTS,
    F64,
    SAFE,
    SCALE,
    Latent,
    Routes,
    energy_distance,
    energy_within_routes,
    execute,
    jump_limit,
    measure,
    problem,
    recipe_runs,
    route_shares,
    three_routes,
    variant_runs,
)

LAW = three_routes()
SCHEDULE = Schedule.cosine(64)
SEEDS = (0, 1, 2)
N = 200


def seeds(seed, n=N):
    return range(1000 * seed, 1000 * seed + n)


def truth(name, seed, n=2000, law=LAW):
    return law.truth(CONSTRAINTS[name], n, generator(seed))[0]


def samples(name, run, seed, law=LAW, n=N):
    at = problem(law, CONSTRAINTS[name])
    runs = {r.name: r for r in (*recipe_runs(), *variant_runs(at))}
    return execute(runs[run], at, seeds(seed, n))[0]


def covariance(law):
    values, vectors = law.modes
    return vectors @ torch.diag(values) @ vectors.T


def noisy(law, a, n=5):
    """x_t of exact samples, normalised, the ends clean as the sampler pins them."""
    z = law.draw(n, generator(3)) / SCALE
    x = math.sqrt(a) * z + math.sqrt(1 - a) * normal(4, n, law.horizon, 2)
    x[:, [0, -1]] = z[:, [0, -1]]
    return x


# the law ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("t", [1, 20, 50, 64])
def test_denoiser_of_one_gaussian_equals_its_closed_form(t):
    """E[x_0 | x_t] = m + sqrt(a) S (a S + (1 - a) I)^-1 (x_t - sqrt(a) m)."""
    law = Routes(LAW.means[:1], LAW.std[:1], torch.ones(1, dtype=F64))
    a, m = SCHEDULE.alpha_bar[t], law.means[0] / SCALE
    S = law.std[0] ** 2 / SCALE**2 * covariance(law)
    gain = math.sqrt(a) * S @ torch.linalg.inv(a * S + (1 - a) * torch.eye(law.horizon, dtype=F64))
    x = noisy(law, a)
    torch.testing.assert_close(
        law.denoiser(SCHEDULE)(x, t), m + gain @ (x - math.sqrt(a) * m), atol=1e-9, rtol=0
    )


@pytest.mark.parametrize("t", [1, 20, 50, 64])
def test_denoiser_of_the_mixture_satisfies_tweedies_formula(t):
    """sqrt(a) E[x_0 | x_t] = x_t + (1 - a) grad log p_t(x_t), the density written by torch, its
    gradient by autograd.
    """
    a = SCHEDULE.alpha_bar[t]
    identity = torch.eye(LAW.horizon, dtype=F64)
    noise = [a * (s / SCALE) ** 2 * covariance(LAW) + (1 - a) * identity for s in LAW.std]
    x = noisy(LAW, a).requires_grad_()
    each = [
        torch.distributions.MultivariateNormal((math.sqrt(a) * m / SCALE).T, S)
        .log_prob(x.transpose(1, 2))
        .sum(1)
        for m, S in zip(LAW.means, noise, strict=True)
    ]
    (score,) = torch.autograd.grad(
        torch.logsumexp(torch.stack(each) + LAW.weights.log()[:, None], 0).sum(), x
    )
    with torch.no_grad():
        expected = (x + (1 - a) * score) / math.sqrt(a)
        torch.testing.assert_close(
            LAW.denoiser(SCHEDULE)(x, t)[:, 1:-1], expected[:, 1:-1], atol=1e-8, rtol=0
        )


def test_float32_is_enough_for_the_denoiser():
    clean = LAW.denoiser(SCHEDULE)
    for t in (1, 10, 40, 64):
        x = noisy(LAW, SCHEDULE.alpha_bar[t], 50)
        torch.testing.assert_close(clean(x.float(), t).double(), clean(x, t), atol=2e-4, rtol=0)


def test_unconstrained_ddpm_samples_have_the_law_up_to_sampling_error():
    """Over 600 plans the energy distance of 64 steps is of the size of truth against truth (its
    standard deviation 0.002); the same measure sees the 0.05 and more by which the constrained laws
    differ.
    """
    at = problem(LAW, Constraint(()))
    x = execute(recipe_runs()[0], at, range(600))[0]
    assert abs(energy_distance(x, LAW.draw(4000, generator(0)).numpy())) < 0.008
    assert energy_distance(x, truth("corner", 0)) > 0.05


@pytest.mark.parametrize("name", CONSTRAINTS)
def test_the_truth_satisfies_the_constraint_and_is_not_rare(name):
    x, acceptance = LAW.truth(CONSTRAINTS[name], 500, generator(0))
    assert len(x) == 500
    assert metrics.worst_waypoint(CONSTRAINTS[name], x).max() <= 0
    assert 0.05 < acceptance < 0.95


# the measures -------------------------------------------------------------------------------------


def test_energy_distance_of_two_points_is_twice_their_distance():
    x, y = np.zeros((3, 5, 2)), np.zeros((4, 5, 2))
    y[..., 0], y[..., 1] = 3.0, 4.0
    assert energy_distance(x, y) == pytest.approx(10.0)


def test_energy_distance_of_one_law_to_itself_is_zero_on_average():
    """300 pairs of 100: the mean within four of its standard errors (0.0007); with each sample
    paired to itself it were 0.016.
    """
    rng = generator(5)
    each = [
        energy_distance(LAW.draw(100, rng).numpy(), LAW.draw(100, rng).numpy()) for _ in range(300)
    ]
    assert abs(np.mean(each)) < 0.003


def test_energy_within_routes_ignores_the_mass_on_each():
    x, y = LAW.draw(4000, generator(0)).numpy(), LAW.draw(4000, generator(1)).numpy()
    lopsided = np.concatenate((x[LAW.route(x) == 0][:1000], x[LAW.route(x) != 0][:300]))
    assert energy_distance(lopsided, y) > 0.05
    assert abs(energy_within_routes(LAW, lopsided, y)) < 0.005


def test_routes_of_the_exact_samples_have_the_weights_of_the_mixture():
    """Up to sampling, and to the few percent of side routes that lie nearer to the middle one."""
    np.testing.assert_allclose(
        route_shares(LAW, LAW.draw(4000, generator(0)).numpy()), LAW.weights, atol=0.04
    )


def test_a_waypoint_out_of_line_is_torn_and_the_truth_is_not():
    x = truth("disc", 0)
    limit = jump_limit(x)
    broken = x[:10].copy()
    broken[:, 16, 1] += 0.5
    row = measure(LAW, CONSTRAINTS["disc"], np.concatenate((broken, x[10:20])), x[:20], x, limit)
    assert row["torn"] == 0.5
    assert row["unsafe"] <= 0.5
    assert row["distance"] == pytest.approx(0.25)


# the methods --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "run",
    ["projected recommended", "primal-dual recommended", "alm recommended", "latent projected"],
)
@pytest.mark.parametrize("name", CONSTRAINTS)
def test_polished_plans_are_safe_at_every_waypoint(name, run):
    assert metrics.violation(CONSTRAINTS[name], samples(name, run, 0, n=120)).max() == 0


@pytest.mark.parametrize("name", CONSTRAINTS)
def test_final_projection_alone_removes_every_violation(name):
    """Final-only projection: the unconstrained plans violate, the polished ones do not at all."""
    assert (
        metrics.worst_waypoint(CONSTRAINTS[name], samples(name, "diffuser", 0)) > SAFE
    ).mean() > 0.2
    assert (
        metrics.violation(CONSTRAINTS[name], samples(name, "projected, final only", 0)).max() == 0
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_clean_projection_is_nearer_the_truth_than_noisy_on_long_trajectories(seed):
    """128 waypoints, a cut corner: within the routes 0.001-0.006 m against 0.21-0.23 m, measured
    over eight batches.
    """
    law = three_routes(128)
    exact = truth("corner", seed, law=law)
    clean, noisy = (
        samples("corner", run, seed, law, n=80)
        for run in ("projected recommended", "projected paper")
    )
    assert energy_within_routes(law, clean, exact) < 0.05
    assert energy_within_routes(law, noisy, exact) > 0.1


@pytest.mark.parametrize("name", ["corner", "slab", "chain"])
def test_carrying_the_shift_to_the_sample_brings_projection_nearer_the_truth(name):
    """Energy distance / m, paired: measured gains of 0.011 to 0.040 in each of eight batches."""
    gains = []
    for seed in SEEDS:
        exact = truth(name, seed)
        plain, latent = (
            energy_distance(samples(name, run, seed), exact)
            for run in ("projected recommended", "latent projected")
        )
        gains.append(plain - latent)
    assert min(gains) > 0.004
    assert np.mean(gains) > 0.008


@pytest.mark.parametrize("seed", SEEDS)
def test_final_only_projection_tears_plans_that_the_latent_one_keeps_whole(seed):
    """Discs on all routes: measured 49 to 58 % torn against 0.5 to 2 %, four batches."""
    limit = jump_limit(truth("discs", 9, 5000))
    final, latent = (
        (metrics.jump(samples("discs", run, seed), (0, 1)) > limit).mean()
        for run in ("projected, final only", "latent projected")
    )
    assert final > 0.4
    assert latent < 0.1


@pytest.mark.parametrize("kernel", ["ddpm", "ddim"])
def test_the_latent_step_is_the_kernel_from_the_shifted_sample(kernel):
    """reverse(x0) + sqrt(b) d = kernel(x_t + sqrt(a) d, x0 + d), and the noise estimate of both is
    the same.
    """
    g, i = CONSTRAINTS["slab"], 30
    a, b = SCHEDULE.alpha_bar[i], SCHEDULE.alpha_bar[i - 1]
    x, x0, z = (normal(seed, 4, 32, 2) for seed in range(3))
    pins = Pins.none(x)
    step = Step(
        x,
        x0,
        SCHEDULE.beta(i),
        math.sqrt(b),
        lambda clean: load_kernel(kernel)(x, clean, z, a, b),
        pins,
        False,
    )
    latent, _ = Latent(CleanProjected(), SCHEDULE).step(step, g, (None, i))
    clean, _ = CleanProjected().step(replace(step, reverse=lambda clean: clean), g, None)
    torch.testing.assert_close(
        latent,
        load_kernel(kernel)(x + math.sqrt(a) * (clean - x0), clean, z, a, b),
        atol=1e-12,
        rtol=0,
    )


@pytest.mark.parametrize(
    ("run", "calls"),
    [
        ("diffuser", 64),
        ("alm recommended", 64),
        ("alm released", 164),
        ("latent projected, 2 calls", 128),
        ("best of 4, 16 steps", 64),
        ("best of 4, 64 steps", 256),
    ],
)
def test_network_calls_are_counted_at_the_network(run, calls):
    at = problem(LAW, CONSTRAINTS["corner"])
    runs = {r.name: r for r in (*recipe_runs(), *variant_runs(at))}
    assert execute(runs[run], at, seeds(0, 4))[1] == calls


def test_runs_without_a_constraint_equal_the_unconstrained_sampler():
    at = problem(LAW, Constraint(()))
    free = execute(recipe_runs()[0], at, seeds(0, 10))[0]
    for run in (*recipe_runs(), *variant_runs(at)):
        if run.k == 1 and run.sampler.extra_steps == 0 and "2 calls" not in run.name:
            np.testing.assert_allclose(
                execute(replace(run, sampler=SamplerSettings()), at, seeds(0, 10))[0],
                free,
                atol=1e-6,
            )
