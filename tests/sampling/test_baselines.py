"""The rivals' known answers: guidance, terminal-only enforcement, a last projection, best of k."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.errors import CdiffError
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.planning.open_loop import plan
from cdiff_cli.planning.timing import candidate_seed
from cdiff_cli.sampling import METHODS, make_method
from cdiff_cli.sampling.baselines import BestOf, FinalProjection, Guidance, Unconstrained
from cdiff_cli.sampling.clean_methods import CleanProjected
from cdiff_cli.sampling.sampler import Step, sample
from tests.problems import (
    draws,
    free_projection,
    gaussian_denoiser,
    half_space,
    normal,
    num,
    pin,
    vec,
    waypoints,
)

SCHEDULE = Schedule.cosine(20)


def step_of(x, last=False, level=0.8, pins=None):
    return Step(x, x, 0.1, level, lambda clean: clean / 2, pins or Pins.none(x), last)


def plans(method, g):
    like = torch.zeros(8, 4, 2, dtype=torch.float64)
    return sample(
        gaussian_denoiser(SCHEDULE, 0.5, 0.1),
        SCHEDULE,
        method,
        g,
        Pins.none(like),
        draws(7, 8, 4, 2),
    ).x


def test_guidance_pushes_along_satisfied_and_violated_rows_alike():
    x = normal(0, 3, 4, 2)
    for b in (-9.0, 9.0):
        out, _ = Guidance(weight=0.25).step(step_of(x), waypoints(half_space(b=b)), None)
        torch.testing.assert_close(out, x / 2 - 0.25 * vec(1.0, -1.0))


def test_guidance_does_not_move_pinned_states():
    x = normal(0, 3, 4, 2)
    out, _ = Guidance().step(step_of(x, pins=pin(x, 0)), waypoints(half_space()), None)
    assert torch.equal(out[:, 0], x[:, 0] / 2)


def test_terminal_equals_projected_with_latent_correction():
    """By hand: x_{t-1} = reverse(x0) + sqrt(alpha_bar_{t-1}) (P_C(x0) - x0)."""
    terminal, g = make_method("terminal", {}), waypoints(HalfSpace(vec(1.0, 1.0), num(0.8)))
    assert terminal == CleanProjected(correction="latent")
    assert torch.equal(plans(terminal, g), plans(CleanProjected(correction="latent"), g))
    x = normal(0, 3, 4, 2)
    out, _ = terminal.step(step_of(x), g, None)
    torch.testing.assert_close(out, x / 2 + 0.8 * (free_projection(g, x) - x), atol=1e-12, rtol=0)


@pytest.mark.parametrize("setting", ["on=clean", "correction=latent", "eta=1"])
def test_terminal_has_no_settings_and_records_none(setting):
    with pytest.raises(
        CdiffError,
        match=f'terminal has no setting "{setting.split("=")[0]}"; its settings are: none',
    ):
        resolve(Request(task="gaussian2d", method="terminal", settings=(setting,)))
    resolved = resolve(Request(task="gaussian2d", method="terminal"))
    assert resolved.method == CleanProjected(correction="latent")
    assert resolved.record()["preset"]["methods"] == {"terminal": {}}
    assert resolved.row()["method"] == "terminal"


def test_final_projection_equals_the_projected_unconstrained_plan():
    g = waypoints(HalfSpace(vec(1.0, 1.0), num(0.8)))
    free = plans(Unconstrained(), g)
    assert float(g(free).max()) > 0.1
    torch.testing.assert_close(
        plans(FinalProjection(), g), free_projection(g, free), atol=1e-12, rtol=0
    )  # one formula


@pytest.fixture(scope="module")
def gaussian():
    return resolve(Request(task="gaussian2d", method="best-of-k", n=6, steps=20))


def test_best_of_one_is_the_unconstrained_plan(gaussian):
    one, free = (
        plan(gaussian.problem, method, gaussian.seeds) for method in (BestOf(1), Unconstrained())
    )
    np.testing.assert_array_equal(one.x, free.x)
    np.testing.assert_array_equal(one.trace, free.trace)
    np.testing.assert_array_equal(one.chain, free.chain)


def test_best_of_k_keeps_the_candidate_with_least_violation_and_counts_all_calls(gaussian):
    tight = replace(gaussian.problem, enforced=gaussian.problem.declared.tighten(3.0))
    best = plan(tight, BestOf(3), [0, 1, 2, 3])
    tries = [
        plan(tight, Unconstrained(), [candidate_seed(seed, j) for seed in range(4)])
        for j in range(3)
    ]
    unsafe = np.stack(
        [tight.enforced(torch.from_numpy(one.x)).clamp_min(0).sum(1) for one in tries]
    )
    chosen = unsafe.argmin(0)
    assert len(set(chosen)) > 1
    np.testing.assert_array_equal(best.x, [tries[j].x[i] for i, j in enumerate(chosen)])
    np.testing.assert_array_equal(best.chain[-1], best.x)
    np.testing.assert_array_equal(best.trace[:, 0, 2], tries[chosen[2]].trace[:, 0, 2])
    assert best.calls == 60


def test_best_of_k_keeps_the_first_candidate_where_it_is_safe(gaussian):
    free = plan(gaussian.problem, Unconstrained(), gaussian.seeds).x
    safe = (gaussian.problem.declared(torch.from_numpy(free)) <= 0).all(1).numpy()
    assert safe.sum() > 0
    np.testing.assert_array_equal(
        plan(gaussian.problem, BestOf(4), gaussian.seeds).x[safe], free[safe]
    )


def test_candidates_of_neighbouring_seeds_share_no_noise():
    seeds = [candidate_seed(seed, j) for seed in range(100) for j in range(8)]
    assert len(set(seeds)) == len(seeds)
    assert max(seeds) < 2**32  # torch's generator takes the low 32 bits of a seed


def test_class_attributes_of_the_methods():
    methods = {name: make_method(name, {}) for name in METHODS}
    assert {name for name, method in methods.items() if not method.enforces} == {
        "diffuser",
        "conditional",
    }
    assert {name for name, method in methods.items() if not method.polished} == {
        "diffuser",
        "best-of-k",
    }
    assert {name for name, method in methods.items() if method.planner == "conditional"} == {
        "conditional"
    }
    assert {method.candidates for name, method in methods.items() if name != "best-of-k"} == {1}
    assert make_method("best-of-k", {"k": 3}).candidates == 3
