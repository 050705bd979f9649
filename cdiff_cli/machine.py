"""The machine that a result is made on: device, package versions, commit.

torch is imported inside the functions, so that commands without a planner stay light.
"""

import contextlib
import platform
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cdiff_cli.errors import CdiffError

if TYPE_CHECKING:
    import torch

DESCRIBE = ("describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*")


def choose_device(name: str) -> "torch.device":
    """The device of that name; `auto` is cuda if there is one, else cpu. Raises CdiffError."""
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise CdiffError(
            f'device "{name}" cannot be used here: {reason}; try --device cpu'
        ) from None
    return device


def git_commit() -> str:
    """The commit of the checkout, with '+' if files differ from it; 'none' outside a checkout."""
    command = ["git", "-C", str(Path(__file__).parent), *DESCRIBE]
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    return "none"


def record(device: "torch.device", wall_s: float, packages: Sequence[str]) -> dict[str, Any]:
    """The head of run.yaml: command, commit, versions of the installed packages, device, time.

    wall_s   [s]
    """
    installed = {}
    for name in packages:
        with contextlib.suppress(PackageNotFoundError):
            installed[name] = version(name)
    return {
        "command": ["cdiff", *sys.argv[1:]],
        "commit": git_commit(),
        "versions": installed,
        "python": platform.python_version(),
        "device": device_name(device),
        "wall_s": round(wall_s, 3),
    }


def device_name(device: "torch.device") -> str:
    """Name of the GPU, or 'cpu (N threads)'."""
    import torch

    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"cpu ({torch.get_num_threads()} threads)"
