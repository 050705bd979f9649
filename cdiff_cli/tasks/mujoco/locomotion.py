"""Hopper and Swimmer (Gymnasium v5, MuJoCo): states, linear gaits found by search (search.py), demonstrations.

A state is the environment's observation: joint positions without x, then all velocities (Hopper's clipped at +-10).
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

BRANCH_SHARE = 0.1  # of all demonstrated steps: random actions, without which the inverse dynamics knows only gaits
BURST_EVERY = 100  # steps between bursts on average, in the walks that have them
BURST_STEPS = (1, 6)  # drawn from this half-open range
SHORT = 10  # steps of a branch: fewer states than a horizon, so that no window holds them
STRIDE = 10  # steps between two states that branches may leave from


@dataclass(frozen=True)
class Gait:
    """The linear policy u = clip(W o + b, -1, 1).

    W   per unit of each observed coordinate   [m, dim]
    b                                          [m]
    """

    W: Array
    b: Array

    def __call__(self, obs: Array) -> Array:
        u: Array = self.W @ obs + self.b
        return u.clip(-1.0, 1.0)


class Outcome(NamedTuple):
    """What one episode came to."""

    reward: float
    steps: int
    fell: bool


@dataclass(frozen=True)
class Locomotion:
    """One walker or swimmer.

    noise   standard deviations of the action noise in demonstrated episodes, and the share of episodes of each
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
        """The Gymnasium environment; options are those of its constructor (width, height, camera_name, ...)."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # their import tells of other environments' versions
            import gymnasium

            if render:
                os.environ.setdefault("MUJOCO_GL", "egl")  # draws without a display
                options = {"width": 240, "height": 180, "camera_name": "track"} | options
            mode = "rgb_array" if render else None
            env = gymnasium.make(
                self.env_id, render_mode=mode, max_episode_steps=self.max_steps, **options
            )
        if render:
            quality = cast(Any, env.unwrapped).model.vis.quality
            quality.offsamples, quality.shadowsize = (
                0,
                0,
            )  # no antialiasing, no shadows: software draws ten times as fast
        return env

    def observe(self, obs: Any) -> Array:
        """State of an observation, or states of a whole episode of observations."""
        return np.asarray(obs["observation"] if isinstance(obs, dict) else obs, dtype=np.float64)

    # experts ----------------------------------------------------------------------------------------------------------

    def experts(self) -> list[Gait]:
        """The shipped gaits of models/<task>/expert.json."""
        path = home() / "models" / self.name / "expert.json"
        try:
            found = json.loads(path.read_text())["policies"]
            gaits = [
                Gait(np.array(p["W"], dtype=np.float64), np.array(p["b"], dtype=np.float64))
                for p in found
            ]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CdiffError(
                f"{shown(path)}: no readable gaits ({error}); search them with `python -m cdiff_cli.tasks.mujoco.gait_search {self.name}`"
            ) from None
        shapes = (len(self.actions), len(self.layout)), (len(self.actions),)
        if not gaits or any((gait.W.shape, gait.b.shape) != shapes for gait in gaits):
            raise CdiffError(
                f"{shown(path)}: expected policies with W of shape {shapes[0]} and b of shape {shapes[1]}"
            )
        return gaits

    def walk(
        self, env: Any, gait: Gait, seed: int, noise: float = 0.0, seen: list[Array] | None = None
    ) -> Outcome:
        """One episode of a gait under action noise of that standard deviation; states are appended to `seen`."""
        rng = np.random.default_rng(seed)
        obs, _ = env.reset(seed=seed)
        total, fell, step = 0.0, False, 0
        while step < self.max_steps and not fell:
            if seen is not None:
                seen.append(obs)
            u = gait(obs)
            if noise:
                u = (u + noise * rng.standard_normal(len(u))).clip(-1.0, 1.0)
            obs, reward, fell, _, _ = env.step(u)
            total += float(reward)
            step += 1
        return Outcome(total, step, bool(fell))

    # demonstrations ---------------------------------------------------------------------------------------------------

    def demonstrate(self, n_steps: int, seed: int) -> Iterator[dict[str, Any]]:
        """Episodes of the gaits, n_steps environment steps in all, nine tenths of them walked, one tenth branches.

        Every second walk is struck by bursts of 1-5 random actions. A burst is an episode of its own, shorter than any
        window, and so are the last steps before a fall: windows show how to recover and not how to stumble. Branches
        leave states of the walk with random actions: short episodes too, for the inverse dynamics.
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
                kept = next(_cut(episode, left))
                left -= len(kept["actions"])
                yield kept
                if left == 0:
                    break
        env.close()
        side.close()

    def _walk_with_branches(
        self, env: Any, side: Any, gait: Gait, noise: float, bursts: bool, rng: np.random.Generator
    ) -> Iterator[dict[str, Any]]:
        """One walk of max_steps, cut where bursts stand, then the branches from its states."""
        obs, _ = env.reset(seed=int(rng.integers(2**31)))
        m, struck, fell = len(self.actions), 0, False
        stretch: dict[str, list[Any]] = _rows(obs)
        leave: list[tuple[Array, Array]] = []
        step = 0
        while step < self.max_steps and not fell:
            if bursts and not struck and rng.random() < 1 / BURST_EVERY:
                struck = int(rng.integers(*BURST_STEPS))
                yield from _cut(stretch)
                stretch = _rows(obs)
            if step % STRIDE == 0:
                leave.append((env.data.qpos.copy(), env.data.qvel.copy()))
            u = rng.uniform(-1.0, 1.0, m) if struck else gait(obs) + noise * rng.standard_normal(m)
            obs, fell = _step(env, u, stretch)
            step += 1
            if struck == 1:
                yield from _cut(stretch)
                stretch = _rows(obs)
            struck = max(struck - 1, 0)
        yield from _cut(stretch, SHORT if fell else None)
        for _ in range(round(step * BRANCH_SHARE / (1 - BRANCH_SHARE) / SHORT)):
            side.set_state(*leave[rng.integers(len(leave))])
            branch = _rows(side._get_obs())
            for _ in range(SHORT):
                _step(side, rng.uniform(-1.0, 1.0, m), branch)
            yield branch


def _rows(obs: Array) -> dict[str, list[Any]]:
    return {"observations": [obs], "actions": [], "rewards": []}


def _step(env: Any, u: Array, rows: dict[str, list[Any]]) -> tuple[Array, bool]:
    """One environment step with the clipped input, recorded; the observation and whether the agent fell."""
    u32 = u.clip(-1.0, 1.0).astype(np.float32)
    obs, reward, fell, _, _ = env.step(u32)
    rows["observations"].append(obs)
    rows["actions"].append(u32)
    rows["rewards"].append(float(reward))
    return obs, bool(fell)


def _cut(rows: dict[str, list[Any]], steps: int | None = None) -> Iterator[dict[str, list[Any]]]:
    """The rows, or pieces of them of at most so many steps; nothing where there is no step."""
    n = len(rows["actions"])
    size = steps or max(n, 1)
    for at in range(0, n, size):
        yield {
            key: values[at : at + size + (key == "observations")] for key, values in rows.items()
        }


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
    gaits=(
        0,
    ),  # a planner of both returns more and keeps to its limits less well: tests/benchmarks/studies/mixed_gaits.py
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
