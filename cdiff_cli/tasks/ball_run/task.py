"""Ball run: a ball runs along x as fast as it can, past a moving obstacle.

The agent observes the present position and velocity of the obstacle, not its motion to come.
The force is 3.5 N times an input in [-1, 1]^2. About v' = 0.987 v + 0.274 u holds, so one input
moves the ball by 6 mm within its own step. Ball and obstacle have a radius of 0.5 m: they touch at
a distance of 1 m between their centres.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from cdiff_cli.arrays import Array
from cdiff_cli.tasks.ball_run.obstacles import PATTERNS, beside
from cdiff_cli.tasks.protocol import Control, Tolerances

DT = 4 / 120  # s
PUSH = 8.2  # m/s^2 per unit of input
DRAG = 0.4  # 1/s
OBSERVED = np.array(
    [0.1, 0.1, 0.2, 0.2]
)  # factors of (x, y, vx, vy) in SafetyBallRun's observation
BURST = 10  # random inputs after each demonstration, in an episode of their own
SHARES = {"straight": 0.15, "lane change": 0.4, "weave": 0.3, "arc": 0.15}
"""Share of the demonstrations of each mode (Runner)."""
Policy = Callable[[int, Array], Array]
"""(step, state [4]) -> input [2]."""


@dataclass(frozen=True)
class BallRun:
    """The task; its environment is env.BallRunEnv."""

    name: str = "ball-run"
    horizon: int = 16
    max_steps: int = 100

    layout = ("x", "y", "vx", "vy")
    units = ("m", "m", "m/s", "m/s")
    positions = ("x", "y")
    velocities = ("vx", "vy")
    shared_scale = (("x", "y"), ("vx", "vy"))
    dt = DT
    control: ClassVar[Control] = "receding_horizon"
    tolerances = Tolerances()
    actions = ("force_x", "force_y")
    invariant = ("x",)
    env_options: ClassVar[Mapping[str, tuple[Any, ...]]] = {
        "pattern": tuple(PATTERNS),
        "collide": (True, False),
    }
    observable = ("obstacle.x", "obstacle.y", "obstacle.vx", "obstacle.vy")
    relative_to: ClassVar[Mapping[str, str]] = {
        name: name.removeprefix("obstacle.") for name in observable
    }

    def make_env(
        self, render: bool = False, pattern: str | None = None, collide: bool = True
    ) -> Any:
        """The environment, truncated after max_steps.

        pattern   motion of the obstacle; None: pattern number seed % 6
        collide   whether the obstacle pushes the ball
        """
        import gymnasium

        from cdiff_cli.tasks.ball_run.env import ENV_ID

        mode = "rgb_array" if render else None
        return gymnasium.make(
            ENV_ID,
            max_episode_steps=self.max_steps,
            pattern=pattern,
            collide=collide,
            render_mode=mode,
        )

    def observe(self, obs: Any) -> Array:
        """State (x, y, vx, vy) [m, m/s] of an observation, or states of an episode of them."""
        return np.asarray(obs, dtype=np.float64)[..., :4] / OBSERVED

    def observed(self, env: Any) -> dict[str, float]:
        """Present position [m] and velocity [m/s] of the obstacle."""
        return env.unwrapped.observed()

    def observed_along(self, run: Array, rng: np.random.Generator) -> Mapping[str, Array]:
        """Positions [m] and velocities [m/s] of an obstacle along a run [n, 4], each [n].

        The obstacle is a ghost, which does not touch the ball. Its pattern is one of the six, and
        it starts as in an episode.
        """
        motion = PATTERNS[rng.choice(tuple(PATTERNS))](rng)
        return dict(zip(self.observable, beside(motion, run[:, :2], self.dt).T, strict=True))

    def brake(self, state: Array) -> Array:
        """Input that stops the ball: full force for about an eighth of a second per m/s."""
        return np.clip(-state[2:], -1.0, 1.0)

    def from_d4rl(self, states: Array) -> Array:
        """States of SafetyBallRun's observations."""
        return self.observe(states)

    def demonstrate(self, n_steps: int, seed: int) -> Iterator[dict[str, Any]]:
        """Runs of max_steps by a PD tracker without an obstacle, each followed by a random burst.

        There are n_steps environment steps in all. A burst is an episode of its own, shorter than
        a window: it serves the inverse dynamics alone.
        """
        from cdiff_cli.tasks.ball_run.env import BallRunEnv

        rng = np.random.default_rng(seed)
        env, done = BallRunEnv("none"), 0
        while done < n_steps:
            obs, _ = env.reset(seed=int(rng.integers(2**31)))
            for policy, length in ((Runner(rng), self.max_steps), (_random_policy(rng), BURST)):
                steps = min(length, n_steps - done)
                rows: dict[str, list[Any]] = {"observations": [obs], "actions": [], "rewards": []}
                for step in range(steps):
                    u = policy(step, self.observe(obs)).astype(np.float32)
                    obs, reward, _, _, _ = env.step(u)
                    rows["observations"].append(obs)
                    rows["actions"].append(u)
                    rows["rewards"].append(reward)
                done += steps
                if steps:
                    yield rows
        env.close()


