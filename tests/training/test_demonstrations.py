"""Normaliser, windows, demonstrations and datasets."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.errors import CdiffError
from cdiff_cli.models.normaliser import Normaliser
from cdiff_cli.tasks.ball_run.task import BALL_RUN
from cdiff_cli.tasks.maze2d import LARGE, UMAZE
from cdiff_cli.tasks.mujoco.locomotion import HOPPER
from cdiff_cli.training.demonstrations import (
    demonstrations,
    digest,
    generating_files,
    load_dataset,
    load_inputs,
)
from cdiff_cli.training.windows import Windows

LAYOUT = ("x", "y", "vx", "vy")
SHARED = (("x", "y"), ("vx", "vy"))
STATES = np.array([[-1.0, 0.0, -4.0, 0.0], [3.0, 1.0, 4.0, 2.0]])


def states(seed: int, n: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.0, [1.0, 5.0, 0.1, 3.0], (n, 4))


# normaliser ---------------------------------------------------------------------------------------


def test_normaliser_by_hand():
    normaliser = Normaliser.fit(STATES, LAYOUT, SHARED)
    assert normaliser.centre.tolist() == [1.0, 0.5, 0.0, 1.0]
    assert normaliser.scale.tolist() == [2.0, 2.0, 4.0, 4.0]
    assert normaliser.encode(torch.from_numpy(STATES)).tolist() == [
        [-1.0, -0.25, -1.0, -0.25],
        [1.0, 0.25, 1.0, 0.25],
    ]


def test_coordinates_without_shared_groups_fill_their_range():
    z = Normaliser.fit(STATES, LAYOUT, ()).encode(torch.from_numpy(STATES))
    assert z.tolist() == [[-1.0] * 4, [1.0] * 4]


def test_constant_coordinate_does_not_divide_by_zero():
    z = Normaliser.fit(np.ones((3, 1)), ("x",), ()).encode(torch.ones(3, 1))
    assert z.tolist() == [[0.0]] * 3


def test_identity_changes_nothing():
    x = torch.from_numpy(STATES)
    assert torch.equal(Normaliser.identity(4).encode(x), x)
    assert torch.equal(Normaliser.identity(4).decode(x), x)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(2, 20))
def test_decode_undoes_encode(seed, n):
    x = torch.from_numpy(states(seed, n))
    normaliser = Normaliser.fit(x.numpy(), LAYOUT, SHARED)
    assert torch.allclose(normaliser.decode(normaliser.encode(x)), x, atol=1e-9)
    assert torch.allclose(normaliser.encode(normaliser.decode(x)), x, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), n=st.integers(2, 20))
def test_encoded_data_is_within_one_and_a_ball_stays_a_ball(seed, n):
    x = states(seed, n)
    normaliser = Normaliser.fit(x, LAYOUT, SHARED)
    assert normaliser.encode(torch.from_numpy(x)).abs().max() <= 1 + 1e-9
    angle = torch.linspace(0, 6.28, 20, dtype=torch.float64)
    circle = torch.stack((angle.cos(), angle.sin(), 0 * angle, 0 * angle), 1)
    radii = (normaliser.encode(circle) - normaliser.encode(torch.zeros(4, dtype=torch.float64)))[
        :, :2
    ].norm(dim=1)
    assert torch.allclose(radii, radii[0].expand_as(radii))


def test_encoding_keeps_the_dtype():
    assert Normaliser.fit(STATES, LAYOUT, SHARED).encode(torch.zeros(1, 4)).dtype == torch.float32


# windows ------------------------------------------------------------------------------------------


def numbered(*lengths: int) -> list[np.ndarray]:
    """Episodes whose states are (episode, step)."""
    return [np.stack((np.full(n, e), np.arange(n)), 1).astype(float) for e, n in enumerate(lengths)]


def test_every_stretch_of_an_episode_is_a_window():
    windows = Windows.from_episodes(numbered(4, 2, 3), 3)
    every = windows[torch.arange(len(windows.starts))]
    assert every[:, 0].tolist() == [[0, 0], [0, 1], [2, 0]]
    assert every[:, :, 1].tolist() == [[0, 1, 2], [1, 2, 3], [0, 1, 2]]


@settings(max_examples=30, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=6),
    horizon=st.integers(1, 12),
    seed=st.integers(0, 99),
)
def test_no_window_crosses_the_border_of_an_episode(lengths, horizon, seed):
    if max(lengths) < horizon:
        with pytest.raises(CdiffError, match=f"a window needs {horizon}"):
            Windows.from_episodes(numbered(*lengths), horizon)
        return
    windows = Windows.from_episodes(numbered(*lengths), horizon)
    assert len(windows.starts) == sum(max(n - horizon + 1, 0) for n in lengths)
    drawn = windows.draw(16, torch.Generator().manual_seed(seed))
    assert drawn.shape == (16, horizon, 2)
    assert (drawn[:, :, 0] == drawn[:, :1, 0]).all()
    assert (drawn[:, :, 1].diff(dim=1) == 1).all()


def test_windows_without_episodes_are_an_error():
    with pytest.raises(CdiffError, match="longest of 0 episodes has 0 states"):
        Windows.from_episodes([], 3)


def test_draws_repeat_with_their_generator():
    windows = Windows.from_episodes(numbered(50), 3)
    first, again = (windows.draw(5, torch.Generator().manual_seed(1)) for _ in range(2))
    assert torch.equal(first, again)


def trip() -> np.ndarray:
    """x and vx of a rest, a ride of 10 steps, a rest, another ride of 20 steps and a rest."""
    speed = np.concatenate((np.zeros(5), np.ones(10), np.zeros(5), np.ones(20), np.zeros(5)))
    return np.stack((speed.cumsum(), speed), 1)


def probabilities(windows: Windows) -> torch.Tensor:
    return torch.diff(windows.cumulative, prepend=torch.zeros(1, dtype=torch.float64))


def test_favoured_trips_get_their_share_by_length():
    uniform = Windows.from_episodes([trip()], 14)
    windows = uniform.favour_trips(0.5, [0], [1])
    ends = windows[torch.arange(len(windows.starts))]
    rest = (ends[:, 0, 1] == 0) & (ends[:, -1, 1] == 0)
    length = torch.where(rest, ends[:, -1, 0] - ends[:, 0, 0], 0.0)
    assert length.sum() > 0
    expected = 0.5 / len(rest) + 0.5 * length / length.sum()
    assert torch.allclose(probabilities(windows), expected)
    assert probabilities(windows)[rest].sum() > 0.5 > probabilities(uniform)[rest].sum()
    assert torch.allclose(
        probabilities(windows)[~rest], torch.tensor(0.5 / len(rest), dtype=torch.float64)
    )


def test_draws_have_the_favoured_share():
    uniform = Windows.from_episodes([trip()], 14)
    shares = []
    for windows in (uniform, uniform.favour_trips(0.9, [0], [1])):
        drawn = windows.draw(2000, torch.Generator().manual_seed(0))
        shares.append(float(((drawn[:, 0, 1] == 0) & (drawn[:, -1, 1] == 0)).double().mean()))
    assert shares[0] < 0.3
    assert shares[1] > 0.85


@pytest.mark.parametrize(
    ("episode", "share"), [(trip(), 0.0), (trip()[5:15], 0.5), (trip()[:5], 0.5)]
)
def test_without_a_share_or_without_trips_draws_stay_uniform(episode, share):
    windows = Windows.from_episodes([episode], 4)
    assert torch.equal(windows.favour_trips(share, [0], [1]).cumulative, windows.cumulative)


# demonstrations -----------------------------------------------------------------------------------


@pytest.fixture
def own_minari(tmp_path, monkeypatch) -> Path:
    """A Minari folder for this test, so that the user's datasets do not change."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


