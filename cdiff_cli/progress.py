"""Progress bars on stderr, shown on a terminal alone."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console

err = Console(stderr=True)
Tick = Callable[[str, int, int], None]
"""(what, done, of how many)"""


@contextmanager
def progress() -> Iterator[Tick]:
    """A bar for each `what` that it is called with."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    tasks: dict[str, Any] = {}
    columns = (
        TextColumn("{task.description:>12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:

        def tick(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total)
            bar.update(tasks[what], completed=done)

        yield tick


@contextmanager
def training_progress() -> Iterator[tuple[Callable[[int, int], None], Callable[[Any], None]]]:
    """Bars for the demonstrations, told (steps done, of how many), and for the training, told its status."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    shape = "{task.description:>16}", "{task.fields[loss]}", "{task.fields[rate]}"
    columns = (
        TextColumn(shape[0]),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(shape[1]),
        TextColumn(shape[2]),
    )
    with Progress(
        *columns,
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=err,
        disable=not err.is_terminal,
    ) as bar:
        data: Any = None
        fits: dict[str, Any] = {}

        def on_data(done: int, total: int) -> None:
            nonlocal data
            data = (
                bar.add_task("demonstrations", total=total, loss="", rate="")
                if data is None
                else data
            )
            bar.update(data, completed=done)

        def on_step(status: Any) -> None:
            if status.what not in fits:
                fits[status.what] = bar.add_task(
                    status.what, total=status.steps, completed=status.step - 1, loss="", rate=""
                )
            speed = bar.tasks[-1].speed
            rate = f"{speed:.1f} steps/s" if speed else ""
            bar.update(
                fits[status.what], completed=status.step, loss=f"loss {status.loss:.4f}", rate=rate
            )

        yield on_data, on_step
