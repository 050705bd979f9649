"""Named problems with known answers, and short constructors, for all tests."""

import math

import numpy as np
import pytest
import qpsolvers
import torch
from scipy.optimize import nnls

from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.black_box import BlackBox
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.spec.load import load_constraints
from cdiff_cli.constraints.state_sets import Ellipsoid, HalfSpace, Quadric
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import SpecError
from cdiff_cli.projection.project import project
from cdiff_cli.projection.solvers.isotonic import nearest_between
from cdiff_cli.sampling.sampler import Step

LAYOUT = ("x", "y", "vx", "vy")
F64 = torch.float64


def vec(*values):
    return torch.tensor(values, dtype=F64)


def num(value):
    return torch.tensor(value, dtype=F64)


def generator(seed):
    return torch.Generator().manual_seed(seed)


def normal(seed, *shape, scale=1.0):
    return scale * torch.randn(*shape, generator=generator(seed), dtype=F64)


# state sets and constraints ---------------------------------------------------------------------------


def half_space(a=(1.0, -1.0), b=0.2):
    return HalfSpace(vec(*a), num(b))


def ball(side, centre=(0.3, -0.2), radius=0.7, dim=None):
    k, dim = len(centre), dim or len(centre)
    return Ellipsoid(
        torch.eye(k, dim, dtype=F64),
        vec(*centre),
        torch.full((k,), radius, dtype=F64),
        num(radius),
        side,
    )


def ellipsoid(side, centre=(0.3, -0.2), axes=(0.5, 1.2)):
    return Ellipsoid(
        torch.eye(len(axes), dtype=F64), vec(*centre), vec(*axes), num(min(axes)), side
    )


def saddle():
    """x^2 - 0.5 y^2 + 0.6 x y + 0.3 x - 0.1 y <= 0.4: neither convex nor the complement of a convex
    set.
    """
    return Quadric(torch.tensor([[1.0, 0.3], [0.3, -0.5]], dtype=F64), vec(0.3, -0.1), num(0.4))


LEVELS = {
    "half-space": half_space(),
    "inside ball": ball("inside"),
    "outside ball": ball("outside"),
    "inside ball squared": ball("inside").quadric(),
    "outside ball squared": ball("outside").quadric(),
    "inside ellipsoid": ellipsoid("inside"),
    "outside ellipsoid": ellipsoid("outside"),
    "general quadric": saddle(),
}


def waypoints(level, name="w"):
    return Constraint((AtWaypoints(name, level),))


def chain(level, alpha, name="c"):
    return Constraint((DiscreteBarrier(name, level, alpha),))


def opaque(fn, name="o"):
    return Constraint((BlackBox(name, fn, lambda horizon: horizon),))


KINDS = {
    **{name: waypoints(level) for name, level in LEVELS.items()},
    **{f"dcbf over {name}": chain(level, 0.3) for name, level in LEVELS.items()},
    "opaque": opaque(lambda x: (x**3).sum(-1) - 0.5),
    "stack": Constraint(
        (
            AtWaypoints("a", half_space()),
            DiscreteBarrier("b", ball("outside"), 0.4),
            AtWaypoints("e", ellipsoid("inside")),
        )
    ),
}


# pins ---------------------------------------------------------------------------------------------


def pin(x, *waypoints, columns=None):
    """x's own values held at these waypoints."""
    mask = torch.zeros(x.shape[1:], dtype=torch.bool)
    for tau in waypoints:
        mask[tau, columns if columns is not None else slice(None)] = True
    return Pins(mask, x)


# references ---------------------------------------------------------------------------------------


def qp_project(A, b, z, fixed=None):
    """min |x - z|^2 s.t. A x <= b, x = z where fixed; by ProxQP's dense backend, about 1e-9 exact."""
    E = np.eye(len(z))[fixed] if fixed is not None and fixed.any() else None
    x = qpsolvers.solve_qp(
        np.eye(len(z)),
        -z,
        A,
        b,
        E,
        None if E is None else z[fixed],
        solver="proxqp",
        eps_abs=1e-10,
        eps_rel=0.0,
    )
    assert x is not None
    return x


