"""Noise that depends on the seed of a plan alone."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch

from cdiff_cli.arrays import Traj


@dataclass
class Noise:
    """Standard normal draws for a batch, with one generator per seed.

    The plan of a seed therefore does not depend on the other seeds of the batch, and every method
    gets the same x_T and z.

    shape   of one plan, (horizon, dim)
    """

    seeds: Sequence[int]
    shape: tuple[int, int]
    device: torch.device | str = "cpu"
    _generators: list[torch.Generator] = field(init=False)

    def __post_init__(self) -> None:
        self._generators = [torch.Generator().manual_seed(seed) for seed in self.seeds]

    def __call__(self) -> Traj:
        """Draw the next noise [batch, horizon, dim]."""
        draws = [torch.randn(self.shape, generator=generator) for generator in self._generators]
        if not draws:
            return torch.empty(0, *self.shape, device=self.device)
        return torch.stack(draws).to(self.device)
