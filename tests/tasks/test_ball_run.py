"""Ball run: SafetyBallRun's physics, the six patterns of the obstacle, contact, demonstrations."""

import hashlib
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from cdiff_cli.errors import CdiffError
from cdiff_cli.tasks.ball_run.env import DT, ENV_ID, RADIUS, BallRunEnv
from cdiff_cli.tasks.ball_run.obstacles import ACCELERATION, PATTERNS
from cdiff_cli.tasks.ball_run.task import BALL_RUN, BURST
from cdiff_cli.training import demonstrations

ROOT = Path(__file__).parents[2]
GOLDEN = json.loads((Path(__file__).parents[1] / "data" / "ball_run_golden.json").read_text())
SEEDS = range(5)


def run(env, seed, steps=100, throttle=0.35):
    """States of ball and obstacle [steps + 1, 4], and the last info, at about 4 m/s along y = 0."""
    obs, info = env.reset(seed=seed)
    ball, obstacle = [BALL_RUN.observe(obs)], [list(BALL_RUN.observed(env).values())]
    for _ in range(steps):
        x = ball[-1]
        push = throttle if x[2] < 4.0 else 0.15
        obs, _, _, _, info = env.step(np.array([push, -0.6 * x[1] - 0.4 * x[3]], dtype=np.float32))
        ball.append(BALL_RUN.observe(obs))
        obstacle.append(list(BALL_RUN.observed(env).values()))
    return np.array(ball), np.array(obstacle), info


def distance(ball, obstacle):
    return np.linalg.norm(ball[:, :2] - obstacle[:, :2], axis=1)


def trace(seed=3, pattern="chaser"):
    """sha256 of every observation of an episode: equal only if the runs are equal to the bit."""
    env = BallRunEnv(pattern)
    obs, _ = env.reset(seed=seed)
    rng, sha = np.random.default_rng(seed), hashlib.sha256(obs.tobytes())
    for _ in range(100):
        sha.update(env.step(rng.uniform(-1, 1, 2))[0].tobytes())
    env.close()
    return sha.hexdigest()


def test_physics_and_reward_are_those_of_safety_ball_run():
    env = BallRunEnv("none")
    obs, _ = env.reset(options={"start": GOLDEN["start"]})
    seen, rewards = [obs], []
    for u in GOLDEN["actions"]:  # some beyond 1: they are clipped
        obs, reward, terminated, truncated, _ = env.step(np.array(u))
        assert (terminated, truncated) == (False, False)
        seen.append(obs)
        rewards.append(reward)
    golden = np.array(GOLDEN["observations"])
    # one pybullet on one machine gives equal digits; 1e-4 allows for another compiler
    np.testing.assert_allclose(
        BALL_RUN.observe(np.array(seen)), BALL_RUN.observe(golden), atol=1e-4
    )
    np.testing.assert_allclose(np.array(seen)[:, 4:], golden[:, 4:], atol=1e-4)
    np.testing.assert_allclose(rewards, GOLDEN["rewards"], atol=1e-4)


@pytest.mark.parametrize(
    "options", [{}, {"pattern": "leader", "collide": False}, {"pattern": "none"}], ids=str
)
def test_environment_passes_gymnasiums_checker(options):
    from gymnasium.utils.env_checker import check_env

    env = gymnasium.make(ENV_ID, render_mode="rgb_array", **options)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # advice on spaces symmetric about 0 and on metadata
        check_env(env.unwrapped)
    env.close()


def test_episode_is_truncated_after_100_steps():
    env = BALL_RUN.make_env()
    env.reset(seed=0)
    ends = [env.step(np.ones(2, dtype=np.float32))[2:4] for _ in range(100)]
    assert ends == [(False, False)] * 99 + [(False, True)]


def python(code):
    """Status, output and errors of a new process that runs the code."""
    paths = os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        env=paths,
    )
    return done.returncode, done.stdout, done.stderr


def test_two_processes_get_the_same_episode_to_the_bit():
    assert python("from tests.tasks.test_ball_run import trace; print(trace(), end='')") == (
        0,
        trace(),
        "",
    )


