"""Pictures of closed-loop episodes: the constrained quantities over time, the path beside the obstacle's, videos."""

from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import numpy as np
from matplotlib import pyplot as plt
from numpy.typing import NDArray

from cdiff_cli.control import Controller, Episodes

Array = NDArray[np.float64]
UNSAFE, SAFE, FORESEEN = "#d1495b", "#1d4e89", "#9aa5b1"
EVERY = 2  # environment steps a video frame


def levels_picture(path: Path, controller: Controller, done: Episodes, levels: Array, title: str) -> None:
    """h = -f of every constraint along each episode (unsafe below 0), as executed; pale, as foreseen."""
    parts, plane = controller.g.parts, len(controller.task.positions) == 2
    figure, axes = plt.subplots(max(len(parts), 1) + plane, 1, figsize=(9, 2.6 * (max(len(parts), 1) + plane)), squeeze=False)
    time = np.arange(levels.shape[1]) * controller.task.dt
    for k, (axis, part) in enumerate(zip(axes[:, 0], parts, strict=False)):
        axis.plot(time, -done.foreseen[:, :, k].T, color=FORESEEN, lw=0.6)
        axis.plot(time, -levels[:, :, k].T, color=SAFE, lw=0.7, alpha=0.8)
        axis.axhline(0, color=UNSAFE, lw=1.2)
        axis.set(xlabel="time / s", ylabel=f"h of {part.name}")
    if plane:
        _paths(axes[-1, 0], controller, done)
    axes[0, 0].set_title(title, fontsize=10)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _paths(axis: Any, controller: Controller, done: Episodes) -> None:
    """Executed paths of the positions, and those of what is observed as `<name>.x, <name>.y`."""
    at = [controller.task.layout.index(name) for name in controller.task.positions]
    for path in done.x[..., at]:
        axis.plot(*path.T, color=SAFE, lw=0.8)
    for name in sorted({name.partition(".")[0] for name in done.observed}):
        for x, y in zip(done.observed[f"{name}.x"], done.observed[f"{name}.y"], strict=True):
            axis.plot(x, y, color=UNSAFE, lw=0.6, alpha=0.6)
    axis.set(xlabel="x / m", ylabel="y / m", aspect="equal", adjustable="datalim")


class Recorder:
    """Frames of the first episode while it runs, then a video: the scene above, the constrained quantities below."""

    def __init__(self, path: Path, controller: Controller) -> None:
        self.path, self.controller = path, controller
        self.frames: list[NDArray[np.uint8]] = []
        self.steps: list[int] = []

    def __call__(self, tau: int, env: Any, plan: Array) -> None:
        if tau % EVERY == 0:
            draw = getattr(self.controller.task, "draw", None)
            self.frames.append(env.render() if draw is None else draw(env, plan))
            self.steps.append(tau)

    def write(self, levels: Array) -> None:
        """levels   of the first episode [steps + 1, parts]"""
        import imageio.v3 as iio

        options: Any = {"duration": 40, "loop": 0} if self.path.suffix == ".gif" else {"fps": 25, "macro_block_size": 2}
        iio.imwrite(self.path, np.stack(list(self._composed(levels))), **options)

    def _composed(self, levels: Array) -> Any:
        height, width = self.frames[0].shape[:2]
        figure, (scene, strip) = plt.subplots(
            2, 1, figsize=(width / 80, height / 80 + 2), dpi=80, height_ratios=[height / 80, 2], layout="constrained"
        )
        picture = scene.imshow(self.frames[0])
        scene.axis("off")
        time = np.arange(len(levels)) * self.controller.task.dt
        for k in range(levels.shape[1]):
            strip.plot(time, -levels[:, k], lw=0.6, alpha=0.35, color=f"C{k}")
        lines = [strip.plot([], [], lw=1.2, color=f"C{k}", label=part.name)[0] for k, part in enumerate(self.controller.g.parts)]
        strip.axhline(0, color=UNSAFE, lw=1.2)
        strip.set(xlabel="time / s", ylabel="h, unsafe below 0")
        strip.legend(loc="upper right", fontsize=7, frameon=False)
        for frame, tau in zip(self.frames, self.steps, strict=True):
            picture.set_data(frame)
            for k, line in enumerate(lines):
                line.set_data(time[: tau + 1], -levels[: tau + 1, k])
            figure.canvas.draw()
            drawn = np.asarray(figure.canvas.buffer_rgba())[..., :3]  # type: ignore[attr-defined]
            yield drawn[: drawn.shape[0] // 2 * 2, : drawn.shape[1] // 2 * 2].copy()
        plt.close(figure)
