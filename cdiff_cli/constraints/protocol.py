"""What every state set answers, and what can be computed for all of them.

A state set is {x : f(x) <= 0} for a scalar function f of one state. Its parameters may differ by
plan and by waypoint: each tensor has the shape that its class documents, or [horizon | 1] or [batch
| 1, horizon | 1] in front of it. A set with such leading dimensions applies to trajectories [batch,
horizon, dim]; a set without them applies to states of any shape [..., dim].
"""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple, Protocol, Self, TypeVar

import torch
from torch import Tensor

D = TypeVar("D")


class SegmentPoints(NamedTuple):
    """The function f at one point of each segment of a trajectory [..., horizon, dim].

    value      f at the point                                            [..., horizon - 1]
    back, on   derivatives by the segment's first and last waypoint      [..., horizon - 1, dim]
    size       |back|^2 + |on|^2 + |f| times the curvature (step_bound)  [..., horizon - 1]
    """

    value: Tensor
    back: Tensor
    on: Tensor
    size: Tensor


class StateSet(Protocol):
    """A scalar function f of a state [..., dim]; a state is allowed where f <= 0.

    The values stay in environment units after pull_back.
    """

    def __call__(self, x: Tensor) -> Tensor: ...
    def gradient(self, x: Tensor) -> Tensor:
        """df/dx [..., dim]."""
        ...

    def step_bound(self, x: Tensor) -> Tensor:
        """|df/dx|^2 [...], plus |f| times the largest curvature.

        The step f / step_bound then stays bounded where the gradient vanishes.
        """
        ...

    def pull_back(self, centre: Tensor, scale: Tensor) -> "StateSet":
        """The function z -> f(centre + scale * z).

        centre, scale   [dim], or with [horizon] or [batch | 1, horizon] in front
        """
        ...

    def tighten(self, margin: float) -> "StateSet":
        """The set where f <= -margin."""
        ...

    def segment_argmax(self, x: Tensor) -> Tensor:
        """Where f is largest on the segments of trajectories [..., horizon, dim], exactly.

        Returns the share s in [0, 1] of each segment that lies before that point
        [..., horizon - 1]. A set that differs by waypoint moves linearly between waypoints.
        """
        ...

    def on_segment(self, x: Tensor, s: Tensor) -> SegmentPoints:
        """The function at the share s of each segment."""
        ...

    @property
    def convex(self) -> bool:
        """Whether the set is convex, so that a segment is safe when its ends are."""
        ...

    def coordinates(self) -> list[int]:
        """The coordinates of a state that f depends on."""
        ...

    def restrict(self, columns: Sequence[int]) -> Self:
        """The function of the coordinates `columns`, which include all that f depends on."""
        ...


def segment_max(level: StateSet, x: Tensor) -> Tensor:
    """The exact maximum of f per segment [..., horizon - 1] of trajectories [..., horizon, dim]."""
    f = level(x)
    at_ends = torch.maximum(f[..., :-1], f[..., 1:])  # rounding must not hide an unsafe end
    return torch.maximum(at_ends, level.on_segment(x, level.segment_argmax(x)).value)


def worse_end(f: Tensor, like: Tensor) -> Tensor:
    """1 where f [..., horizon] is larger at a segment's last waypoint, else 0, as `like`."""
    return (f[..., 1:] > f[..., :-1]).to(like)


def nonzero_columns(*parameters: Tensor) -> list[int]:
    """The indices of the last dimension at which some parameter is not zero."""
    dim = parameters[0].shape[-1]
    used = torch.stack([(p != 0).reshape(-1, dim).any(0) for p in parameters]).any(0)
    return used.nonzero()[:, 0].tolist()


def converted(record: D, like: Tensor) -> D:
    """The set or constraint with its parameters in the dtype and on the device of `like`."""
    return _mapped(record, lambda _, value: value.to(like))


def selected(record: D, plans: Tensor) -> D:
    """The set or constraint of some plans of the batch alone."""

    def rows(trailing: int, value: Tensor) -> Tensor:
        return value[plans] if value.ndim == trailing + 2 and len(value) > 1 else value

    return _mapped(record, rows)


def _mapped(record: D, change: Callable[[int, Tensor], Tensor]) -> D:
    """The record with each parameter changed; change(dimensions at one waypoint, parameter).

    A record is a dataclass. Its class attribute `trailing` holds the number of dimensions that each
    parameter has at one waypoint; a field with such an attribute is a record too.
    """
    trailing = getattr(record, "trailing", {})
    new: dict[str, Any] = {}
    for field in fields(record):  # type: ignore[arg-type]
        value = getattr(record, field.name)
        if isinstance(value, Tensor):
            new[field.name] = change(trailing.get(field.name, value.ndim), value)
        elif hasattr(value, "trailing"):
            new[field.name] = _mapped(value, change)
    return replace(record, **new)  # type: ignore[type-var]