def least_distance(A, b, z):
    """min |x - z|^2 s.t. A x <= b, by non-negative least squares (Lawson and Hanson, 1974, ch. 23).

    It is exact in sharp corners, where ProxQP may find nothing.
    """
    matrix = np.vstack((-A.T, A @ z - b))
    u, _ = nnls(matrix, np.append(np.zeros(len(z)), 1.0))
    r = matrix @ u - np.append(np.zeros(len(z)), 1.0)
    return z - r[:-1] / r[-1]


def dense_jacobian(g, x):
    """(J, offset) with g(x) = J x + offset, of affine rows, for one plan [1, horizon, dim]."""
    J = torch.autograd.functional.jacobian(lambda v: g(v.reshape(x.shape))[0], x.flatten())
    return J.numpy(), (g(x)[0] - J @ x.flatten()).numpy()


def nearest_of(points, z):
    """The least distance from z [n, 2] to a cloud of points [m, 2]."""
    return torch.cdist(z, points).min(1).values


# samplers with known answers ----------------------------------------------------------------------

UNIT_MEAN_SHIFT = waypoints(
    HalfSpace(vec(-1.0), num(-1.0))
)  # g(x) = 1 - x: E x >= 1 turns N(0, 1) into N(1, 1), lam* = 1


def langevin_chain(method, g, *, steps, batch, beta, seed):
    """Unadjusted Langevin of N(0, 1) under `method`: final samples [batch, 1, 1] and the state
    after each step.
    """
    rng = generator(seed)
    x = torch.randn(batch, 1, 1, generator=rng, dtype=F64)
    pins, state, states = Pins.none(x), method.init(x, g), []
    for _ in range(steps):
        z = torch.randn(x.shape, generator=rng, dtype=F64)
        step = Step(
            x, x, beta, 1.0, lambda _, x=x, z=z: x - beta / 2 * x + math.sqrt(beta) * z, pins, False
        )
        x, state = method.step(step, g, state)
        states.append(state)
    return x, states


def gaussian_denoiser(schedule, mean, std):
    """E[x_0 | x_t] of N(mean, std^2), exactly."""
    level = dict(zip(schedule.t, schedule.alpha_bar, strict=True))

    def clean(x, t):
        a = level[t]
        return mean + std**2 * math.sqrt(a) / (a * std**2 + 1 - a) * (x - math.sqrt(a) * mean)

    return clean


def draws(seed, *shape):
    """A noise source of one generator, float64."""
    rng = generator(seed)
    return lambda: torch.randn(*shape, generator=rng, dtype=F64)


QP = 1e-6  # accuracy of ProxQP: 1e-9 per constraint, less for hundreds of coupled ones


def nearest_chain(h, gamma, weight, fixed):
    """The nearest values to h that satisfy a barrier, as projection/barrier.py computes them.

    fixed   indices with v_k = h_k, at the start and at the end [n]
    """
    free = torch.nonzero(~fixed)[:, 0]
    first, last = (int(free[0]), int(free[-1]) + 1) if len(free) else (0, 0)
    return nearest_between(h, gamma, weight, first, last)


def free_projection(g, z):
    """Projection with nothing pinned."""
    return project(g, z, Pins.none(z))


def qp_projection(g, z, pins=None):
    """The nearest trajectories by ProxQP, for affine rows."""
    fixed = None if pins is None else pins.mask.flatten().numpy()
    out = []
    for one in z:
        J, offset = dense_jacobian(g, one[None])
        out.append(qp_project(J, -offset, one.flatten().numpy(), fixed).reshape(one.shape))
    return torch.from_numpy(np.stack(out))


def refused_at(path, start):
    """Loading the file raises a SpecError that starts with the file and then `start`.

    start   line, field and complaint
    """
    with pytest.raises(SpecError) as caught:
        load_constraints(path, "maze2d-umaze", ("x", "y", "vx", "vy"))
    assert str(caught.value).startswith(f"{path}:{start}"), str(caught.value)
