"""What all pictures share: colours, axis labels, figures and videos.

Figures are made without pyplot, so that drawing changes nothing in the calling process: no backend,
no open figure, no setting.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cdiff_cli.tasks.protocol import Task

UNSAFE = "#d1495b"  # red: unsafe sets, limits, obstacles
RESULT = "#1d4e89"  # blue: executed paths, final samples, values of the shown plans
REFERENCE = "#9aa5b1"  # grey: unconstrained plans, predicted values
ACCENT = "#2e933c"  # green: the plan that is followed, the first state of a chain
INK = "#1b1b1e"  # black: start and goal, the agent
WALL = "#3d4451"  # dark grey
SET_ALPHA = 0.35  # opacity of an unsafe set
FRAME_MS, FRAMES_PER_S = (
    40,
    25,
)  # the same pace for GIF (time per frame) and MP4 (frames per second)

Image = NDArray[np.uint8]
"""RGB picture [height, width, 3]."""


def new_figure(width: float, height: float, dpi: float = 100, layout: Any = None) -> Figure:
    """An empty figure of the given size in inches."""
    figure = Figure(figsize=(width, height), dpi=dpi, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: Path, dpi: float = 130) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=dpi)


def image(figure: Figure) -> Image:
    """The figure as an image; height and width are even, as video codecs need."""
    canvas: Any = figure.canvas
    canvas.draw()
    drawn = np.asarray(canvas.buffer_rgba())[..., :3]
    return drawn[: drawn.shape[0] // 2 * 2, : drawn.shape[1] // 2 * 2].copy()


def write_video(path: Path, frames: Iterable[Image]) -> None:
    """Write a GIF or an MP4, by the suffix of the path."""
    import imageio.v3 as iio

    options: dict[str, Any] = (
        {"duration": FRAME_MS, "loop": 0}
        if path.suffix == ".gif"
        else {"fps": 1000 // FRAME_MS, "macro_block_size": 2}
    )
    iio.imwrite(path, np.stack(list(frames)), **options)


def position_columns(task: Task) -> list[int]:
    """Columns of the positions in a state."""
    return [task.layout.index(name) for name in task.positions]


def position_labels(task: Task) -> list[str]:
    """Axis label of each position: its name, with its unit if it has one."""
    units = [task.units[column] for column in position_columns(task)]
    return [
        f"{name} / {unit}" if unit else name
        for name, unit in zip(task.positions, units, strict=True)
    ]
