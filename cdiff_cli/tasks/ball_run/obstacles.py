"""A moving obstacle in the plane: six patterns of motion, drawn from a seeded generator."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cdiff_cli.arrays import Array

Vector = tuple[float, float]
Velocity = Callable[[float, Vector, Vector, Vector], Vector]
RUN_SPEED = 3.5  # m/s, about the speed of the demonstrations; crossings are timed by it
ACCELERATION = 8.0  # m/s^2, largest acceleration of patterns that steer; the agent's is 8.2
CHASE_GAP = 0.4  # s, largest head start of the agent over the chaser, beyond 2 m
STEP = 1 / 30  # s, environment step


@dataclass(frozen=True)
class Motion:
    """Start of an obstacle, and its velocity until the next step.

    start      (x, y) [m]
    velocity   (time [s], position and velocity of the obstacle, position of the agent) -> (vx, vy)
               [m/s]
    """

    start: Vector
    velocity: Velocity


def steady(start: Vector, velocity: Vector) -> Motion:
    """A straight line at constant velocity."""
    return Motion(start, lambda _t, _o, _v, _p: velocity)


def oncoming(rng: np.random.Generator) -> Motion:
    """Straight towards the start of the agent, a little off the line y = 0."""
    return steady(
        (rng.uniform(7.0, 10.0), rng.uniform(-0.4, 0.4)),
        (-rng.uniform(0.8, 2.0), rng.uniform(-0.1, 0.1)),
    )


def crossing(rng: np.random.Generator) -> Motion:
    """From one side to the other; it is at y = 0 about when an agent at RUN_SPEED is."""
    x, speed, side = rng.uniform(4.0, 7.5), rng.uniform(1.0, 2.5), rng.choice((-1.0, 1.0))
    arrival = x / RUN_SPEED + 0.2 + rng.uniform(-0.25, 0.25)  # acceleration costs the agent 0.2 s
    return steady((x, -side * speed * arrival), (rng.uniform(-0.3, 0.3), side * speed))


def leader(rng: np.random.Generator) -> Motion:
    """Ahead in the same direction, slower than the agent, weaving."""
    speed, width, rate, phase = (
        rng.uniform(1.2, 2.4),
        rng.uniform(0.1, 0.6),
        rng.uniform(1.0, 2.5),
        rng.uniform(0, 2 * math.pi),
    )

    def velocity(t: float, _o: Vector, _v: Vector, _p: Vector) -> Vector:
        return speed, width * rate * math.cos(rate * t + phase)

    return Motion((rng.uniform(2.2, 3.5), rng.uniform(-0.3, 0.3)), velocity)


def circling(rng: np.random.Generator) -> Motion:
    """Around a fixed point on the way of the agent."""
    centre = (rng.uniform(4.0, 6.5), rng.uniform(-0.5, 0.5))
    radius, phase = rng.uniform(0.6, 1.4), rng.uniform(0, 2 * math.pi)
    rate = rng.choice((-1.0, 1.0)) * rng.uniform(0.8, 2.0) / radius

    def velocity(_t: float, o: Vector, _v: Vector, _p: Vector) -> Vector:
        dx, dy = o[0] - centre[0], o[1] - centre[1]
        # tangential steps alone would spiral outwards
        out = 2.0 * (radius / math.hypot(dx, dy) - 1.0)
        return -rate * dy + out * dx, rate * dx + out * dy

    return Motion(
        (centre[0] + radius * math.cos(phase), centre[1] + radius * math.sin(phase)), velocity
    )


def random_waypoint(rng: np.random.Generator) -> Motion:
    """From one random point to the next across the way of the agent."""
    points = [(rng.uniform(2.5, 9.0), rng.uniform(-1.8, 1.8)) for _ in range(40)]
    speeds = [rng.uniform(1.0, 2.5) for _ in points]
    start, target = points[0], 1

    def velocity(_t: float, o: Vector, v: Vector, _p: Vector) -> Vector:
        nonlocal target
        while math.dist(points[target % len(points)], o) < 0.3:
            target += 1
        return steer(v, velocity_to(o, points[target % len(points)], speeds[target % len(points)]))

    return Motion(start, velocity)


def chaser(rng: np.random.Generator) -> Motion:
    """After the agent from behind, always steering towards its present position."""
    speed = rng.uniform(3.8, 5.0)

    def velocity(_t: float, o: Vector, v: Vector, p: Vector) -> Vector:
        return steer(v, velocity_to(o, p, speed))

    return Motion((-2.0 - rng.uniform(0.0, CHASE_GAP) * speed, rng.uniform(-0.8, 0.8)), velocity)


def velocity_to(point: Vector, target: Vector, speed: float) -> Vector:
    """Velocity of that speed from a point to a target; zero if they coincide."""
    dx, dy = target[0] - point[0], target[1] - point[1]
    distance = math.hypot(dx, dy)
    return (speed * dx / distance, speed * dy / distance) if distance > 1e-9 else (0.0, 0.0)


def steer(v: Vector, target: Vector) -> Vector:
    """The velocity nearest to a target velocity that ACCELERATION allows within one step."""
    dx, dy = target[0] - v[0], target[1] - v[1]
    share = min(1.0, ACCELERATION * STEP / max(math.hypot(dx, dy), 1e-9))
    return v[0] + share * dx, v[1] + share * dy


PATTERNS: dict[str, Callable[[np.random.Generator], Motion]] = {
    "oncoming": oncoming,
    "crossing": crossing,
    "leader": leader,
    "circling": circling,
    "random-waypoint": random_waypoint,
    "chaser": chaser,
}


def beside(motion: Motion, path: Array, dt: float) -> Array:
    """Position and velocity of a free obstacle at each step of an agent's path [n, 2]: [n, 4]."""
    position = motion.start
    velocity = motion.velocity(0.0, position, (0.0, 0.0), tuple(path[0]))
    rows = [(*position, *velocity)]
    for step, agent in enumerate(path[1:].tolist(), start=1):
        position = (position[0] + dt * velocity[0], position[1] + dt * velocity[1])
        velocity = motion.velocity(dt * step, position, velocity, (agent[0], agent[1]))
        rows.append((*position, *velocity))
    return np.array(rows)
