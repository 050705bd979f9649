"""The projection with dynamics against other solvers, and what it costs by horizon and by batch. One run.

    python tests/benchmarks/speed/reaching.py [--batches 1,10,100] [--repeats 5] [--threads 2] [--plot docs/cost.png]

Solvers: demonstrations that cross the mazes' discs, start and goal pinned, tangent planes as chosen at the demonstration. Ours (the
planes' choice included) ends at the minimiser; ProxQP (qpsolvers, sparse, one plan after another) and a dense batched Mehrotra
predictor-corrector on the inputs get the planes and end at 5e-4. Warm: the same after a smooth change of 1 mm, from the last
solution (ProxQP: primal). By horizon: straight paths of the maze's ball, a disc over the middle of each. Medians, ms a plan.
"""

import argparse
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import qpsolvers
import torch
from rich.console import Console
from rich.table import Table
from scipy import sparse
from timing import milliseconds

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.constraints.dynamics import LinearDynamics, dynamics_of, split
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.state_sets import Ellipsoid
from cdiff_cli.projection.dynamics import project_dynamics
from cdiff_cli.projection.segments import tangent_half_spaces
from cdiff_cli.projection.solvers.half_spaces import NEVER

CONSTRAINTS = Path(__file__).parents[3] / "constraints"
USED = (0, 1)
FAR = 1e3  # bound of a half-space that is not there, for solvers that want a number


def ours(d, parts, weight, z, pins, warm=None):
    return project_dynamics(
        d, parts, None, z, pins, columns=USED, weight=weight, rounds=1, warm=warm, tolerance=1e-6
    )


def halfspaces(parts, z, mask):
    """As ours takes them at z, of the waypoints 1 .. horizon - 2."""
    a, b = tangent_half_spaces(parts, z[..., USED], Pins(mask[:, USED], z[..., USED]))
    return a[:, 1:-1], b[:, 1:-1]


def proxqp(d, weight, z, a, b):
    """The problem of one plan [horizon, n] for qpsolvers: states and inputs as unknowns, dynamics and ends as equalities."""
    (horizon, n), m = z.shape, d.B.shape[1]
    steps = horizon - 1
    makes = sparse.kron(sparse.eye(steps, horizon, k=1), sparse.eye(n)) - sparse.kron(
        sparse.eye(steps, horizon), d.A.numpy()
    )
    equal = sparse.hstack((makes, sparse.kron(sparse.eye(steps), -d.B.numpy())))
    ends = sparse.vstack((sparse.eye(n, n * horizon), sparse.eye(n, n * horizon, k=n * steps)))
    row, slot = np.nonzero(b.numpy() < NEVER)
    columns = ((row + 1) * n)[:, None] + np.array(USED)
    entries = (
        a.numpy()[row, slot].ravel(),
        (np.repeat(np.arange(len(row)), len(USED)), columns.ravel()),
    )
    w = np.concatenate((np.tile(weight.numpy(), horizon), np.full(m * steps, 1e-9)))
    free = np.full(n * horizon, np.inf)
    return {
        "P": sparse.diags(w, format="csc"),
        "q": -w * np.concatenate((z.numpy().ravel(), np.zeros(m * steps))),
        "G": sparse.csc_matrix(
            sparse.csr_matrix(entries, shape=(len(row), n * horizon + m * steps))
        ),
        "h": b.numpy()[row, slot],
        "A": sparse.vstack(
            (equal, sparse.hstack((ends, sparse.csc_matrix((2 * n, m * steps))))), format="csc"
        ),
        "b": np.concatenate((np.tile(d.c.numpy(), steps), z[0], z[-1])),
        "lb": np.concatenate((-free, np.tile(d.low.numpy(), steps))),
        "ub": np.concatenate((free, np.tile(d.high.numpy(), steps))),
    }


