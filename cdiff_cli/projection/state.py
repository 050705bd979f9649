"""The nearest state in a state set, exactly."""

import torch
from torch import Tensor

from cdiff_cli.arrays import dot, times
from cdiff_cli.constraints.protocol import StateSet
from cdiff_cli.constraints.state_sets import Ellipsoid, HalfSpace, Quadric, QuadricInFrame
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import InfeasibleError


def has_state_projection(part: AtWaypoints) -> bool:
    """Whether project_state takes the state set of the part."""
    return isinstance(part.level, HalfSpace | Quadric | QuadricInFrame | Ellipsoid)


def project_state(level: StateSet, z: Tensor) -> Tensor:
    """The nearest state with f <= 0, for states z [..., dim]."""
    if isinstance(level, HalfSpace):
        size = level.a.square().sum(-1).clamp_min(1e-30)
        return z - (level(z).clamp_min(0) / size)[..., None] * level.a
    if isinstance(level, Ellipsoid):
        return _nearest_ball(level, z) if level.is_ball else _nearest_quadric(level.quadric(), z)
    assert isinstance(level, Quadric | QuadricInFrame)
    return _nearest_quadric(level if isinstance(level, Quadric) else level.multiplied_out(), z)


def _nearest_ball(ball: Ellipsoid, z: Tensor) -> Tensor:
    """The nearest point of the sphere; the centre itself moves along the first axis."""
    inner = times(z, ball.which.mT)
    radial, radius = inner - ball.centre, ball.axes[..., :1]
    length = radial.norm(dim=-1, keepdim=True)
    first = torch.zeros_like(radial)
    first[..., 0] = 1.0
    unit = torch.where(length > 1e-12, radial / length.clamp_min(1e-12), first)
    wrong = length < radius if ball.side == "outside" else length > radius
    moved = torch.where(wrong, ball.centre + radius * unit, inner)
    return z + times(moved - inner, ball.which)


def _nearest_quadric(quadric: Quadric, z: Tensor) -> Tensor:
    """min |x - z|^2 s.t. x.P x + q.x <= r, for P of any signature, by its scalar secular equation.

    In the eigenbasis of P the stationary points are y(mu) = (y0 - mu q / 2) / (1 + mu lambda).
    f(y(mu)) decreases on 0 <= mu < -1 / min(lambda), and its root is the global minimiser
    (S-lemma). The root is found by bisection in float64.
    """
    wrong = quadric(z) > 0
    if not bool(wrong.any()):
        return z
    P, q, r = _parameters_of(quadric, wrong)
    eigenvalue, basis = torch.linalg.eigh(P)
    y0, q = times(z[wrong].double(), basis), times(q, basis)
    # With a negative lowest eigenvalue, bisection fails at the stationary point of f: step off it.
    lowest = eigenvalue[..., 0]
    stuck = (lowest < 0) & (
        (2 * y0[:, 0] * lowest + q[..., 0]).abs() < 1e-9 * eigenvalue.abs().amax(-1)
    )
    y0[:, 0] = torch.where(stuck, y0[:, 0] + 1e-6, y0[:, 0])
    ceiling = torch.where(lowest < 0, -1 / lowest, torch.inf)

    def y(mu: Tensor) -> Tensor:
        return (y0 - mu[:, None] * q / 2) / (1 + mu[:, None] * eigenvalue)

    def f(mu: Tensor) -> Tensor:
        at = y(mu)
        return (at.square() * eigenvalue).sum(-1) + dot(at, q) - r

    low = torch.zeros(len(y0), dtype=torch.float64, device=z.device)
    high = torch.where(lowest < 0, ceiling * (1 - 1e-12), 1.0).expand_as(low)
    for _ in range(200):
        short = (f(high) > 0) & (lowest >= 0)
        if not bool(short.any()):
            break
        high = torch.where(short, 4 * high, high)
    if bool((f(high) > 1e-6 * (1 + r.abs())).any()):
        raise InfeasibleError(
            "a quadratic constraint has no feasible point at all: x.P x + q.x never falls to r;"
            " raise r"
        )
    for _ in range(100):
        middle = (low + high) / 2
        above = f(middle) > 0
        low, high = torch.where(above, middle, low), torch.where(above, high, middle)
    out = z.clone()
    out[wrong] = times(y(high), basis.mT).to(z)
    return out


def _parameters_of(quadric: Quadric, which: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """P, q, r in float64 of some states of a batch; shared parameters stay single."""
    P, q, r = (v.double() for v in (quadric.P, quadric.q, quadric.r))
    return (
        P if P.ndim == 2 else P.expand(*which.shape, *P.shape[-2:])[which],
        q if q.ndim == 1 else q.expand(*which.shape, q.shape[-1])[which],
        r if r.ndim == 0 else r.expand(which.shape)[which],
    )
