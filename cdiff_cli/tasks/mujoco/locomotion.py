"""Hopper and Swimmer (Gymnasium v5, MuJoCo): states, linear gaits (gait_search.py), demonstrations.

A state is the observation of the environment: joint positions without x, then all velocities, which
Hopper clips at +-10.
"""

import json
import os
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np

from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError
from cdiff_cli.paths import home, shown
from cdiff_cli.tasks.protocol import Control, Tolerances

BRANCH_SHARE = 0.1  # share of random actions in the demonstrations, for the inverse dynamics
BURST_EVERY = 100  # mean number of steps between bursts, in walks with bursts
BURST_STEPS = (1, 6)  # half-open range of the length of a burst, in steps
SHORT = 10  # steps of a branch; with fewer states than a horizon, no window contains it
STRIDE = 10  # steps between two states that branches may start from


@dataclass(frozen=True)
class Gait:
    """The linear policy u = clip(W x + b, -1, 1) of the state x.

    W   [m, dim]
    b   [m]
    """

    W: Array
    b: Array

    def __call__(self, state: Array) -> Array:
        """Input [m] at a state [dim]."""
        u: Array = self.W @ state + self.b
        return u.clip(-1.0, 1.0)


class Outcome(NamedTuple):
    """Return and length of one episode."""

    reward: float
    steps: int
    fell: bool


