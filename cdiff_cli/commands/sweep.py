"""`cdiff sweep`: a matrix of runs, one seed each; joblib's processes make the missing ones.

A run of one seed does not depend on its neighbours and works on one thread. The numbers are
therefore equal to the last digit, however many jobs there are and wherever a sweep was
interrupted. Times are not: they are of a batch of one on a busy machine.
"""

import contextlib
import hashlib
import json
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, cast

from rich.console import Console
from rich.live import Live
from rich.table import Table

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.names import check_choice, check_sweep
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.run_directory import find_rows, read_rows
from cdiff_cli.errors import CdiffError
from cdiff_cli.evaluation.columns import Row
from cdiff_cli.models.recipe import load_recipe

BACKENDS = ("local", "ray", "dask")


@dataclass(frozen=True)
class Matrix:
    """The requested runs; constraints None are the task's own."""

    tasks: Sequence[str]
    methods: Sequence[str]
    presets: Sequence[str]
    constraints: Sequence[Path | None]
    seeds: Sequence[int]
    rollout: bool = False
    random: bool = False


@dataclass(frozen=True)
class Job:
    """One run of the matrix.

    name    of its directory, after the time: the request, and a digest of all that decides its
            result but the code
    group   task, constraints, method and preset
    """

    options: Request
    rollout: bool
    group: tuple[str, ...]
    name: str


@dataclass(frozen=True)
class Outcome:
    """A job that is over.

    error      why it failed; None where it did not
    diverged   its run is kept, but its episode diverged
    """

    job: Job
    seconds: float
    error: str | None = None
    diverged: bool = False

    @property
    def trouble(self) -> str | None:
        """One line where it failed or diverged."""
        if self.error is not None:
            return f"failed: {self.job.name}: {self.error}"
        if self.diverged:
            return (
                f"diverged: {self.job.name}: a plan or a state was no longer finite; "
                "what was done until then is kept"
            )
        return None


@dataclass(frozen=True)
class Plan:
    """The jobs of a matrix: done (its directory is whole), to do, or refused before it began."""

    done: Sequence[Outcome]
    todo: Sequence[Job]
    refused: Sequence[Outcome]


def plan_sweep(matrix: Matrix, root: Path) -> Plan:
    """Sort the jobs of a matrix by what lies below root; raises CdiffError for an unknown name."""
    _check_names(matrix)
    existing = {
        path.parent.name.partition("-")[2].partition("-")[2]: path for path in find_rows(root)
    }
    done: list[Outcome] = []
    todo: list[Job] = []
    refused: list[Outcome] = []
    for task, constraints, preset, method in product(
        matrix.tasks, matrix.constraints, matrix.presets, matrix.methods
    ):
        for job in _jobs(matrix, task, constraints, preset, method):
            if isinstance(job, Outcome):
                refused.append(job)
            elif job.name in existing:
                done.append(Outcome(job, 0.0, diverged=_diverged(read_rows(existing[job.name]))))
            else:
                todo.append(job)
    return Plan(done, todo, refused)


def _jobs(
    matrix: Matrix, task: str, constraints: Path | None, preset: str, method: str
) -> Iterator[Job | Outcome]:
    kind = "rollout" if matrix.rollout else "plan"
    request = Request(
        task=task,
        method=method,
        preset=preset,
        constraints=constraints,
        n=1,
        device="cpu",
        random=matrix.random,
    )
    stem = constraints.stem if constraints else Path(load_recipe(task).constraints).stem
    group = (task, stem, method, preset)
    digest, error = "", None
    try:
        config = resolve(request).record()
        left_out = ("options", "start", "goal")
        decides = {key: value for key, value in config.items() if key not in left_out}
        decides["constraints"] = config["constraints"]["content"]
        decides |= {} if matrix.random else {"pins": (config["start"], config["goal"])}
        text = json.dumps(decides | {"random": matrix.random}, sort_keys=True, default=str)
        digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    except CdiffError as refusal:
        error = str(refusal)
    for seed in matrix.seeds:
        options = Request(**(vars(request) | {"seed": seed}))
        job = Job(
            options,
            matrix.rollout,
            group,
            f"{kind}-{'-'.join(group)}-seed{seed}{'-random' * matrix.random}-{digest}",
        )
        yield job if error is None else Outcome(job, 0.0, error)


def _check_names(matrix: Matrix) -> None:
    check_sweep(matrix.tasks, matrix.methods, matrix.presets)
    for path in matrix.constraints:
        if path is not None and not path.exists():
            raise CdiffError(f"--constraints: {path}: no such file")


def run_jobs(
    jobs: Sequence[Job],
    root: Path,
    workers: int,
    backend: str = "local",
    address: str | None = None,
) -> Iterator[Outcome]:
    """Make the runs and yield outcomes as they come; a failed job has its error in its outcome."""
    from joblib import Parallel, delayed

    with _backend(backend, address, workers):
        runs = [delayed(run_job)(job, root.absolute(), Path.cwd()) for job in jobs]
        if backend != "ray":
            yield from Parallel(n_jobs=workers, batch_size=1, return_as="generator_unordered")(runs)
            return
        with Parallel(n_jobs=workers, batch_size=1) as pool:
            # Ray's joblib backend returns all results at once: a few jobs at a time show progress
            for first in range(0, len(runs), 4 * workers):
                yield from pool(runs[first : first + 4 * workers])


