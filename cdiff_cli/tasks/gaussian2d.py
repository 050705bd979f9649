"""Figure 1 of the paper: points of a 2-D Gaussian kept outside a disc, sampled with the exact score."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from cdiff_cli.arrays import Array, Traj
from cdiff_cli.errors import CdiffError
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.tasks.protocol import Control, Tolerances


class Gaussian2D:
    """x ~ N(0, S), S with standard deviations 1.5 and 1 along axes turned by 30 degrees. One waypoint, no pins."""

    name = "gaussian2d"
    layout = ("x", "y")
    units = ("", "")
    positions = ("x", "y")
    velocities: tuple[str, ...] = ()
    shared_scale = (("x", "y"),)
    dt = 1.0
    control: Control = "open_loop"
    tolerances = Tolerances()
    scale = 1.5  # of the normalised coordinates

    def covariance(self) -> torch.Tensor:
        c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
        turn = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
        return turn @ torch.diag(torch.tensor([1.5, 1.0], dtype=torch.float64).square()) @ turn.T

    def denoiser(self, schedule: Schedule) -> Callable[[Traj, int], Traj]:
        """E[x_0 | x_t] = sqrt(a) S (a S + (1 - a) I)^-1 x_t, exactly, in normalised coordinates."""
        covariance = self.covariance() / self.scale**2
        level = dict(zip(schedule.t, schedule.alpha_bar, strict=True))

        def clean(x: Traj, t: int) -> Traj:
            a = level[t]
            gain = (
                math.sqrt(a)
                * covariance
                @ torch.linalg.inv(a * covariance + (1 - a) * torch.eye(2, dtype=torch.float64))
            )
            return x @ gain.T.to(x)

        return clean

    def truth(self, n: int, seed: int) -> Array:
        """Exact samples of the unconstrained law [n, 2]."""
        rng = np.random.default_rng(seed)
        return rng.multivariate_normal(np.zeros(2), self.covariance().numpy(), n)

    def make_env(self, render: bool = False) -> Any:
        raise CdiffError(
            "gaussian2d is a distribution, not an environment: it can be planned, not rolled out or trained"
        )

    def observe(self, obs: Any) -> Array:
        return np.asarray(obs, dtype=np.float64)


GAUSSIAN2D = Gaussian2D()
