"""Hopper and Swimmer: layout in MuJoCo, shipped gaits, demonstrations, search for gaits."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.spec.load import load_constraints
from cdiff_cli.errors import CdiffError
from cdiff_cli.tasks.maze2d import UMAZE
from cdiff_cli.tasks.mujoco import gait_search, locomotion
from cdiff_cli.tasks.mujoco.gait_search import SEARCHES, Whitening, measure, search_gait
from cdiff_cli.tasks.mujoco.locomotion import BRANCH_SHARE, HOPPER, SWIMMER, Gait
from cdiff_cli.tasks.protocol import observed_in, walls_of
from cdiff_cli.training.demonstrations import demonstrations, load_dataset

TASKS = [HOPPER, SWIMMER]
each_task = pytest.mark.parametrize("task", TASKS, ids=lambda task: task.name)
HORIZON = 16
ROOT = Path(__file__).parents[2]
RETURN = {"hopper": 3150.0, "swimmer": 340.0}
"""Least mean return of an expert over 20 new seeds."""


@pytest.fixture(scope="module", params=TASKS, ids=lambda task: task.name)
def demonstrated(request):
    return request.param, list(request.param.demonstrate(5000, 1))


# the environments ---------------------------------------------------------------------------------


@each_task
def test_layout_is_that_of_the_environment(task):
    env = task.make_env()
    own = env.unwrapped
    obs, _ = env.reset(seed=0)
    joints = [own.model.joint(i).name for i in range(own.model.njnt)]
    env.close()
    assert own.dt == pytest.approx(task.dt)
    assert env.action_space.shape == (len(task.actions),)
    assert len(task.observe(obs)) == len(task.layout)
    assert np.array_equal(
        task.observe(obs), np.concatenate((own.data.qpos, own.data.qvel))[-len(task.layout) :]
    )
    at, first = {"hopper": (8, "thigh_joint"), "swimmer": (7, "motor2_rot")}[task.name]
    assert task.layout[at] == {"hopper": "thigh_velocity", "swimmer": "rotor2_velocity"}[task.name]
    assert joints[at - len(task.layout)] == first  # velocities come last, one per joint


@each_task
def test_episode_of_observations_equals_its_single_observations(task):
    rows = np.arange(3.0 * len(task.layout), dtype=np.float32).reshape(3, -1)
    assert task.observe(rows).dtype == np.float64
    assert np.array_equal(task.observe(rows), np.stack([task.observe(row) for row in rows]))


def test_locomotion_has_no_observed_quantities_and_no_walls():
    env = SWIMMER.make_env()
    assert observed_in(SWIMMER, env) == {}
    env.close()
    assert walls_of(SWIMMER).shape == (0, 4)


# the shipped gaits --------------------------------------------------------------------------------


@each_task
def test_shipped_gaits_reach_their_return_without_a_fall(task):
    env = task.make_env().unwrapped
    for gait in task.experts():
        outs = [task.walk(env, gait, seed) for seed in (30_000, 30_001)]
        assert [out.fell for out in outs] == [False, False]
        assert (
            np.mean([out.reward for out in outs]) >= 0.98 * RETURN[task.name]
        )  # two episodes spread by about 1 %


@each_task
def test_recorded_returns_reach_the_required_levels(task):
    path = ROOT / "models" / task.name / "expert.json"
    policies = json.loads(path.read_text())["policies"]
    assert len({policy["seed"] for policy in policies}) == len(policies) >= 2  # several gaits
    for policy in policies:
        assert policy["returns"][0]["noise"] == 0.0
        assert policy["returns"][0]["mean"] >= RETURN[task.name]
        assert [(row["n"], row["falls"]) for row in policy["returns"]] == [(20, 0)] * len(
            SEARCHES[task.name].test
        )


@each_task
def test_recorded_return_is_reproduced_by_its_episodes(task):
    path = ROOT / "models" / task.name / "expert.json"
    policy = json.loads(path.read_text())["policies"][0]
    least = policy["returns"][0]
    again = measure(task, task.experts()[0], 0.0, gait_search.TEST[:2])
    assert least["min"] - 0.1 <= again["min"]  # printed to one decimal
    assert again["mean"] == pytest.approx(least["mean"], abs=4 * least["sd"] + 1)


def test_hopper_without_input_falls():
    env = HOPPER.make_env().unwrapped
    out = HOPPER.walk(env, Gait(np.zeros((3, 11)), np.zeros(3)), 0)
    assert out.fell
    assert 20 < out.steps < 400


BAD = {
    "no file": (None, "no readable gaits"),
    "no json": ("{", "no readable gaits"),
    "no policies": ('{"policies": []}', r"expected policies with W of shape \(2, 8\)"),
    "another task's": (
        '{"policies": [{"W": [[1, 2]], "b": [0]}]}',
        r"expected policies with W of shape \(2, 8\)",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_unreadable_gaits_error_names_the_search_command(case, tmp_path, monkeypatch):
    text, said = BAD[case]
    (tmp_path / "models" / "swimmer").mkdir(parents=True)
    (tmp_path / "constraints").mkdir()
    if text is not None:
        (tmp_path / "models" / "swimmer" / "expert.json").write_text(text)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CdiffError, match=said) as caught:
        SWIMMER.experts()
    assert str(caught.value).startswith("models/swimmer/expert.json: ")


# demonstrations -----------------------------------------------------------------------------------


def test_demonstrations_have_exactly_the_requested_steps(demonstrated):
    _, episodes = demonstrated
    assert sum(len(episode["actions"]) for episode in episodes) == 5000
    for episode in episodes:
        assert (
            len(episode["observations"]) - 1
            == len(episode["actions"])
            == len(episode["rewards"])
            > 0
        )


def test_most_steps_are_in_windows_and_a_tenth_in_branches(demonstrated):
    _, episodes = demonstrated
    lengths = np.array([len(episode["actions"]) for episode in episodes])
    short = lengths[lengths + 1 < HORIZON].sum() / lengths.sum()
    assert (
        BRANCH_SHARE - 0.03 < short < BRANCH_SHARE + 0.12
    )  # the branches of the last walk may be cut off; bursts come on top


@pytest.mark.parametrize(("suffix", "share"), [("", 0.05), ("-hard", 0.1)])
def test_shipped_limits_are_the_stated_quantiles_of_the_walks(demonstrated, suffix, share):
    task, episodes = demonstrated
    kinds, _ = load_constraints(
        ROOT / "constraints" / f"{task.name}{suffix}.yaml", task.name, task.layout
    )
    (limit,) = {kind.barrier.b for kind in kinds}
    (name,) = {name for kind in kinds for name in kind.barrier.a}
    assert sorted(kind.barrier.a[name] for kind in kinds) == [-1.0, 1.0]
    walks = np.concatenate(
        [np.array(e["observations"]) for e in episodes if len(e["observations"]) >= HORIZON]
    )
    beyond = np.abs(walks[:, task.layout.index(name)]) > limit
    assert beyond.mean() == pytest.approx(
        share, abs=0.03
    )  # five walks of 1000 steps against the 180 behind the limit


def test_recorded_actions_are_clipped_and_reproduce_the_recorded_states(demonstrated):
    task, episodes = demonstrated
    assert max(np.abs(np.stack(episode["actions"])).max() for episode in episodes) <= 1.0
    env, q = (
        task.make_env().unwrapped,
        {"hopper": 5, "swimmer": 3}[task.name],
    )  # number of coordinates that are joint positions
    env.reset(seed=0)
    for before, u, after in (tuple(e[k][i] for k, i in STEP) for e in episodes[::50]):
        if np.abs(before).max() < 10:  # the state is unknown where Hopper clips its velocities
            env.set_state(np.concatenate((env.data.qpos[:-q], before[:q])), before[q:])
            # contact forces start from the last step's, to the solver's tolerance: 1e-3 rad/s
            assert env.step(u)[0] == pytest.approx(after, abs=2e-2)


STEP = (("observations", 0), ("actions", 0), ("observations", 1))


@each_task
def test_demonstrations_repeat_with_their_seed(task):
    first, again, other = (
        [e["actions"] for e in task.demonstrate(1300, seed)] for seed in (3, 3, 4)
    )
    assert np.array_equal(np.concatenate(first), np.concatenate(again))
    assert not np.array_equal(np.concatenate(first), np.concatenate(other))


def test_gaits_alternate_with_and_without_bursts(monkeypatch):
    gaits = [Gait(np.zeros((2, 8)), np.full(2, b)) for b in (-0.5, 0.5)]
    monkeypatch.setattr(type(SWIMMER), "experts", lambda _: gaits)
    task = replace(SWIMMER, noise={0.0: 1.0}, max_steps=300)
    walked = [
        np.stack(e["actions"])
        for e in task.demonstrate(4000, 0)
        if len(e["observations"]) >= HORIZON
    ]
    assert all((u == u[0, 0]).all() for u in walked)
    turns = [(float(u[0, 0]), len(u) == 300) for u in walked]
    assert {*turns} == {(-0.5, True), (-0.5, False), (0.5, True), (0.5, False)}
    steps = [sum(len(u) for u in walked if u[0, 0] == b) for b in (-0.5, 0.5)]
    assert steps[0] / sum(steps) == pytest.approx(
        0.5, abs=0.1
    )  # an unfinished turn leaves two of about 14 walks over


def test_only_the_named_gaits_are_demonstrated(monkeypatch):
    monkeypatch.setattr(
        type(SWIMMER),
        "experts",
        lambda _: [Gait(np.zeros((2, 8)), np.full(2, b)) for b in (-0.5, 0.5)],
    )
    task = replace(SWIMMER, noise={0.0: 1.0}, max_steps=300, gaits=(1,))
    for episode in task.demonstrate(1500, 0):
        if len(episode["observations"]) >= HORIZON:
            assert (np.stack(episode["actions"]) == 0.5).all()


def test_no_window_ends_in_a_fall(monkeypatch):
    monkeypatch.setattr(type(HOPPER), "experts", lambda _: [Gait(np.zeros((3, 11)), np.zeros(3))])
    monkeypatch.setattr(locomotion, "BURST_EVERY", np.inf)  # a burst would cut the fall in two
    episodes = list(HOPPER.demonstrate(1000, 0))
    assert max(len(episode["observations"]) for episode in episodes) < HORIZON


def test_minari_returns_the_demonstrated_observations(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    stored = demonstrations(SWIMMER, 1200, 0)
    made = list(SWIMMER.demonstrate(1200, 0))
    assert [len(states) for states in stored] == [len(episode["observations"]) for episode in made]
    assert np.array_equal(
        np.concatenate(stored), np.concatenate([np.array(e["observations"]) for e in made])
    )
    with pytest.raises(CdiffError, match="but hopper has 11 coordinates"):
        load_dataset(HOPPER, "cdiff/swimmer-v0")
    with pytest.raises(
        CdiffError, match=r"observations of shape .* but maze2d-umaze has 4 coordinates"
    ):
        load_dataset(UMAZE, "cdiff/swimmer-v0")


# the search ---------------------------------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), cuts=st.lists(st.integers(1, 39), max_size=4))
def test_whitening_in_batches_equals_mean_and_deviation_of_all_data(seed, cuts):
    seen = np.random.default_rng(seed).normal(3.0, [1.0, 10.0], (40, 2))
    whitening = Whitening(2)
    for piece in np.split(seen, sorted(set(cuts))):
        whitening.add(piece)
    assert whitening.mean == pytest.approx(seen.mean(0))
    assert whitening.deviation() == pytest.approx(seen.std(0), abs=1e-7)


def test_folded_gait_equals_the_policy_on_whitened_observations():
    rng = np.random.default_rng(0)
    whitening = Whitening(3)
    whitening.add(rng.normal(2.0, 3.0, (50, 3)))
    M, obs = 0.1 * rng.normal(size=(2, 3)), rng.normal(size=3)
    assert whitening.fold(M)(obs) == pytest.approx(
        M @ ((obs - whitening.mean) / whitening.deviation())
    )


def test_gait_clips_its_inputs():
    assert Gait(np.array([[10.0], [-10.0], [0.5]]), np.zeros(3))(np.ones(1)).tolist() == [
        1.0,
        -1.0,
        0.5,
    ]


TINY = replace(SEARCHES["swimmer"], at_least=-1e9).within(12_000)
BRIEF = replace(SWIMMER, max_steps=200)


def test_tiny_search_improves_and_repeats_with_its_seed():
    first, again = search_gait(BRIEF, TINY, 0), search_gait(BRIEF, TINY, 0)
    assert first is not None
    assert again is not None
    gait, steps = first
    assert 12_000 <= steps < 12_000 + 4_000  # one iteration and one test over
    standing = measure(BRIEF, Gait(np.zeros((2, 8)), np.zeros(2)), 0.0, range(3))["mean"]
    assert measure(BRIEF, gait, 0.0, range(3))["mean"] > standing + 10
    assert np.array_equal(gait.W, again[0].W)
    assert np.array_equal(gait.b, again[0].b)


def test_seed_below_the_screen_is_given_up():
    assert search_gait(BRIEF, replace(TINY, at_least=1e9), 0) is None


def test_search_writes_a_file_that_the_task_reads(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gait_search, "load_task", lambda _: BRIEF)
    monkeypatch.setitem(SEARCHES, "swimmer", TINY)
    out = tmp_path / "models" / "swimmer" / "expert.json"
    (tmp_path / "constraints").mkdir()
    (tmp_path / "models").mkdir()
    gait_search.main(["swimmer", "--steps", "1000", "--seed", "1", "2", "--out", str(out)])
    monkeypatch.chdir(tmp_path)
    assert len(BRIEF.experts()) == 2
    assert [policy["seed"] for policy in json.loads(out.read_text())["policies"]] == [1, 2]
    assert "2 gaits in " in capsys.readouterr().err