def solve(problem, start=None):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ProxQP's format advice
        x = qpsolvers.solve_qp(**problem, solver="proxqp", eps_abs=5e-4, initvals=start)
    assert x is not None
    return x


class Condensed:
    """Cost, equalities and inequalities of a batch on the inputs alone, dense; what does not depend on z is made once."""

    def __init__(self, d, weight, horizon):
        n, m, steps = len(weight), d.B.shape[1], horizon - 1
        columns = torch.eye(steps * m).double().view(-1, steps, m)
        moved = LinearDynamics(d.A, d.B, torch.zeros_like(d.c), d.low, d.high)
        G = moved.rollout(torch.zeros(len(columns), n).double(), columns).flatten(1).T.contiguous()
        self.G, self.W, self.d, self.shape = G, weight.repeat(horizon), d, (horizon, n)
        self.P = G.view(horizon, n, -1)[1:-1, USED]
        self.H = G.T @ (self.W[:, None] * G) + 1e-9 * torch.eye(steps * m).double()

    def interior_point(self, z, a, b):
        """Mehrotra's predictor-corrector, every plan until all are within 5e-4."""
        batch, (horizon, n) = len(z), self.shape
        zero = torch.zeros(batch, horizon - 1, self.d.B.shape[1]).double()
        drift = self.d.rollout(z[:, 0], zero)
        q = -((z - drift).flatten(1) * self.W) @ self.G
        E, e = self.G[-n:], z[:, -1] - drift[:, -1]
        C = torch.einsum("bhmk,hku->bhmu", a, self.P).flatten(1, 2)
        eye = torch.eye(len(self.H)).double().expand(batch, -1, -1)
        C = torch.cat((eye, -eye, C), 1)
        room = (b.clamp_max(FAR) - torch.einsum("bhmk,bhk->bhm", a, drift[:, 1:-1, USED])).flatten(
            1
        )
        steps = horizon - 1
        h = torch.cat(
            (
                self.d.high.repeat(steps).expand(batch, -1),
                -self.d.low.repeat(steps).expand(batch, -1),
                room,
            ),
            1,
        )
        u, nu = q.new_zeros(q.shape), q.new_zeros(batch, n)
        s = (h - (C @ u[..., None])[..., 0]).clamp_min(1.0)
        y = torch.ones_like(s)
        for _ in range(60):
            dual = u @ self.H + q + nu @ E + (y[:, None] @ C)[:, 0]
            gap, slack, mu = (
                u @ E.T - e,
                (C @ u[..., None])[..., 0] + s - h,
                (s * y).mean(1, keepdim=True),
            )
            if (
                max(
                    float(dual.abs().max()),
                    float(gap.abs().max()),
                    float(slack.abs().max()),
                    float(mu.max()),
                )
                < 5e-4
            ):
                return u
            K = self.H + C.mT @ ((y / s)[..., None] * C)
            factor = torch.linalg.cholesky(K)
            KE = torch.cholesky_solve(E.T.expand(batch, -1, -1), factor)
            schur = E @ KE

            def step(
                target, dual=dual, gap=gap, slack=slack, factor=factor, KE=KE, schur=schur, y=y, s=s
            ):
                right = -dual - ((y / s * slack + target / s)[:, None] @ C)[:, 0]
                du = torch.cholesky_solve(right[..., None], factor)[..., 0]
                dnu = torch.linalg.solve(schur, (du @ E.T + gap)[..., None])[..., 0]
                du = du - (KE @ dnu[..., None])[..., 0]
                ds = -slack - (C @ du[..., None])[..., 0]
                return du, dnu, ds, (target - y * ds) / s

            def reach(v, dv):
                return torch.where(dv < 0, -v / dv, torch.inf).amin(1, keepdim=True).clamp_max(1.0)

            _, _, ds, dy = step(-s * y)
            share = torch.minimum(reach(s, ds), reach(y, dy))
            centre = ((s + share * ds) * (y + share * dy)).mean(1, keepdim=True) ** 3 / mu**2
            du, dnu, ds, dy = step(centre - s * y - ds * dy)
            share = 0.99 * torch.minimum(reach(s, ds), reach(y, dy))
            u, nu = u + share * du, nu + share * dnu
            s, y = (
                (s + share * ds).clamp_min(1e-7),
                (y + share * dy).clamp_min(1e-7),
            )  # those that are done would run dry
        raise AssertionError("the interior-point method did not converge")


