"""Acting: replanning at every step, on a point mass whose planner and inverse dynamics are known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from cdiff_cli.constraints.observed import Observed
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.evaluation import metrics
from cdiff_cli.models.networks import InverseDynamics
from cdiff_cli.models.normaliser import Normaliser, ResidualNormaliser
from cdiff_cli.models.planner import Planner
from cdiff_cli.models.preset import ControlSettings, SamplerSettings
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.planning.episodes import Episodes
from cdiff_cli.planning.receding_horizon import Controller, rollout
from cdiff_cli.sampling.baselines import BestOf, Unconstrained
from cdiff_cli.sampling.clean_methods import (
    CleanAugmentedLagrangian,
    CleanPrimalDual,
    CleanProjected,
)
from cdiff_cli.sampling.methods import PrimalDual
from tests.problems import F64, chain, vec

DT, H = 0.1, 6


class Mass(gymnasium.Env):
    """p' = p + dt v, v' = v + dt u; it falls where p > fall."""

    action_space = gymnasium.spaces.Box(-10.0, 10.0, (1,), np.float32)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, fall: float) -> None:
        self.fall = fall

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = np.array([0.0, self.np_random.uniform(0.0, 0.1)])
        return self.x.copy(), {}

    def step(self, u):
        self.x = self.x + DT * np.array([self.x[1], float(u[0])])
        return (
            self.x.copy(),
            float(self.x[1]),
            bool(self.x[0] > self.fall),
            False,
            {"contact": self.x[1] > 0.5},
        )


@dataclass(frozen=True)
class MassTask:
    name = "mass"
    layout = ("p", "v")
    actions = ("u",)
    positions: tuple[str, ...] = ()
    invariant = ("p",)
    observable = ("clock",)
    dt = DT
    max_steps = 20

    def make_env(self, fall: float = np.inf) -> Mass:
        return Mass(fall)

    def observe(self, obs: Any) -> np.ndarray:
        return np.asarray(obs, dtype=np.float64)

    def observed(self, env: Mass) -> dict[str, float]:
        return {"clock": float(env.x[0])}


def inverse() -> InverseDynamics:
    """u = (v' - v) / dt, written as a network: silu(a) - silu(-a) = a, twice."""
    net = InverseDynamics(2, 1, 2)
    change = torch.tensor([[0.0, 0.0, 0.0, 1 / DT]])
    weights = {"layers.0.weight": torch.cat((change, -change)), "layers.0.bias": torch.zeros(2)}
    weights |= {
        "layers.2.weight": torch.tensor([[1.0, -1.0], [-1.0, 1.0]]),
        "layers.2.bias": torch.zeros(2),
    }
    weights |= {"layers.4.weight": torch.tensor([[1.0, -1.0]]), "layers.4.bias": torch.zeros(1)}
    net.load_state_dict(
        net.state_dict() | weights | {"low": torch.tensor([-10.0]), "high": torch.tensor([10.0])}
    )
    return net.requires_grad_(False)


def frame() -> ResidualNormaliser:
    """Windows that speed up by 0.1 a step: their mean is the plan."""
    k = torch.arange(H, dtype=F64)
    mean = torch.stack((torch.zeros(H, dtype=F64), 0.1 * k), 1)
    return ResidualNormaliser(
        Normaliser(vec(0.0, 0.0), vec(1.0, 1.0)),
        torch.tensor([False, True]),
        mean,
        torch.zeros(H, 2, 2, dtype=F64),
        torch.full((H, 2), 0.1, dtype=F64),
    )


def mean_window(x: torch.Tensor, t: int) -> torch.Tensor:
    return torch.cat((x[:, :1], torch.zeros_like(x[:, 1:])), 1)


LIMIT = chain(HalfSpace(vec(0.0, 1.0), vec(0.75).squeeze()), 0.5)
WARM = ControlSettings(warm_start=0.4)
PLAIN, POLISHED = SamplerSettings(), SamplerSettings(polish=True)
PLANNER = Planner(
    denoiser=mean_window,
    schedule=Schedule.cosine(3),
    normaliser=frame(),
    horizon=H,
    coordinates=MassTask.layout,
    dt=DT,
    inverse_dynamics=lambda x, following: inverse()(
        *(torch.from_numpy(states).float() for states in (x, following))
    ).numpy(),
)
FREE = Controller(PLANNER, LIMIT, Unconstrained(), sampler=PLAIN)
HELD = replace(FREE, method=CleanProjected(), sampler=POLISHED)


def act(controller: Controller, seeds: Sequence[int], env: Any = None, **options: Any) -> Episodes:
    return rollout(controller, MassTask(), seeds, env, **options)


def asking(denoiser: Any) -> Planner:
    return replace(PLANNER, denoiser=denoiser)


class Plain:
    """The answers of a method that ignores the constraints."""

    enforces, polished, candidates, planner = False, False, 1, "unconditional"


def same(a: Episodes, b: Episodes, rows: slice) -> None:
    for name in ("x", "u", "reward", "predicted", "violation"):
        np.testing.assert_array_equal(getattr(a, name)[rows], getattr(b, name))


def test_the_plan_is_followed_exactly_by_the_exact_inverse_dynamics():
    done = act(FREE, [0, 1])
    np.testing.assert_allclose(
        done.x[:, 1:, 1] - done.x[:, :-1, 1], 0.1, atol=1e-5
    )  # the network is float32
    np.testing.assert_allclose(done.x[:, :, 1], done.predicted[:, :, 1], atol=1e-5)
    np.testing.assert_allclose(done.observed["clock"], done.x[..., 0])


def test_an_episode_does_not_depend_on_its_neighbours():
    same(act(FREE, [3, 4, 5]), act(FREE, [4]), slice(1, 2))


def test_projected_plans_never_let_the_speed_pass_its_limit():
    free, held = (
        act(FREE, [0, 1]),
        act(HELD, [0, 1]),
    )
    assert free.x[:, :, 1].max() > 1.5
    assert held.x[:, :, 1].max() <= 0.75 + 1e-5
    assert held.x[:, -1, 1].min() > 0.7  # and come close to it
    assert held.violation.max() == 0.0
    assert free.violation.max() > 0.1


def test_a_barrier_approaches_its_limit_no_faster_than_alpha_allows():
    held = act(HELD, [0])
    h = 0.75 - held.x[0, :, 1]
    assert (h[1:] >= 0.5 * h[:-1] - 1e-5).all()


def test_each_plan_is_followed_for_as_many_steps_as_asked():
    done = act(replace(FREE, control=ControlSettings(execute=4)), [0], steps=10)
    assert np.isfinite(done.violation[0]).nonzero()[0].tolist() == [0, 4, 8]
    assert len(done.latency_s) == 3
    np.testing.assert_allclose(done.x[0, 1:, 1] - done.x[0, :-1, 1], 0.1, atol=1e-5)
    np.testing.assert_allclose(done.predicted[0, :, 1], done.x[0, :, 1], atol=1e-4)


def test_an_episode_that_falls_ends_alone():
    done = act(FREE, [0, 1], {"fall": 0.5}, steps=20)
    assert done.fell.all()
    ends = np.isfinite(done.reward).sum(1)
    assert (ends < 20).all()
    for i, end in enumerate(ends):
        assert np.isnan(done.x[i, end + 1 :]).all()
        assert done.x[i, end, 0] > 0.5 >= done.x[i, end - 1, 0]


def test_a_plan_that_is_not_finite_ends_its_episode_and_no_other():
    def broken(x: torch.Tensor, t: int) -> torch.Tensor:
        z = mean_window(x, t)
        return torch.where(x[:, :1, 1:] > 0.55, torch.nan, z)

    slow = act(replace(FREE, planner=asking(broken)), [0, 1])
    assert slow.diverged.all()
    assert not slow.fell.any()
    assert 4 <= np.isfinite(slow.reward[0]).sum() <= 7


def test_disturbed_inputs_are_recorded_as_executed():
    done = act(replace(FREE, control=ControlSettings(action_noise=0.1)), [0], steps=8)
    np.testing.assert_allclose(np.diff(done.x[0, :, 1]), DT * done.u[0, :, 0], atol=1e-6)
    assert done.u[0, :, 0].std() > 0.3


def test_a_warm_plan_redoes_its_share_of_the_steps():
    calls = []

    def counted(x: torch.Tensor, t: int) -> torch.Tensor:
        calls.append(t)
        return mean_window(x, t)

    warm = replace(FREE, planner=asking(counted), control=WARM)
    act(warm, [0], steps=3)
    assert calls == [3, 2, 1, 1, 1]
    assert warm.calls == 1


def test_executed_levels_are_scored_against_what_was_observed_then():
    done = act(FREE, [0, 1], steps=5)
    levels = metrics.executed_levels(LIMIT, done.x, done.observed, DT)
    np.testing.assert_allclose(levels[..., 0], done.x[..., 1] - 0.75)
    np.testing.assert_allclose(
        done.predicted_levels[:, 1:, 0], done.predicted[:, 1:, 1] - 0.75, atol=1e-6
    )


def test_metrics_of_an_episode():
    done = act(FREE, [0], steps=10)
    levels = metrics.executed_levels(LIMIT, done.x, done.observed, DT)
    (row,) = metrics.control_metrics(done, levels, (np.array([-10.0]), np.array([10.0])))
    over = np.clip(done.x[0, :, 1] - 0.75, 0, None)
    assert row["executed_violation"] == pytest.approx(over.sum())
    assert row["violation_rate"] == pytest.approx(100 * (over > 1e-6).mean())
    assert row["contacts"] == (done.x[0, 1:, 1] > 0.5).sum()
    assert (row["fell"], row["saturation"], row["steps"]) == (0.0, 0.0, 10.0)


def test_waypoint_constraints_ask_nothing_of_the_state_that_is_already_there():
    """The present state may be unsafe: what can still move is made safe, with no error."""
    held = Constraint(
        (AtWaypoints("speed", HalfSpace(vec(0.0, 1.0), torch.tensor(0.01, dtype=F64))),)
    )
    done = act(replace(HELD, declared=held), [0], steps=5)
    assert done.x[0, 0, 1] > 0.01
    assert done.x[0, 1:, 1].max() <= 0.01 + 1e-5


def test_where_no_plan_obeys_the_agent_brakes_and_it_is_counted():
    """Two bounds that exclude each other; the brake takes a tenth of the speed."""
    narrow = (AtWaypoints("low", HalfSpace(vec(0.0, 1.0), torch.tensor(0.2, dtype=F64))),)
    narrow += (AtWaypoints("high", HalfSpace(vec(0.0, -1.0), torch.tensor(-0.4, dtype=F64))),)
    never = Constraint(narrow)
    acting = replace(HELD, declared=never, fallback_action=lambda x: -x[1:])
    done = act(acting, [0], steps=5)
    assert (done.braked == 1).all()
    np.testing.assert_allclose(done.x[0, 1:, 1], 0.9 * done.x[0, :-1, 1], atol=1e-6)
    (row,) = metrics.control_metrics(
        done,
        metrics.executed_levels(never, done.x, done.observed, DT),
        (vec(-10).numpy(), vec(10).numpy()),
    )
    assert row["braked"] == 100.0
    assert np.isfinite(
        [row["latency_ms"], row["overhead"]]
    ).all()  # where no network call came through, too
    assert (act(replace(acting, enforced=LIMIT), [0], steps=5).braked == 0).all()


def test_what_a_step_tells_reaches_the_method():
    """SafeDiffuser's variants ask how many steps are left."""
    told = []

    class Asked(Plain):
        def init(self, x, g):
            return None

        def step(self, step, g, state):
            told.append((step.left, step.last))
            return step.reverse(step.x0), state

    act(replace(FREE, method=Asked()), [0], steps=1)
    assert told == [(2, False), (1, False), (0, True)]


def test_what_a_warm_plan_does_not_reach_goes_on_as_the_frame_foresees():
    """A plan that leaves the frame's mean by 0.3 everywhere, followed for two steps, without noise: its last two waypoints are the
    mean again, and not where it stood at its end.
    """
    seen = []

    def off(x: torch.Tensor, t: int) -> torch.Tensor:
        seen.append((t, x))
        return torch.where(torch.arange(H)[:, None] > 0, 0.3, x)

    cold = SamplerSettings(temperature=0.0)
    two = ControlSettings(warm_start=0.4, execute=2)
    act(replace(FREE, planner=asking(off), sampler=cold, control=two), [0], steps=4)
    assert [t for t, _ in seen] == [3, 2, 1, 1]
    began = seen[-1][1][0]
    assert (began[-2:] == 0).all()
    assert (began[1:-2].abs() > 0.01).any()


def observed_limit() -> Constraint:
    """v <= 0.75, told anew at each step."""

    def make(seen, dt, horizon):
        return AtWaypoints("speed", HalfSpace(vec(0.0, 1.0), 0.75 + 0 * seen["clock"][:, None]))

    return Constraint((Observed("speed", ("clock",), make),))


def test_a_warm_plan_that_no_longer_obeys_what_is_observed_is_made_anew():
    """Plans speed up by 0.1 a step from below 0.1, over five steps: the third or fourth is the first that comes to the limit."""
    told = observed_limit()
    acting = replace(HELD, control=WARM, declared=told)
    done = act(acting, range(6), steps=5)
    np.testing.assert_array_equal(done.calls[:, :2], [[3, 1]] * 6)
    for i, start in enumerate(done.x[:, 0, 1]):
        np.testing.assert_array_equal(done.calls[i, 2:], [3 if start > 0.05 else 1, 3, 3])
    same(done, act(acting, [4], steps=5), slice(4, 5))
    assert len(set(done.calls[:, 2])) == 2  # some of them together, some not
    known = Constraint((AtWaypoints("speed", HalfSpace(vec(0.0, 1.0), vec(0.75).squeeze())),))
    for other in (
        replace(acting, declared=known),
        replace(acting, method=Unconstrained(), sampler=PLAIN),
    ):
        np.testing.assert_array_equal(act(other, [0], steps=5).calls, [[3, 1, 1, 1, 1]])


def test_multipliers_do_not_outlast_what_is_observed():
    counts = Counting()
    told = observed_limit()
    act(replace(FREE, method=counts, control=WARM, declared=told), [0], steps=4)
    assert counts.begun == [[0], [1], [2], [0], *[[0], [1], [2]] * 2]


class Counting(Plain):
    # It satisfies something, so that a warm start is watched.
    polished = True

    """Unconstrained; its multipliers, one row of the plan's chain each, count the steps."""

    def init(self, x, g):
        return torch.zeros(len(x), H - 1)

    def step(self, step, g, state):
        self.begun = [*getattr(self, "begun", []), state[:, 0].tolist()]
        return step.reverse(step.x0), state + 1


def test_multipliers_go_on_from_plan_to_plan_where_that_is_asked_those_of_each_episode_its_own():
    fresh, kept = Counting(), Counting()
    act(replace(FREE, method=fresh), [0], steps=2)
    act(replace(FREE, method=kept, control=ControlSettings(carry_multipliers=True)), [0], steps=2)
    assert fresh.begun == [[0], [1], [2]] * 2
    assert kept.begun == [[0], [1], [2], [3], [4], [5]]


def test_the_safest_of_k_plans_is_executed():
    """Plans whose speed is noise alone, on an episode's own draws: the more there are, the less the one that is kept is over."""

    def noisy(x: torch.Tensor, t: int) -> torch.Tensor:
        return x

    low = chain(HalfSpace(vec(0.0, 1.0), vec(0.1).squeeze()), 0.5)
    acting = replace(FREE, planner=asking(noisy), declared=low)
    one, many = (act(replace(acting, method=BestOf(k)), [0, 1, 2], steps=4) for k in (1, 16))
    assert many.violation[:, :4].mean() < 0.7 * one.violation[:, :4].mean()
    same(
        one, act(acting, [0, 1, 2], steps=4), slice(0, 3)
    )  # the first candidate is the seed's own plan
    same(many, act(replace(acting, method=BestOf(16)), [1], steps=4), slice(1, 2))
    assert replace(acting, method=BestOf(16)).calls == 48


def test_a_candidate_that_is_not_finite_is_not_kept():
    def broken(x: torch.Tensor, t: int) -> torch.Tensor:
        z = mean_window(x, t)
        return torch.cat((torch.full_like(z[:1], torch.nan), z[1:]))

    assert not act(
        replace(FREE, planner=asking(broken), method=BestOf(2)), [0], steps=3
    ).diverged.any()


@pytest.mark.parametrize(
    "method", [CleanProjected(), CleanPrimalDual(), PrimalDual(eta=0.1), CleanAugmentedLagrangian()]
)
def test_rows_as_one_matrix_give_the_plans_that_part_by_part_gives(method, monkeypatch):
    """To 1e-6: the order of additions in float32 differs."""
    both = Constraint(
        (*LIMIT.parts, *chain(HalfSpace(vec(0.0, -1.0), vec(0.2).squeeze()), 0.3).parts)
    )
    acting = replace(FREE, method=method, declared=both, sampler=POLISHED)
    assert acting.condensed is not None
    fast = act(acting, [0, 1, 2])
    monkeypatch.setattr("cdiff_cli.constraints.trajectory.Constraint.condense", lambda *_: None)
    plain = act(replace(acting), [0, 1, 2])
    np.testing.assert_allclose(fast.x, plain.x, atol=1e-6)
    np.testing.assert_allclose(fast.predicted, plain.predicted, atol=1e-6)
    assert fast.violation.max() == plain.violation.max() or method.on == "noisy"
