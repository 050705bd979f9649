"""Demonstrations: episodes of states, inputs and rewards from Minari datasets or HDF5 files."""

import contextlib
import hashlib
import inspect
import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from filelock import FileLock

from cdiff_cli import tasks
from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError
from cdiff_cli.paths import home
from cdiff_cli.tasks.protocol import ControlTask, Demonstrates, HasExactScore, ReadsD4RL, Task

Progress = Callable[[int, int], None]
"""(steps done, steps in all)"""


# the task's own demonstrations -------------------------------------------------------------------


def dataset_name(task: Task) -> str:
    """Minari id of the task's own demonstrations."""
    return f"cdiff/{task.name}-v0"


def demonstrations(
    task: Task, steps: int, seed: int, progress: Progress | None = None
) -> list[Array]:
    """The task's own demonstrations as episodes of states [n, dim], environment units.

    They are generated once, as a local Minari dataset, and read again while steps, seed,
    generating code and content hash stay the same. Processes that need them at the same time wait
    for the first.
    """
    if isinstance(task, HasExactScore):
        raise CdiffError(f"{task.name} needs no training: its score is exact")
    minari = _minari()
    root = Path(minari.storage.get_dataset_path())
    root.mkdir(parents=True, exist_ok=True)
    with FileLock(root / f".cdiff-{task.name}.lock"):
        origin = {"cdiff_steps": steps, "cdiff_seed": seed, "cdiff_code": _code_sha256(task)}
        if dataset_name(task) in minari.list_local_datasets():
            episodes, metadata = _minari_episodes(minari, dataset_name(task), task)
            expected = origin | {"cdiff_sha256": digest(episodes)}
            if {key: metadata.get(key) for key in expected} == expected:
                return episodes
            with contextlib.redirect_stdout(io.StringIO()):  # Minari prints
                minari.delete_dataset(dataset_name(task))
        dataset = _generate(minari, task, steps, seed, progress)
        episodes, _ = _minari_episodes(minari, dataset_name(task), task)
        dataset.storage.update_metadata(origin | {"cdiff_sha256": digest(episodes)})
        return episodes


def _generate(minari: Any, task: Task, steps: int, seed: int, progress: Progress | None) -> Any:
    """A new Minari dataset of the task's demonstrations."""
    if not isinstance(task, Demonstrates):
        raise CdiffError(f"{task.name} generates no demonstrations; name a dataset with --dataset")
    buffers, done = [], 0
    for number, rows in enumerate(task.demonstrate(steps, seed)):
        buffers.append(_episode_buffer(rows, number))
        done += len(rows["actions"])
        if progress:
            progress(done, steps)
    summary, _, _ = (inspect.getdoc(task.demonstrate) or "").partition(".")
    with warnings.catch_warnings():
        # Minari recommends metadata that a local dataset does not need
        warnings.simplefilter("ignore")
        return minari.create_dataset_from_buffers(
            dataset_name(task),
            buffers,
            env=task.make_env(),
            algorithm_name="demonstrations of cdiff",
            author="cdiff",
            description=f"{steps} steps, seed {seed}: {summary}",
            data_format="hdf5",
        )


