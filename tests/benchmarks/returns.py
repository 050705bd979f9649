"""Whether a planner conditioned on the return, by classifier-free guidance as in Decision Diffuser, returns more than the shipped.

    python tests/benchmarks/returns.py --task swimmer [--weights 1 1.5 2 4] [--episodes 10] [--seed 1000] [--limits]
    python tests/benchmarks/returns.py --task hopper --folder FOLDER      # a planner of all gaits, left there by mixed_gaits.py

The planner is trained on with labels: r, the discounted mean reward of the walk from the window's first state on (0.99 a step,
which a gait's phase hardly moves; pieces of a walk that bursts cut are one walk again), its 2 and 98 % quantiles to -1 and 1.
The label is (r, 1 - r), so that zeros mean none; a quarter of the windows, and those with less than 100 steps of their walk
left, are shown without. What is asked for is r = 1, with weight w: x0 = x0(none) + w (x0(r = 1) - x0(none)), two network calls a
step but for w = 1. `no label` is the same network without guidance: what training on alone changes.
"""

import argparse
import copy
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from acting import act
from mixed_gaits import move_to
from rich.console import Console
from rich.table import Table

from cdiff_cli.checkpoint import build
from cdiff_cli.closed_loop import controller
from cdiff_cli.conditioning import drop, guided
from cdiff_cli.control import Controller
from cdiff_cli.data import demonstrations
from cdiff_cli.diffusion import Schedule, Weighing, training_loss
from cdiff_cli.planning import network_denoiser
from cdiff_cli.recipe import home
from cdiff_cli.request import RELATIVE_LIMIT, Options, Resolved, resolve
from cdiff_cli.tasks import load_task
from cdiff_cli.training import Data

DISCOUNT = 0.99
LEFT = 100  # steps of its walk that a window must begin before the end of to have a label
DROPOUT = 0.25


def rewards_of(source: str) -> list[np.ndarray]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import minari

        return [np.asarray(episode.rewards, dtype=np.float64) for episode in minari.load_dataset(source).iterate_episodes()]


def returns(episodes: Sequence[np.ndarray], rewards: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Discounted mean reward from each state of each episode to the end of its walk; NaN where less than LEFT steps are left."""
    out: list[np.ndarray] = []
    total, weight, left = 0.0, 0.0, 0
    for i in reversed(range(len(episodes))):
        if i + 1 == len(episodes) or not np.array_equal(episodes[i][-1], episodes[i + 1][0]):
            total, weight, left = 0.0, 0.0, 0
        each = np.full(len(episodes[i]), np.nan)
        for k in reversed(range(len(rewards[i]))):
            total, weight, left = rewards[i][k] + DISCOUNT * total, 1 + DISCOUNT * weight, left + 1
            each[k] = total / weight if left >= LEFT else np.nan
        out.append(each)
    return out[::-1]


def taught(resolved: Resolved, task, steps: int, seed: int = 0) -> torch.nn.Module:
    """The shipped planner trained on with labels of the return, the mean of its weights over the training."""
    checkpoint, recipe = resolved.checkpoint, resolved.recipe
    assert checkpoint is not None
    spec = recipe.train["conditional"]
    episodes = demonstrations(task, recipe.demonstrations.steps, recipe.demonstrations.seed)
    value = np.concatenate(returns(episodes, rewards_of(f"cdiff/{task.name}-v0")))
    low, high = np.nanquantile(value, (0.02, 0.98))
    r = torch.from_numpy(2 * (value - low) / (high - low) - 1).float().clamp(-1, 1)
    labels = torch.stack((r, 1 - r), 1).nan_to_num(0.0)
    Console(stderr=True).print(
        f"{task.name}: reward a step {low:.3f} to {high:.3f}; {(labels != 0).any(1).float().mean():.2f} labelled"
    )
    data = Data.of(task, recipe, spec, episodes)
    schedule, generator = Schedule.cosine(recipe.n_steps), torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    net = build(len(task.layout), recipe.horizon, spec.network)
    net.load_state_dict(net.state_dict() | checkpoint.net.state_dict())
    mean = copy.deepcopy(net).requires_grad_(False)
    optimiser = torch.optim.Adam(net.parameters(), spec.learning_rate)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    windows = data.windows
    assert data.frame is not None
    for _ in range(steps):
        some = torch.randint(len(windows.starts), (spec.batch,), generator=generator)
        x0, label = data.frame.encode(windows[some]), drop(labels[windows.starts[some]], DROPOUT, generator)
        loss, _ = training_loss(net, schedule, x0.float(), data.pinned, Weighing(0, 1), generator, False, label)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        rate.step()
        for old, new in zip(mean.parameters(), net.parameters(), strict=True):
            old.data.lerp_(new.data, 1 - spec.ema)
    return mean.eval()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="hopper")
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--weights", type=float, nargs="+", default=[1.0, 1.5, 2.0, 4.0])
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--folder", type=Path, help="of mixed_gaits.py")
    parser.add_argument("--net", type=Path, help="file of the trained weights: read where it is, else written")
    parser.add_argument("--limits", action="store_true", help="recommended alm at both limits too")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    saved = asked.net and asked.net.resolve()
    task = load_task(asked.task)
    if asked.folder:
        move_to(asked.folder, task.name)
        task = replace(task, gaits=None)
    plain = resolve(Options(task=asked.task, method="diffuser", device="cpu"))
    if saved and saved.exists():
        net = build(len(plain.problem.task.layout), plain.recipe.horizon, plain.recipe.train["conditional"].network).eval()
        net.load_state_dict(torch.load(saved))
    else:
        net = taught(plain, task, asked.steps)
        if saved:
            torch.save(net.state_dict(), saved)
    acting = {"none": controller(plain)}
    if asked.limits:
        for name in (asked.task, f"{asked.task}-hard"):
            found = resolve(Options(task=asked.task, constraints=home() / "constraints" / f"{name}.yaml", device="cpu"))
            acting[f"alm, {name}"] = controller(found)
    seeds = range(asked.seed, asked.seed + asked.episodes)
    table = Table(title=f"{asked.task}: {asked.episodes} episodes from seed {asked.seed}")
    for title in ("constraint", "planner", "return", "fell", "violating", "violation rate / %", "worst / g"):
        table.add_column(title, justify="left" if title in ("constraint", "planner") else "right")

    def add(constraint: str, planner: str, changed: Controller) -> None:
        found = act(changed, seeds, changed.g)
        fell, rate = f"{found.done.fell.sum()}", f"{found.mean('violation_rate'):.3f}"
        reward = np.array([row["reward"] for row in found.rows])
        returned = f"{reward.mean():.1f} ± {reward.std(ddof=1) / len(reward) ** 0.5:.1f}"
        table.add_row(constraint, planner, returned, fell, found.violating(), rate, found.worst())
        Console(stderr=True).print(constraint, planner, returned, fell, rate)

    for constraint, each in acting.items():
        add(constraint, "unconditioned", each)
        add(constraint, "no label", replace(each, denoiser=network_denoiser(net, RELATIVE_LIMIT)))
        for weight in asked.weights:
            add(constraint, f"guided, w = {weight:g}", replace(each, denoiser=guided(net, weight, RELATIVE_LIMIT)))
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
