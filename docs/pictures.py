"""The pictures of docs/method/: `python docs/pictures.py` draws them anew; about a minute on two cores.

segments.png   a path across a disc, the tangent half-spaces of its segments, and its projection
dynamics.png   the same path projected with and without double-integrator dynamics, and the inputs that each asks for
margins.png    Hopper without margins, and the conformal margin from its episodes
"""

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch

mpl.use("Agg")
import matplotlib.pyplot as plt

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.constraints.dynamics import LinearDynamics, LinearDynamicsConstraint
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.state_sets import Ellipsoid
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.evaluation import conformal, metrics
from cdiff_cli.planning.receding_horizon import rollout
from cdiff_cli.projection.project import project
from cdiff_cli.projection.solvers.sphere_normals import normals_of

FOLDER = Path(__file__).parent / "method"
GREY, BLUE, RED, ORANGE = "#8a8a8a", "#2b6cb0", "#d1495b", "#d98e04"
SIZE = {"dpi": 110, "bbox_inches": "tight"}


def disc(dim: int, radius: float = 1.0) -> Ellipsoid:
    """Outside a disc around the origin of the first two coordinates."""
    which = torch.eye(dim, dtype=torch.float64)[:2]
    return Ellipsoid(
        which,
        torch.zeros(2, dtype=torch.float64),
        torch.full((2,), radius, dtype=torch.float64),
        torch.tensor(radius),
        "outside",
    )


def ends(x: torch.Tensor) -> Pins:
    mask = torch.zeros(x.shape[1:], dtype=torch.bool)
    mask[[0, -1]] = True
    return Pins(mask, x)


def bare(axes: plt.Axes, title: str) -> None:
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10)
    axes.set_xlabel("x / m")
    axes.set_ylabel("y / m")


def segments_picture() -> None:
    """Left: waypoints pushed out along their own nearest points. Right: tangent half-spaces that rotate along the path."""
    s = torch.linspace(-2.2, 2.2, 12, dtype=torch.float64)
    z = torch.stack((s, 0.22 + 0.1 * torch.sin(2 * s)), -1)[None]
    level = disc(2)
    distance = z.norm(dim=-1, keepdim=True)
    pushed = torch.where(distance < 1, z / distance, z)
    x = project(Constraint((OnSegments("disc", level),)), z, ends(z))
    n = normals_of(z, ends(z).mask.all(1))[0]
    inside = ((z[0, 1:] + z[0, :-1]) / 2).norm(dim=-1) < 1.1
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 4.1), sharey=True)
    for axes in (left, right):
        axes.add_patch(plt.Circle((0, 0), 1, color=RED, alpha=0.25))
        axes.plot(*z[0].T, "o-", color=GREY, ms=4, lw=1, label="unconstrained z")
    left.plot(
        *pushed[0].T, "o-", color=ORANGE, ms=4, label="each waypoint to its nearest safe point"
    )
    bare(left, "safe at the waypoints, cuts through between them")
    for normal in n[inside]:
        along = torch.stack((-normal[1], normal[0]))
        right.plot(
            *torch.stack((normal - 0.7 * along, normal + 0.7 * along)).T,
            color=BLUE,
            lw=0.8,
            alpha=0.5,
        )
    right.plot(
        [], [], color=BLUE, lw=0.8, alpha=0.5, label="boundary of a segment's tangent half-space"
    )
    right.plot(*x[0].T, "o-", color=BLUE, ms=4, label="projection x")
    bare(right, "safe on the segments: both ends of each in its half-space")
    for axes in (left, right):
        axes.set_xlim(-2.4, 2.4)
        axes.set_ylim(-1.2, 2.3)
        axes.legend(fontsize=8, loc="upper left")
    figure.tight_layout()
    figure.savefig(FOLDER / "segments.png", **SIZE)
    plt.close(figure)