def test_importing_the_environment_prints_nothing():
    assert python("import cdiff_cli.tasks.ball_run.env as b; b.BallRunEnv().close()") == (0, "", "")


def test_episode_does_not_depend_on_earlier_episodes():
    env = BallRunEnv("oncoming")
    first = run(env, 1)
    run(env, 2)
    np.testing.assert_array_equal(run(env, 1)[0], first[0])


def test_seed_sets_the_pattern_unless_one_is_given():
    env = BallRunEnv()
    assert [env.reset(seed=seed)[1]["pattern"] for seed in range(12)] == 2 * list(PATTERNS)
    assert env.reset()[1]["pattern"] in PATTERNS
    assert BallRunEnv("chaser").reset(seed=0)[1]["pattern"] == "chaser"


@pytest.mark.parametrize("pattern", PATTERNS)
def test_obstacle_moves_by_its_observed_velocity(pattern):
    _, obstacle, _ = run(BallRunEnv(pattern), 4)
    moved = np.diff(obstacle[:, :2], axis=0) / DT
    np.testing.assert_allclose(
        moved, obstacle[:-1, 2:], atol=1e-9
    )  # rounding of sums of 1e-2 metres
    assert (
        np.linalg.norm(obstacle[:, 2:], axis=1).max() < 5.5
    )  # m/s: the chaser's 5.0 is the fastest


@pytest.mark.parametrize("pattern", ["random-waypoint", "chaser"])
def test_steering_patterns_have_bounded_acceleration(pattern):
    _, obstacle, _ = run(BallRunEnv(pattern), 4)
    assert np.linalg.norm(np.diff(obstacle[:, 2:], axis=0), axis=1).max() < ACCELERATION * DT + 1e-9


@pytest.mark.parametrize("seed", SEEDS)
def test_pattern_moves_as_its_name_says(seed):
    o = {name: run(BallRunEnv(name, collide=False), seed) for name in PATTERNS}
    assert (o["oncoming"][1][:, 2] < 0).all()
    assert o["oncoming"][1][0, 0] > 5
    assert o["crossing"][1][0, 1] * o["crossing"][1][-1, 1] < 0  # from one side to the other
    assert (o["leader"][1][:, 2] > 0).all()
    assert o["leader"][1][0, 0] > 2
    loop = o["circling"][1][:, :2]
    centre = (loop.min(0) + loop.max(0)) / 2
    turned = np.unwrap(np.arctan2(*(loop - centre).T[::-1]))
    assert abs(turned[-1] - turned[0]) > 1.0  # rad
    assert (
        o["random-waypoint"][1][:, :2].max(0) - o["random-waypoint"][1][:, :2].min(0)
    ).max() > 1.0
    behind = o["chaser"][1]
    assert behind[0, 0] < -1.9
    heading = o["chaser"][0][-1, :2] - behind[-1, :2]
    assert heading @ behind[-1, 2:] > 0 or np.linalg.norm(heading) < 1


@pytest.mark.parametrize("pattern", PATTERNS)
def test_obstacle_starts_away_from_the_ball_and_meets_one_that_ignores_it(pattern):
    env = BallRunEnv(pattern, collide=False)
    gaps = [distance(*run(env, seed)[:2]) for seed in SEEDS]
    assert min(gap[0] for gap in gaps) > 2.0
    assert min(gap.min() for gap in gaps) < 1.2


def test_contacts_are_counted_with_solid_balls_and_not_with_a_ghost():
    block = {"start": (0.0, 0.0), "obstacle": (1.5, 0.0, 0.0, 0.0)}
    ends = {}
    for collide in (True, False):
        env = BallRunEnv("oncoming", collide=collide)
        env.reset(seed=0, options=block)
        infos = [env.step(np.array([1.0, 0.0], dtype=np.float32)) for _ in range(40)]
        ends[collide] = (
            BALL_RUN.observe(infos[-1][0])[0],
            infos[-1][4]["contacts"],
            sum(i[4]["contact"] for i in infos),
        )
    assert (
        ends[True][0] < 1.5 - 2 * RADIUS + 0.05
    )  # the balls stop at contact, with a few centimetres of overlap in a substep
    assert ends[True][1] == ends[True][2] > 0
    assert ends[False][0] > 3.0
    assert ends[False][1] == 0


