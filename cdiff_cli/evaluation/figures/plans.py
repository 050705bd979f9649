"""Pictures: plans in the maze, convergence over the diffusion steps, Langevin chains, rollout videos."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint

mpl.use("Agg")
UNSAFE, FREE = "#d1495b", "#9aa5b1"


def plan_picture(
    path: Path, task: Any, g: Constraint, x: Array, x_free: Array | None, title: str
) -> None:
    """Plans coloured by time over the pale unconstrained ones, with the unsafe sets; a strip a constraint not in the plane."""
    at = _columns(task)
    strips = [part for part in g.parts if not in_plane(part, task)]
    figure, axes = _canvas(task, x, at, len(strips))
    draw_maze(axes[0], task)
    draw_unsafe(axes[0], task, g)
    if x.shape[1] == 1:
        axes[0].plot(*x[:, 0, at].T, ".", ms=2, color="#1d4e89")
    for line in () if x_free is None else x_free:
        axes[0].plot(*line[:, at].T, color=FREE, lw=0.9, alpha=0.7, zorder=2)
    if x.shape[1] > 1:
        draw_timed(axes[0], x[..., at])
        axes[0].plot(*x[:, 0, at].T, "o", color="#1b1b1e", ms=5, zorder=5)
        axes[0].plot(*x[:, -1, at].T, "*", color="#1b1b1e", ms=9, zorder=5)
    axes[0].set_title(title, fontsize=10)
    for axis, part in zip(axes[1:], strips, strict=True):
        for plans, colour in ((x_free, FREE), (x, "#1d4e89")):
            if plans is not None:
                axis.plot(part(torch.from_numpy(plans)).numpy().T, color=colour, lw=0.8)
        axis.axhline(0, color=UNSAFE, lw=1)
        axis.set(xlabel="waypoint", ylabel="g (unsafe above 0)", title=part.name)
    _save(figure, path)


def convergence_picture(path: Path, traces: dict[str, Array]) -> None:
    """Total violation (mean over plans) against the network call, of the noisy sample and of its clean estimate."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True)
    for name, trace in traces.items():
        for column, (axis, where) in enumerate(
            zip(axes, ("noisy sample x_t", "clean estimate"), strict=True)
        ):
            axis.plot(np.arange(1, len(trace) + 1), trace[:, column].mean(-1), label=name)
            axis.set(xlabel="network call", title=where)
    axes[0].set_ylabel("total violation, mean over plans")
    axes[0].set_yscale("symlog", linthresh=1e-3)
    axes[0].legend(frameon=False, fontsize=8)
    _save(figure, path)


def chain_picture(
    path: Path, task: Any, g: Constraint, chain: Array, truth: Array | None, title: str
) -> None:
    """Density of all chain states, the last states, and a few whole chains (Figure 1)."""
    figure, axis = plt.subplots(figsize=(5.2, 5))
    points, last = chain.reshape(-1, chain.shape[-1]), chain[-1, :, 0]
    axis.hexbin(
        *points[:, :2].T, gridsize=60, extent=(-4, 4, -4, 4), cmap="YlOrBr", mincnt=1, bins="log"
    )
    draw_unsafe(axis, task, g, (-4, 4, -4, 4))
    for k in range(min(3, chain.shape[1])):
        axis.plot(*chain[::5, k, 0].T, color=UNSAFE, lw=0.4, alpha=0.8)
        axis.plot(*chain[0, k, 0], "o", color="#2e933c", ms=5)
    axis.plot(*last.T, ".", color="#1d4e89", ms=2.5)
    if truth is not None:
        axis.contour(*_density(truth), levels=4, colors="k", linewidths=0.5)
    axis.set(xlim=(-4, 4), ylim=(-4, 4), aspect="equal", title=title)
    _save(figure, path)


def rollout_video(
    path: Path, task: Any, g: Constraint, executed: Array, plans: Array, every: int = 2
) -> None:
    """The first episode as a GIF or an MP4, by the suffix of the path: maze, unsafe sets, plan, ball, path so far."""
    import imageio.v3 as iio

    iio.imwrite(
        path, np.stack(list(_frames(task, g, executed[0], plans[0], every))), **_writer(path)
    )


def _writer(path: Path) -> dict[str, Any]:
    return (
        {"duration": 40, "loop": 0} if path.suffix == ".gif" else {"fps": 25, "macro_block_size": 2}
    )


