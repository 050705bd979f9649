"""`cdiff_cli/BallRun-v0`: a ball on a plane is rewarded for running along x past a moving obstacle.

Physics, reward, cost and the first seven observations are those of SafetyBallRun
(Bullet-Safety-Gym 1.4.0), to about 1e-5.

    gymnasium.make("cdiff_cli.tasks.ball_run.env:cdiff_cli/BallRun-v0", pattern="chaser")
"""

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError, suggestion
from cdiff_cli.tasks.ball_run.obstacles import PATTERNS, Motion, Vector, steady


@contextlib.contextmanager
def _silent_stderr() -> Iterator[None]:
    """Silence file descriptor 2: pybullet's C code prints its build time at import."""
    sys.stderr.flush()
    stderr, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(null)


with _silent_stderr():
    import pybullet as pb
ENV_ID = "cdiff_cli/BallRun-v0"
DT = 4 / 120  # s, environment step of four substeps
FORCE = 3.5  # N per unit of action
RADIUS = 0.5  # m, of the ball and the obstacle
MASS = 0.3  # kg, of the ball
HEAVY = 3e4  # kg, of the obstacle: a collision changes its velocity by 1e-5 of the ball's change
GOAL_X = 1000.0  # m, x of the point from which the reward measures the distance
MAX_STEPS = 100
LANE, SPEED_LIMIT = 2.0, 2.5  # m and m/s, limits of SafetyBallRun's own cost
WIDTH, HEIGHT = 320, 240  # pixels of a picture
OBSERVED = np.array(
    [0.1, 0.1, 0.2, 0.2]
)  # factors of (x, y, vx, vy) in SafetyBallRun's observation


