"""Pictures of closed-loop episodes: the constrained quantities over time, the path beside the obstacle's, videos."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from matplotlib import pyplot as plt
from numpy.typing import NDArray

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.planning.episodes import Episodes
from cdiff_cli.tasks.protocol import ControlTask

mpl.use("Agg")
UNSAFE, SAFE, FORESEEN = "#d1495b", "#1d4e89", "#9aa5b1"
FRAME, FRAMES = (
    0.04,
    250,
)  # seconds a video frame at true speed; frames at most: longer episodes are shown faster


def levels_picture(
    path: Path, task: ControlTask, g: Constraint, done: Episodes, levels: Array, title: str
) -> None:
    """h = -f of every constraint along each episode (unsafe below 0), as executed; pale, as foreseen."""
    parts, plane = g.parts, len(task.positions) == 2
    figure, axes = plt.subplots(
        max(len(parts), 1) + plane,
        1,
        figsize=(9, 2.6 * (max(len(parts), 1) + plane)),
        squeeze=False,
    )
    time = np.arange(levels.shape[1]) * task.dt
    for k, (axis, part) in enumerate(zip(axes[:, 0], parts, strict=False)):
        axis.plot(time, -done.predicted_levels[:, :, k].T, color=FORESEEN, lw=0.6)
        axis.plot(time, -levels[:, :, k].T, color=SAFE, lw=0.7, alpha=0.8)
        axis.axhline(0, color=UNSAFE, lw=1.2)
        axis.set(xlabel="time / s", ylabel=f"h of {part.name}")
    if plane:
        _paths(axes[-1, 0], task, done)
    axes[0, 0].set_title(title, fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _paths(axis: Any, task: ControlTask, done: Episodes) -> None:
    """Executed paths of the positions, and those of what is observed as `<name>.x, <name>.y`."""
    at = [task.layout.index(name) for name in task.positions]
    for path in done.x[..., at]:
        axis.plot(*path.T, color=SAFE, lw=0.8)
    for name in sorted({name.partition(".")[0] for name in done.observed}):
        for x, y in zip(done.observed[f"{name}.x"], done.observed[f"{name}.y"], strict=True):
            axis.plot(x, y, color=UNSAFE, lw=0.6, alpha=0.6)
    axis.set(xlabel="x / m", ylabel="y / m", aspect="equal", adjustable="datalim")


class Recorder:
    """Frames of the first episode while it runs, then a video: the scene above, the constrained quantities below. The scene is the
    environment's own picture, or, of a task in the plane, its map: path, plan, obstacle, unsafe set.
    """

    def __init__(self, path: Path, task: ControlTask, g: Constraint) -> None:
        self.path, self.task, self.g = path, task, g
        self.frames: list[NDArray[np.uint8]] = []
        self.plans: list[Array] = []
        self.every = max(round(FRAME / task.dt), -(-task.max_steps // FRAMES), 1)

    @property
    def plane(self) -> bool:
        return len(self.task.positions) == 2

    def __call__(self, tau: int, env: Any, plan: Array) -> None:
        if tau % self.every == 0:
            self.plans.append(plan.copy())
            if not self.plane:
                self.frames.append(env.render())

    def write(self, done: Episodes, levels: Array) -> None:
        """levels   of all episodes [n, steps + 1, parts]; the first is drawn"""
        import imageio.v3 as iio

        if not self.plans:  # the first plan was not finite: there is nothing to show
            return
        options: Any = (
            {"duration": 40, "loop": 0}
            if self.path.suffix == ".gif"
            else {"fps": 25, "macro_block_size": 2}
        )
        iio.imwrite(self.path, np.stack(list(self._composed(done, levels[0]))), **options)

    def _composed(self, done: Episodes, levels: Array) -> Iterator[NDArray[np.uint8]]:
        figure, (scene, strip) = plt.subplots(
            2, 1, figsize=(6.4, 6.0), dpi=80, height_ratios=[2, 1], layout="constrained"
        )
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
                self._map(scene, done, tau, plan)
            else:
                scene.imshow(self.frames[number])
                scene.axis("off")
            for k, line in enumerate(lines):
                line.set_data(time[: tau + 1], -levels[: tau + 1, k])
            figure.canvas.draw()
            drawn = np.asarray(figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
            yield drawn[: drawn.shape[0] // 2 * 2, : drawn.shape[1] // 2 * 2].copy()
        plt.close(figure)

    def _map(self, scene: Any, done: Episodes, tau: int, plan: Array) -> None:
        """Five metres around the agent: its path, the plan followed, what is unsafe now."""
        task, at = self.task, [self.task.layout.index(name) for name in self.task.positions]
        here = done.x[0, tau]
        x, y = here[at]
        scene.plot(*done.x[0, : tau + 1][:, at].T, color=SAFE, lw=1.5)
        scene.plot(*plan[:, at].T, color="#2e933c", lw=1.5)
        scene.plot(x, y, "o", color=SAFE, ms=9)
        xs, ys = np.meshgrid(np.linspace(x - 5, x + 5, 160), np.linspace(y - 2.5, y + 2.5, 80))
        grid = np.broadcast_to(here, (*xs.shape, len(here))).copy()
        grid[..., at[0]], grid[..., at[1]] = xs, ys
        seen = {name: torch.tensor([values[0, tau]]) for name, values in done.observed.items()}
        for part in self.g.bind(seen, task.dt, 1).parts:
            level = getattr(part, "level", None)
            if level is not None:
                value = (
                    level(torch.from_numpy(grid.reshape(1, -1, 1, len(here)).swapaxes(0, 1)))
                    .numpy()
                    .reshape(xs.shape)
                )
                scene.contourf(
                    xs, ys, value, levels=[0, max(value.max(), 1e-9)], colors=[UNSAFE], alpha=0.35
                )
        for name in sorted({name.partition(".")[0] for name in done.observed}):
            scene.plot(
                done.observed[f"{name}.x"][0, tau],
                done.observed[f"{name}.y"][0, tau],
                "o",
                color=UNSAFE,
                ms=9,
            )
        scene.set(
            xlim=(x - 5, x + 5),
            ylim=(y - 2.5, y + 2.5),
            aspect="equal",
            xlabel="x / m",
            ylabel="y / m",
        )
