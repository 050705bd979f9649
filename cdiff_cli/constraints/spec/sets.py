"""The constraint kinds over one state set, linear and quadratic, and their state sets."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, PlainSerializer, WithJsonSchema, WrapValidator, model_validator
from torch import Tensor

from cdiff_cli.constraints.observed import Observed, ObservedValues, carried
from cdiff_cli.constraints.protocol import StateSet
from cdiff_cli.constraints.state_sets import Ellipsoid, HalfSpace, Quadric
from cdiff_cli.constraints.trajectory import TrajectoryConstraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.yaml_files import Strict

Location = tuple[str | int, ...]
Layout = Sequence[str]
Number = Annotated[float, Field(strict=True)]
PositiveNumber = Annotated[float, Field(strict=True, gt=0)]
Coordinates = Annotated[dict[str, Number], Field(min_length=1)]
Safety = Annotated[
    Literal["waypoints", "segments"] | None,
    Field(
        description="where it must hold: at waypoints, or all along the straight segments between"
        " them; default: the preset's"
    ),
]
_AS_IT_IS = PlainSerializer(lambda value: value, return_type=float | str)


def _or_name(value: Any, number: Callable[[Any], float]) -> Any:
    return value if isinstance(value, str) else number(value)


def _schema(**number: Any) -> WithJsonSchema:
    name = {"type": "string", "description": "name of an observed quantity, such as obstacle.x"}
    return WithJsonSchema({"anyOf": [{"type": "number"} | number, name]})


Quantity = Annotated[Number, WrapValidator(_or_name), _AS_IT_IS, _schema()]
"""A number, or the name of an observed quantity."""
PositiveQuantity = Annotated[
    PositiveNumber, WrapValidator(_or_name), _AS_IT_IS, _schema(exclusiveMinimum=0)
]
Quantities = Annotated[dict[str, Quantity], Field(min_length=1)]
Velocity = Annotated[
    Quantities | None,
    Field(
        description="rate of change of each coordinate of the set, per second, over the waypoints"
        " of the plan"
    ),
]
Hold = Annotated[
    bool | None,
    Field(description="true: the set stays where it is observed, whatever its velocity"),
]
NOTHING: ObservedValues = {}


class Linear(Strict):
    """a.x <= b."""

    kind: Literal["linear"]
    name: str = ""
    safety: Safety = None
    a: Annotated[
        Quantities,
        Field(description="coefficient of each coordinate; coordinates left out count 0"),
    ]
    b: Annotated[Quantity, Field(description="bound, in the units of a.x")]
    velocity: Velocity = None
    hold: Hold = None

    @model_validator(mode="after")
    def _not_zero(self) -> "Linear":
        if not any(self.a.values()):
            raise ValueError(
                "all coefficients are 0, so the constraint restricts nothing; give at least one"
                " that is not"
            )
        check_velocity(self.velocity, self)
        return self

    def coordinates(self) -> Iterator[tuple[Location, str]]:
        yield from ((("a", name), name) for name in self.a)

    def observes(self) -> Iterator[tuple[Location, str]]:
        """The names of observed quantities, and where they stand."""
        yield from names_in({"a": self.a, "b": self.b, "velocity": self.velocity})

    def level(self, layout: Layout, observed: ObservedValues = NOTHING) -> StateSet:
        return HalfSpace(vector(self.a, layout, observed), _filled(self.b, observed))

    def compile(self, layout: Layout) -> TrajectoryConstraint:
        return observed_or_not(
            self.name,
            self,
            self.velocity,
            self.hold,
            layout,
            lambda at, _: AtWaypoints(self.name, at(0.0)),
        )

    def describe(self) -> str:
        return f"{added(self.a)} <= {shown(self.b)}{moves(self.velocity, self.hold)}"


class Quadratic(Strict):
    """Inside or outside a ball (centre, radius), ellipsoid (centre, semi_axes), or x.P x + q.x = r.

    form distance: signed distance to the ball's surface, metres; a lower bound for an ellipsoid.
    form squared:  radius^2 - |x - centre|^2 and the like, square metres.
    """

    kind: Literal["quadratic"]
    name: str = ""
    safety: Safety = None
    side: Literal["outside", "inside"]
    centre: Quantities | None = None
    radius: PositiveQuantity | None = None
    semi_axes: Annotated[dict[str, PositiveQuantity], Field(min_length=1)] | None = None
    P: Annotated[dict[str, Coordinates], Field(min_length=1)] | None = None
    q: Quantities | None = None
    r: Quantity | None = None
    form: Literal["distance", "squared"] = "distance"
    velocity: Velocity = None
    hold: Hold = None

    @model_validator(mode="after")
    def _one_shape(self) -> "Quadratic":
        general = self.P is not None or self.q is not None or self.r is not None
        round_ = self.centre is not None or self.radius is not None or self.semi_axes is not None
        if general and round_:
            raise ValueError(
                "found both a centre and P, q, r; give either centre and radius (or semi_axes), or"
                " P, q, r"
            )
        if general and (self.P is None or self.r is None):
            raise ValueError(
                "P and r belong together (q is optional): x.P x + q.x <= r inside, >= r outside"
            )
        if not general and (
            self.centre is None or (self.radius is None) == (self.semi_axes is None)
        ):
            raise ValueError("expected a centre and either a radius or semi_axes (or P, q, r)")
        if self.semi_axes is not None and set(self.semi_axes) != set(self.centre or {}):
            raise ValueError("semi_axes must name the same coordinates as centre")
        if general and "form" in self.model_fields_set and self.form == "distance":
            raise ValueError("P, q, r has no distance form; leave `form` out")
        check_velocity(self.velocity, self)
        return self

    def coordinates(self) -> Iterator[tuple[Location, str]]:
        for field in ("centre", "semi_axes", "P", "q"):
            for name in getattr(self, field) or {}:
                yield (field, name), name
        for row, columns in (self.P or {}).items():
            yield from ((("P", row, name), name) for name in columns)

    def observes(self) -> Iterator[tuple[Location, str]]:
        """The names of observed quantities, and where they stand."""
        yield from names_in(
            {
                field: getattr(self, field)
                for field in ("centre", "radius", "semi_axes", "q", "r", "velocity")
            }
        )

    def level(self, layout: Layout, observed: ObservedValues = NOTHING) -> StateSet:
        sign = 1 if self.side == "outside" else -1
        if self.P is not None:
            assert self.r is not None
            P = torch.stack([vector(self.P.get(row, {}), layout) for row in layout])
            return Quadric(
                -sign * (P + P.T) / 2,
                -sign * vector(self.q or {}, layout, observed),
                -sign * _filled(self.r, observed),
            )
        assert self.centre is not None
        names = [name for name in layout if name in self.centre]
        lengths = {name: self.semi_axes[name] if self.semi_axes else self.radius for name in names}
        axes, centre = vector(lengths, names, observed), vector(self.centre, names, observed)
        which = torch.eye(len(layout), dtype=torch.float64)[[layout.index(name) for name in names]]
        m = axes.amin(-1)
        if self.form == "distance":
            return Ellipsoid(which, centre, axes, m, self.side)
        around = Quadric(
            -sign * which.T @ which, torch.zeros(len(layout), dtype=torch.float64), -sign * m**2
        )  # m^2 - |x|^2
        to_ball = m[..., None] / axes
        return around.pull_back(-(centre * to_ball) @ which, to_ball @ which + (1 - which.sum(0)))

    def compile(self, layout: Layout) -> TrajectoryConstraint:
        return observed_or_not(
            self.name,
            self,
            self.velocity,
            self.hold,
            layout,
            lambda at, _: AtWaypoints(self.name, at(0.0)),
        )

    def describe(self) -> str:
        if self.P is not None:
            square = " + ".join(
                f"{v:g} {a} {b}" for a, row in self.P.items() for b, v in row.items()
            )
            linear = f" + {added(self.q)}" if self.q else ""
            relation = ">=" if self.side == "outside" else "<="
            moving = moves(self.velocity, self.hold)
            return f"{square}{linear} {relation} {shown(self.r)}{moving}"
        centre = ", ".join(
            f"{name} = {shown(value)}" for name, value in (self.centre or {}).items()
        )
        size = (
            f"radius {shown(self.radius)}"
            if self.radius
            else "semi-axes " + added(self.semi_axes or {}).replace(" + ", ", ")
        )
        shape = "ball" if self.radius else "ellipsoid"
        moving = moves(self.velocity, self.hold)
        return f"{self.side} the {shape} at {centre}, {size} ({self.form}){moving}"


def observed_or_not(
    name: str,
    shape: Linear | Quadratic,
    velocity: Mapping[str, float | str] | None,
    hold: bool | None,
    layout: Layout,
    part: Callable[[Callable[[float], StateSet], Layout], TrajectoryConstraint],
) -> TrajectoryConstraint:
    """The part of a shape; an Observed part where the shape has observed quantities.

    part   (at, layout) -> the part, with at(time) the state set `time` seconds after each waypoint
    """
    velocity = None if hold else velocity
    observed = [name for location, name in shape.observes() if location[0] != "velocity"]
    observed += [name for _, name in names_in(velocity or {})]
    names = tuple(dict.fromkeys(observed))
    if not names:
        return part(lambda _: shape.level(layout), layout)

    def make(observed: ObservedValues, dt: float, horizon: int) -> TrajectoryConstraint:
        level = shape.level(layout, observed)
        if velocity is None:
            return part(lambda _: level, layout)
        rate = vector(velocity, layout, observed)
        return part(lambda time: carried(level, rate, dt, horizon, time), layout)

    return Observed(name, names, make)


def check_velocity(velocity: Mapping[str, float | str] | None, shape: Linear | Quadratic) -> None:
    """Raise ValueError for a velocity of foreign coordinates, or of a set that does not move."""
    if velocity is None:
        return
    coordinates = dict.fromkeys(name for _, name in shape.coordinates())
    foreign = [name for name in velocity if name not in coordinates]
    if foreign:
        raise ValueError(
            f'`velocity` moves "{foreign[0]}", on which the set does not depend; it has'
            f" {', '.join(coordinates)}"
        )
    if not any(location[0] != "velocity" for location, _ in shape.observes()):
        raise ValueError(
            "`velocity` says how an observed set moves on, and nothing here is observed; leave it"
            " out"
        )


def names_in(numbers: Mapping[str, Any]) -> Iterator[tuple[Location, str]]:
    """The names of observed quantities among numbers and tables, and where they stand."""
    for field, value in numbers.items():
        if isinstance(value, str):
            yield (field,), value
        elif isinstance(value, dict):
            yield from (((field, *inner), name) for inner, name in names_in(value))


def vector(values: Mapping[str, Any], layout: Layout, observed: ObservedValues = NOTHING) -> Tensor:
    """The numbers in the layout's order, 0 where there is none.

    [dim], or [batch, 1, dim] where some are observed
    """
    ordered = [values.get(name, 0.0) for name in layout]
    if not any(isinstance(value, str) for value in ordered):
        return torch.tensor(ordered, dtype=torch.float64)
    numbers = [_filled(value, observed) for value in ordered]
    shape = max((number.shape for number in numbers), key=len)
    return torch.stack([number.expand(shape) for number in numbers], -1)


def _filled(value: float | str, observed: ObservedValues) -> Tensor:
    """A number as a tensor: [], or [batch, 1] if it is observed."""
    return (
        observed[value].double()[:, None]
        if isinstance(value, str)
        else torch.tensor(value, dtype=torch.float64)
    )


def added(values: Mapping[str, float | str]) -> str:
    return " + ".join(f"{shown(value)} {name}" for name, value in values.items())


def shown(value: float | str | None) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def moves(velocity: Mapping[str, float | str] | None, hold: bool | None) -> str:
    """', moving on at ...', or nothing for a fixed set."""
    if velocity is None:
        return ""
    return (
        ", held where it is observed"
        if hold
        else f", moving on at {added(velocity).replace(' + ', ', ')} per second"
    )
