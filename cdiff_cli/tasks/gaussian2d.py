"""Figure 1 of the paper: points of a 2-D Gaussian outside a disc, sampled with the exact score."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from cdiff_cli.arrays import Array, Traj
from cdiff_cli.errors import CdiffError
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.tasks.protocol import Control, Tolerances

DEVIATIONS = (1.5, 1.0)  # standard deviations along the principal axes
ANGLE = math.pi / 6  # from the x axis to the first principal axis [rad]


class Gaussian2D:
    """A distribution x ~ N(0, S) of one waypoint, without pins.

    S has standard deviations DEVIATIONS along axes that are rotated by ANGLE.
    """

    name = "gaussian2d"
    layout = ("x", "y")
    units = ("", "")
    positions = ("x", "y")
    velocities: tuple[str, ...] = ()
    shared_scale = (("x", "y"),)
    dt = 1.0
    control: Control = "open_loop"
    tolerances = Tolerances()
    scale = 1.5

    def covariance(self) -> torch.Tensor:
        """S [2, 2]."""
        c, s = math.cos(ANGLE), math.sin(ANGLE)
        axes = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
        variances = torch.tensor(DEVIATIONS, dtype=torch.float64).square()
        return axes @ torch.diag(variances) @ axes.T

    def denoiser(self, schedule: Schedule) -> Callable[[Traj, int], Traj]:
        """E[x_0 | x_t] = sqrt(a) S (a S + (1 - a) I)^-1 x_t, in normalised coordinates."""
        covariance = self.covariance() / self.scale**2
        alpha_bar = dict(zip(schedule.t, schedule.alpha_bar, strict=True))
        identity = torch.eye(2, dtype=torch.float64)

        def clean(x: Traj, t: int) -> Traj:
            a = alpha_bar[t]
            inverse = torch.linalg.inv(a * covariance + (1 - a) * identity)
            gain = math.sqrt(a) * covariance @ inverse
            return x @ gain.T.to(x)

        return clean

    def truth(self, n: int, seed: int) -> Array:
        """Exact samples of the unconstrained distribution [n, 2]."""
        rng = np.random.default_rng(seed)
        return rng.multivariate_normal(np.zeros(2), self.covariance().numpy(), n)

    def make_env(self, render: bool = False) -> Any:
        """Raises CdiffError."""
        raise CdiffError(
            "gaussian2d is a distribution, not an environment: "
            "it can be planned, not rolled out or trained"
        )

    def observe(self, obs: Any) -> Array:
        """The observation itself, as an array."""
        return np.asarray(obs, dtype=np.float64)


GAUSSIAN2D = Gaussian2D()