def crossing(task):
    """Dynamics, parts, weight, demonstrations around the disc that the dynamics make, and the task's denoiser."""
    experiment = resolve(Request(task=task, constraints=CONSTRAINTS / f"{task}-disc.yaml", n=1))
    problem = experiment.problem
    windows = experiment.checkpoint.demonstrations.double()
    inside = problem.declared(windows) > 0
    windows = windows[inside.any(1) & ~inside[:, [0, -1]].any(1)]
    reachable = dynamics_of(problem.enforced)[0]
    windows = windows[(reachable(windows) <= 1e-4).all(1)]
    part = split(problem.enforced)[0].parts[0]
    level = part.level
    narrow = replace(part, level=replace(level, which=level.which[..., USED]))
    return reachable.dynamics, (narrow,), reachable.weight, windows, problem


def against_solvers(batches, repeats):
    table = Table(
        title="ms a plan; in brackets how many times ours, cold against cold, warm against warm"
    )
    for head in (
        "H",
        "batch",
        "network",
        "ours, cold",
        "ours, warm",
        "ProxQP, cold",
        "ProxQP, warm",
        "interior point",
    ):
        table.add_column(head, justify="right")
    costs = {}
    for task in ("maze2d-umaze", "maze2d-large"):
        d, parts, weight, windows, problem = crossing(task)
        horizon = windows.shape[1]
        mask = torch.zeros(windows.shape[1:], dtype=torch.bool)
        mask[[0, -1]] = True
        found = ours(d, parts, weight, windows, Pins(mask, windows))[1].u
        windows = windows[
            found.abs().amax((1, 2)) <= 1 + 1e-6
        ]  # the others cannot get past the disc
        bump = (
            torch.sin(torch.linspace(0, torch.pi, horizon).double())[:, None]
            * torch.tensor([1e-3, 1e-3, 0, 0]).double()
        )
        some = windows[:8]
        a, b = halfspaces(parts, some, mask)
        problems = [proxqp(d, weight, z, *of) for z, *of in zip(some, a, b, strict=True)]
        a, b = halfspaces(parts, some + bump, mask)
        later = [proxqp(d, weight, z, *of) for z, *of in zip(some + bump, a, b, strict=True)]
        found = [solve(p) for p in problems]
        cold = milliseconds(lambda problems=problems: [solve(p) for p in problems], 2) / len(some)
        warm = milliseconds(
            lambda later=later, found=found: [
                solve(p, x) for p, x in zip(later, found, strict=True)
            ],
            2,
        ) / len(some)
        x, _ = ours(d, parts, weight, some, Pins(mask, some))
        theirs = torch.tensor(np.stack(found)[:, : some[0].numel()]).view(some.shape)
        print(
            f"{task}: largest difference to ProxQP {float((x - theirs)[..., USED].abs().max()):.1e} m"
        )
        dense = Condensed(d, weight, horizon)
        for batch in batches:
            z = windows[torch.arange(batch) % len(windows)]
            pins, normal = Pins(mask, z), problem.normaliser.encode(z).float()
            _, state = ours(d, parts, weight, z, pins)
            mine = milliseconds(partial(ours, d, parts, weight, z, pins), repeats) / batch
            again = (
                milliseconds(partial(ours, d, parts, weight, z + bump, pins, state), repeats)
                / batch
            )
            network = milliseconds(partial(problem.planner.denoiser, normal, 10), 3) / batch
            costs[horizon, batch] = (batch * mine, batch * again, batch * network)
            cells = [
                f"{network:.2f}",
                f"{mine:.2f}",
                f"{again:.2f}",
                f"{cold:.1f} ({cold / mine:.0f})",
                f"{warm:.1f} ({warm / again:.0f})",
            ]
            if batch * horizon <= 1300:  # beyond, minutes
                a, b = halfspaces(parts, z, mask)
                ms = milliseconds(partial(dense.interior_point, z, a, b), 1) / batch
                cells.append(f"{ms:.1f} ({ms / mine:.0f})")
            table.add_row(str(horizon), str(batch), *cells)
    Console(width=150).print(table)
    return costs