class BallRunEnv(gymnasium.Env[Array, NDArray[np.float32]]):
    """The environment. Episodes end by truncation alone, which gymnasium.make adds.

    pattern       one of obstacles.PATTERNS, or "none" for no obstacle; None: pattern number
                  seed % 6, drawn at random if reset gets no seed
    collide       whether the obstacle pushes the ball; otherwise the ball can run through it

    action        force in [-1, 1]^2 along x and y
    observation   [0.1 x, 0.1 y, 0.2 vx, 0.2 vy, 0.1 spin(3)], and with an obstacle also
                  [0.1 x, 0.1 y, 0.2 vx, 0.2 vy] of it
    reward        60 times the decrease of the distance to (1000, 0) in metres, minus 0.5 |action|
    info          cost (SafetyBallRun's own), contact (whether the balls touched during the step),
                  contacts (steps with contact so far), pattern

    reset(options={"start": (x, y), "obstacle": (x, y, vx, vy)}), both optional, places the ball and
    sends the obstacle along a straight line.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(
        self, pattern: str | None = None, collide: bool = True, render_mode: str | None = None
    ) -> None:
        if pattern is not None and pattern not in (*PATTERNS, "none"):
            raise CdiffError(
                f'no pattern "{pattern}"{suggestion(pattern, PATTERNS)}; '
                f"choose from {', '.join(PATTERNS)}, none"
            )
        self.pattern, self.collide, self.render_mode = pattern, collide, render_mode
        self.playing = pattern or "none"
        self.contacts, self._steps = 0, 0
        self._motion: Motion | None = None
        self._where: Vector = (0.0, 0.0)
        self._velocity: Vector = (0.0, 0.0)
        size = 7 if pattern == "none" else 11
        self.observation_space = Box(-1000.0, 1000.0, (size,), np.float64)
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)
        self._client = pb.connect(pb.DIRECT)
        self._world()
        self._read()

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        names = tuple(PATTERNS)
        # always drawn, so that a chosen pattern does not shift the draws that follow
        number = int(self.np_random.integers(len(names)))
        self.playing = self.pattern or names[number if seed is None else seed % len(names)]
        given = options or {}
        start = given.get("start", self.np_random.uniform(-0.01, 0.01, 2))
        self._motion = None if self.playing == "none" else self._draw(given)
        self._steps, self.contacts = 0, 0
        self._world()  # the solver's cached impulses must not carry over into this episode
        self._place(self._ball, start)
        if self._motion is not None:
            self._where = self._motion.start
            self._place(self._obstacle, self._where)
        pb.stepSimulation(physicsClientId=self._client)
        self._read()
        if self._motion is not None:
            self._velocity = self._motion.velocity(0.0, self._where, (0.0, 0.0), self._position[:2])
        return self._observation(), self._info(False)

    def step(
        self, action: NDArray[np.floating[Any]]
    ) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        u = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)
        before = self._distance()
        force = (FORCE * u[0], FORCE * u[1], 0.0)
        pb.applyExternalForce(
            self._ball, -1, force, self._position, pb.WORLD_FRAME, physicsClientId=self._client
        )
        crossed = False
        if self._motion is not None:
            crossed = self.collide and self._in_the_way()
            self._push_obstacle()
        pb.stepSimulation(physicsClientId=self._client)
        self._read()
        self._steps += 1
        contact = crossed or self._pressed()
        self.contacts += contact
        if self._motion is not None:
            t, (x, y), (vx, vy) = DT * self._steps, self._where, self._velocity
            self._where = (x + DT * vx, y + DT * vy)
            self._place(self._obstacle, self._where)  # its motion ignores collisions
            self._velocity = self._motion.velocity(
                t, self._where, self._velocity, self._position[:2]
            )
        reward = 60.0 * (before - self._distance()) - 0.5 * float(np.hypot(*u))
        return self._observation(), reward, False, False, self._info(contact)

    def render(self) -> NDArray[np.uint8] | None:
        """A picture [240, 320, 3] from above and behind; the camera follows the ball."""
        if self.render_mode != "rgb_array":
            return None
        view = pb.computeViewMatrixFromYawPitchRoll(
            (self._position[0] + 1.5, 0, 0), 7.0, -90, -50, 0, 2
        )
        lens = pb.computeProjectionMatrixFOV(60, WIDTH / HEIGHT, 0.1, 60.0)
        eye = {"renderer": pb.ER_TINY_RENDERER, "physicsClientId": self._client}
        pixels = pb.getCameraImage(WIDTH, HEIGHT, view, lens, shadow=0, **eye)[2]
        return np.reshape(np.asarray(pixels, dtype=np.uint8), (HEIGHT, WIDTH, 4))[:, :, :3].copy()

    def close(self) -> None:
        if self._client >= 0:
            pb.disconnect(self._client)
            self._client = -1

    def observed(self) -> dict[str, float]:
        """Present position [m] and velocity [m/s] of the obstacle; empty without an obstacle."""
        if self._motion is None:
            return {}
        values = (*self._where, *self._velocity)
        return {
            f"obstacle.{name}": float(value)
            for name, value in zip(("x", "y", "vx", "vy"), values, strict=True)
        }

    # the simulation ----------------------------------------------------------------------------

    def _draw(self, given: Mapping[str, Any]) -> Motion:
        if "obstacle" in given:
            x, y, vx, vy = (float(value) for value in given["obstacle"])
            return steady((x, y), (vx, vy))
        return PATTERNS[self.playing](self.np_random)

    def _world(self) -> None:
        """A new simulation with plane, ball and obstacle."""
        c = {"physicsClientId": self._client}
        pb.resetSimulation(**c)
        pb.setPhysicsEngineParameter(
            fixedTimeStep=DT,
            numSubSteps=4,
            numSolverIterations=5,
            deterministicOverlappingPairs=1,
            **c,
        )
        pb.setGravity(0, 0, -9.81, **c)
        pb.setDefaultContactERP(0.9, **c)
        plane = pb.createCollisionShape(
            pb.GEOM_BOX, halfExtents=(250, 250, 1), collisionFramePosition=(0, 0, -1), **c
        )
        sphere = pb.createCollisionShape(pb.GEOM_SPHERE, radius=RADIUS, **c)
        floor = pb.createMultiBody(
            0, plane, self._box((250, 250, 1), (0.86, 0.88, 0.90, 1), -1.0), **c
        )
        pb.changeDynamics(floor, -1, lateralFriction=0.8, restitution=0.5, **c)
        self._ball = pb.createMultiBody(
            MASS, sphere, self._sphere((0.16, 0.38, 0.75, 1)), (0, 0, RADIUS), **c
        )
        rolling = {"rollingFriction": 0.03, "spinningFriction": 0.03}
        pb.changeDynamics(self._ball, -1, lateralFriction=1.1, restitution=0.7, **rolling, **c)
        self._obstacle = -1
        if self.playing != "none":
            mass, solid = (HEAVY, sphere) if self.collide else (0, -1)
            self._obstacle = pb.createMultiBody(
                mass, solid, self._sphere((0.85, 0.25, 0.2, 1)), (0, 0, RADIUS), **c
            )
            pb.changeDynamics(self._obstacle, -1, linearDamping=0, **c)
            pb.setCollisionFilterPair(floor, self._obstacle, -1, -1, 0, **c)
        if self.render_mode:
            self._markings()

    def _sphere(self, colour: tuple[float, ...]) -> int:
        if not self.render_mode:
            return -1
        return int(
            pb.createVisualShape(
                pb.GEOM_SPHERE, radius=RADIUS, rgbaColor=colour, physicsClientId=self._client
            )
        )

    def _box(self, half: tuple[float, ...], colour: tuple[float, ...], z: float) -> int:
        if not self.render_mode:
            return -1
        frame = {"visualFramePosition": (0, 0, z), "physicsClientId": self._client}
        return int(pb.createVisualShape(pb.GEOM_BOX, halfExtents=half, rgbaColor=colour, **frame))

    def _markings(self) -> None:
        """Lines along y = -2 and y = 2 and a stripe every 2 m make the motion visible."""
        grey, yellow = (0.62, 0.65, 0.68, 1), (0.95, 0.65, 0.1, 1)
        stripe, line = (
            self._box((0.03, LANE, 0.005), grey, 0.0),
            self._box((25, 0.05, 0.01), yellow, 0.0),
        )
        marks = [(stripe, x, 0.0) for x in range(-6, 42, 2)] + [
            (line, 15.0, -LANE),
            (line, 15.0, LANE),
        ]
        for shape, x, y in marks:
            pb.createMultiBody(0, -1, shape, (x, y, 0), physicsClientId=self._client)

    def _place(self, body: int, where: Vector) -> None:
        pb.resetBasePositionAndOrientation(
            body, (*where, RADIUS), (0, 0, 0, 1), physicsClientId=self._client
        )

    def _read(self) -> None:
        self._position = pb.getBasePositionAndOrientation(self._ball, physicsClientId=self._client)[
            0
        ]
        self._twist = pb.getBaseVelocity(self._ball, physicsClientId=self._client)

    def _distance(self) -> float:
        return float(np.hypot(self._position[0] - GOAL_X, self._position[1]))

    def _push_obstacle(self) -> None:
        """Set the velocity of the obstacle for this step and lift its weight.

        Bullet then moves it through the substeps, and the ball cannot deflect it.
        """
        c = {"physicsClientId": self._client}
        if self.collide:
            pb.resetBaseVelocity(self._obstacle, (*self._velocity, 0), (0, 0, 0), **c)
            pb.applyExternalForce(
                self._obstacle,
                -1,
                (0, 0, 9.81 * HEAVY),
                (*self._where, RADIUS),
                pb.WORLD_FRAME,
                **c,
            )

    def _in_the_way(self) -> bool:
        """Whether the balls overlap within this step if neither deflects the other.

        The effect of the present input, at most 6 mm, is left out.
        """
        d = np.subtract(self._where, self._position[:2])
        w = DT * np.subtract(self._velocity, self._twist[0][:2])
        nearest = d + w * np.clip(-(d @ w) / max(w @ w, 1e-12), 0.0, 1.0)
        return bool(nearest @ nearest < (2 * RADIUS) ** 2)

    def _pressed(self) -> bool:
        """Whether the balls pushed each other in the last substep, whose contacts Bullet keeps."""
        if self._motion is None or not self.collide:
            return False
        return any(
            point[9] > 0
            for point in pb.getContactPoints(
                self._ball, self._obstacle, physicsClientId=self._client
            )
        )

    def _observation(self) -> Array:
        velocity, spin = self._twist
        ball = OBSERVED * (*self._position[:2], *velocity[:2])
        obstacle = OBSERVED * (*self._where, *self._velocity) if self._motion is not None else ()
        return np.concatenate((ball, 0.1 * np.array(spin), obstacle))

    def _info(self, contact: bool) -> dict[str, Any]:
        speed = float(np.linalg.norm(self._twist[0]))
        cost = float(abs(self._position[1]) > LANE or speed > SPEED_LIMIT)
        return {
            "cost": cost,
            "contact": contact,
            "contacts": self.contacts,
            "pattern": self.playing,
        }


gymnasium.register(
    ENV_ID, entry_point="cdiff_cli.tasks.ball_run.env:BallRunEnv", max_episode_steps=MAX_STEPS
)
