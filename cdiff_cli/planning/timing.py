"""Time of the network and of the rest; seeds of further candidates."""

import time
from dataclasses import dataclass

import numpy as np
import torch

from cdiff_cli.arrays import Traj
from cdiff_cli.models.denoiser import Denoiser


def candidate_seed(seed: int, j: int) -> int:
    """The seed of candidate j: the seed itself, then draws that no neighbouring seed shares."""
    return seed if j == 0 else int(np.random.SeedSequence((seed, j)).generate_state(1)[0])


@dataclass
class Timed:
    """A denoiser whose wall time is added up."""

    denoiser: Denoiser
    device: torch.device
    seconds: float = 0.0

    def __call__(self, x: Traj, t: int) -> Traj:
        synchronise(self.device)
        began = time.perf_counter()
        x0 = self.denoiser(x, t)
        synchronise(self.device)
        self.seconds += time.perf_counter() - began
        return x0


def synchronise(device: torch.device) -> None:
    """Wait for the device, so that a clock read afterwards counts its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
