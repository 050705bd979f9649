"""How much faster than ProxQP is the exact projection onto a barrier?

    python tests/benchmarks/speed/chain.py [--alpha 0.05] [--repeats 9] [--plans 3]

Both solve min sum_k w_k (v_k - h_k)^2 s.t. v_{k+1} >= (1 - alpha) v_k on one thread. Ours is the
median over the repeats, after a warm-up, of the whole batch. ProxQP (through qpsolvers) is its
faster backend: the median over a few plans, times the batch. Its matrices are made before the clock
starts.
"""

import argparse
import statistics
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import qpsolvers
import torch
from rich.console import Console
from rich.table import Table
from scipy import sparse
from timing import milliseconds

from cdiff_cli.projection.solvers.isotonic import nearest_between, pool_violators

INTERIOR_POINT = {"cvxopt", "kvxopt", "qpax", "qtqp", "ecos", "clarabel"}
DATA = ("noise", "walk", "smooth")
HARD = ("smooth and noise", "falling", "feasible", "drop after a rise", "peak before a rise")


def nearest_chain(h: torch.Tensor, gamma: float, weight: torch.Tensor) -> torch.Tensor:
    """The projection of h [batch, n] with no fixed value."""
    return nearest_between(h, gamma, weight, 0, h.shape[1])


def draw(kind: str, batch: int, n: int) -> torch.Tensor:
    """Values h [batch, n] of order 1, with a drop or a peak of 1000."""
    rng = torch.Generator().manual_seed(n)
    noise = torch.randn(batch, n, generator=rng, dtype=torch.float64)
    phase = torch.rand(batch, 1, generator=rng, dtype=torch.float64)
    s = torch.linspace(0, 1, n, dtype=torch.float64).expand(batch, n)
    wave = 1 + torch.sin(2 * torch.pi * (2 * s + phase))
    return {
        "noise": noise,
        "walk": noise.cumsum(1) / n**0.5,
        "smooth": wave,
        "smooth and noise": wave + 0.05 * noise,
        "falling": 2 - 2 * s,
        "feasible": s,
        "drop after a rise": torch.where(s < 1, s, -1e3),
        "peak before a rise": torch.where(s > 0, s, 1e3),
    }[kind]


def qp(
    h: np.ndarray, gamma: float, w: np.ndarray, solver: str, dense: bool, **options: Any
) -> Callable[[], np.ndarray | None]:
    n = len(h)
    A = sparse.diags(
        [np.full(n - 1, gamma), np.full(n - 1, -1.0)], [0, 1], shape=(n - 1, n), format="csc"
    )
    P = sparse.diags(w, format="csc")
    matrices = (
        (P.toarray(), -w * h, A.toarray(), np.zeros(n - 1))
        if dense
        else (P, -w * h, A, np.zeros(n - 1))
    )
    return lambda: qpsolvers.solve_qp(*matrices, solver=solver, **options)


def proxqp(
    h: np.ndarray, gamma: float, w: np.ndarray, backend: str
) -> Callable[[], np.ndarray | None]:
    return qp(h, gamma, w, "proxqp", backend == "dense", backend=backend, eps_abs=1e-9, eps_rel=0.0)


parser = argparse.ArgumentParser()
parser.add_argument("--alpha", type=float, default=0.05)
parser.add_argument("--repeats", type=int, default=9)
parser.add_argument("--plans", type=int, default=3, help="plans that ProxQP is timed on")
arguments = parser.parse_args()
gamma, repeats, plans = 1 - arguments.alpha, arguments.repeats, arguments.plans
warnings.simplefilter("ignore")  # ProxQP's format advice
torch.set_num_threads(1)
console = Console(width=132)

table = Table(
    "data",
    "H",
    "batch",
    "rounds",
    "ours / ms",
    "ProxQP / ms",
    "backend",
    "ratio",
    "largest difference",
)
for kind in DATA:
    for n in (16, 96, 384, 1536):
        h, w, free = (
            draw(kind, 256, n),
            torch.linspace(0.5, 2.0, n, dtype=torch.float64),
            torch.zeros(n, dtype=torch.bool),
        )
        one = {
            backend: statistics.median(
                milliseconds(proxqp(x, gamma, w.numpy(), backend), 3) for x in h[:plans].numpy()
            )
            for backend in ("sparse", "dense")
            if n <= 384 or backend == "sparse"
        }
        backend = min(one, key=lambda name: one[name])
        exact = torch.from_numpy(
            np.stack([proxqp(x, gamma, w.numpy(), backend)() for x in h[:plans].numpy()])
        )
        difference = float((nearest_chain(h[:plans], gamma, w) - exact).abs().max())
        for batch in (1, 10, 256):
            few = h[:batch]
            ours = milliseconds(lambda few=few, w=w: nearest_chain(few, gamma, w), repeats)
            theirs, rounds = batch * one[backend], pool_violators(few, gamma, w)[1]
            cells = (
                f"{ours:.2f}",
                f"{theirs:.1f}",
                backend,
                f"{theirs / ours:.0f}",
                f"{difference:.0e}",
            )
            table.add_row(kind, str(n), str(batch), str(rounds), *cells, end_section=batch == 256)
console.print(
    f"alpha {arguments.alpha:g}; ProxQP to 1e-9, {plans} plans; ours the median of {repeats}", table
)

interior = sorted(INTERIOR_POINT & set(qpsolvers.available_solvers))
if not interior:
    console.print("no interior-point solver of qpsolvers is installed: none compared")
for solver in interior:
    for n in (16, 96):
        w = np.linspace(0.5, 2.0, n)
        taken = milliseconds(qp(draw("noise", 1, n)[0].numpy(), gamma, w, solver, dense=True), 3)
        console.print(f"{solver}, dense, H {n}: {taken:.2f} ms per plan")

table = Table(
    "ns per value, noise",
    *(f"H {n}" for n in (96, 384, 1536)),
    title="flat: the cost is linear in batch and horizon",
)
for batch in (64, 256, 1024):
    cells = []
    for n in (96, 384, 1536):
        h, w, free = (
            draw("noise", batch, n),
            torch.ones(n, dtype=torch.float64),
            torch.zeros(n, dtype=torch.bool),
        )
        taken = milliseconds(lambda h=h, w=w: nearest_chain(h, gamma, w), 3)
        cells.append(f"{1e6 * taken / batch / n:.0f}")
    table.add_row(f"batch {batch}", *cells)
console.print(table)

table = Table(
    "rounds (ms), batch 10",
    *(f"H {n}, alpha {a:g}" for n in (384, 1536) for a in (0.85, 0.05, 0.001)),
)
for kind in DATA + HARD:
    cells = []
    for n in (384, 1536):
        for alpha in (0.85, 0.05, 0.001):
            h, w = draw(kind, 10, n), torch.ones(n, dtype=torch.float64)
            rounds = pool_violators(h, 1 - alpha, w)[1]
            taken = milliseconds(lambda h=h, w=w, alpha=alpha: pool_violators(h, 1 - alpha, w), 3)
            cells.append(f"{rounds} ({taken:.1f})")
    table.add_row(kind, *cells)
console.print(table)