def run_job(job: Job, root: Path, folder: Path) -> Outcome:
    """Make one run, with `folder` as the working directory wherever the worker was started."""
    from cdiff_cli.commands.plan import plan_run
    from cdiff_cli.commands.rollout import control_run, rollout_run

    began = time.perf_counter()
    try:
        with contextlib.chdir(folder), _one_thread():
            resolved = resolve(job.options)
            execute = control_run if resolved.replans else rollout_run
            make = cast(Any, execute if job.rollout else plan_run)
            finished = make(resolved, root, lambda *_: None, name=job.name, pictures=False)
        return Outcome(job, time.perf_counter() - began, diverged=_diverged(finished.rows))
    except CdiffError as error:
        return Outcome(job, time.perf_counter() - began, str(error))
    except Exception as error:  # reported at the end; the other jobs go on
        message = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Outcome(job, time.perf_counter() - began, message)


def _diverged(rows: Sequence[Row]) -> bool:
    return any(row.get("diverged") == 1 for row in rows)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Work on one thread: the order of additions sets the last digits."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def _backend(name: str, address: str | None, workers: int) -> Iterator[None]:
    """joblib's local processes, or the cluster at an address by its own joblib backend."""
    from joblib import parallel_config

    if name == "ray":
        with _extra(name):
            import ray
            from ray.util.joblib import register_ray
        with _reached(name, address):
            ray.init(address=address, log_to_driver=False, logging_level="error")
        try:
            cpus = int(ray.cluster_resources().get("CPU", 0))
            if workers > cpus:
                raise CdiffError(
                    f"--jobs: the Ray cluster has {cpus} CPUs, one for each job; found {workers}"
                )
            register_ray()
            # without num_cpus one node may get all jobs
            with parallel_config("ray", ray_remote_args={"num_cpus": 1}):
                yield
        finally:
            ray.shutdown()
    elif name == "dask":
        with _extra(name):
            from dask.distributed import Client
        with _reached(name, address):
            client = Client(address)
        with client, parallel_config("dask"):
            yield
    else:
        with parallel_config("loky", inner_max_num_threads=1):
            yield


@contextlib.contextmanager
def _reached(name: str, address: str | None) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, RuntimeError) as error:
        where = f"--address {address}" if address else f"--backend {name}"
        raise CdiffError(
            f"{where}: no {name} cluster answers there: {' '.join(str(error).split())[:200]}"
        ) from None


@contextlib.contextmanager
def _extra(name: str) -> Iterator[None]:
    try:
        yield
    except ImportError:
        raise CdiffError(
            f"--backend {name}: not installed here; "
            f"install the extra: pip install 'cdiff-cli[{name}]'"
        ) from None


def run_sweep(
    matrix: Matrix,
    root: Path,
    workers: int,
    screen: Console,
    backend: str = "local",
    address: str | None = None,
) -> list[Outcome]:
    """Make the missing runs and return those that failed or diverged, older ones included.

    screen   shows a table, or one line per run where it is no terminal
    """
    if workers < 1 or not matrix.seeds:
        raise CdiffError(f"--{'seeds' if workers >= 1 else 'jobs'}: expected at least 1")
    check_choice("backend", backend, BACKENDS, "--backend")
    if address and backend == "local":
        raise CdiffError(
            "--address: the runs are local; "
            "name the cluster's kind with --backend ray or --backend dask"
        )
    plan = plan_sweep(matrix, root)
    over, began = list(plan.refused), time.monotonic()
    with (
        Live(console=screen, auto_refresh=False)
        if screen.is_terminal
        else contextlib.nullcontext() as live
    ):
        if live:
            live.update(progress_table(over, plan, began), refresh=True)
        for outcome in run_jobs(plan.todo, root, workers, backend, address) if plan.todo else ():
            over.append(outcome)
            if live:
                live.update(progress_table(over, plan, began), refresh=True)
            else:
                state = (
                    "failed" if outcome.error else "made, diverged:" if outcome.diverged else "made"
                )
                screen.print(
                    f"{len(plan.done) + len(over)} of {_size(plan)}: {state} {outcome.job.name}",
                    soft_wrap=True,
                )
    return [outcome for outcome in (*plan.done, *over) if outcome.trouble]


def _size(plan: Plan) -> int:
    return len(plan.done) + len(plan.todo) + len(plan.refused)


def progress_table(over: Sequence[Outcome], plan: Plan, began: float) -> Table:
    """One row per group: runs done, diverged, failed, all, and mean seconds per run made.

    over    refused jobs and those made now
    began   time.monotonic() when the first run began
    """
    completed = len(over) - len(plan.refused)
    left = len(plan.todo) - completed
    eta = (
        f", about {(time.monotonic() - began) * left / completed:.0f} s"
        if completed and left
        else ""
    )
    table = Table(
        title=f"{len(plan.done)} were there, {completed} made, {left} to do{eta}",
        title_justify="left",
    )
    for heading in ("task", "constraints", "method", "preset"):
        table.add_column(heading)
    for heading in ("done", "diverged", "failed", "of", "s / run"):
        table.add_column(heading, justify="right")
    jobs = (*plan.todo, *(outcome.job for outcome in (*plan.done, *plan.refused)))
    older = Counter(outcome.job.group for outcome in plan.done)
    failed = Counter(outcome.job.group for outcome in over if outcome.error is not None)
    diverged = Counter(outcome.job.group for outcome in (*plan.done, *over) if outcome.diverged)
    for group, total in Counter(job.group for job in jobs).items():
        took = [
            outcome.seconds
            for outcome in over
            if outcome.job.group == group and outcome.error is None
        ]
        mean = f"{sum(took) / len(took):.1f}" if took else ""
        counts = (older[group] + len(took), diverged[group], failed[group], total)
        table.add_row(*group, *map(str, counts), mean)
    return table
