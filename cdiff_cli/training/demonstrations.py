"""Demonstrations: episodes of states from Minari or HDF5, the affine normaliser, windows of one horizon."""

import contextlib
import hashlib
import inspect
import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock

from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError
from cdiff_cli.paths import home
from cdiff_cli.tasks.protocol import (
    ControlTask,
    Demonstrates,
    HasExactScore,
    ReadsD4RL,
    Task,
)

Progress = Callable[[int, int], None]


def demonstrations(
    task: Task, steps: int, seed: int, progress: Progress | None = None
) -> list[Array]:
    """The task's own demonstrations as episodes of states [steps + 1, dim]: generated once as the local Minari dataset
    `cdiff/<task>-v0`, reused when its steps, seed, generating code and content hash are the expected ones. Processes that
    ask at the same time wait for the first.
    """
    if isinstance(task, HasExactScore):
        raise CdiffError(f"{task.name} needs no training: its score is exact")
    minari = _minari()
    root = Path(minari.storage.get_dataset_path())
    root.mkdir(parents=True, exist_ok=True)
    with FileLock(root / f".cdiff-{task.name}.lock"):
        return _stored_demonstrations(minari, task, steps, seed, progress)


def _stored_demonstrations(
    minari: Any, task: Task, steps: int, seed: int, progress: Progress | None
) -> list[Array]:
    if not isinstance(task, Demonstrates):
        raise CdiffError(f"{task.name} generates no demonstrations; name a dataset with --dataset")
    name = f"cdiff/{task.name}-v0"
    recipe = {"cdiff_steps": steps, "cdiff_seed": seed, "cdiff_code": _code(task)}
    if name in minari.list_local_datasets():
        episodes, metadata = _minari_episodes(minari, name, task)
        asked = recipe | {"cdiff_sha256": digest(episodes)}
        if {key: metadata.get(key) for key in asked} == asked:
            return episodes
        with contextlib.redirect_stdout(io.StringIO()):  # it prints
            minari.delete_dataset(name)
    buffers, done = [], 0
    for number, rows in enumerate(task.demonstrate(steps, seed)):
        buffers.append(_episode_buffer(rows, number))
        done += len(rows["actions"])
        if progress:
            progress(done, steps)
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore"
        )  # Minari advises on optional metadata that a local dataset does not need
        dataset = minari.create_dataset_from_buffers(
            name,
            buffers,
            env=task.make_env(),
            algorithm_name="demonstrations of cdiff",
            author="cdiff",
            description=f"{steps} steps, seed {seed}: {(inspect.getdoc(task.demonstrate) or '').partition('.')[0]}",
            data_format="hdf5",
        )
    episodes, _ = _minari_episodes(minari, name, task)
    dataset.storage.update_metadata(recipe | {"cdiff_sha256": digest(episodes)})
    return episodes


def load_dataset(task: Task, source: str) -> list[Array]:
    """Episodes of states of a Minari dataset (by its id) or of a D4RL-style HDF5 file (by its path)."""
    path = Path(source)
    if path.suffix in (".hdf5", ".h5"):
        return list(_hdf5_episodes(path, task))
    minari = _minari()
    known = sorted(minari.list_local_datasets())
    if source not in known:
        raise CdiffError(
            f'no local Minari dataset "{source}" and no .hdf5 file of that name; here are: {", ".join(known) or "none"}. '
            "Download one with `minari download ID`, or leave --dataset out to generate demonstrations"
        )
    return _minari_episodes(minari, source, task)[0]


