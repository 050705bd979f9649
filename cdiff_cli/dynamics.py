"""Linear dynamics with bounded inputs, and the nearest trajectory that they can produce.

    x^{tau+1} = A x^tau + B u^tau + c,   low <= u <= high

The projection onto {dynamics, input box, half-spaces, segments outside balls, start and goal pinned} is solved by ADMM, the whole
batch at once: the inputs u are the only unknowns (condensed), the dynamics hold exactly in every iterate, the box and the
obstacles are met by copies of u and of the positions. One round is one product with a matrix that depends on the dynamics and
the horizon alone, is computed once and shared by the batch, and one closed-form projection of the copies.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cdiff_cli.constraint import Constraint, Part, Pins, Pull, Rows, Segments, Traj, Waypoints
from cdiff_cli.levels import each_end, take
from cdiff_cli.segments import nearest_in_planes, planes

Array = NDArray[np.float64]
DYNAMICS_FROM = 0.995
"""Of 0, 0.9, 0.95 and 0.995 the one with the smallest distance, all as safe when executed: alm on maze2d-umaze-disc and -slalom,
100 random pairs, seed 2000.
"""


@dataclass(frozen=True)
class LinearDynamics:
    """x' = A x + B u + c with low <= u <= high.

    A [n, n], B [n, m], c [n], low, high [m]
    """

    A: Tensor
    B: Tensor
    c: Tensor
    low: Tensor
    high: Tensor

    def __call__(self, x: Tensor, u: Tensor) -> Tensor:
        return x @ self.A.T + u @ self.B.T + self.c

    def to(self, like: Tensor) -> "LinearDynamics":
        return LinearDynamics(*(v.to(like) for v in (self.A, self.B, self.c, self.low, self.high)))

    def rollout(self, x0: Tensor, u: Tensor) -> Traj:
        """States from x0 [batch, n] under the inputs u [batch, horizon - 1, m]: [batch, horizon, n]."""
        states = [x0]
        for tau in range(u.shape[1]):
            states.append(self(states[-1], u[:, tau]))
        return torch.stack(states, 1)

    def wanted(self, x: Traj) -> Tensor:
        """The inputs that come closest to producing x, whatever their size [batch, horizon - 1, m]."""
        return (x[:, 1:] - x[:, :-1] @ self.A.T - self.c) @ torch.linalg.pinv(self.B).T

    def inputs(self, x: Traj) -> Tensor:
        """The same, cut to the inputs' bounds."""
        return torch.clamp(self.wanted(x), self.low, self.high)

    def residual(self, x: Traj) -> Tensor:
        """|x' - A x - B u - c| of each step under those inputs [batch, horizon - 1]."""
        return (x[:, 1:] - self(x[:, :-1], self.inputs(x))).norm(dim=-1)


@dataclass(frozen=True, eq=False)
class Reachable:
    """Each step is one that the dynamics can make: |x' - A x - B u - c| <= tolerance for some u within its bounds. A row a step.

    dynamics       environment units
    centre, scale  of the trajectories it is applied to: x = centre + scale * z   [n]
    weight         of each coordinate in the distance of its projection, environment units   [n]
    """

    name: str
    dynamics: LinearDynamics
    centre: Tensor
    scale: Tensor
    weight: Tensor
    tolerance: float

    trailing: ClassVar = {"centre": 1, "scale": 1}
    spans = False  # between two states there is nothing to obey

    @classmethod
    def of(cls, name: str, dynamics: LinearDynamics, tolerance: float) -> "Reachable":
        """Of trajectories in environment units, every coordinate weighing 1."""
        one = torch.ones_like(dynamics.c)
        return cls(name, dynamics, torch.zeros_like(one), one, one, tolerance)

    def labels(self, horizon: int) -> list[str]:
        return [f"{self.name}@{tau}-{tau + 1}" for tau in range(horizon - 1)]

    def decode(self, z: Traj) -> Traj:
        return self.centre + self.scale * z

    def encode(self, x: Traj) -> Traj:
        return (x - self.centre) / self.scale

    def __call__(self, x: Traj) -> Rows:
        return self.dynamics.residual(self.decode(x)) - self.tolerance

    def linearise(self, x: Traj) -> tuple[Rows, Pull, Rows]:
        state = self.decode(x)
        miss = state[:, 1:] - self.dynamics(state[:, :-1], self.dynamics.inputs(state))
        length = miss.norm(dim=-1)
        unit = miss / length[..., None].clamp_min(1e-12)
        first, last = each_end(self.scale, 1)
        back, on = unit @ self.dynamics.A * first, unit * last

        def pull(w: Rows) -> Traj:
            out = torch.zeros_like(x)
            out[:, :-1] -= w[..., None] * back
            out[:, 1:] += w[..., None] * on
            return out

        return length - self.tolerance, pull, 2 * (back.square().sum(-1) + on.square().sum(-1))

    def pull_back(self, centre: Tensor, scale: Tensor) -> "Reachable":
        return replace(self, centre=self.centre + self.scale * centre, scale=self.scale * scale)

    def take(self, which: Tensor) -> "Reachable":
        return take(self, which)

    def to(self, like: Tensor) -> "Reachable":
        moved = {name: getattr(self, name).to(like) for name in ("dynamics", "centre", "scale", "weight")}
        return replace(self, **moved)

    def shift(self, margin: float) -> "Reachable":
        return replace(self, tolerance=self.tolerance - margin)

    shift_level = shift

    def segment_max(self, x: Traj) -> Rows:
        """A step's own row."""
        return self(x)

    def on_segments(self) -> tuple[Part, ...]:
        return (self,)