def dynamics_picture(dt: float = 0.1, bound: float = 3.0, horizon: int = 48) -> None:
    """A double integrator |u| <= bound past a disc, planned without and with its dynamics."""
    one, zero = torch.eye(2, dtype=torch.float64), torch.zeros(2, 2, dtype=torch.float64)
    A = torch.cat((torch.cat((one, dt * one), 1), torch.cat((zero, one), 1)))
    B = torch.cat((dt**2 / 2 * one, dt * one))
    low = torch.full((2,), -bound, dtype=torch.float64)
    dynamics = LinearDynamics(A, B, torch.zeros(4, dtype=torch.float64), low, -low)
    tau = torch.linspace(0, 1, horizon, dtype=torch.float64)
    s = 3 * tau**2 - 2 * tau**3  # from rest to rest
    p = torch.stack((-2.4 + 4.8 * s, 0.25 + 0 * s), -1)
    v = torch.stack((4.8 * 6 * tau * (1 - tau) / (dt * (horizon - 1)), 0 * tau), -1)
    z = torch.cat((p, v), -1)[None]
    around = OnSegments("disc", disc(4))
    plain = project(Constraint((around,)), z, ends(z))
    exact = LinearDynamicsConstraint.from_dynamics("dynamics", dynamics, 1e-5)
    reachable = project(Constraint((around, exact)), z, ends(z))
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(9.5, 3.7), gridspec_kw={"width_ratios": [1.35, 1]}
    )
    left.add_patch(plt.Circle((0, 0), 1, color=RED, alpha=0.25))
    times = dt * np.arange(horizon - 1)
    right.axhspan(-bound, bound, color="#e8eef5")
    for name, x, colour in (
        ("unconstrained z", z, GREY),
        ("on segments only", plain, ORANGE),
        ("with dynamics", reachable, BLUE),
    ):
        left.plot(*x[0, :, :2].T, "o-", color=colour, ms=2.5, lw=1, label=name)
        wanted = (
            x[0, 1:, :2] - 2 * x[0, :-1, :2] + torch.cat((x[0, :1, :2], x[0, :-2, :2]))
        ) / dt**2
        needed = (
            wanted[1:].abs().amax(1)
            if name != "with dynamics"
            else dynamics.inputs(x)[0, 1:].abs().amax(1)
        )
        right.semilogy(times[1:], needed.clamp_min(1e-2), color=colour, lw=1.4)
    bare(left, f"past a disc, |acceleration| <= {bound:g} m/s² per axis")
    left.set_ylim(-1.1, 2.0)
    left.legend(fontsize=8, loc="upper left")
    right.axhline(bound, color="k", lw=0.8, ls="--")
    right.set_title("acceleration that each step needs (largest axis)", fontsize=10)
    right.set_xlabel("time / s")
    right.set_ylabel("m/s²")
    figure.tight_layout()
    figure.savefig(FOLDER / "dynamics.png", **SIZE)
    plt.close(figure)
    sys.stderr.write(f"dynamics: steps need up to {needed.max():.2f} m/s^2 with dynamics\n")


def margins_picture(episodes: int = 20, seed: int = 1000, level: float = 0.95) -> None:
    """Hopper at its harder limit with no margin: `--margin 0`."""
    file = Path("constraints/hopper-hard.yaml")
    request = Request(
        task="hopper",
        method="alm",
        constraints=file,
        n=episodes,
        seed=seed,
        margin=0.0,
        device="cpu",
    )
    experiment = resolve(request)
    task, g = experiment.task, experiment.declared
    done = rollout(controller(experiment), task, experiment.seeds)
    executed = metrics.executed_levels(g, done.x, done.observed, task.dt)
    part = [part.name for part in g.parts].index("thigh-down")
    scores = np.sort(conformal.errors(done.predicted_levels, executed)[:, part])
    margin = conformal.conformal(scores, level)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.6))
    planned, real = -done.predicted_levels[:, 1:, part].ravel(), -executed[:, 1:, part].ravel()
    left.plot(planned, real, ".", color=BLUE, ms=1.5, alpha=0.4, rasterized=True)
    left.plot([-0.2, 1], [-0.2, 1], color="k", lw=0.8)
    left.axhline(0, color=RED, lw=1)
    left.set_xlim(-0.1, 0.6)
    left.set_ylim(-0.3, 0.6)
    left.set_xlabel("h of the state that was planned / rad/s")
    left.set_ylabel("h of the state executed / rad/s")
    left.set_title("no margin: below the red line the limit is exceeded", fontsize=10)
    right.step(scores, np.arange(1, episodes + 1) / episodes, where="post", color=BLUE)
    right.axhline(level, color="k", lw=0.8, ls="--")
    right.axvline(margin, color=RED, lw=1.2, label=f"margin of the first pass, {margin:.3f} rad/s")
    right.set_xlabel("largest error of an episode / rad/s")
    right.set_ylabel("share of episodes")
    right.set_title(f"{episodes} episodes, level {level:g}", fontsize=10)
    right.legend(fontsize=8, loc="lower right")
    figure.tight_layout()
    figure.savefig(FOLDER / "margins.png", **SIZE)
    plt.close(figure)
    unsafe = (executed[:, 1:, part] > 1e-6).any(1).sum()
    sys.stderr.write(f"margins: {unsafe} of {episodes} episodes exceed thigh-down; ")
    sys.stderr.write(f"median error {np.median(scores):.4f}, margin {margin:.4f}\n")


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or ("segments", "dynamics", "margins"):
        {"segments": segments_picture, "dynamics": dynamics_picture, "margins": margins_picture}[
            name
        ]()
