"""Where models and constraints are, and how paths are shown."""

import os
from pathlib import Path

from cdiff_cli.errors import CdiffError


def home() -> Path:
    """Where models/ and constraints/ are: the working directory if it has them, else the checkout, else the package."""
    package = Path(__file__).parent
    for place in (Path.cwd(), package.parent, package / "shipped"):
        if (place / "models").is_dir() and (place / "constraints").is_dir():
            return place
    raise CdiffError(
        "no folder models/ and constraints/ here; run cdiff in its checkout, or reinstall it"
    )


def shown(path: Path) -> Path:
    """The path relative to the working directory where it lies below it."""
    return (
        Path(os.path.relpath(path))
        if path.is_absolute() and path.is_relative_to(Path.cwd())
        else path
    )
