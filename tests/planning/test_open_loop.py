"""Problems to plans: feasibility, pins, divergence, polish, and following a plan in the simulator."""

from dataclasses import replace

import numpy as np
import pytest

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import needed_speed, parse_settings, resolve
from cdiff_cli.errors import CdiffError, InfeasibleError
from cdiff_cli.models.preset import SamplerSettings
from cdiff_cli.planning.execution import follow
from cdiff_cli.planning.open_loop import plan
from cdiff_cli.planning.problem import POLISH_MARGIN, check_feasible
from cdiff_cli.planning.start_goal import parse_state
from cdiff_cli.sampling import make_method
from cdiff_cli.sampling.baselines import Unconstrained
from cdiff_cli.sampling.clean_methods import CleanProjected
from cdiff_cli.tasks import load_task


@pytest.fixture(scope="module")
def umaze():
    return resolve(Request(n=2))


def test_a_plan_of_a_seed_does_not_depend_on_its_batch(umaze):
    """Equal up to float32 rounding of differently batched convolutions."""
    both = plan(umaze.problem, Unconstrained(), [3, 4]).x
    alone = plan(umaze.problem, Unconstrained(), [4]).x
    np.testing.assert_allclose(both[1], alone[0], atol=2e-3)


def test_projection_on_the_clean_estimate_leaves_a_plan_that_already_obeys_unchanged(umaze):
    loose = replace(umaze.problem, enforced=umaze.problem.declared.tighten(-100.0))
    np.testing.assert_array_equal(
        plan(loose, CleanProjected(), [0]).x, plan(loose, Unconstrained(), [0]).x
    )


def test_polish_ends_a_margin_inside(umaze):
    plans = plan(
        replace(umaze.problem, enforced=umaze.problem.declared),
        CleanProjected(),
        [0, 1],
        SamplerSettings(polish=True),
    )
    values = plans.x[..., 0] - plans.x[..., 1] - 1.82
    assert values.max() <= -0.99 * POLISH_MARGIN
    assert plans.polish.max() < 1e-4


def test_calls_count_the_extra_steps(umaze):
    method = make_method("alm", {"on": "noisy"})
    problem = replace(umaze.problem, enforced=umaze.problem.declared)
    assert plan(problem, method, [0], SamplerSettings(extra_steps=3)).calls == (
        problem.planner.schedule.n_steps + 3
    )


def test_a_diverged_plan_is_said_aloud(umaze):
    lost = replace(umaze.planner, denoiser=lambda x, _: x * float("nan"))
    broken = replace(umaze.problem, planner=lost)
    with pytest.raises(CdiffError, match=r"seeds \[0\] diverged to NaN"):
        plan(broken, Unconstrained(), [0])


def test_a_start_outside_the_constraints_is_refused(umaze):
    with pytest.raises(InfeasibleError, match='"cut-corner" excludes the start'):
        check_feasible(replace(umaze.problem, declared=umaze.problem.declared.tighten(0.5)))


def test_random_pairs_are_free_allowed_and_within_the_data_speed():
    resolved = resolve(Request(n=20, random=True))
    task, card = resolved.task, resolved.checkpoint.card
    for start, goal in zip(resolved.problem.start, resolved.problem.goal, strict=True):
        assert task.is_free(start[:2], 0.1)
        assert start[0] - start[1] <= 1.82
        assert task.path_length(start[:2], goal[:2]) / (127 * 0.01) <= card.data["speed_q95"]


def test_needed_speed_of_the_paper_pair_is_its_route_over_the_horizon(umaze):
    """0.68 m right, 2.22 m up and 0.9 m left through the cell centres, in 1.27 s."""
    assert needed_speed(umaze)[0] == pytest.approx(3.62 / 1.27, abs=0.05)


def test_a_state_can_be_named_or_listed():
    task = load_task("maze2d-umaze")
    np.testing.assert_array_equal(parse_state("--start", "0.5,-1", None, task), [0.5, -1, 0, 0])
    np.testing.assert_array_equal(
        parse_state("--start", "y=-1,x=0.5,vx=2", None, task), [0.5, -1, 2, 0]
    )
    with pytest.raises(CdiffError, match="finite"):
        parse_state("--start", "nan,0", None, task)
    with pytest.raises(CdiffError, match="name=value"):
        parse_settings(["rho"])


def test_the_tracking_controller_reaches_a_straight_plan_goal():
    task = load_task("maze2d-umaze")
    tau = np.linspace(0, 1, 128)
    along = 3 * tau**2 - 2 * tau**3
    rate = np.gradient(along, 0.01)
    x = np.stack((-1 + 2 * along, np.ones(128), 2 * rate, np.zeros(128)), axis=1)[None]
    done = follow(task, x, [0])
    assert done.success.all()
    assert done.goal_distance[0] < 0.02
