"""A moving obstacle in the plane: six patterns of motion, each drawn from a seeded generator."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cdiff_cli.arrays import Array

Vector = tuple[float, float]
Velocity = Callable[[float, Vector, Vector, Vector], Vector]
RUN_SPEED = 3.5  # m/s, about what the demonstrations run at: crossings are timed by it
ACCELERATION = (
    8.0  # m/s^2, the most a pattern that steers changes its velocity by; the agent's own is 8.2
)
CHASE_GAP = 0.4  # s, how far behind the start the chaser sets out, at its own speed, beyond 2 m


@dataclass(frozen=True)
class Motion:
    """Where an obstacle begins and how it goes on.

    start      (x, y)                                                                metres
    velocity   of (time, obstacle's position, its velocity, agent's position), m/s: what it moves by until the next step
    """

    start: Vector
    velocity: Velocity


def steady(start: Vector, velocity: Vector) -> Motion:
    """A straight line at constant velocity."""
    return Motion(start, lambda _t, _o, _v, _p: velocity)


def oncoming(rng: np.random.Generator) -> Motion:
    """Straight towards the start, a little off the line y = 0."""
    return steady(
        (rng.uniform(7.0, 10.0), rng.uniform(-0.4, 0.4)),
        (-rng.uniform(0.8, 2.0), rng.uniform(-0.1, 0.1)),
    )


def crossing(rng: np.random.Generator) -> Motion:
    """From one side to the other, over y = 0 at about the time an agent at RUN_SPEED comes there."""
    x, speed, side = rng.uniform(4.0, 7.5), rng.uniform(1.0, 2.5), rng.choice((-1.0, 1.0))
    arrival = x / RUN_SPEED + 0.2 + rng.uniform(-0.25, 0.25)  # 0.2 s are lost on gathering speed
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
    """Round a fixed point on the agent's way."""
    centre = (rng.uniform(4.0, 6.5), rng.uniform(-0.5, 0.5))
    radius, phase = rng.uniform(0.6, 1.4), rng.uniform(0, 2 * math.pi)
    rate = rng.choice((-1.0, 1.0)) * rng.uniform(0.8, 2.0) / radius

    def velocity(_t: float, o: Vector, _v: Vector, _p: Vector) -> Vector:
        dx, dy = o[0] - centre[0], o[1] - centre[1]
        out = 2.0 * (radius / math.hypot(dx, dy) - 1.0)  # tangents alone would spiral outwards
        return -rate * dy + out * dx, rate * dx + out * dy

    return Motion(
        (centre[0] + radius * math.cos(phase), centre[1] + radius * math.sin(phase)), velocity
    )


def random_waypoint(rng: np.random.Generator) -> Motion:
    """From point to random point across the agent's way."""
    points = [(rng.uniform(2.5, 9.0), rng.uniform(-1.8, 1.8)) for _ in range(40)]
    speeds = [rng.uniform(1.0, 2.5) for _ in points]
    start, target = points[0], 1

    def velocity(_t: float, o: Vector, v: Vector, _p: Vector) -> Vector:
        nonlocal target
        while math.dist(points[target % len(points)], o) < 0.3:
            target += 1
        return steer(v, towards(o, points[target % len(points)], speeds[target % len(points)]))

    return Motion(start, velocity)


def chaser(rng: np.random.Generator) -> Motion:
    """After the agent from behind, always turning towards where it is."""
    speed = rng.uniform(3.8, 5.0)

    def velocity(_t: float, o: Vector, v: Vector, p: Vector) -> Vector:
        return steer(v, towards(o, p, speed))

    return Motion((-2.0 - rng.uniform(0.0, CHASE_GAP) * speed, rng.uniform(-0.8, 0.8)), velocity)


def towards(here: Vector, there: Vector, speed: float) -> Vector:
    """The velocity of that speed from here to there; none at all where they coincide."""
    dx, dy = there[0] - here[0], there[1] - here[1]
    distance = math.hypot(dx, dy)
    return (speed * dx / distance, speed * dy / distance) if distance > 1e-9 else (0.0, 0.0)


def steer(v: Vector, wanted: Vector, dt: float = 1 / 30) -> Vector:
    """The velocity nearest to the wanted one that ACCELERATION allows within one step."""
    dx, dy = wanted[0] - v[0], wanted[1] - v[1]
    share = min(1.0, ACCELERATION * dt / max(math.hypot(dx, dy), 1e-9))
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
    """Place and velocity of the obstacle at each step of an agent's path [n, 2], where nothing holds it up [n, 4]."""
    where, velocity, seen = (
        motion.start,
        motion.velocity(0.0, motion.start, (0.0, 0.0), tuple(path[0])),
        [],
    )
    for step, agent in enumerate(path[1:].tolist(), start=1):
        seen.append((*where, *velocity))
        where = (where[0] + dt * velocity[0], where[1] + dt * velocity[1])
        velocity = motion.velocity(dt * step, where, velocity, (agent[0], agent[1]))
    return np.array([*seen, (*where, *velocity)])
