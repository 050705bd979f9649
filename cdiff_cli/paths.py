"""Where models/ and constraints/ are, and how paths are shown."""

import os
from pathlib import Path

from cdiff_cli.errors import CdiffError


def home() -> Path:
    """The folder with models/ and constraints/: working directory, else checkout, else package."""
    package = Path(__file__).parent
    for place in (Path.cwd(), package.parent, package / "shipped"):
        if (place / "models").is_dir() and (place / "constraints").is_dir():
            return place
    raise CdiffError(
        "no folder models/ and constraints/ here; run cdiff in its checkout, or reinstall it"
    )


def shown(path: Path) -> Path:
    """The path relative to the working directory if it lies below it, else as it is."""
    below = path.is_absolute() and path.is_relative_to(Path.cwd())
    return Path(os.path.relpath(path)) if below else path
