"""Episodes that begin where they may not be: the shipped planners leave, no error is raised, and what was unsafe is counted."""

import gymnasium
import numpy as np
import pytest

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.evaluation import metrics
from cdiff_cli.planning.receding_horizon import rollout

SEEDS = (0, 1)


class Begun(gymnasium.Wrapper):
    """The environment, each episode of it begun by begin(env, seed)."""

    def __init__(self, env, begin):
        super().__init__(env)
        self.begin = begin

    def reset(self, *, seed=None, options=None):
        return self.begin(self.env, seed)


class Begins:
    """The task, its environments begun by begin(env, seed)."""

    def __init__(self, task, begin):
        self.task, self.begin = task, begin

    def __getattr__(self, name):
        return getattr(self.task, name)

    def make_env(self, **options):
        return Begun(self.task.make_env(**options), self.begin)


def acted(name, method, begin, steps):
    """(levels f of the executed states, unsafe above 0 [n, steps + 1], metrics of each episode)."""
    experiment = resolve(Request(task=name, method=method, n=len(SEEDS), device="cpu"))
    task, g = experiment.task, experiment.declared
    done = rollout(controller(experiment), Begins(task, begin), SEEDS, steps=steps)
    assert not done.diverged.any()
    levels = metrics.executed_levels(g, done.x, done.observed, task.dt)
    bound = np.ones(done.u.shape[2])
    return levels.max(-1), metrics.control_metrics(done, levels, (-bound, bound))


def beside(x, y, vx, vy):
    """The obstacle there, 1.2 m being the safety radius and 1 m contact."""
    return lambda env, seed: env.reset(seed=seed, options={"obstacle": (x, y, vx, vy)})


def turning(task, rate):
    """That coordinate of a walker at that rate, all others as they begin."""
    name, value = rate

    def begin(env, seed):
        env.reset(seed=seed)
        inner = env.unwrapped
        velocities = inner.data.qvel.copy()
        velocities[task.layout.index(name) - len(task.layout)] = (
            value  # a state ends with all velocities
        )
        inner.set_state(inner.data.qpos.copy(), velocities)
        return inner._get_obs(), {}

    return begin


@pytest.mark.parametrize(
    "where",
    [(1.05, 0.0, 0.0, 0.0), (1.1, 0.1, 0.0, 0.0), (1.1, 0.0, -0.5, 0.0), (0.0, 1.1, 0.0, -0.5)],
    ids=["ahead", "obliquely ahead", "coming on", "from the side"],
)
def test_a_ball_that_begins_inside_the_safety_radius_leaves_it_without_contact(where):
    f, rows = acted("ball-run", "alm", beside(*where), 30)
    assert (f[:, 0] > 0.05).all()
    assert (
        f[:, 20:] <= 0
    ).all()  # two thirds of a second: full force moves it by 1.6 m in that time
    for each, row in zip(f, rows, strict=True):
        assert row["contacts"] == 0
        assert row["safe_executed"] == 0
        assert row["violation_rate"] == pytest.approx(100 * (each > 1e-6).mean())


def test_without_the_constraint_the_same_ball_runs_into_the_obstacle():
    _, rows = acted("ball-run", "diffuser", beside(1.1, 0.1, 0.0, 0.0), 30)
    assert min(row["contacts"] for row in rows) > 0


LIMITS = {"hopper": 3.5, "swimmer": 5.0}
BEYOND = {
    "hopper up": (
        "hopper",
        ("thigh_velocity", 4.5),
    ),  # at 5 and more it falls with and without the constraint
    "hopper down": ("hopper", ("thigh_velocity", -5.0)),
    "swimmer up": ("swimmer", ("rotor2_velocity", 9.0)),
    "swimmer down": ("swimmer", ("rotor2_velocity", -9.0)),
}


def acted_from(case, method):
    name, rate = BEYOND[case]
    task = resolve(Request(task=name, n=1, device="cpu")).task
    return acted(name, method, turning(task, rate), 20)


@pytest.mark.parametrize("case", BEYOND)
def test_a_walker_that_begins_beyond_its_limit_comes_back_to_it(case):
    name, (_, value) = BEYOND[case]
    excess = abs(value) - LIMITS[name]
    f, rows = acted_from(case, "alm")
    np.testing.assert_allclose(f[:, 0], excess, atol=1e-9)
    assert (
        f[:, 5:] <= 0
    ).all()  # an exact barrier with alpha 0.85 leaves 0.15^5 of the excess; the margin covers more
    for each, row in zip(f, rows, strict=True):
        assert row["executed_worst"] == pytest.approx(each.max())
        assert row["executed_violation"] >= excess - 1e-9
        assert row["violation_rate"] == pytest.approx(100 * (each > 1e-6).mean())
        assert (row["safe_executed"], row["fell"]) == (0, 0)


def test_a_projected_walker_comes_back_to_within_its_own_error():
    """It rides its margin, which was fitted to walks, not to such a start: 0.15 rad/s is what it lacks here."""
    f, rows = acted_from("hopper down", "projected")
    assert f[:, 5:].max() <= 0.15
    assert max(row["fell"] for row in rows) == 0


def test_without_the_constraint_the_same_walker_stays_beyond_it():
    f, _ = acted_from("hopper down", "diffuser")
    assert (f[:, :15] > 0.15).all()