class Counting:
    """UMAZE that counts how often it generates demonstrations."""

    def __init__(self) -> None:
        self.generated = 0

    def __getattr__(self, name):
        return getattr(UMAZE, name)

    def demonstrate(self, n_steps, seed):
        self.generated += 1
        return UMAZE.demonstrate(n_steps, seed)


@pytest.mark.usefixtures("own_minari")
def test_demonstrations_are_generated_once_then_reused_until_steps_or_seed_change():
    import minari

    task, told = Counting(), []
    first = demonstrations(task, 3000, 0, lambda done, of: told.append((done, of)))
    assert [len(episode) for episode in first] == [2001, 1001]
    assert told == [(2000, 3000), (3000, 3000)]
    assert "cdiff/maze2d-umaze-v0" in minari.list_local_datasets()
    again = demonstrations(task, 3000, 0)
    assert task.generated == 1
    assert digest(again) == digest(first)
    fewer = demonstrations(task, 2500, 0)
    assert task.generated == 2
    assert [len(episode) for episode in fewer] == [2001, 501]
    other = demonstrations(task, 2500, 1)
    assert task.generated == 3
    assert digest(other) != digest(fewer)
    assert digest(load_dataset(UMAZE, "cdiff/maze2d-umaze-v0")) == digest(other)