def paths(d, horizon, batch):
    """From rest to rest, straight, each in another direction, and a disc that reaches a little over the middle of each."""
    along = torch.linspace(0, 6, batch).double()
    force = 0.5 * torch.cos(torch.pi * torch.arange(horizon - 1).double() / (horizon - 2))
    u = force[:, None] * torch.stack((along.cos(), along.sin()), 1)[:, None]
    z = d.rollout(torch.zeros(batch, 4).double(), u)
    middle, one = z[:, horizon // 2], torch.ones(2).double()
    size = (0.3 * (middle - z[:, 0])[:, USED].norm(dim=1, keepdim=True)).clamp_max(0.3)
    aside = torch.stack((-middle[:, 3], middle[:, 2]), 1)
    centre = (middle[:, USED] + 0.95 * size * aside / aside.norm(dim=1, keepdim=True))[:, None]
    level = Ellipsoid(torch.eye(2).double(), centre, size[:, None] * one, size, "outside")
    disc = OnSegments("disc", level)
    return z, disc


def by_horizon(repeats):
    d, _, weight, _, _ = crossing("maze2d-umaze")
    table = Table(title="cold, paths of H waypoints, batch 16: ms a plan")
    for head in ("H", "ours", "ours / H / us"):
        table.add_column(head, justify="right")
    costs = {}
    for horizon in (64, 128, 256, 512, 1024):
        z, disc = paths(d, horizon, 16)
        mask = torch.zeros(z.shape[1:], dtype=torch.bool)
        mask[0] = mask[-1] = True
        costs[horizon] = (
            milliseconds(partial(ours, d, (disc,), weight, z, Pins(mask, z)), repeats) / 16
        )
        table.add_row(
            str(horizon), f"{costs[horizon]:.2f}", f"{1e3 * costs[horizon] / horizon:.1f}"
        )
    Console(width=150).print(table)
    return costs


def draw(path, horizons, batches):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    H = list(horizons)
    left.loglog(H, list(horizons.values()), "o-", color="C0", label="projection, from cold")
    left.loglog(H, [horizons[H[-1]] * h / H[-1] for h in H], ":", color="0.6", label="linear")
    left.set(xlabel="waypoints H", ylabel="ms a plan (batch 16)", xticks=H, xticklabels=H)
    for horizon, colour in zip(sorted({h for h, _ in batches}), ("C0", "C3"), strict=True):
        B = [b for h, b in batches if h == horizon]
        cold, warm, network = zip(*(batches[horizon, b] for b in B), strict=True)
        right.loglog(B, cold, "o-", color=colour, label=f"H = {horizon}, from cold")
        right.loglog(B, warm, "v-", color=colour, alpha=0.5, label="after a change of 1 mm")
        right.loglog(B, network, "--", color=colour, label="the network call")
    right.set(xlabel="plans in a batch", ylabel="ms a batch", xticks=B, xticklabels=B)
    for axes in (left, right):
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--batches", default="1,10,100")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    with torch.inference_mode():
        horizons = by_horizon(arguments.repeats)
        batches = against_solvers([int(b) for b in arguments.batches.split(",")], arguments.repeats)
    if arguments.plot:
        draw(arguments.plot, horizons, batches)
