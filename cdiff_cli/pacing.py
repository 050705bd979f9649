"""The nearest trajectory that linear dynamics with bounded inputs make within limits on rates, around obstacles, the whole batch
at once.

    minimise |x - z|^2_W   s.t.  x' = A x + B u + c,  low <= u <= high,  limits on x' - x,  a.x <= b at waypoints,  pins

A limit on a rate acts on the state and inputs of its step, since the dynamics say what they change: as convex limits of each
waypoint all of them are solved together (interior.py). Obstacles are half-spaces of tangent planes, chosen anew at each result.
Where no trajectory is within all limits, goals give way first.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from cdiff_cli.constraint import Constraint, Pins, Segments, Traj, Waypoints
from cdiff_cli.dynamics import LinearDynamics
from cdiff_cli.interior import HARD, YIELDING, Limits, nearest
from cdiff_cli.levels import Affine
from cdiff_cli.rates import Rate
from cdiff_cli.segments import NEVER, planes

MISSED = 1e-4  # of a limit, in its units: from there on the limits contradict each other


def nearest_paced(
    dynamics: LinearDynamics,
    parts: Sequence[Waypoints | Segments],
    rates: Sequence[Rate],
    z: Traj,
    pins: Pins,
    *,
    used: Sequence[int],
    weight: Tensor,
    turns: int,
    tolerance: float,
    begin: Traj | None = None,
) -> tuple[Traj, Tensor]:
    """The trajectory nearest to z, |x - z|^2 weighted by coordinate, that the dynamics produce from the first state of z within all
    limits, a pinned last state reached; and its inputs [batch, horizon - 1, m].

    parts, rates  act on the coordinates `used` alone, in the units of z
    weight        of each coordinate in the distance   [n]
    turns         times at most that tangent planes are chosen, first at `begin`, or z
    tolerance     violation of a part up to which its planes are not chosen anew
    """
    where, last = list(used), pins.mask[-1]
    held, g = Pins(pins.mask[:, where], z[..., where]), Constraint(tuple(parts))
    free = ~held.mask.any(1)[:, None]
    x, u = (z if begin is None else begin).clone(), dynamics.inputs(z)
    always, walls = _always(dynamics, rates, where, z.shape[1]), _none(parts, z, u)
    todo = torch.ones(len(z), dtype=torch.bool, device=z.device)
    touched, walled = (g(x[..., where]) > 0).any(1), ~todo
    for turn in range(turns + 1):
        if bool(touched.any()):
            near = [part.take(touched.nonzero()[:, 0]) for part in parts]
            a, b = planes(near, x[touched][..., where], Pins(held.mask, held.values[touched]))
            there, slope = free & (b < NEVER), torch.zeros_like(walls.L[touched])
            slope[:, :, :, 0, where] = torch.where(there[..., None], -a, 0.0)
            walls.L[touched], walls.o[touched] = slope, torch.where(there, b, 1.0)[..., None]
        walled = walled | touched
        limits = [*always, Limits(walls.L[todo], walls.o[todo])] if parts else always
        x[todo], u[todo] = _within(dynamics, limits, z[todo], weight, 0.5 * dynamics.inputs(z[todo]), last)
        unsafe = (g(x[..., where]) > tolerance).any(1)
        todo = touched = unsafe & ~walled | walled & (turn + 1 < turns)
        if not bool(todo.any()):
            break
    return x, u


def _within(
    dynamics: LinearDynamics, limits: Sequence[Limits], z: Tensor, weight: Tensor, u: Tensor, end: Tensor
) -> tuple[Tensor, Tensor]:
    """The nearest trajectories within the limits; where there are none, goals and then limits give way."""
    x, made = nearest(dynamics, limits, z, weight, u, end)
    q = torch.cat((x, torch.nn.functional.pad(made, (0, 0, 0, 1))), 2)
    slack = [each(q) for each in limits]
    missed = torch.stack([(s[..., 1:].norm(dim=-1) - s[..., 0]).amax((1, 2)) for s in slack]).amax(0)
    missed = torch.maximum(missed, torch.where(end, x[:, -1] - z[:, -1], 0.0).abs().amax(1))
    soft = ~(missed < MISSED)
    if bool(soft.any()):
        some = [Limits(*(v[soft] if len(v) == len(z) else v for v in each)) for each in limits]
        x[soft], made[soft] = nearest(dynamics, some, z[soft], weight, u[soft], end, YIELDING)
    return x, made


def _none(parts: Sequence[Waypoints | Segments], x: Tensor, u: Tensor) -> Limits:
    """As many half-spaces a waypoint as planes() makes of the parts, none of them there yet."""
    count = sum(1 if isinstance(part.level, Affine) else 2 for part in parts)
    shape = (*x.shape[:2], count, 1)
    return Limits(x.new_zeros(*shape, x.shape[2] + u.shape[2]), x.new_ones(shape))


def _always(dynamics: LinearDynamics, rates: Sequence[Rate], used: list[int], horizon: int) -> list[Limits]:
    """Inputs within their bounds, in shares of half their range, with the rates of single coordinates; lengths of rates."""
    n, m = dynamics.B.shape
    one, half = torch.eye(n + m).to(dynamics.A), (dynamics.high - dynamics.low) / 2
    change = torch.cat((dynamics.A, dynamics.B), 1)[used] - one[used]
    rows = [(-one[n:] / half[:, None], dynamics.high / half), (one[n:] / half[:, None], -dynamics.low / half)]
    lengths = []
    for rate in rates:
        L, o = rate.which @ change / rate.dt, rate.which @ dynamics.c[used] / rate.dt
        if rate.norm:
            lengths.append((torch.cat((torch.zeros_like(L[:1]), L)), torch.cat((o.new_tensor([rate.high]), o))))
        else:
            rows += [(-L, rate.high - o), (L, o - rate.low)]
    single = [(L[i : i + 1], o[i : i + 1]) for L, o in rows for i in range(len(L)) if bool(o[i].isfinite())]
    return [Limits(*(torch.stack(v) for v in zip(*kind, strict=True))).of_steps(horizon) for kind in (single, *([one] for one in lengths)) if kind]