def _episode_buffer(rows: dict[str, Any], number: int) -> Any:
    from minari.data_collector import EpisodeBuffer

    n = len(rows["actions"])
    observations = rows["observations"]
    stacked = (
        {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
        if isinstance(observations[0], dict)
        else np.stack(observations)
    )
    return EpisodeBuffer(
        id=number,
        observations=stacked,
        actions=np.stack(rows["actions"]),
        rewards=rows["rewards"],
        terminations=[False] * n,
        truncations=[False] * (n - 1) + [True],
    )


def digest(episodes: Sequence[Array]) -> str:
    """sha256 of the lengths and the float64 states of the episodes."""
    sha = hashlib.sha256(str([episode.shape for episode in episodes]).encode())
    for episode in episodes:
        sha.update(np.ascontiguousarray(episode, dtype=np.float64).tobytes())
    return sha.hexdigest()


def generating_files(task: Task) -> list[Path]:
    """The files that decide what a task demonstrates: its code, and its expert if it has one.

    The code is the module of the task, or all modules of its folder if it is a package.
    """
    module, package = Path(inspect.getfile(type(task))), Path(inspect.getfile(tasks)).parent
    files = sorted(module.parent.glob("*.py")) if module.parent.parent == package else [module]
    expert = home() / "models" / task.name / "expert.json"
    return [*files, expert] if expert.exists() else files


def _code_sha256(task: Task) -> str:
    content = b"".join(file.read_bytes() for file in generating_files(task))
    return hashlib.sha256(content).hexdigest()


# datasets ----------------------------------------------------------------------------------------


def load_dataset(task: Task, source: str) -> list[Array]:
    """Episodes of states of a dataset: a Minari id, or the path of a D4RL-style HDF5 file."""
    if _is_hdf5(source):
        return list(_hdf5_episodes(Path(source), task))
    minari = _minari()
    known = sorted(minari.list_local_datasets())
    if source not in known:
        raise CdiffError(
            f'no local Minari dataset "{source}" and no .hdf5 file of that name; '
            f"local datasets: {', '.join(known) or 'none'}. "
            "Download one with `minari download ID`, or leave --dataset out to generate "
            "demonstrations"
        )
    return _minari_episodes(minari, source, task)[0]


def load_inputs(task: Task, source: str) -> list[Array]:
    """Inputs of the episodes of a dataset, each [steps, m].

    Empty for an HDF5 file of a task that names no inputs: they keep the coordinates of D4RL.
    """
    if not _is_hdf5(source):
        return _minari_arrays(source, "actions")
    if not isinstance(task, ControlTask):
        return []
    inputs = _hdf5(Path(source), "actions")
    return [_checked(u, task, source, "actions", task.actions) for u in inputs]


def load_rewards(source: str, episodes: Sequence[Array]) -> list[Array]:
    """Rewards of the episodes of a dataset, each [steps]."""
    if _is_hdf5(source):
        why = ", because its recipe conditions the planner on the return"
        rewards = _hdf5(Path(source), "rewards", why)
    else:
        rewards = _minari_arrays(source, "rewards")
    if len(rewards) != len(episodes):
        raise CdiffError(
            f"{source}: {len(rewards)} episodes of rewards for {len(episodes)} of states; "
            "repair the dataset"
        )
    steps, states = [r.size for r in rewards], [len(x) for x in episodes]
    if any(r.ndim != 1 for r in rewards) or any(
        n - r not in (0, 1) for n, r in zip(states, steps, strict=True)
    ):
        raise CdiffError(
            f"{source}: rewards of {sum(steps)} steps for {sum(states)} states; "
            "expected one per step, repair the dataset"
        )
    if not all(np.isfinite(r).all() for r in rewards):
        raise CdiffError(f"{source}: rewards hold NaN or inf; repair or choose another dataset")
    return rewards


def _minari() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import minari
    return minari


def _minari_episodes(minari: Any, name: str, task: Task) -> tuple[list[Array], dict[str, Any]]:
    """Episodes of states of a local dataset, and its metadata."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset = minari.load_dataset(name)
        episodes = [task.observe(episode.observations) for episode in dataset.iterate_episodes()]
    return [_checked(episode, task, name) for episode in episodes], dict(dataset.storage.metadata)


def _minari_arrays(name: str, field: Literal["actions", "rewards"]) -> list[Array]:
    """One array of each episode of a local dataset."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset = _minari().load_dataset(name)
        return [
            np.asarray(getattr(episode, field), dtype=np.float64)
            for episode in dataset.iterate_episodes()
        ]


def _is_hdf5(source: str) -> bool:
    return Path(source).suffix in (".hdf5", ".h5")


def _hdf5_episodes(path: Path, task: Task) -> Iterator[Array]:
    for episode in _hdf5(path, "observations"):
        states = _checked(episode, task, str(path))
        if isinstance(task, ReadsD4RL):
            states = _checked(task.from_d4rl(states), task, str(path))
        yield states


def _hdf5(path: Path, name: str, why: str = "") -> list[Array]:
    """One array of the file, cut into episodes.

    D4RL's layout: observations [n, dim], actions [n, m], rewards [n], and timeouts or terminals
    [n], which mark the last step of each episode.
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
    """The episode, if it is finite and has one column per name (default: the coordinates)."""
    names = names or task.layout
    if episode.ndim != 2 or episode.shape[1] != len(names):
        kind = "coordinates" if what == "observations" else "inputs"
        raise CdiffError(
            f"{source}: {what} of shape {episode.shape}, but {task.name} has {len(names)} {kind} "
            f"({', '.join(names)}); choose a dataset of this environment"
        )
    if not np.isfinite(episode).all():
        raise CdiffError(f"{source}: {what} hold NaN or inf; repair or choose another dataset")
    return episode