def _frames(
    task: Any, g: Constraint, executed: Array, plan: Array, every: int
) -> Iterator[NDArray[np.uint8]]:
    at = _columns(task)
    figure, axes = _canvas(task, executed[None], at, 0, dpi=80)
    draw_maze(axes[0], task)
    draw_unsafe(axes[0], task, g)
    axes[0].plot(*plan[:, at].T, color=FREE, lw=1)
    (trail,) = axes[0].plot([], [], color="#1d4e89", lw=1.5)
    (ball,) = axes[0].plot([], [], "o", color="#1b1b1e", ms=8)
    for tau in range(0, len(executed), every):
        trail.set_data(*executed[: tau + 1, at].T)
        ball.set_data(*executed[tau : tau + 1, at].T)
        figure.canvas.draw()
        frame = np.asarray(figure.canvas.buffer_rgba())[..., :3]
        yield frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2].copy()
    plt.close(figure)


def in_plane(part: TrajectoryConstraint, task: Any) -> bool:
    """Whether the part is a set in the plane of the positions, so that it can be drawn there."""
    level = getattr(part, "level", None)
    if level is None or len(task.positions) != 2:
        return False
    others = [i for i in range(len(task.layout)) if i not in _columns(task)]
    probe = torch.tensor(np.random.default_rng(0).normal(size=(16, len(task.layout))))
    return not others or bool((level.gradient(probe)[:, others] == 0).all())


def draw_maze(axis: Any, task: Any) -> None:
    for x0, y0, x1, y1 in task.walls():
        axis.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, color="#3d4451", lw=0, zorder=1))


def draw_unsafe(axis: Any, task: Any, g: Constraint, extent: Sequence[float] | None = None) -> None:
    at = _columns(task)
    x0, x1, y0, y1 = extent or _extent(task)
    xs, ys = np.meshgrid(np.linspace(x0, x1, 400), np.linspace(y0, y1, 400))
    grid = np.zeros((*xs.shape, len(task.layout)))
    grid[..., at[0]], grid[..., at[1]] = xs, ys
    for part in g.parts:
        if (level := part.level) is not None and in_plane(part, task):
            value = level(torch.from_numpy(grid)).numpy()
            if value.max() > 0:
                axis.contourf(
                    xs,
                    ys,
                    value,
                    levels=[0, max(value.max(), 1e-9)],
                    colors=[UNSAFE],
                    alpha=0.35,
                    zorder=3,
                )
                axis.contour(xs, ys, value, levels=[0], colors=[UNSAFE], linewidths=1.2, zorder=3)


def draw_timed(axis: Any, paths: Array) -> None:
    """Lines [n, horizon, 2] coloured from start (blue) to end (red)."""
    for path in paths:
        pairs = np.stack((path[:-1], path[1:]), axis=1)
        lines = LineCollection(
            list(pairs), cmap="turbo", array=np.linspace(0.05, 0.95, len(pairs)), lw=1.4, zorder=4
        )
        lines.set_clim(0, 1)
        axis.add_collection(lines)


def _columns(task: Any) -> list[int]:
    return [task.layout.index(name) for name in task.positions]


def _extent(task: Any) -> tuple[float, float, float, float]:
    walls = task.walls()
    if len(walls) == 0:
        return -4.0, 4.0, -4.0, 4.0
    return walls[:, 0].min(), walls[:, 2].max(), walls[:, 1].min(), walls[:, 3].max()


def _canvas(task: Any, x: Array, at: list[int], strips: int, dpi: int = 130) -> tuple[Any, Any]:  # noqa: ARG001
    x0, x1, y0, y1 = _extent(task)
    height = 4.2
    width = max(height * (x1 - x0) / (y1 - y0), 3.6)
    ratios = [width] + [4.0] * strips
    figure, axes = plt.subplots(
        1,
        1 + strips,
        figsize=(sum(ratios), height + 0.4),
        dpi=dpi,
        squeeze=False,
        width_ratios=ratios,
    )
    axes[0, 0].set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xlabel="x / m", ylabel="y / m")
    return figure, axes[0]


def _density(points: Array) -> tuple[Array, Array, Array]:
    counts, xs, ys = np.histogram2d(points[:, 0], points[:, 1], bins=40, range=[[-4, 4], [-4, 4]])
    return (xs[1:] + xs[:-1]) / 2, (ys[1:] + ys[:-1]) / 2, counts.T


def _save(figure: Any, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)