@dataclass(frozen=True)
class Locomotion:
    """One walker or swimmer.

    noise   share of the demonstrated episodes by the standard deviation of their action noise
    gaits   numbers of the shipped gaits that are demonstrated; None: all
    """

    name: str
    env_id: str
    layout: tuple[str, ...]
    units: tuple[str, ...]
    actions: tuple[str, ...]
    dt: float
    noise: Mapping[float, float]
    gaits: tuple[int, ...] | None = None

    positions: tuple[str, ...] = ()
    velocities: tuple[str, ...] = ()
    shared_scale: tuple[tuple[str, ...], ...] = ()
    invariant: tuple[str, ...] = ()
    max_steps: int = 1000

    control: ClassVar[Control] = "receding_horizon"
    tolerances = Tolerances()

    def make_env(self, render: bool = False, **options: Any) -> Any:
        """The Gymnasium environment.

        options   arguments of its constructor (width, height, camera_name, ...)
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the import warns of versions of other environments
            import gymnasium

            if render:
                os.environ.setdefault("MUJOCO_GL", "egl")  # renders without a display
                options = {"width": 240, "height": 180, "camera_name": "track"} | options
            mode = "rgb_array" if render else None
            env = gymnasium.make(
                self.env_id, render_mode=mode, max_episode_steps=self.max_steps, **options
            )
        if render:
            # without antialiasing and shadows, software renders ten times as fast
            quality = cast(Any, env.unwrapped).model.vis.quality
            quality.offsamples = quality.shadowsize = 0
        return env

    def observe(self, obs: Any) -> Array:
        """State [dim] of an observation, or states [n, dim] of an episode of observations."""
        return np.asarray(obs["observation"] if isinstance(obs, dict) else obs, dtype=np.float64)

    # experts -----------------------------------------------------------------------------------

    def experts(self) -> list[Gait]:
        """The shipped gaits, from models/<task>/expert.json."""
        path = home() / "models" / self.name / "expert.json"
        try:
            gaits = [
                Gait(np.array(p["W"], dtype=np.float64), np.array(p["b"], dtype=np.float64))
                for p in json.loads(path.read_text())["policies"]
            ]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CdiffError(
                f"{shown(path)}: no readable gaits ({error}); search for them with "
                f"`python -m cdiff_cli.tasks.mujoco.gait_search {self.name}`"
            ) from None
        shapes = (len(self.actions), len(self.layout)), (len(self.actions),)
        if not gaits or any((gait.W.shape, gait.b.shape) != shapes for gait in gaits):
            raise CdiffError(
                f"{shown(path)}: expected policies with W of shape {shapes[0]} "
                f"and b of shape {shapes[1]}"
            )
        return gaits

    def walk(
        self, env: Any, gait: Gait, seed: int, noise: float = 0.0, states: list[Array] | None = None
    ) -> Outcome:
        """One episode of a gait, with action noise of that standard deviation.

        states   list to which the states of the episode are appended
        """
        rng = np.random.default_rng(seed)
        obs, _ = env.reset(seed=seed)
        total, fell, step = 0.0, False, 0
        while step < self.max_steps and not fell:
            if states is not None:
                states.append(obs)
            u = gait(obs)
            if noise:
                u = (u + noise * rng.standard_normal(len(u))).clip(-1.0, 1.0)
            obs, reward, fell, _, _ = env.step(u)
            total += float(reward)
            step += 1
        return Outcome(total, step, bool(fell))

    # demonstrations ----------------------------------------------------------------------------

    def demonstrate(self, n_steps: int, seed: int) -> Iterator[dict[str, Any]]:
        """Episodes of the gaits: nine tenths of the steps are walks, one tenth are branches.

        There are n_steps environment steps in all. Every second walk contains bursts of 1-5 random
        actions. A burst is an episode of its own, shorter than any window, and so are the last
        steps before a fall. Windows then show how to recover and not how to stumble. Branches are
        short episodes of random actions from states of the walk, for the inverse dynamics.
        """
        rng = np.random.default_rng(seed)
        env, side = self.make_env().unwrapped, self.make_env().unwrapped
        gaits = [
            gait for i, gait in enumerate(self.experts()) if self.gaits is None or i in self.gaits
        ]
        side.reset(seed=seed)
        left = n_steps
        number = int(rng.integers(len(gaits)))
        while left > 0:
            noise = float(rng.choice(list(self.noise), p=list(self.noise.values())))
            bursts = bool(number % 2)
            gait = gaits[(number // 2) % len(gaits)]
            number += 1
            for episode in self._walk_with_branches(env, side, gait, noise, bursts, rng):
                first = next(_cut(episode, left))
                left -= len(first["actions"])
                yield first
                if left == 0:
                    break
        env.close()
        side.close()

    def _walk_with_branches(
        self, env: Any, side: Any, gait: Gait, noise: float, bursts: bool, rng: np.random.Generator
    ) -> Iterator[dict[str, Any]]:
        """One walk of max_steps, cut at its bursts, then the branches from its states."""
        obs, _ = env.reset(seed=int(rng.integers(2**31)))
        m, fell = len(self.actions), False
        rows = _rows(obs)
        starts: list[tuple[Array, Array]] = []
        step, burst = 0, 0  # burst: random actions that are left
        while step < self.max_steps and not fell:
            if bursts and not burst and rng.random() < 1 / BURST_EVERY:
                burst = int(rng.integers(*BURST_STEPS))
                yield from _cut(rows)
                rows = _rows(obs)
            if step % STRIDE == 0:
                starts.append((env.data.qpos.copy(), env.data.qvel.copy()))
            u = rng.uniform(-1.0, 1.0, m) if burst else gait(obs) + noise * rng.standard_normal(m)
            obs, fell = _step(env, u, rows)
            step += 1
            if burst == 1:
                yield from _cut(rows)
                rows = _rows(obs)
            burst = max(burst - 1, 0)
        yield from _cut(rows, SHORT if fell else None)
        for _ in range(round(step * BRANCH_SHARE / (1 - BRANCH_SHARE) / SHORT)):
            side.set_state(*starts[rng.integers(len(starts))])
            branch = _rows(side._get_obs())
            for _ in range(SHORT):
                _step(side, rng.uniform(-1.0, 1.0, m), branch)
            yield branch


def _rows(obs: Array) -> dict[str, list[Any]]:
    """An episode that starts with an observation."""
    return {"observations": [obs], "actions": [], "rewards": []}


def _step(env: Any, u: Array, rows: dict[str, list[Any]]) -> tuple[Array, bool]:
    """One recorded environment step; returns the observation and whether the agent fell."""
    u32 = u.clip(-1.0, 1.0).astype(np.float32)
    obs, reward, fell, _, _ = env.step(u32)
    rows["observations"].append(obs)
    rows["actions"].append(u32)
    rows["rewards"].append(float(reward))
    return obs, bool(fell)


def _cut(rows: dict[str, list[Any]], steps: int | None = None) -> Iterator[dict[str, list[Any]]]:
    """An episode in pieces of at most so many steps (None: one piece); nothing without steps."""
    n = len(rows["actions"])
    size = steps or max(n, 1)
    for first in range(0, n, size):
        last = first + size
        yield {key: values[first : last + (key == "observations")] for key, values in rows.items()}


HOPPER = Locomotion(
    name="hopper",
    env_id="Hopper-v5",
    layout=(
        *("height", "torso_angle", "thigh_angle", "leg_angle", "foot_angle"),
        *("vx", "vz", "torso_velocity", "thigh_velocity", "leg_velocity", "foot_velocity"),
    ),
    units=("m", *["rad"] * 4, *["m/s"] * 2, *["rad/s"] * 4),
    actions=("thigh_torque", "leg_torque", "foot_torque"),
    dt=0.008,
    noise={0.0: 0.5, 0.05: 0.3, 0.1: 0.2},
    # with both gaits a planner returns more and satisfies its limits less well:
    # tests/benchmarks/studies/mixed_gaits.py
    gaits=(0,),
)
SWIMMER = Locomotion(
    name="swimmer",
    env_id="Swimmer-v5",
    layout=(
        *("tip_angle", "rotor1_angle", "rotor2_angle"),
        *("vx", "vy", "tip_velocity", "rotor1_velocity", "rotor2_velocity"),
    ),
    units=(*["rad"] * 3, *["m/s"] * 2, *["rad/s"] * 3),
    actions=("rotor1_torque", "rotor2_torque"),
    dt=0.04,
    noise={0.0: 0.4, 0.1: 0.3, 0.3: 0.2, 0.6: 0.1},
)
