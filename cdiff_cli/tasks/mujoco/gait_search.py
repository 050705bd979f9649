"""Augmented Random Search (Mania et al. 2018, V2-t) for linear gaits: python -m cdiff_cli.tasks.mujoco.gait_search hopper

Each iteration tries the policy perturbed by +nu d and -nu d along N random directions d, keeps the b directions with the
largest of their two returns, and steps by alpha / (b sigma) * sum (return+ - return-) d, sigma the standard deviation of
the 2 b returns. Observations are whitened by their running mean and deviation, which the result folds into W and b.

A seed is searched without noise first; then, whitening frozen, under action noise; then, whitened anew by its own walk,
under more, so that the gait does not fall where it is executed imprecisely. Each phase starts from the policy that was best
on the selection seeds in the one before; the returns written down are of other seeds.
"""

import argparse
import copy
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cdiff_cli.arrays import Array
from cdiff_cli.errors import CdiffError
from cdiff_cli.paths import home, shown
from cdiff_cli.tasks import load_task
from cdiff_cli.tasks.mujoco.locomotion import Gait, Locomotion

Report = Callable[[str], None]
SELECTION = range(10_000, 10_018)
TEST = range(20_000, 20_020)


class Phase(NamedTuple):
    """One stretch of a search under noise.

    until       environment steps at its end, since the whitening was last begun
    noise       standard deviations of the action noise, direction by direction in turn
    selection   those of the selection episodes, in turn
    episodes    how many of these
    whiten      whether to begin a new whitening, of the gait's own states
    """

    until: int
    noise: tuple[float, ...]
    selection: tuple[float, ...]
    episodes: int
    whiten: bool = False


@dataclass(frozen=True)
class Search:
    """Constants of the search of one task.

    directions, best, alpha, nu   N, b, step size and size of the perturbations
    survival                      taken off the reward of a step: else standing still pays
    screen, at_least              a seed that has not reached this return by so many steps is given up
    quiet                         the phase without noise, in which observations are whitened
    noisy                         the phases after it
    test                          standard deviations of the action noise the returns written down are under
    """

    directions: int
    best: int
    alpha: float
    nu: float
    survival: float
    screen: int
    at_least: float
    quiet: Phase
    noisy: tuple[Phase, ...]
    test: tuple[float, ...]

    def within(self, steps: int) -> "Search":
        """The same search in that many steps altogether."""
        begun = [i for i, phase in enumerate(self.noisy) if phase.whiten]
        ends = [(self.quiet, *self.noisy)[i].until for i in begun] + [
            (self.quiet, *self.noisy)[-1].until
        ]
        share = steps / sum(ends)
        shorter = [
            phase._replace(until=round(phase.until * share)) for phase in (self.quiet, *self.noisy)
        ]
        return replace(
            self, screen=round(self.screen * share), quiet=shorter[0], noisy=tuple(shorter[1:])
        )


SEARCHES = {
    "hopper": Search(
        directions=8,
        best=4,
        alpha=0.01,
        nu=0.025,
        survival=1.0,
        screen=600_000,
        at_least=1000.0,
        quiet=Phase(2_200_000, (0.0,), (0.0,), 12),
        noisy=(
            Phase(4_000_000, (0.15, 0.05), (0.0, 0.05, 0.1), 12),
            Phase(1_000_000, (0.2, 0.1), (0.0, 0.1, 0.15), 18, whiten=True),
        ),
        test=(0.0, 0.05, 0.1),
    ),
    "swimmer": Search(
        directions=4,
        best=4,
        alpha=0.05,
        nu=0.1,
        survival=0.0,
        screen=300_000,
        at_least=150.0,
        quiet=Phase(1_200_000, (0.0,), (0.0,), 18),
        noisy=(),
        test=(0.0, 0.1, 0.3),
    ),
}


