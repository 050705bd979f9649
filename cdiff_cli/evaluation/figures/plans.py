"""Pictures of plans: in the plane, over the diffusion steps, Langevin chains, rollout videos."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cdiff_cli.arrays import Array
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.evaluation.figures.style import (
    ACCENT,
    INK,
    REFERENCE,
    RESULT,
    SET_ALPHA,
    UNSAFE,
    WALL,
    Image,
    image,
    new_figure,
    position_columns,
    position_labels,
    save,
    write_video,
)
from cdiff_cli.tasks.protocol import Task, walls_of

Extent = tuple[float, float, float, float]
"""Drawn part of the plane: x_min, x_max, y_min, y_max."""

HEIGHT = 4.2  # [inch] of the plane
LEAST_WIDTH = 3.6  # [inch] of the plane
STRIP_WIDTH = 4.0  # [inch] of a constraint that has no place in the plane
GRID = 400  # points per axis at which unsafe sets are evaluated
CHAIN_SHARE = (
    0.998  # share of the chain states, per coordinate, inside the extent of a chain picture
)


def plan_picture(
    path: Path, task: Task, g: Constraint, x: Array, x_free: Array | None, title: str
) -> None:
    """Draw plans in the plane, coloured by time, with the unsafe sets.

    A constraint that has no place in the plane gets a strip of its own: g over the waypoints.

    x        plans or executed paths              [n, horizon, dim]
    x_free   unconstrained plans, drawn in grey   [n, horizon, dim]
    """
    columns = position_columns(task)
    strips = [part for part in g.parts if not _in_plane(part, task)]
    extent = _extent(task, g, [x] if x_free is None else [x, x_free])
    figure, plane, strip_axes = _canvas(task, extent, len(strips))
    _draw_walls(plane, task)
    _draw_unsafe(plane, task, g, extent)
    if x.shape[1] == 1:
        plane.plot(*x[:, 0, columns].T, ".", ms=2, color=RESULT)
    for line in () if x_free is None else x_free:
        plane.plot(*line[:, columns].T, color=REFERENCE, lw=0.9, alpha=0.7, zorder=2)
    if x.shape[1] > 1:
        _draw_timed(plane, x[..., columns])
        plane.plot(*x[:, 0, columns].T, "o", color=INK, ms=5, zorder=5)
        plane.plot(*x[:, -1, columns].T, "*", color=INK, ms=9, zorder=5)
    plane.set_title(title, fontsize=10)
    for axis, part in zip(strip_axes, strips, strict=True):
        for plans, colour in ((x_free, REFERENCE), (x, RESULT)):
            if plans is not None:
                axis.plot(part(torch.from_numpy(plans)).numpy().T, color=colour, lw=0.8)
        axis.axhline(0, color=UNSAFE, lw=1)
        axis.set(xlabel="waypoint", ylabel="g (unsafe above 0)", title=part.name)
    save(figure, path)


def convergence_picture(path: Path, traces: dict[str, Array]) -> None:
    """Draw the total violation over the network calls, as a mean over the plans.

    traces   violation of the noisy sample and of its clean estimate, by method   [calls, 2, n]
    """
    figure = new_figure(9, 3.4)
    axes = figure.subplots(1, 2, sharey=True)
    for name, trace in traces.items():
        for column, (axis, title) in enumerate(
            zip(axes, ("noisy sample x_t", "clean estimate"), strict=True)
        ):
            axis.plot(np.arange(1, len(trace) + 1), trace[:, column].mean(-1), label=name)
            axis.set(xlabel="network call", title=title)
    axes[0].set_ylabel("total violation, mean over plans")
    axes[0].set_yscale("symlog", linthresh=1e-3)
    axes[0].legend(frameon=False, fontsize=8)
    save(figure, path)


def chain_picture(
    path: Path, task: Task, g: Constraint, chain: Array, truth: Array | None, title: str
) -> None:
    """Draw Langevin chains: density of all states, the last states, three whole chains (Figure 1).

    chain   states of each chain                               [steps, n, 1, dim]
    truth   samples of the constrained law, drawn as contours  [m, dim]
    """
    figure = new_figure(5.2, 5)
    axis = figure.subplots()
    points, last = chain.reshape(-1, chain.shape[-1])[:, :2], chain[-1, :, 0]
    tail = (1 - CHAIN_SHARE) / 2
    extent = _box(np.quantile(points, [tail, 1 - tail], axis=0))
    axis.hexbin(*points.T, gridsize=60, extent=extent, cmap="YlOrBr", mincnt=1, bins="log")
    _draw_unsafe(axis, task, g, extent)
    for k in range(min(3, chain.shape[1])):
        axis.plot(*chain[::5, k, 0].T, color=UNSAFE, lw=0.4, alpha=0.8)
        axis.plot(*chain[0, k, 0], "o", color=ACCENT, ms=5)
    axis.plot(*last.T, ".", color=RESULT, ms=2.5)
    if truth is not None:
        axis.contour(*_density(truth, extent), levels=4, colors="k", linewidths=0.5)
    x0, x1, y0, y1 = extent
    axis.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", title=title)
    save(figure, path)


def rollout_video(
    path: Path, task: Task, g: Constraint, executed: Array, plans: Array, every: int = 2
) -> None:
    """Write a video of the first episode, GIF or MP4 by the suffix of the path.

    executed   states of each episode           [n, steps + 1, dim]
    plans      the plan that each one follows   [n, horizon, dim]
    every      environment steps per frame
    """
    write_video(path, _frames(task, g, executed[0], plans[0], every))


def _frames(task: Task, g: Constraint, executed: Array, plan: Array, every: int) -> Iterator[Image]:
    columns = position_columns(task)
    extent = _extent(task, g, [executed, plan])
    figure, axis, _ = _canvas(task, extent, strips=0, dpi=80)
    _draw_walls(axis, task)
    _draw_unsafe(axis, task, g, extent)
    axis.plot(*plan[:, columns].T, color=REFERENCE, lw=1)
    (trail,) = axis.plot([], [], color=RESULT, lw=1.5)
    (agent,) = axis.plot([], [], "o", color=INK, ms=8)
    for tau in range(0, len(executed), every):
        trail.set_data(*executed[: tau + 1, columns].T)
        agent.set_data(*executed[tau : tau + 1, columns].T)
        yield image(figure)


def _in_plane(part: TrajectoryConstraint, task: Task) -> bool:
    """Whether the constraint is a set in the plane of the positions, and can be drawn there."""
    level = getattr(part, "level", None)
    if level is None or len(task.positions) != 2:
        return False
    others = [i for i in range(len(task.layout)) if i not in position_columns(task)]
    probe = torch.tensor(np.random.default_rng(0).normal(size=(16, len(task.layout))))
    return not others or bool((level.gradient(probe)[:, others] == 0).all())


def _draw_walls(axis: Any, task: Task) -> None:
    for x0, y0, x1, y1 in walls_of(task):
        axis.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, color=WALL, lw=0, zorder=1))


def _draw_unsafe(axis: Any, task: Task, g: Constraint, extent: Extent) -> None:
    for xs, ys, value in _values_in_plane(task, g, extent):
        if value.max() > 0:
            levels = [0, max(value.max(), 1e-9)]
            axis.contourf(xs, ys, value, levels, colors=[UNSAFE], alpha=SET_ALPHA, zorder=3)
            axis.contour(xs, ys, value, levels=[0], colors=[UNSAFE], linewidths=1.2, zorder=3)


def _values_in_plane(
    task: Task, g: Constraint, extent: Extent
) -> Iterator[tuple[Array, Array, Array]]:
    """Grid (xs, ys) over the extent and f on it, for each constraint that is a set in the plane."""
    columns = position_columns(task)
    x0, x1, y0, y1 = extent
    xs, ys = np.meshgrid(np.linspace(x0, x1, GRID), np.linspace(y0, y1, GRID))
    grid = np.zeros((*xs.shape, len(task.layout)))
    grid[..., columns[0]], grid[..., columns[1]] = xs, ys
    for part in g.parts:
        if (level := part.level) is not None and _in_plane(part, task):
            yield xs, ys, level(torch.from_numpy(grid)).numpy()


def _draw_timed(axis: Any, paths: Array) -> None:
    """Lines [n, horizon, 2] coloured from start (blue) to end (red)."""
    for path in paths:
        pairs = np.stack((path[:-1], path[1:]), axis=1)
        lines = LineCollection(
            list(pairs), cmap="turbo", array=np.linspace(0.05, 0.95, len(pairs)), lw=1.4, zorder=4
        )
        lines.set_clim(0, 1)
        axis.add_collection(lines)


def _extent(task: Task, g: Constraint, trajectories: Sequence[Array]) -> Extent:
    """The walls; without walls, the trajectories; without trajectories, the unsafe sets."""
    walls = walls_of(task)
    if len(walls):
        return walls[:, 0].min(), walls[:, 2].max(), walls[:, 1].min(), walls[:, 3].max()
    columns = position_columns(task)
    points = np.concatenate([x.reshape(-1, x.shape[-1])[:, columns] for x in trajectories])
    points = points[np.isfinite(points).all(1)]
    return _box(points) if len(points) else _around_sets(task, g)


def _box(points: Array) -> Extent:
    """The box around points [n, 2], a tenth larger, its sides at most 2 to 1."""
    low, high = points.min(0), points.max(0)
    half = (high - low) / 2
    half = 1.1 * np.maximum(half, half.max() / 2 or 1.0)
    (x, y), (dx, dy) = (low + high) / 2, half
    return x - dx, x + dx, y - dy, y + dy


def _around_sets(task: Task, g: Constraint) -> Extent:
    """The smallest of some squares around the origin that shows a boundary of every set."""
    for half in (2.0, 4.0, 8.0, 16.0, 32.0, 64.0):
        extent = (-half, half, -half, half)
        if all(value.min() <= 0 < value.max() for _, _, value in _values_in_plane(task, g, extent)):
            break
    return extent


def _canvas(
    task: Task, extent: Extent, strips: int, dpi: float = 130
) -> tuple[Figure, Any, list[Any]]:
    """A figure, its axes for the plane, and one pair of axes per strip."""
    x0, x1, y0, y1 = extent
    widths = [max(HEIGHT * (x1 - x0) / (y1 - y0), LEAST_WIDTH)] + [STRIP_WIDTH] * strips
    figure = new_figure(sum(widths), HEIGHT + 0.4, dpi)
    plane, *others = figure.subplots(1, 1 + strips, squeeze=False, width_ratios=widths)[0]
    label_x, label_y = position_labels(task)
    plane.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xlabel=label_x, ylabel=label_y)
    return figure, plane, others


def _density(points: Array, extent: Extent) -> tuple[Array, Array, Array]:
    """Histogram of points [n, 2] over the extent: centres of its bins along x and y, counts."""
    x0, x1, y0, y1 = extent
    x, y = points[:, :2].T
    counts, xs, ys = np.histogram2d(x, y, bins=40, range=[[x0, x1], [y0, y1]])
    return (xs[1:] + xs[:-1]) / 2, (ys[1:] + ys[:-1]) / 2, counts.T