def load_inputs(task: Task, source: str) -> list[Array]:
    """The inputs of the episodes of a Minari dataset or, of control tasks, of an HDF5 file, each [steps, m]; none of another
    task's HDF5 file, whose inputs keep its own frame.
    """
    if Path(source).suffix in (".hdf5", ".h5"):
        actions = task.actions if isinstance(task, ControlTask) else ()
        return (
            [_checked(u, task, source, "actions", actions) for u in _hdf5(Path(source), "actions")]
            if actions
            else []
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset = _minari().load_dataset(source)
        return [
            np.asarray(episode.actions, dtype=np.float64) for episode in dataset.iterate_episodes()
        ]


def load_rewards(source: str, episodes: Sequence[Array]) -> list[Array]:
    """The rewards of the episodes of a Minari dataset or of an HDF5 file, each [steps]."""
    if Path(source).suffix in (".hdf5", ".h5"):
        rewards = _hdf5(
            Path(source), "rewards", ", for its recipe conditions the planner on the return"
        )
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            dataset = _minari().load_dataset(source)
            rewards = [
                np.asarray(episode.rewards, dtype=np.float64)
                for episode in dataset.iterate_episodes()
            ]
    if len(rewards) != len(episodes):
        raise CdiffError(
            f"{source}: {len(rewards)} episodes of rewards for {len(episodes)} of states; repair the dataset"
        )
    sizes, states = [r.size for r in rewards], [len(x) for x in episodes]
    if any(r.ndim != 1 for r in rewards) or any(
        n - r not in (0, 1) for n, r in zip(states, sizes, strict=True)
    ):
        raise CdiffError(
            f"{source}: rewards of {sum(sizes)} steps for {sum(states)} states; expected one a step, repair the dataset"
        )
    if not all(np.isfinite(r).all() for r in rewards):
        raise CdiffError(f"{source}: rewards hold NaN or inf; repair or choose another dataset")
    return rewards


def digest(episodes: Sequence[Array]) -> str:
    """sha256 over the lengths and the float64 states of the episodes."""
    sha = hashlib.sha256(str([episode.shape for episode in episodes]).encode())
    for episode in episodes:
        sha.update(np.ascontiguousarray(episode, dtype=np.float64).tobytes())
    return sha.hexdigest()


def _code(task: Task) -> str:
    """Hash of what generates the demonstrations, code and expert: edited, it must not meet its old data."""
    expert = home() / "models" / task.name / "expert.json"
    files = [Path(inspect.getfile(type(task))), *([expert] if expert.exists() else [])]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _minari() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import minari
    return minari


def _episode_buffer(rows: dict[str, Any], number: int) -> Any:
    from minari.data_collector import EpisodeBuffer

    n = len(rows["actions"])
    seen = rows["observations"]
    stacked = (
        {key: np.stack([obs[key] for obs in seen]) for key in seen[0]}
        if isinstance(seen[0], dict)
        else np.stack(seen)
    )
    last = [False] * (n - 1) + [True]
    return EpisodeBuffer(
        id=number,
        observations=stacked,
        actions=np.stack(rows["actions"]),
        rewards=rows["rewards"],
        terminations=[False] * n,
        truncations=last,
    )


def _minari_episodes(minari: Any, name: str, task: Task) -> tuple[list[Array], dict[str, Any]]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset = minari.load_dataset(name)
        episodes = [task.observe(episode.observations) for episode in dataset.iterate_episodes()]
    return [_checked(episode, task, name) for episode in episodes], dict(dataset.storage.metadata)


def _hdf5_episodes(path: Path, task: Task) -> Iterator[Array]:
    for episode in _hdf5(path, "observations"):
        states = _checked(episode, task, str(path))
        if isinstance(task, ReadsD4RL):
            states = _checked(task.from_d4rl(states), task, str(path))
        yield states


def _hdf5(path: Path, name: str, why: str = "") -> list[Array]:
    """That array of the file, episode by episode. D4RL's layout: observations [n, dim], actions [n, m], rewards [n], timeouts or
    terminals [n] marking each episode's last step.
    """
    import h5py

    if not path.exists():
        raise CdiffError(f"{path}: no such file; expected a D4RL-style HDF5 dataset")
    try:
        with h5py.File(path, "r") as file:
            rows = np.asarray(file[name], dtype=np.float64)
            if len(rows) == 0:
                raise ValueError(f"{name} is empty")
            ends = np.zeros(len(rows), dtype=bool)
            for key in ("timeouts", "terminals"):
                if key in file:
                    ends |= np.asarray(file[key], dtype=bool)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise CdiffError(
            f"{path}: not a D4RL-style HDF5 dataset ({error}); it needs {name} and timeouts{why}"
        ) from None
    return [episode for episode in np.split(rows, np.flatnonzero(ends) + 1) if len(episode)]


def _checked(
    episode: Array, task: Task, source: str, what: str = "observations", names: Sequence[str] = ()
) -> Array:
    """The episode, if its columns can be those names, else the task's coordinates."""
    names = names or task.layout
    if episode.ndim != 2 or episode.shape[1] != len(names):
        raise CdiffError(
            f"{source}: {what} of shape {episode.shape}, but {task.name} has {len(names)} "
            f"{'coordinates' if what == 'observations' else 'inputs'} ({', '.join(names)}); choose a dataset of this environment"
        )
    if not np.isfinite(episode).all():
        raise CdiffError(f"{source}: {what} hold NaN or inf; repair or choose another dataset")
    return episode
