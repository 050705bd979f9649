"""The projections of one diffusion step against the network call they accompany, and with dynamics against ProxQP. One run.

    python tests/benchmarks/projections.py [--task maze2d-umaze] [--batches 1,10,256] [--repeats 9] [--threads 2]

Trajectories are the shipped demonstrations around the task's disc; ours is the median over the repeats after a warm-up, of the
whole batch. ProxQP (qpsolvers, sparse) solves the same problem with dynamics, tangent planes given, one plan after another.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
import qpsolvers
import torch
from rich.console import Console
from rich.table import Table
from scipy import sparse
from timing import milliseconds

from cdiff_cli.constraint import Constraint, Pins, pull_back
from cdiff_cli.dynamics import Reachable, dynamics_of, split
from cdiff_cli.projection import project_from
from cdiff_cli.request import Options, resolve
from cdiff_cli.segments import planes

CONSTRAINTS = Path(__file__).parents[2] / "constraints"


def proxqp(part: Reachable, g: Constraint, x: torch.Tensor, mask: torch.Tensor) -> float:
    """Milliseconds for one plan x [1, horizon, n]: states and inputs as unknowns, the dynamics and the pinned ends
    as equalities, the tangent planes and the inputs' bounds as the rest; environment units.
    """
    d, (_, horizon, n) = part.dynamics, x.shape
    m, steps = d.B.shape[1], horizon - 1
    on, stay = sparse.eye(steps, horizon, k=1), sparse.eye(steps, horizon)
    makes = sparse.kron(on, sparse.eye(n)) - sparse.kron(stay, d.A.numpy())
    equal = sparse.hstack((makes, sparse.kron(sparse.eye(steps), -d.B.numpy())))
    ends = sparse.vstack((sparse.eye(n, n * horizon), sparse.eye(n, n * horizon, k=n * steps)))
    a, b = planes(g.parts, x, Pins(mask, x))
    rows, bound = [], []
    for k in range(a.shape[2]):
        where = np.flatnonzero(b[0, 1:-1, k] < 1e20) + 1  # the pinned ends cannot move
        columns = (where[:, None] * n + np.arange(n)).ravel()
        entries = (a[0, where, k].numpy().ravel(), (np.repeat(np.arange(len(where)), n), columns))
        rows.append(sparse.csr_matrix(entries, shape=(len(where), n * horizon)))
        bound.append(b[0, where, k].numpy())
    inputs = sparse.csc_matrix((sum(map(len, bound)), m * steps))
    weight = np.concatenate((np.tile(part.weight.numpy(), horizon), np.full(m * steps, 1e-9)))
    free = np.full(n * horizon, np.inf)
    problem = {
        "P": sparse.diags(weight, format="csc"),
        "q": -weight * np.concatenate((x[0].numpy().ravel(), np.zeros(m * steps))),
        "G": sparse.hstack((sparse.vstack(rows), inputs), format="csc"),
        "h": np.concatenate(bound),
        "A": sparse.vstack((equal, sparse.hstack((ends, sparse.csc_matrix((2 * n, m * steps))))), format="csc"),
        "b": np.concatenate((np.tile(d.c.numpy(), steps), x[0, 0], x[0, -1])),
        "lb": np.concatenate((-free, np.tile(d.low.numpy(), steps))),
        "ub": np.concatenate((free, np.tile(d.high.numpy(), steps))),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ProxQP's format advice
        assert qpsolvers.solve_qp(**problem, solver="proxqp", eps_abs=5e-4) is not None
        return milliseconds(lambda: qpsolvers.solve_qp(**problem, solver="proxqp", eps_abs=5e-4), 2)


def measure(task: str, batch: int, repeats: int) -> list[str]:
    """The cells of one line of the table."""
    resolved = resolve(Options(task=task, constraints=CONSTRAINTS / f"{task}-disc.yaml", n=1))
    problem, checkpoint = resolved.problem, resolved.checkpoint
    assert checkpoint is not None
    windows = checkpoint.demonstrations.double()
    inside = problem.g(windows) > 0
    crossing = windows[inside.any(1) & ~inside[:, [0, -1]].any(1)]  # those that enter the disc on their way, over and over
    x = crossing[torch.arange(batch) % len(crossing)]
    z64 = problem.normaliser.encode(x)
    z = z64.float()
    mask = torch.zeros(z.shape[1:], dtype=torch.bool)
    mask[[0, -1]] = True
    pins, pins64 = Pins(mask, z), Pins(mask, z64)
    back = (problem.normaliser.centre, problem.normaliser.scale)
    whole64 = pull_back(problem.enforced, *back)
    whole = whole64.to(z)
    waypoints, segments = pull_back(problem.g, *back).to(z), split(whole)[0]
    with torch.inference_mode():
        warm = project_from(whole, z, pins, None, 10)[1]
        network = milliseconds(lambda: problem.denoiser(z, 10), repeats)
        parts = [
            milliseconds(lambda: project_from(waypoints, z, pins, None, 0), repeats),
            milliseconds(lambda: project_from(segments, z, pins, None, 0), repeats),
            milliseconds(lambda: project_from(whole, z, pins, warm, 10, 0.0), repeats),
        ]
        fine = milliseconds(lambda: project_from(whole64, z64, pins64, None, 600, 5e-4), max(repeats // 3, 1))
        rival = batch * proxqp(dynamics_of(problem.enforced)[0], split(problem.enforced)[0], x[:1], mask)
    cells = [text for ms in parts for text in (f"{ms:.2f}", f"{100 * ms / network:.0f}")]
    return [str(batch), f"{network:.1f}", *cells, f"{fine:.1f}", f"{rival:.0f}", f"{rival / fine:.0f}"]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--task", default="maze2d-umaze")
    parser.add_argument("--batches", default="1,10,256")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    table = Table(title=f"{arguments.task}: milliseconds, % of the network call; at the end both to 5e-4 in float64")
    for head in ("batch", "network", "waypoints", "%", "segments", "%", "dynamics, 10 rounds", "%", "ours", "ProxQP", "ratio"):
        table.add_column(head, justify="right")
    for batch in map(int, arguments.batches.split(",")):
        table.add_row(*measure(arguments.task, batch, arguments.repeats))
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
