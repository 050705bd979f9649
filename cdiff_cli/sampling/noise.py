"""Noise that depends on a plan's own seed alone."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch

from cdiff_cli.arrays import Traj


@dataclass
class Noise:
    """Standard normal draws of one shape for a batch, one generator a seed, so that a seed's plan does not depend on its
    neighbours in the batch and every method meets the same x_T and z.
    """

    seeds: Sequence[int]
    shape: tuple[int, int]
    device: torch.device | str = "cpu"
    _generators: list[torch.Generator] = field(init=False)

    def __post_init__(self) -> None:
        self._generators = [torch.Generator().manual_seed(seed) for seed in self.seeds]

    def __call__(self) -> Traj:
        """The next draw [batch, horizon, dim]."""
        draws = [torch.randn(self.shape, generator=generator) for generator in self._generators]
        return (
            torch.stack(draws).to(self.device)
            if draws
            else torch.empty(0, *self.shape, device=self.device)
        )