def test_ball_hit_by_the_obstacle_is_pushed():
    env = BallRunEnv("oncoming")
    env.reset(seed=0, options={"obstacle": (-1.5, 0.0, 3.0, 0.0)})
    for _ in range(60):
        obs, _, _, _, info = env.step(np.zeros(2, dtype=np.float32))
    x, o = BALL_RUN.observe(obs), BALL_RUN.observe(obs[7:])
    assert info["contacts"] > 20
    np.testing.assert_allclose(
        o, [-1.5 + 60 * DT * 3.0, 0.0, 3.0, 0.0], atol=1e-9
    )  # the ball does not deflect it
    assert x[2] == pytest.approx(3.0, abs=0.05)  # m/s, the speed of the obstacle
    assert np.hypot(*(x - o)[:2]) == pytest.approx(2 * RADIUS, abs=0.01)


def test_picture_shows_both_balls():
    env = BALL_RUN.make_env(render=True, pattern="leader")
    env.reset(seed=0)
    picture = env.render().astype(int)
    assert picture.shape == (240, 320, 3)
    red, _, blue = picture[..., 0], picture[..., 1], picture[..., 2]
    assert (blue - red > 60).sum() > 100
    assert (red - blue > 90).sum() > 100
    env.close()


def test_environment_reports_the_observable_quantities():
    env = BALL_RUN.make_env(pattern="circling")
    obs, _ = env.reset(seed=0)
    seen = BALL_RUN.observed(env)
    assert tuple(seen) == BALL_RUN.observable
    np.testing.assert_allclose(BALL_RUN.observe(obs[7:]), list(seen.values()))
    assert BALL_RUN.observed(BALL_RUN.make_env(pattern="none")) == {}


def test_unknown_pattern_error_lists_the_known_ones():
    with pytest.raises(CdiffError, match=r'no pattern "chasr".*chaser'):
        BallRunEnv("chasr")


@pytest.fixture(scope="module")
def demonstrated():
    return list(BALL_RUN.demonstrate(6000, 0))


def test_demonstrations_are_runs_and_bursts_shorter_than_a_window(demonstrated):
    lengths = [len(rows["actions"]) for rows in demonstrated]
    assert lengths[:-1:2] == [100] * len(lengths[:-1:2])
    assert set(lengths[1:-1:2]) == {BURST}
    assert sum(lengths) == 6000
    assert BALL_RUN.horizon > BURST + 1
    returns = [sum(rows["rewards"]) for rows in demonstrated if len(rows["actions"]) == 100]
    assert (
        580 < np.mean(returns) < 740
    )  # 657 +- 114 over 1500 runs: five standard errors of 55 runs
    states = np.concatenate(
        [BALL_RUN.observe(np.stack(rows["observations"])) for rows in demonstrated[::2]]
    )
    assert np.abs(states[:, 1]).max() < 3.0


def test_demonstrations_are_a_function_of_their_seed(demonstrated):
    again = list(BALL_RUN.demonstrate(500, 0))
    for rows, same in zip(again[:4], demonstrated[:4], strict=True):
        np.testing.assert_array_equal(rows["actions"], same["actions"])
        np.testing.assert_array_equal(rows["observations"], same["observations"])
    other = next(BALL_RUN.demonstrate(100, 1))
    assert not np.array_equal(other["actions"], demonstrated[0]["actions"])


def test_demonstrations_are_recorded_and_read_back(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episodes = demonstrations.demonstrations(BALL_RUN, 330, 0)
    assert [len(episode) for episode in episodes] == 3 * [101, BURST + 1]
    first = next(BALL_RUN.demonstrate(330, 0))
    np.testing.assert_allclose(
        episodes[0], BALL_RUN.observe(np.stack(first["observations"])), atol=1e-12
    )
