"""Augmented Random Search (Mania et al. 2018, V2-t) for linear gaits.

    python -m cdiff_cli.tasks.mujoco.gait_search hopper

Each iteration tries the policy perturbed by +nu d and -nu d along N random directions d. It keeps
the b directions with the largest of their two returns, and adds to the policy

    alpha / (b sigma) * sum (return+ - return-) d

where sigma is the standard deviation of the 2 b returns. Observations are whitened by their running
mean and deviation, which W and b of the result include.

A search starts without noise. It continues under action noise with the same whitening. Then it
continues under more noise with a new whitening from its own walks, so that an imprecisely executed
gait does not fall. Each phase starts from the policy that was best on the selection seeds in the
phase before. The returns in the file are those of other seeds.
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
SELECTION = range(10_000, 10_018)  # seeds on which policies are compared
TEST = range(20_000, 20_020)  # seeds of the returns in the file


class Phase(NamedTuple):
    """One phase of a search.

    until       environment steps at its end, counted from the last new whitening
    noise       standard deviations of the action noise, one per direction in turn
    selection   standard deviations of the action noise, one per selection episode in turn
    episodes    number of selection episodes
    whiten      whether the phase starts with a new whitening, of the states of its gait
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
    survival                      subtracted from the reward per step, so that standing still does
                                  not pay
    screen, at_least              steps after which a seed needs this return to go on
    quiet                         phase without noise, in which observations are whitened
    noisy                         phases that follow
    test                          standard deviations of the action noise of the returns in the file
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
        phases = (self.quiet, *self.noisy)
        # a phase that whitens counts its steps from zero, so the one before it adds to the total
        ends = [phases[i].until for i, phase in enumerate(self.noisy) if phase.whiten]
        share = steps / (sum(ends) + phases[-1].until)
        quiet, *noisy = (phase._replace(until=round(phase.until * share)) for phase in phases)
        return replace(self, screen=round(self.screen * share), quiet=quiet, noisy=tuple(noisy))


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

    def add(self, states: Array) -> None:
        """Chan's update by a batch [k, dim]."""
        k, mean = len(states), states.mean(0)
        gap = mean - self.mean
        self.squares = (
            self.squares + ((states - mean) ** 2).sum(0) + gap**2 * self.n * k / (self.n + k)
        )
        self.mean = self.mean + gap * k / (self.n + k)
        self.n += k

    def deviation(self) -> Array:
        """Standard deviations [dim]; ones without data."""
        return np.sqrt(self.squares / max(self.n, 1)) + 1e-8 if self.n else np.ones_like(self.mean)

    def fold(self, M: Array, decimals: int | None = None) -> Gait:
        """The gait M (x - mean) / deviation as a policy W x + b of the state x."""
        W = M / self.deviation()
        b = -W @ self.mean
        return Gait(W, b) if decimals is None else Gait(W.round(decimals), b.round(decimals))