def dynamics_of(g: Constraint) -> list[Reachable]:
    """The parts that ask for dynamics to be obeyed."""
    return [part for part in g.parts if isinstance(part, Reachable)]


def split(g: Constraint) -> tuple[Constraint, Constraint]:
    """g without its dynamics, and its dynamics alone."""
    found = dynamics_of(g)
    if not found:
        return g, Constraint(())
    return Constraint(tuple(part for part in g.parts if part not in found)), Constraint(tuple(found))


def due(g: Constraint, level: float, dynamics_from: float) -> Constraint:
    """g, without its dynamics while the sample is still too noisy for them: level = sqrt(alpha_bar_{t-1}) below dynamics_from."""
    return g if level >= dynamics_from else split(g)[0]


def fit(x: Array, u: Array, after: Array) -> tuple[LinearDynamics, float]:
    """Least squares on the transitions (x, u, after) [k, n], [k, m], [k, n], refitted to those within three median residuals
    until that set is stable, so that collisions and clipped speeds drop out. Also the share of transitions so explained, to
    one in ten thousand of the usual step of each coordinate.
    """
    known = np.concatenate((x, u, np.ones((len(x), 1))), 1)
    step = np.maximum(np.abs(after - x).mean(0), 1e-9 * (1 + np.abs(x).max(0)))  # one that never moves has rounding alone
    kept = np.ones(len(x), dtype=bool)
    for _ in range(20):
        coefficients = np.linalg.lstsq(known[kept], after[kept], rcond=None)[0]
        miss = (np.abs(after - known @ coefficients) / step).max(1)
        now = miss <= max(3 * float(np.median(miss)), 1e-9)
        if (now == kept).all():
            break
        kept = now
    n, m = x.shape[1], u.shape[1]
    A, B, c = np.split(coefficients.T, (n, n + m), axis=1)
    low, high = u.min(0), u.max(0)
    found = LinearDynamics(*(torch.from_numpy(np.ascontiguousarray(v)) for v in (A, B, c[:, 0], low, high)))
    return found, float((miss <= 1e-4).mean())


class Warm(NamedTuple):
    """Where ADMM stands: copies and scaled multipliers of the inputs and of the constrained coordinates, and the inputs u.

    w_u, y_u, u [batch, horizon - 1, m], w_p, y_p [copies, batch, horizon, k]
    """

    w_u: Tensor
    y_u: Tensor
    w_p: Tensor
    y_p: Tensor
    u: Tensor

    def of(self, which: Tensor) -> "Warm":
        """Of some trajectories of the batch alone."""
        return Warm(self.w_u[which], self.y_u[which], self.w_p[:, which], self.y_p[:, which], self.u[which])


RHO_U, RHO_P = 0.02, 5.0  # weights of the copies of u and of positions
RELAXATION = 1.6
TURNS = (0, 10, 20, 40)  # rounds before which the tangent planes (segments.py) are chosen anew; then they rest, to converge


