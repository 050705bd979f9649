"""How well does the present state alone predict the label that `conditional` is given?

    python tests/benchmarks/studies/labels.py [--task hopper]

The label says whether a window of the demonstrations satisfies a constraint file. `conditional` can
use only what the label says beyond the present state. The prediction is by the ten nearest
neighbours, in standard deviations, of the first states of 3000 windows among those of 40 000
windows of other episodes.
"""

import argparse

import torch
from torch import Tensor

from cdiff_cli.models.recipe import load_recipe
from cdiff_cli.paths import home
from cdiff_cli.tasks import load_task
from cdiff_cli.training.demonstrations import demonstrations
from cdiff_cli.training.labels import ConstraintLabel
from cdiff_cli.training.windows import Windows

NEIGHBOURS, KNOWN, ASKED = 10, 40_000, 3_000


def predicted(known: Tensor, obeys: Tensor, asked: Tensor) -> Tensor:
    """Share of the nearest known states whose windows satisfy the constraints [n]."""
    near = [
        torch.cdist(some, known).topk(NEIGHBOURS, largest=False).indices
        for some in asked.split(200)
    ]
    return obeys[torch.cat(near)].double().mean(1)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="hopper")
    name = parser.parse_args().task
    task, recipe = load_task(name), load_recipe(name)
    every = demonstrations(task, recipe.demonstrations.steps, recipe.demonstrations.seed)
    episodes = [episode for episode in every if len(episode) >= recipe.horizon]
    order = torch.randperm(len(episodes), generator=torch.Generator().manual_seed(0)).tolist()
    apart = len(episodes) // 10
    drawn = []
    for chosen, n in ((order[apart:], KNOWN), (order[:apart], ASKED)):
        drawn.append(
            Windows.from_episodes([episodes[i] for i in chosen], recipe.horizon)
            .draw(n, torch.Generator().manual_seed(1))
            .double()
        )
    deviation, mean = torch.std_mean(drawn[0][:, 0], 0)
    known, asked = ((x[:, 0] - mean) / deviation for x in drawn)
    print(
        "| constraints | satisfying windows | predicted right | variance explained |\n| --- | ---: | ---: | ---: |"
    )
    for path in sorted((home() / "constraints").glob(f"{name}*.yaml")):
        condition = ConstraintLabel.read(path, task)
        of_known, truth = (
            torch.cat([condition.label(some) for some in x.split(4096)])[:, 0] > 0 for x in drawn
        )
        guess = predicted(known, of_known, asked)
        right, left = (
            ((guess > 0.5) == truth).double().mean(),
            (guess - truth.double()).square().mean(),
        )
        print(
            f"| {path.stem} | {truth.double().mean():.3f} | {right:.3f} | {1 - left / truth.double().var():.3f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