class Runner:
    """A policy that tracks a speed and a lateral position by PD, with AR(1) noise on the input.

    Gains, references and noise are random. The mode sets the lateral reference: straight on, from
    lane to lane, weaving about a lane, or an arc (a parabola in time) to one side.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.mode = str(rng.choice(list(SHARES), p=list(SHARES.values())))
        self.mean_speed, self.lane = rng.uniform(2.9, 4.9), rng.uniform(-1.6, 1.6)
        self.kp, self.kd, self.kv = (
            rng.uniform(3.0, 9.0),
            rng.uniform(2.0, 5.0),
            rng.uniform(1.0, 3.5),
        )
        self.width, self.rate = rng.uniform(0.2, 1.4), rng.uniform(1.0, 4.0)
        self.phase = rng.uniform(0.0, 2 * math.pi)
        self.correlation, self.strength = rng.uniform(0.7, 0.95), rng.uniform(0.0, 0.25)
        self.speed, self.redraw_at, self.noise = self.mean_speed, 0.0, np.zeros(2)
        if self.mode == "straight":
            self.lane = 0.0

    def __call__(self, step: int, state: Array) -> Array:
        """Input [2] at a state [4]; steps must be given in order."""
        rng, t = self.rng, DT * step
        if t >= self.redraw_at:
            self.redraw_at = t + rng.uniform(0.3, 1.5)
            self.speed = self.mean_speed + rng.uniform(-0.9, 0.9)
            if self.mode == "lane change":
                self.lane = rng.uniform(-1.6, 1.6)
        y, vy, ay = self._lateral(t)
        spread = self.strength * math.sqrt(1 - self.correlation**2)
        self.noise = self.correlation * self.noise + spread * rng.normal(size=2)
        ahead = self.kv * (self.speed - state[2])
        aside = ay + self.kp * (y - state[1]) + self.kd * (vy - state[3])
        acceleration = np.array([ahead, aside])
        return np.clip((acceleration + DRAG * state[2:]) / PUSH + self.noise, -1.0, 1.0)

    def _lateral(self, t: float) -> tuple[float, float, float]:
        """Lateral position [m], velocity [m/s] and acceleration [m/s^2] to track at time t [s]."""
        if self.mode == "weave":
            angle, width, rate = self.rate * t + self.phase, self.width, self.rate
            return (
                0.5 * self.lane + width * math.sin(angle),
                width * rate * math.cos(angle),
                -width * rate**2 * math.sin(angle),
            )
        if self.mode == "arc":
            return self.lane * t**2 / 9, 2 * self.lane * t / 9, 2 * self.lane / 9
        return self.lane, 0.0, 0.0


def _random_policy(rng: np.random.Generator) -> Policy:
    """Random inputs, whatever the state."""
    return lambda _step, _state: rng.uniform(-1.0, 1.0, 2)


BALL_RUN = BallRun()