def nearest_reachable(
    dynamics: LinearDynamics,
    parts: Sequence[Waypoints | Segments],
    rest: Callable[[Traj, Pins], Traj] | None,
    z: Traj,
    pins: Pins,
    *,
    used: Sequence[int],
    weight: Tensor,
    rounds: int,
    warm: Warm | None = None,
    tolerance: float = 0.0,
) -> tuple[Traj, Warm]:
    """The trajectory nearest to z, |x - z|^2 weighted by coordinate, that the dynamics produce from the first state of z under
    bounded inputs, with the parts (affine at waypoints, balls on segments) obeyed and a pinned last state reached.

    parts, rest  act on the coordinates `used` alone; rest is the projection onto whatever else is to hold, or None
    weight      of each coordinate in the distance   [n]
    rounds      of ADMM at most; it stops where every copy is within `tolerance` of the trajectory
    """
    used, ends = tuple(used), bool(pins.mask[-1].all())
    copies = (len(parts) > 0) + (rest is not None)
    numbers = tuple(tuple(v.flatten().tolist()) for v in (dynamics.A, dynamics.B, dynamics.c))
    f = _factor(numbers, z.shape[1], used, copies, ends, tuple(weight.tolist()), z.dtype, z.device)
    held = Pins(pins.mask[:, used], z[..., used])
    drift = (z[:, 0] @ f.F.T + f.offset).reshape(z.shape)  # where no input leads
    u_base = ((z - drift) * weight).flatten(1) @ f.G @ f.S.T
    if ends:
        u_base = u_base + (z[:, -1] - drift[:, -1]) @ f.S_e.T
    p_base, p_drift = u_base @ f.PG.T, drift[..., used]
    u_shape, p_shape = (len(z), z.shape[1] - 1, len(dynamics.low)), (len(z), z.shape[1], len(used))
    w_u, y_u, w_p, y_p, u = warm or _cold(dynamics, z, used, copies)
    at = z[..., used]
    for k in range(rounds):
        if parts and k in TURNS:
            halfspaces = planes(parts, at, held)
        push = (w_p - y_p).sum(0) - copies * p_drift
        pushes = torch.cat((RHO_U * (w_u - y_u).flatten(1), RHO_P * push.flatten(1)), 1)
        u = (u_base + pushes @ f.K_u.T).reshape(u_shape)
        at = (p_base + pushes @ f.K_p.T).reshape(p_shape) + p_drift
        over = RELAXATION * u + (1 - RELAXATION) * w_u + y_u
        w_u = torch.clamp(over, dynamics.low, dynamics.high)
        y_u = over - w_u
        if copies:
            over = RELAXATION * at + (1 - RELAXATION) * w_p + y_p
            each = [nearest_in_planes(over[0], halfspaces, held)] if parts else []
            w_p = torch.stack([*each, rest(over[-1], held)] if rest else each)
            y_p = over - w_p
        if tolerance and k % 5 == 4 and _gap(u - w_u) < tolerance and _gap(at - w_p) < tolerance:
            break
    return drift + (u.flatten(1) @ f.G.T).reshape(z.shape), Warm(w_u, y_u, w_p, y_p, u)


def _cold(dynamics: LinearDynamics, z: Traj, used: tuple[int, ...], copies: int) -> Warm:
    """ADMM at z itself, with no multipliers."""
    u, p = dynamics.inputs(z), z[..., used].expand(copies, -1, -1, -1)
    return Warm(u, torch.zeros_like(u), p, torch.zeros_like(p), u)


def _gap(x: Tensor) -> float:
    return float(x.abs().max()) if x.numel() else 0.0


class _Factor(NamedTuple):
    """Matrices of one problem shape: x = F x0 + offset + G u; u = S r + S_e e minimises the quadratic part for the right-hand
    side r under the equality of the last state; K maps the pushes of the copies to u and to the positions.
    """

    F: Tensor
    offset: Tensor
    G: Tensor
    PG: Tensor
    S: Tensor
    S_e: Tensor
    K_u: Tensor
    K_p: Tensor


@lru_cache(maxsize=8)
def _factor(
    numbers: tuple[tuple[float, ...], ...],
    horizon: int,
    used: tuple[int, ...],
    copies: int,
    ends: bool,
    weight: tuple[float, ...],
    dtype: torch.dtype,
    device: torch.device,
) -> _Factor:
    n, steps = len(weight), horizon - 1
    A, B, c = (torch.tensor(values, dtype=torch.float64) for values in numbers)
    A, B = A.reshape(n, n), B.reshape(n, -1)
    m = B.shape[1]
    power = [torch.eye(n, dtype=torch.float64)]
    offset = [torch.zeros(n, dtype=torch.float64)]
    for _ in range(steps):
        power.append(A @ power[-1])
        offset.append(A @ offset[-1] + c)
    response = (torch.stack(power) @ B)[:steps]  # of x^{tau+1+k} to u^tau
    G = torch.zeros(horizon, n, steps, m, dtype=torch.float64)
    for tau in range(1, horizon):
        G[tau, :, :tau] = response[:tau].flip(0).transpose(0, 1)
    PG = G[:, used].reshape(horizon * len(used), steps * m)
    last = G[-1].reshape(n, steps * m)
    flat = G.reshape(horizon * n, steps * m)
    heavy = torch.tensor(weight, dtype=torch.float64).repeat(horizon)[:, None]
    M = flat.T @ (heavy * flat) + RHO_U * torch.eye(steps * m, dtype=torch.float64) + copies * RHO_P * PG.T @ PG
    S = torch.cholesky_inverse(torch.linalg.cholesky(M))
    S_e = torch.zeros(steps * m, n, dtype=torch.float64)
    if ends:
        S_e = S @ last.T @ torch.linalg.pinv(last @ S @ last.T)
        S = S - S_e @ last @ S
    K_u = torch.cat((S, S @ PG.T), 1)
    made = (torch.cat(power), torch.cat(offset), flat, PG, S, S_e, K_u, PG @ K_u)
    return _Factor(*(v.to(device, dtype) for v in made))
