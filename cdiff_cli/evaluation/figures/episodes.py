"""Pictures of closed-loop episodes: constrained quantities over time, paths, videos."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.evaluation.figures.style import (
    ACCENT,
    REFERENCE,
    RESULT,
    SET_ALPHA,
    UNSAFE,
    Image,
    image,
    new_figure,
    position_columns,
    position_labels,
    save,
    write_video,
)
from cdiff_cli.planning.episodes import Episodes
from cdiff_cli.tasks.protocol import ControlTask

FRAME_S = 0.04  # [s] of simulated time per video frame at true speed
MOST_FRAMES = 250  # frames per video; longer episodes are shown faster
VIEW = (5.0, 2.5)  # [unit of the positions] half width and half height of the map in a video


def levels_picture(
    path: Path, task: ControlTask, g: Constraint, done: Episodes, levels: Array, title: str
) -> None:
    """Draw h = -f of every constraint along each episode, unsafe below 0.

    Blue is the executed value, grey the value that the plan predicted. A task in the plane also
    gets its paths.

    levels   f at the executed states   [n, steps + 1, parts]
    """
    plane = len(task.positions) == 2
    rows = max(len(g.parts), 1) + plane
    figure = new_figure(9, 2.6 * rows)
    axes = figure.subplots(rows, 1, squeeze=False)[:, 0]
    time = np.arange(levels.shape[1]) * task.dt
    for k, (axis, part) in enumerate(zip(axes, g.parts, strict=False)):
        axis.plot(time, -done.predicted_levels[:, :, k].T, color=REFERENCE, lw=0.6)
        axis.plot(time, -levels[:, :, k].T, color=RESULT, lw=0.7, alpha=0.8)
        axis.axhline(0, color=UNSAFE, lw=1.2)
        axis.set(xlabel="time / s", ylabel=f"h of {part.name}")
    if plane:
        _draw_paths(axes[-1], task, done)
    axes[0].set_title(title, fontsize=10)
    save(figure, path, dpi=110)


def _draw_paths(axis: Any, task: ControlTask, done: Episodes) -> None:
    """Executed paths, and the paths of the observed points."""
    for path in done.x[..., position_columns(task)]:
        axis.plot(*path.T, color=RESULT, lw=0.8)
    for xs, ys in _observed_points(task, done):
        for x, y in zip(xs, ys, strict=True):
            axis.plot(x, y, color=UNSAFE, lw=0.6, alpha=0.6)
    label_x, label_y = position_labels(task)
    axis.set(xlabel=label_x, ylabel=label_y, aspect="equal", adjustable="datalim")


def _observed_points(task: ControlTask, done: Episodes) -> Iterator[tuple[Array, Array]]:
    """Both coordinates [n, steps + 1] of every observed point in the plane of the positions.

    Two observed quantities are a point if their names are NAME.x and NAME.y, for positions x and y.
    """
    first, second = task.positions
    for name in sorted({name.rpartition(".")[0] for name in done.observed}):
        if {f"{name}.{first}", f"{name}.{second}"} <= set(done.observed):
            yield done.observed[f"{name}.{first}"], done.observed[f"{name}.{second}"]


class Recorder:
    """Records the first episode while it runs, and writes it as a video.

    The upper half of a frame is the scene: the picture of the environment, or the map if the task
    moves in the plane. The lower half shows the constrained quantities over time.
    """

    def __init__(self, path: Path, task: ControlTask, g: Constraint) -> None:
        self.path, self.task, self.g = path, task, g
        self.renderings: list[Image] = []
        self.plans: list[Array] = []
        self.every = max(round(FRAME_S / task.dt), -(-task.max_steps // MOST_FRAMES), 1)

    @property
    def plane(self) -> bool:
        return len(self.task.positions) == 2

    def __call__(self, tau: int, env: Any, plan: Array) -> None:
        """Record step tau, its environment and the plan [horizon, dim] that is followed."""
        if tau % self.every == 0:
            self.plans.append(plan.copy())
            if not self.plane:
                self.renderings.append(env.render())

    def write(self, done: Episodes, levels: Array) -> None:
        """Write the video, if at least one plan was finite.

        levels   f at the executed states of all episodes   [n, steps + 1, parts]
        """
        if self.plans:
            write_video(self.path, self._frames(done, levels[0]))

    def _frames(self, done: Episodes, levels: Array) -> Iterator[Image]:
        figure = new_figure(6.4, 6.0, dpi=80, layout="constrained")
        scene, strip = figure.subplots(2, 1, height_ratios=[2, 1])
        time = np.arange(len(levels)) * self.task.dt
        lines = [
            strip.plot([], [], lw=1.2, color=f"C{k}", label=part.name)[0]
            for k, part in enumerate(self.g.parts)
        ]
        strip.plot(time, -levels, lw=0.6, alpha=0.35, color="0.5")
        strip.axhline(0, color=UNSAFE, lw=1.2)
        strip.set(xlabel="time / s", ylabel="h, unsafe below 0")
        strip.legend(loc="upper right", fontsize=7, frameon=False)
        for number, plan in enumerate(self.plans):
            tau = self.every * number
            scene.clear()
            if self.plane:
                self._draw_map(scene, done, tau, plan)
            else:
                scene.imshow(self.renderings[number])
                scene.axis("off")
            for k, line in enumerate(lines):
                line.set_data(time[: tau + 1], -levels[: tau + 1, k])
            yield image(figure)

    def _draw_map(self, scene: Any, done: Episodes, tau: int, plan: Array) -> None:
        """Draw the view around the agent: its path, the plan, unsafe sets, observed points."""
        columns = position_columns(self.task)
        state = done.x[0, tau]
        x, y = state[columns]
        scene.plot(*done.x[0, : tau + 1][:, columns].T, color=RESULT, lw=1.5)
        scene.plot(*plan[:, columns].T, color=ACCENT, lw=1.5)
        scene.plot(x, y, "o", color=RESULT, ms=9)
        self._draw_unsafe(scene, done, tau)
        for xs, ys in _observed_points(self.task, done):
            scene.plot(xs[0, tau], ys[0, tau], "o", color=UNSAFE, ms=9)
        label_x, label_y = position_labels(self.task)
        scene.set(
            xlim=(x - VIEW[0], x + VIEW[0]),
            ylim=(y - VIEW[1], y + VIEW[1]),
            aspect="equal",
            xlabel=label_x,
            ylabel=label_y,
        )

    def _draw_unsafe(self, scene: Any, done: Episodes, tau: int) -> None:
        """Draw the unsafe sets for the state and the observations of step tau."""
        columns = position_columns(self.task)
        state = done.x[0, tau]
        x, y = state[columns]
        xs, ys = np.meshgrid(
            np.linspace(x - VIEW[0], x + VIEW[0], 160), np.linspace(y - VIEW[1], y + VIEW[1], 80)
        )
        grid = np.broadcast_to(state, (*xs.shape, len(state))).copy()
        grid[..., columns[0]], grid[..., columns[1]] = xs, ys
        points = torch.from_numpy(grid.reshape(-1, 1, 1, len(state)))
        present = {name: torch.tensor([value[0, tau]]) for name, value in done.observed.items()}
        for part in self.g.bind(present, self.task.dt, 1).parts:
            level = getattr(part, "level", None)
            if level is not None:
                value = level(points).numpy().reshape(xs.shape)
                levels = [0, max(value.max(), 1e-9)]
                scene.contourf(xs, ys, value, levels, colors=[UNSAFE], alpha=SET_ALPHA)
