"""The noise schedule of a diffusion model."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise


@dataclass(frozen=True)
class Schedule:
    """Noise levels alpha_bar[i] for i = 0 (clean) ... n_steps, each at the trained step t[i].

    q(x_t | x_0) = N(sqrt(alpha_bar_t) x_0, (1 - alpha_bar_t) I)
    """

    alpha_bar: tuple[float, ...]
    t: tuple[int, ...]

    @classmethod
    def cosine(cls, n_steps: int) -> "Schedule":
        """Cosine schedule, offset s = 0.008, beta at most 0.999 (Nichol and Dhariwal, 2021)."""
        level = [
            math.cos((i / n_steps + 0.008) / 1.008 * math.pi / 2) ** 2 for i in range(n_steps + 1)
        ]
        alpha_bar = [1.0]
        for before, after in pairwise(level):
            alpha_bar.append(alpha_bar[-1] * (1 - min(1 - after / before, 0.999)))
        return cls(tuple(alpha_bar), tuple(range(n_steps + 1)))

    @classmethod
    def from_alphas_cumprod(cls, alphas_cumprod: Sequence[float]) -> "Schedule":
        """The schedule with these alpha_bar at the steps 1 to n.

        Raises ValueError unless they fall and lie between 0 and 1.
        """
        levels = [float(level) for level in alphas_cumprod]
        falling = all(after < before for before, after in pairwise([1.0, *levels]))
        if not levels or not falling or levels[-1] <= 0:
            raise ValueError("alphas_cumprod: expected numbers that fall from below 1 to above 0")
        return cls((1.0, *levels), tuple(range(len(levels) + 1)))

    @property
    def n_steps(self) -> int:
        """Number of diffusion steps."""
        return len(self.t) - 1

    def beta(self, i: int) -> float:
        """beta_t = 1 - alpha_bar_t / alpha_bar_{t-1}."""
        return 1 - self.alpha_bar[i] / self.alpha_bar[i - 1]

    def respaced(self, n_steps: int) -> "Schedule":
        """The same noise range in fewer steps: i_k = n (k / n_steps)^1.5, which includes n.

        The last step ends at a clean estimate, a mean that has lost the detail below its noise
        level, so the steps are shorter near the data. The power 1.5 is ours, from
        tests/benchmarks/studies/solvers.py: powers 1 and 2 and steps even in log-SNR are worse.
        """
        rounded = (round(self.n_steps * (k / n_steps) ** 1.5) for k in range(1, n_steps + 1))
        # each step once; the sequence is convex, so it ends at n
        keep = list(accumulate(rounded, lambda before, i: max(before + 1, i), initial=0))
        return Schedule(tuple(self.alpha_bar[i] for i in keep), tuple(self.t[i] for i in keep))

    def until(self, n_steps: int) -> "Schedule":
        """Only the last n_steps steps, those nearest to the data."""
        return Schedule(self.alpha_bar[: n_steps + 1], self.t[: n_steps + 1])
