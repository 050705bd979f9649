"""The barrier of a ball that is approached: distance and its rate of change together, for inputs that are forces."""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from cdiff_cli.arrays import times
from cdiff_cli.constraints.state_sets import Ellipsoid, SegmentPoints

NEAREST = 1e-9  # of a distance to the centre, so that the centre itself has a normal


@dataclass(frozen=True)
class BallHOCBF:
    """f = -psi,  psi = h + time dh/dt,  h = |y| - radius  with y = which x - centre, and dh/dt = (y / |y|).w, w = rates x - drift.

    psi >= 0 all along gives h(t) >= h(0) e^(-t / time): a path that starts outside never enters (a control barrier function of
    relative degree 2; Xiao and Belta, 2019). One waypoint's positions and velocities decide it, and an input that is a force
    moves it at once, where h alone answers only steps later.

    which, centre   relative position in metres      [k, dim], [k]
    rates, drift    relative velocity in metres a second   [k, dim], [k]
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
        """|y|, y / |y|, w and w along the line of sight, (y / |y|).w."""
        y = times(x, self.which.mT) - self.centre
        length = torch.linalg.vector_norm(y, dim=-1).clamp_min(NEAREST)
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
        """The worse end of each segment: nothing more is known of it between them."""
        f = self(x)
        return (f[..., 1:] > f[..., :-1]).to(x)

    def on_segment(self, x: Tensor, s: Tensor) -> SegmentPoints:
        f, slope = self(x), self.gradient(x)
        back, on = (1 - s)[..., None] * slope[..., :-1, :], s[..., None] * slope[..., 1:, :]
        return SegmentPoints(
            torch.lerp(f[..., :-1], f[..., 1:], s),
            back,
            on,
            back.square().sum(-1) + on.square().sum(-1),
        )


def second_order(ball: Ellipsoid, later: Tensor, led: Tensor, time: float) -> BallHOCBF:
    """The barrier of a ball that states keep outside of.

    later   where its centre will be `time` seconds on    [..., k]
    led     the state `time` seconds on is led x          [dim, dim]
    """
    rates = ball.which @ (led - torch.eye(len(led), dtype=led.dtype, device=led.device)) / time
    return BallHOCBF(ball.which, ball.centre, rates, (later - ball.centre) / time, ball.m, time)