class Whitening:
    """Running mean and variance of the observations."""

    def __init__(self, dim: int) -> None:
        self.n, self.mean, self.squares = 0, np.zeros(dim), np.zeros(dim)

    def add(self, seen: Array) -> None:
        """Chan's update by a batch [k, dim]."""
        k, mean = len(seen), seen.mean(0)
        gap = mean - self.mean
        self.squares = (
            self.squares + ((seen - mean) ** 2).sum(0) + gap**2 * self.n * k / (self.n + k)
        )
        self.mean = self.mean + gap * k / (self.n + k)
        self.n += k

    def deviation(self) -> Array:
        return np.sqrt(self.squares / max(self.n, 1)) + 1e-8 if self.n else np.ones_like(self.mean)

    def fold(self, M: Array, decimals: int | None = None) -> Gait:
        """The gait M (o - mean) / deviation in the observations themselves."""
        W = M / self.deviation()
        b = -W @ self.mean
        return Gait(W, b) if decimals is None else Gait(W.round(decimals), b.round(decimals))


class Climb:
    """One search: the present M, its whitening, the steps taken and the best policy so far."""

    def __init__(self, task: Locomotion, search: Search, seed: int) -> None:
        self.task, self.search = task, search
        self.env = task.make_env().unwrapped
        self.rng = np.random.default_rng(seed)
        self.M = np.zeros((len(task.actions), len(task.layout)))
        self.whitening = Whitening(len(task.layout))
        self.steps, self.before = 0, 0
        self.forget()

    def forget(self) -> None:
        """Let the present policy be the best so far."""
        self.best, self.best_score = self.whitening.fold(self.M, 4), -np.inf
        self.best_state = self.M, copy.copy(self.whitening)

    def whiten(self, seed: int) -> None:
        """Start from the best gait with the deviations of its own states and a mean that gives its b back."""
        seen: list[Array] = []
        for episode in range(10):
            self.task.walk(self.env, self.best, episode, 0.05, seen)
        self.whitening = Whitening(len(self.task.layout))
        self.whitening.add(np.array(seen))
        self.whitening.mean = -np.linalg.pinv(self.best.W) @ self.best.b
        self.M = self.best.W * self.whitening.deviation()
        self.rng = np.random.default_rng(seed)
        self.before, self.steps = self.before + self.steps, 0

    def run(self, phase: Phase, learn: bool, report: Report) -> None:
        """Iterations up to the phase's end, the policy tested every tenth of the way."""
        first, tested = self.steps, 0
        while self.steps < phase.until:
            self._iterate(phase.noise, learn)
            tenth = 10 * (self.steps - first) // max(phase.until - first, 1)
            if tenth > tested:
                tested = tenth
                score = self.test(phase.selection, phase.episodes)
                report(
                    f"{self.before + self.steps} steps: return {score:.1f}, best {self.best_score:.1f}"
                )

    def _iterate(self, noise: Sequence[float], learn: bool) -> None:
        s = self.search
        returns, ways = np.zeros((s.directions, 2)), []
        seen: list[Array] = []
        for i in range(s.directions):
            way = self.rng.standard_normal(self.M.shape)
            ways.append(way)
            episode = int(self.rng.integers(2**31))
            for j, sign in enumerate((1.0, -1.0)):
                gait = self.whitening.fold(self.M + sign * s.nu * way)
                out = self.task.walk(
                    self.env, gait, episode, noise[i % len(noise)], seen if learn else None
                )
                returns[i, j] = out.reward - s.survival * out.steps
                self.steps += out.steps
        top = np.argsort(returns.max(1))[::-1][: s.best]
        sigma = max(float(returns[top].std()), 1e-6)
        gain = returns[top, 0] - returns[top, 1]
        self.M = self.M + s.alpha / (s.best * sigma) * sum(
            g * ways[i] for g, i in zip(gain, top, strict=True)
        )
        if learn:
            self.whitening.add(np.array(seen))

    def test(self, noise: Sequence[float], episodes: int) -> float:
        """Mean return of the rounded policy over selection episodes, the noise in turn; the best is remembered."""
        gait = self.whitening.fold(self.M, 4)
        outs = [
            self.task.walk(self.env, gait, seed, noise[i % len(noise)])
            for i, seed in enumerate(SELECTION[:episodes])
        ]
        self.steps += sum(out.steps for out in outs)
        score = float(np.mean([out.reward for out in outs]))
        if score > self.best_score:
            self.best, self.best_score = gait, score
            self.best_state = self.M, copy.copy(self.whitening)
        return score