class Climb:
    """A running search: the present M, its whitening, the steps so far and the best policy."""

    def __init__(self, task: Locomotion, search: Search, seed: int) -> None:
        self.task, self.search = task, search
        self.env = task.make_env().unwrapped
        self.rng = np.random.default_rng(seed)
        self.M = np.zeros((len(task.actions), len(task.layout)))
        self.whitening = Whitening(len(task.layout))
        self.steps, self.before = 0, 0
        self.forget()

    def forget(self) -> None:
        """Make the present policy the best one."""
        self.best, self.best_score = self.whitening.fold(self.M, 4), -np.inf
        self.best_state = self.M, copy.copy(self.whitening)

    def whiten(self, seed: int) -> None:
        """Start from the best gait, with the deviations of its states; the mean keeps its b."""
        states: list[Array] = []
        for episode in range(10):
            self.task.walk(self.env, self.best, episode, 0.05, states)
        self.whitening = Whitening(len(self.task.layout))
        self.whitening.add(np.array(states))
        self.whitening.mean = -np.linalg.pinv(self.best.W) @ self.best.b
        self.M = self.best.W * self.whitening.deviation()
        self.rng = np.random.default_rng(seed)
        self.before, self.steps = self.before + self.steps, 0

    def run(self, phase: Phase, learn: bool, report: Report) -> None:
        """Iterations up to the end of a phase, with a test after every tenth of it.

        learn   whether the whitening is updated
        """
        first, tested = self.steps, 0
        while self.steps < phase.until:
            self._iterate(phase.noise, learn)
            tenth = 10 * (self.steps - first) // max(phase.until - first, 1)
            if tenth > tested:
                tested = tenth
                score = self.test(phase.selection, phase.episodes)
                steps = self.before + self.steps
                report(f"{steps} steps: return {score:.1f}, best {self.best_score:.1f}")

    def _iterate(self, noise: Sequence[float], learn: bool) -> None:
        """One iteration."""
        s = self.search
        returns, directions = np.zeros((s.directions, 2)), []
        states: list[Array] | None = [] if learn else None
        for i in range(s.directions):
            d = self.rng.standard_normal(self.M.shape)
            directions.append(d)
            episode = int(self.rng.integers(2**31))
            for j, sign in enumerate((1.0, -1.0)):
                gait = self.whitening.fold(self.M + sign * s.nu * d)
                outcome = self.task.walk(self.env, gait, episode, noise[i % len(noise)], states)
                returns[i, j] = outcome.reward - s.survival * outcome.steps
                self.steps += outcome.steps
        top = np.argsort(returns.max(1))[::-1][: s.best]
        sigma = max(float(returns[top].std()), 1e-6)
        gain = returns[top, 0] - returns[top, 1]
        self.M = self.M + s.alpha / (s.best * sigma) * sum(
            g * directions[i] for g, i in zip(gain, top, strict=True)
        )
        if states is not None:
            self.whitening.add(np.array(states))

    def test(self, noise: Sequence[float], episodes: int) -> float:
        """Mean return of the rounded policy over selection episodes; the best policy is kept."""
        gait = self.whitening.fold(self.M, 4)
        outcomes = [
            self.task.walk(self.env, gait, seed, noise[i % len(noise)])
            for i, seed in enumerate(SELECTION[:episodes])
        ]
        self.steps += sum(outcome.steps for outcome in outcomes)
        score = float(np.mean([outcome.reward for outcome in outcomes]))
        if score > self.best_score:
            self.best, self.best_score = gait, score
            self.best_state = self.M, copy.copy(self.whitening)
        return score


def search_gait(
    task: Locomotion, search: Search, seed: int, report: Report = lambda _: None
) -> tuple[Gait, int] | None:
    """The gait of a seed and its environment steps; None if the seed misses `at_least`."""
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
    """Mean, standard deviation and minimum of the return and the number of falls over the seeds."""
    env = task.make_env().unwrapped
    outcomes = [task.walk(env, gait, seed, noise) for seed in seeds]
    rewards = np.array([outcome.reward for outcome in outcomes])
    return {
        "noise": noise,
        "n": len(outcomes),
        "mean": round(float(rewards.mean()), 1),
        "sd": round(float(rewards.std(ddof=1)), 1),
        "min": round(float(rewards.min()), 1),
        "falls": sum(outcome.fell for outcome in outcomes),
    }


def entry(task: Locomotion, search: Search, seed: int, gait: Gait, steps: int) -> dict[str, Any]:
    """The entry of a gait in the file."""
    returns = [measure(task, gait, noise) for noise in search.test]
    return {
        "seed": seed,
        "steps": steps,
        "returns": returns,
        "W": gait.W.tolist(),
        "b": gait.b.tolist(),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Search the gaits of a task and write them to a file."""
    parser = argparse.ArgumentParser(description="Search linear gaits by Augmented Random Search.")
    parser.add_argument("task", choices=list(SEARCHES))
    parser.add_argument(
        "--steps", type=int, help="environment steps per seed (default: the task's)"
    )
    parser.add_argument(
        "--seed", type=int, nargs="+", default=[0], help="one or more seeds, one gait per seed"
    )
    parser.add_argument(
        "--out", type=Path, help="JSON file to write (default: models/<task>/expert.json)"
    )
    options = parser.parse_args(arguments)
    task, search = load_task(options.task), SEARCHES[options.task]
    if not isinstance(task, Locomotion):
        raise CdiffError(f"{task.name} has no gaits to search for")
    if options.steps:
        search = search.within(options.steps)
    out = options.out or home() / "models" / task.name / "expert.json"
    policies = []
    for seed in options.seed:
        result = search_gait(task, search, seed, partial(_print_seed, seed))
        if result is None:
            _print(f"seed {seed}: given up, under {search.at_least:g}")
            continue
        policies.append(entry(task, search, seed, *result))
        _print(f"seed {seed}: {policies[-1]['returns']}")
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(dump(task.name, policies))
    _print(
        f"{len(policies)} gaits in {shown(out)}" if policies else "no gait found; nothing written"
    )


def dump(name: str, policies: Sequence[dict[str, Any]]) -> str:
    """The file of the gaits as JSON."""
    text = json.dumps({"task": name, "policies": policies}, indent=1)
    return text + "\n"


def _print_seed(seed: int, text: str) -> None:
    _print(f"seed {seed}: {text}")


def _print(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    main()
