"""Progress bars on stderr, shown only on a terminal."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console

err = Console(stderr=True)
Tick = Callable[[str, int, int], None]
"""Called with what is under way, how many of it are done, and of how many."""


@contextmanager
def progress() -> Iterator[Tick]:
    """Show one bar per thing under way that the tick is called with."""
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
    """Show one bar for the demonstrations and one per network in training.

    Yields (on_data, on_step). on_data is called with the steps done and of how many; on_step with
    the training's status: what, step, steps, loss.
    """
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description:>16}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[loss]}"),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err, disable=not err.is_terminal) as bar:
        data: Any = None
        fits: dict[str, Any] = {}

        def on_data(done: int, total: int) -> None:
            nonlocal data
            if data is None:
                data = bar.add_task("demonstrations", total=total, loss="", rate="")
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
