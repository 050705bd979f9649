"""Ball run: a ball pushed along x as fast as it likes, past a moving obstacle it sees only as it is now.

Frame: metres on the plane, dt 1/30 s, force in [-1, 1]^2 times 3.5 N; about v' = 0.987 v + 0.274 u, so one input moves the ball
by 6 mm within its own step. Ball and obstacle have radius 0.5 m: they touch at a centre distance of 1.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from cdiff_cli.arrays import Array
from cdiff_cli.tasks.ball_run.obstacles import PATTERNS, beside
from cdiff_cli.tasks.protocol import Control, Tolerances

DT = 4 / 120
PUSH = 8.2  # m/s^2 a unit of force
DRAG = 0.4  # 1/s
OBSERVED = np.array([0.1, 0.1, 0.2, 0.2])  # what SafetyBallRun multiplies (x, y, vx, vy) by
BURST = 10  # random inputs after each demonstration, an episode of their own
MODES = ("straight", "lane change", "weave", "arc")
SHARES = (0.15, 0.4, 0.3, 0.15)


@dataclass(frozen=True)
class BallRun:
    """The task; its environment is ball_env.BallRunEnv."""

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
        """The environment, ended after max_steps by truncation; pattern None plays pattern number seed % 6."""
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
        """State (x, y, vx, vy) in m and m/s of an observation, or of a whole episode of observations."""
        return np.asarray(obs, dtype=np.float64)[..., :4] / OBSERVED

    def observed(self, env: Any) -> dict[str, float]:
        """The obstacle's present position (m) and velocity (m/s)."""
        return env.unwrapped.observed()

    def observed_along(self, run: Array, rng: np.random.Generator) -> Mapping[str, Array]:
        """The obstacle's positions (m) and velocities (m/s) along a run [n, 4] that was recorded without one, each [n]: what it
        would have shown beside a ghost, which leaves the ball alone, in any of the six patterns, begun as in an episode.
        """
        motion = PATTERNS[rng.choice(tuple(PATTERNS))](rng)
        return dict(zip(self.observable, beside(motion, run[:, :2], self.dt).T, strict=True))

    def brake(self, state: Array) -> Array:
        """Inputs that stop the ball as fast as they can: an eighth of a second of full force a m/s."""
        return np.clip(-state[2:], -1.0, 1.0)

    def from_d4rl(self, states: Array) -> Array:
        """Observations of SafetyBallRun as states."""
        return self.observe(states)

    def demonstrate(self, n_steps: int, seed: int) -> Iterator[dict[str, Any]]:
        """Runs of max_steps by a PD tracker without an obstacle, each followed by a burst of random inputs as an episode of
        its own (for the inverse dynamics: shorter than a window); n_steps environment steps in all.
        """
        from cdiff_cli.tasks.ball_run.env import BallRunEnv

        rng = np.random.default_rng(seed)
        env, done = BallRunEnv("none"), 0
        while done < n_steps:
            obs, _ = env.reset(seed=int(rng.integers(2**31)))
            for inputs, length in ((self._runner(rng), self.max_steps), (_anything(rng), BURST)):
                steps = min(length, n_steps - done)
                rows: dict[str, list[Any]] = {"observations": [obs], "actions": [], "rewards": []}
                next(inputs)
                for _ in range(steps):
                    u = inputs.send(self.observe(obs)).astype(np.float32)
                    obs, reward, _, _, _ = env.step(u)
                    rows["observations"].append(obs)
                    rows["actions"].append(u)
                    rows["rewards"].append(reward)
                done += steps
                if steps:
                    yield rows
        env.close()

    def _runner(self, rng: np.random.Generator) -> Any:
        """Forces of one run: speed and lateral position tracked by PD with random gains, references and AR(1) noise.

        Modes: straight on, from lane to lane, weaving about a lane, an arc (a parabola in time) to one side.
        """
        mode = rng.choice(MODES, p=SHARES)
        base, lane = rng.uniform(2.9, 4.9), rng.uniform(-1.6, 1.6)
        kp, kd, kv = rng.uniform(3.0, 9.0), rng.uniform(2.0, 5.0), rng.uniform(1.0, 3.5)
        width, rate, phase = (
            rng.uniform(0.2, 1.4),
            rng.uniform(1.0, 4.0),
            rng.uniform(0.0, 2 * math.pi),
        )
        stay, strength = rng.uniform(0.7, 0.95), rng.uniform(0.0, 0.25)
        speed, redraw, noise = base, 0.0, np.zeros(2)
        if mode == "straight":
            lane = 0.0
        state = yield np.zeros(2)
        for step in range(10**9):
            t = DT * step
            if t >= redraw:
                redraw = t + rng.uniform(0.3, 1.5)
                speed = base + rng.uniform(-0.9, 0.9)
                if mode == "lane change":
                    lane = rng.uniform(-1.6, 1.6)
            y, vy, ay = lane, 0.0, 0.0
            if mode == "weave":
                wave = rate * t + phase
                y, vy, ay = (
                    0.5 * lane + width * math.sin(wave),
                    width * rate * math.cos(wave),
                    -width * rate**2 * math.sin(wave),
                )
            elif mode == "arc":
                y, vy, ay = lane * t**2 / 9, 2 * lane * t / 9, 2 * lane / 9
            noise = stay * noise + strength * math.sqrt(1 - stay**2) * rng.normal(size=2)
            wanted = np.array(
                [kv * (speed - state[2]), ay + kp * (y - state[1]) + kd * (vy - state[3])]
            )
            state = yield np.clip((wanted + DRAG * state[2:]) / PUSH + noise, -1.0, 1.0)


def _anything(rng: np.random.Generator) -> Any:
    """Random forces, whatever the state."""
    yield np.zeros(2)
    while True:
        yield rng.uniform(-1.0, 1.0, 2)


BALL_RUN = BallRun()