def search_gait(
    task: Locomotion, search: Search, seed: int, report: Report = lambda _: None
) -> tuple[Gait, int] | None:
    """The gait of a seed and the environment steps it took, or None where the seed was given up."""
    climb = Climb(task, search, seed)
    climb.run(search.quiet._replace(until=search.screen), True, report)
    if climb.best_score < search.at_least:
        return None
    climb.run(search.quiet, True, report)
    for phase in search.noisy:
        climb.M, climb.whitening = climb.best_state
        if phase.whiten:
            climb.whiten(seed + 100)
        climb.forget()
        climb.run(phase, False, report)
    return climb.best, climb.before + climb.steps


def measure(
    task: Locomotion, gait: Gait, noise: float, seeds: Sequence[int] = TEST
) -> dict[str, float]:
    """Mean, spread and least return and the number of falls over the seeds."""
    env = task.make_env().unwrapped
    outs = [task.walk(env, gait, seed, noise) for seed in seeds]
    rewards = np.array([out.reward for out in outs])
    return {
        "noise": noise,
        "n": len(outs),
        "mean": round(float(rewards.mean()), 1),
        "sd": round(float(rewards.std(ddof=1)), 1),
        "min": round(float(rewards.min()), 1),
        "falls": sum(out.fell for out in outs),
    }


def entry(task: Locomotion, search: Search, seed: int, gait: Gait, steps: int) -> dict[str, Any]:
    """What is written down of a gait."""
    returns = [measure(task, gait, noise) for noise in search.test]
    return {
        "seed": seed,
        "steps": steps,
        "returns": returns,
        "W": gait.W.tolist(),
        "b": gait.b.tolist(),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Search linear gaits by Augmented Random Search.")
    parser.add_argument("task", choices=list(SEARCHES))
    parser.add_argument("--steps", type=int, help="environment steps a seed (default: the task's)")
    parser.add_argument(
        "--seed", type=int, nargs="+", default=[0], help="one or several seeds, a gait each"
    )
    parser.add_argument(
        "--out", type=Path, help="JSON file to write (default: models/<task>/expert.json)"
    )
    asked = parser.parse_args(arguments)
    task, search = load_task(asked.task), SEARCHES[asked.task]
    if not isinstance(task, Locomotion):
        raise CdiffError(f"{task.name} has no gaits to search for")
    if asked.steps:
        search = search.within(asked.steps)
    out = asked.out or home() / "models" / task.name / "expert.json"
    policies = []
    for seed in asked.seed:
        found = search_gait(task, search, seed, partial(_tell_seed, seed))
        if found is None:
            _tell(f"seed {seed}: given up, under {search.at_least:g}")
            continue
        policies.append(entry(task, search, seed, *found))
        _tell(f"seed {seed}: {policies[-1]['returns']}")
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(dump(task.name, policies))
    _tell(
        f"{len(policies)} gaits in {shown(out)}" if policies else "no gait found; nothing written"
    )


def dump(name: str, policies: Sequence[dict[str, Any]]) -> str:
    """JSON with one line a row of W."""
    text = json.dumps({"task": name, "policies": policies}, indent=1)
    return text + "\n"


def _tell_seed(seed: int, text: str) -> None:
    _tell(f"seed {seed}: {text}")


def _tell(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    main()
