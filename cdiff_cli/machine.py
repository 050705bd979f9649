"""Where a result is made: device, versions, commit."""

import contextlib
import platform
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from cdiff_cli.errors import CdiffError


def choose_device(name: str) -> torch.device:
    """`auto` is cuda where there is one, else cpu."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise CdiffError(
            f'device "{name}" cannot be used here: {str(error).splitlines()[0]}; try --device cpu'
        ) from None
    return device


def git_commit() -> str:
    """The checkout's commit, with '+' where files differ from it; 'none' outside a checkout."""
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        run = [
            "git",
            "-C",
            str(Path(__file__).parent),
            "describe",
            "--always",
            "--dirty=+",
            "--abbrev=12",
            "--exclude=*",
        ]
        return subprocess.run(run, capture_output=True, text=True, check=True).stdout.strip()
    return "none"


def record(device: torch.device, wall_s: float, packages: Sequence[str]) -> dict[str, Any]:
    """What a run says of its making: command, commit, versions of packages, device, seconds."""
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


def device_name(device: torch.device) -> str:
    return (
        torch.cuda.get_device_name(device)
        if device.type == "cuda"
        else f"cpu ({torch.get_num_threads()} threads)"
    )