@pytest.mark.usefixtures("own_minari")
def test_concurrent_requests_share_one_generation_of_demonstrations():
    task = Counting()
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(lambda _: demonstrations(task, 200, 7), range(2))
    assert task.generated == 1
    assert digest(first) == digest(second)


def test_altered_demonstrations_are_generated_again(own_minari):
    task = Counting()
    first = demonstrations(task, 100, 0)
    (file,) = own_minari.rglob("*.hdf5")
    with h5py.File(file, "r+") as dataset:
        dataset["episode_0/observations/observation"][3, 0] += 1.0
    again = demonstrations(task, 100, 0)
    assert task.generated == 2
    assert digest(again) == digest(first)


@pytest.mark.parametrize(
    ("task", "expected"),
    [
        (UMAZE, ["maze2d.py"]),
        (BALL_RUN, ["__init__.py", "env.py", "obstacles.py", "task.py"]),
        (HOPPER, ["__init__.py", "gait_search.py", "locomotion.py", "expert.json"]),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_demonstrations_depend_on_the_modules_of_their_task_and_its_expert(task, expected):
    assert [file.name for file in generating_files(task)] == expected


def test_digest_depends_on_lengths_and_values():
    a = np.arange(8.0).reshape(4, 2)
    assert digest([a]) == digest([a.copy()])
    assert (
        len({digest(episodes) for episodes in ([a], [a[:2], a[2:]], [a + 1e-12], [a[::-1]])}) == 4
    )


# datasets of others -------------------------------------------------------------------------------


def write(path: Path, **columns) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[name] = values
    return path


def test_d4rl_file_is_cut_into_episodes_and_converted(tmp_path):
    rows = np.zeros((6, 4))
    rows[0] = [0.949, 2.936, 0.5, -1.5]
    path = write(
        tmp_path / "large.hdf5",
        observations=rows,
        timeouts=[0, 0, 1, 0, 0, 0],
        terminals=[0, 0, 0, 0, 1, 0],
    )
    episodes = load_dataset(LARGE, str(path))
    assert [len(episode) for episode in episodes] == [3, 2, 1]
    assert episodes[0][0] == pytest.approx([-2.364, 2.851, -1.5, -0.5])


def test_inputs_of_a_control_task_are_cut_like_its_states(tmp_path):
    inputs = np.arange(18.0).reshape(6, 3)
    path = write(
        tmp_path / "hopper.hdf5",
        observations=np.zeros((6, 11)),
        actions=inputs,
        timeouts=[0, 0, 1, 0, 0, 0],
    )
    assert [len(episode) for episode in load_dataset(HOPPER, str(path))] == [3, 3]
    np.testing.assert_array_equal(load_inputs(HOPPER, str(path)), inputs.reshape(2, 3, 3))


def test_inputs_of_a_maze_file_are_not_read(tmp_path):
    path = write(tmp_path / "maze.hdf5", observations=np.zeros((6, 4)), actions=np.zeros((6, 2)))
    assert load_inputs(UMAZE, str(path)) == []


def test_file_without_ends_is_one_episode(tmp_path):
    path = write(tmp_path / "one.h5", observations=np.zeros((5, 4), dtype=np.float32))
    (episode,) = load_dataset(UMAZE, str(path))
    assert episode.shape == (5, 4)
    assert episode.dtype == np.float64


NAN = np.zeros((3, 4))
NAN[1, 2] = np.nan
BAD_FILES = {
    "too many coordinates": (
        {"observations": np.zeros((3, 29))},
        r"observations of shape \(3, 29\), but maze2d-umaze has 4",
    ),
    "a flat list": ({"observations": np.zeros(3)}, r"observations of shape \(3,\)"),
    "NaN": ({"observations": NAN}, "observations hold NaN or inf"),
    "infinity": ({"observations": NAN + np.inf}, "observations hold NaN or inf"),
    "no observations": (
        {"states": np.zeros((3, 4))},
        "not a D4RL-style HDF5 dataset .* it needs observations and timeouts",
    ),
    "ends of another length": (
        {"observations": np.zeros((3, 4)), "timeouts": [0, 1]},
        "not a D4RL-style HDF5 dataset",
    ),
    "text": ({"observations": ["a", "b"]}, "not a D4RL-style HDF5 dataset"),
    "a single number": ({"observations": 1.0}, "not a D4RL-style HDF5 dataset"),
    "nothing": ({"observations": np.zeros((0, 4))}, "not a D4RL-style HDF5 dataset"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_file_is_refused_for(case, tmp_path):
    columns, said = BAD_FILES[case]
    path = write(tmp_path / "bad.hdf5", **columns)
    with pytest.raises(CdiffError, match=said) as caught:
        load_dataset(UMAZE, str(path))
    assert str(caught.value).startswith(f"{path}: ")


def test_file_that_is_no_hdf5_is_refused(tmp_path):
    path = tmp_path / "text.hdf5"
    path.write_text("hello")
    with pytest.raises(CdiffError, match="not a D4RL-style HDF5 dataset"):
        load_dataset(UMAZE, str(path))


def test_missing_file_error_says_so(tmp_path):
    with pytest.raises(
        CdiffError, match=r"none\.hdf5: no such file; expected a D4RL-style HDF5 dataset"
    ):
        load_dataset(UMAZE, str(tmp_path / "none.hdf5"))


@pytest.mark.usefixtures("own_minari")
def test_missing_minari_dataset_error_lists_the_local_ones():
    with pytest.raises(
        CdiffError, match=r'no local Minari dataset "D4RL/x-v1".*local datasets: none'
    ):
        load_dataset(UMAZE, "D4RL/x-v1")
    demonstrations(UMAZE, 20, 0)
    with pytest.raises(CdiffError, match=r"local datasets: cdiff/maze2d-umaze-v0.*minari download"):
        load_dataset(UMAZE, "D4RL/x-v1")


@pytest.mark.usefixtures("own_minari")
def test_minari_dataset_of_another_environment_is_refused():
    demonstrations(UMAZE, 20, 0)

    class Arm:
        """A task of other coordinates."""

        name, layout = "arm", ("angle", "rate")
        observe = staticmethod(UMAZE.observe)

    with pytest.raises(
        CdiffError,
        match=r"cdiff/maze2d-umaze-v0: observations of shape \(21, 4\), but arm has 2 coordinates",
    ):
        load_dataset(Arm(), "cdiff/maze2d-umaze-v0")
