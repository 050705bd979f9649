"""The second-order control barrier function of a ball, for inputs that are forces."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from cdiff_cli.arrays import times
from cdiff_cli.constraints.protocol import SegmentPoints, worse_end
from cdiff_cli.constraints.state_sets import Ellipsoid

LEAST_DISTANCE = 1e-9  # [m] smallest distance to the centre; gives the centre itself a normal


@dataclass(frozen=True)
class BallHOCBF:
    """f = -psi with psi = h + time dh/dt, the high-order control barrier function of a ball.

        h = |y| - radius,  y = which x - centre,   dh/dt = (y / |y|).w,  w = rates x - drift

    A path with psi >= 0 has h(t) >= h(0) e^(-t / time), so a path that starts outside never enters.
    The relative degree is 2 (Xiao and Belta, 2019): psi depends on the velocity of one waypoint, so
    a force changes psi within one step, whereas it changes h only steps later.

    which, centre   relative position in metres                [k, dim], [k]
    rates, drift    relative velocity in metres per second     [k, dim], [k]
    radius          metres
    time            seconds
    """

    which: Tensor
    centre: Tensor
    rates: Tensor
    drift: Tensor
    radius: Tensor
    time: float

    trailing: ClassVar = {"which": 2, "centre": 1, "rates": 2, "drift": 1, "radius": 0}
    convex = False

    def __call__(self, x: Tensor) -> Tensor:
        length, _, _, closing = self._sight(x)
        return self.radius - length - self.time * closing

    def _sight(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """|y|, y / |y|, w, and w along the line of sight (y / |y|).w."""
        y = times(x, self.which.mT) - self.centre
        length = torch.linalg.vector_norm(y, dim=-1).clamp_min(LEAST_DISTANCE)
        normal, rate = y / length[..., None], times(x, self.rates.mT) - self.drift
        return length, normal, rate, (normal * rate).sum(-1)

    def gradient(self, x: Tensor) -> Tensor:
        length, normal, rate, closing = self._sight(x)
        across = (rate - closing[..., None] * normal) / length[..., None]
        return -times(normal + self.time * across, self.which) - times(
            self.time * normal, self.rates
        )

    def step_bound(self, x: Tensor) -> Tensor:
        return self.gradient(x).square().sum(-1)

    def pull_back(self, centre: Tensor, scale: Tensor) -> "BallHOCBF":
        return replace(
            self,
            which=self.which * scale[..., None, :],
            centre=self.centre - times(centre, self.which.mT),
            rates=self.rates * scale[..., None, :],
            drift=self.drift - times(centre, self.rates.mT),
        )

    def tighten(self, margin: float) -> "BallHOCBF":
        return replace(self, radius=self.radius + margin)

    def segment_argmax(self, x: Tensor) -> Tensor:
        """The worse end of each segment: the largest value in between is not known."""
        return worse_end(self(x), x)

    def coordinates(self) -> list[int]:
        return list(range(self.which.shape[-1]))

    def restrict(self, columns: Sequence[int]) -> "BallHOCBF":
        return replace(self, which=self.which[..., columns], rates=self.rates[..., columns])

    def on_segment(self, x: Tensor, s: Tensor) -> SegmentPoints:
        f, slope = self(x), self.gradient(x)
        back, on = (1 - s)[..., None] * slope[..., :-1, :], s[..., None] * slope[..., 1:, :]
        return SegmentPoints(
            torch.lerp(f[..., :-1], f[..., 1:], s),
            back,
            on,
            back.square().sum(-1) + on.square().sum(-1),
        )


def second_order(ball: Ellipsoid, later: Tensor, matrix: Tensor, time: float) -> BallHOCBF:
    """The second-order barrier of a ball whose outside is allowed.

    later    centre of the ball after `time` seconds                [..., k]
    matrix   the state after `time` seconds is matrix x             [dim, dim]
    """
    one = torch.eye(len(matrix), dtype=matrix.dtype, device=matrix.device)
    rates = ball.which @ (matrix - one) / time
    return BallHOCBF(ball.which, ball.centre, rates, (later - ball.centre) / time, ball.m, time)
