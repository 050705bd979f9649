"""The constraint kinds of a YAML file, one pydantic class each, and their compilation into g(x) <= 0.

Environment units and coordinate names only. A further kind comes from another package by the entry-point group
`cdiff.constraints`: a Strict model with `kind`, `name`, `coordinates()` and `compile(layout)`.
"""

from collections.abc import Iterator, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, Union, cast

import torch
from pydantic import Field, create_model, model_validator

from cdiff_cli.config import Document, Strict
from cdiff_cli.constraint import Chain, Constraint, Part, Waypoints
from cdiff_cli.dynamics import LinearDynamics, Reachable
from cdiff_cli.errors import suggestion
from cdiff_cli.levels import Affine, Ellipsoid, Level, Quadric

Number = Annotated[float, Field(strict=True)]
PositiveNumber = Annotated[float, Field(strict=True, gt=0)]
Coordinates = Annotated[dict[str, Number], Field(min_length=1)]
Location = tuple[str | int, ...]
Layout = Sequence[str]
DYNAMICS_TOLERANCE = 1e-5  # of a step against the dynamics, environment units: the rounding of float32 plans
Safety = Annotated[
    Literal["waypoints", "segments"] | None,
    Field(description="where it must hold: at waypoints, or all along the straight segments between them; default: the preset's"),
]


class Linear(Strict):
    """a.x <= b."""

    kind: Literal["linear"]
    name: str = ""
    safety: Safety = None
    a: Annotated[Coordinates, Field(description="coefficient of each coordinate; coordinates left out count 0")]
    b: Annotated[Number, Field(description="bound, in the units of a.x")]

    @model_validator(mode="after")
    def _not_zero(self) -> "Linear":
        if not any(self.a.values()):
            raise ValueError("all coefficients are 0, so the constraint restricts nothing; give at least one that is not")
        return self

    def coordinates(self) -> Iterator[tuple[Location, str]]:
        yield from ((("a", name), name) for name in self.a)

    def level(self, layout: Layout) -> Level:
        return Affine(_vector(self.a, layout), torch.tensor(self.b, dtype=torch.float64))

    def compile(self, layout: Layout) -> Part:
        return Waypoints(self.name, self.level(layout))

    def describe(self) -> str:
        return f"{_sum(self.a)} <= {self.b:g}"


class Quadratic(Strict):
    """Inside or outside a ball (centre, radius), an ellipsoid (centre, semi_axes), or x.P x + q.x = r.

    form distance: the signed distance to the ball's surface (for an ellipsoid a lower bound of it), metres.
    form squared:  radius^2 - |x - centre|^2 and the like, square metres.
    """

    kind: Literal["quadratic"]
    name: str = ""
    safety: Safety = None
    side: Literal["outside", "inside"]
    centre: Coordinates | None = None
    radius: PositiveNumber | None = None
    semi_axes: Annotated[dict[str, PositiveNumber], Field(min_length=1)] | None = None
    P: Annotated[dict[str, Coordinates], Field(min_length=1)] | None = None
    q: Coordinates | None = None
    r: Number | None = None
    form: Literal["distance", "squared"] = "distance"

    @model_validator(mode="after")
    def _one_shape(self) -> "Quadratic":
        general = self.P is not None or self.q is not None or self.r is not None
        round_ = self.centre is not None or self.radius is not None or self.semi_axes is not None
        if general and round_:
            raise ValueError("found both a centre and P, q, r; give either centre and radius (or semi_axes), or P, q, r")
        if general and (self.P is None or self.r is None):
            raise ValueError("P and r belong together (q is optional): x.P x + q.x <= r inside, >= r outside")
        if not general and (self.centre is None or (self.radius is None) == (self.semi_axes is None)):
            raise ValueError("expected a centre and either a radius or semi_axes (or P, q, r)")
        if self.semi_axes is not None and set(self.semi_axes) != set(self.centre or {}):
            raise ValueError("semi_axes must name the same coordinates as centre")
        if general and "form" in self.model_fields_set and self.form == "distance":
            raise ValueError("P, q, r has no distance form; leave `form` out")
        return self

    def coordinates(self) -> Iterator[tuple[Location, str]]:
        for field in ("centre", "semi_axes", "P", "q"):
            for name in getattr(self, field) or {}:
                yield (field, name), name
        for row, columns in (self.P or {}).items():
            yield from ((("P", row, name), name) for name in columns)

    def level(self, layout: Layout) -> Level:
        sign = -1.0 if self.side == "outside" else 1.0
        if self.P is not None:
            P = torch.stack([_vector(self.P.get(row, {}), layout) for row in layout])
            r = torch.tensor(self.r, dtype=torch.float64)
            return Quadric(sign * (P + P.T) / 2, sign * _vector(self.q or {}, layout), sign * r)
        assert self.centre is not None
        names = [name for name in layout if name in self.centre]
        axes = torch.tensor([self.semi_axes[n] if self.semi_axes else self.radius for n in names], dtype=torch.float64)
        centre = torch.tensor([self.centre[name] for name in names], dtype=torch.float64)
        which = torch.stack([_vector({name: 1.0}, layout) for name in names])
        ball = Ellipsoid(which, centre, axes, axes.min(), -int(sign))
        if self.form == "distance":
            return ball
        level, square = ball.quadric(), axes.min() ** 2
        return Quadric(level.P * square, level.q * square, level.r * square)

    def compile(self, layout: Layout) -> Part:
        return Waypoints(self.name, self.level(layout))

    def describe(self) -> str:
        if self.P is not None:
            square = " + ".join(f"{v:g} {a} {b}" for a, row in self.P.items() for b, v in row.items())
            linear = f" + {_sum(self.q)}" if self.q else ""
            return f"{square}{linear} {'>=' if self.side == 'outside' else '<='} {self.r:g}"
        centre = ", ".join(f"{name} = {value:g}" for name, value in (self.centre or {}).items())
        size = f"radius {self.radius:g}" if self.radius else "semi-axes " + _sum(self.semi_axes or {}).replace(" + ", ", ")
        return f"{self.side} the {'ball' if self.radius else 'ellipsoid'} at {centre}, {size} ({self.form})"


class Dcbf(Strict):
    """Discrete control barrier function along the plan: h(x') >= (1 - alpha) h(x), h >= 0 safe, h = -g of the barrier."""

    kind: Literal["dcbf"]
    name: str = ""
    safety: Safety = None
    alpha: Annotated[float, Field(strict=True, gt=0, le=1, description="share of h that a step may use up")]
    barrier: Annotated[Linear | Quadratic, Field(discriminator="kind")]

    def coordinates(self) -> Iterator[tuple[Location, str]]:
        yield from ((("barrier", *location), name) for location, name in self.barrier.coordinates())

    def compile(self, layout: Layout) -> Part:
        return Chain(self.name, self.barrier.level(layout), self.alpha)

    def describe(self) -> str:
        return f"h' >= {1 - self.alpha:g} h, h >= 0 where {self.barrier.describe()}"


class Dynamics(Strict):
    """Every step is one that x' = A x + B u + c makes with bounded inputs u: given here, or fitted to the demonstrations."""

    kind: Literal["dynamics"]
    name: str = ""
    fit: Annotated[Literal["demonstrations"] | None, Field(description="take the dynamics that the checkpoint was fitted")] = None
    A: Annotated[dict[str, Coordinates] | None, Field(description="row by coordinate x', column by coordinate x")] = None
    B: Annotated[dict[str, Coordinates] | None, Field(description="row by coordinate x', column by input")] = None
    c: Coordinates | None = None
    inputs: Annotated[dict[str, tuple[Number, Number]] | None, Field(description="lowest and highest value of each input")] = None
    tolerance: Annotated[PositiveNumber, Field(description="of the largest miss of a step, its own units")] = DYNAMICS_TOLERANCE

    @model_validator(mode="after")
    def _given_or_fitted(self) -> "Dynamics":
        given = (self.A, self.B, self.inputs)
        if self.fit and any(part is not None for part in (*given, self.c)):
            raise ValueError("found both `fit` and matrices; give either `fit: demonstrations`, or A, B and inputs")
        if not self.fit and any(part is None for part in given):
            raise ValueError("expected `fit: demonstrations`, or A, B and inputs")
        for row, columns in (self.B or {}).items():
            for name in columns:
                if name not in (self.inputs or {}):
                    raise ValueError(f'B.{row} names the input "{name}", which `inputs` does not bound')
        for name, (low, high) in (self.inputs or {}).items():
            if not low < high:
                raise ValueError(f"inputs.{name}: the lowest value, {low:g}, is not below the highest, {high:g}")
        return self

    @classmethod
    def of(cls, dynamics: LinearDynamics, layout: Layout, name: str, tolerance: float = DYNAMICS_TOLERANCE) -> "Dynamics":
        """The kind that gives these dynamics."""
        inputs = [f"u{i}" for i in range(dynamics.B.shape[1])]
        return cls(
            kind="dynamics",
            name=name,
            A={row: dict(zip(layout, values, strict=True)) for row, values in zip(layout, dynamics.A.tolist(), strict=True)},
            B={row: dict(zip(inputs, values, strict=True)) for row, values in zip(layout, dynamics.B.tolist(), strict=True)},
            c=dict(zip(layout, dynamics.c.tolist(), strict=True)),
            inputs=dict(zip(inputs, zip(dynamics.low.tolist(), dynamics.high.tolist(), strict=True), strict=True)),
            tolerance=tolerance,
        )

    def coordinates(self) -> Iterator[tuple[Location, str]]:
        for field, rows in (("A", self.A), ("B", self.B), ("c", self.c)):
            for row in rows or {}:
                yield (field, row), row
        for row, columns in (self.A or {}).items():
            yield from ((("A", row, name), name) for name in columns)

    def compile(self, layout: Layout) -> Part:
        assert self.A is not None
        assert self.B is not None
        assert self.inputs is not None
        low, high = torch.tensor(list(self.inputs.values()), dtype=torch.float64).T
        dynamics = LinearDynamics(
            A=torch.stack([_vector(self.A.get(row, {}), layout) for row in layout]),
            B=torch.stack([_vector(self.B.get(row, {}), list(self.inputs)) for row in layout]),
            c=_vector(self.c or {}, layout),
            low=low,
            high=high,
        )
        return Reachable.of(self.name, dynamics, self.tolerance)

    def describe(self) -> str:
        if self.fit:
            return "each step obeys the dynamics fitted to the demonstrations"
        bounds = ", ".join(f"{low:g} <= {name} <= {high:g}" for name, (low, high) in (self.inputs or {}).items())
        return f"each step obeys x' = A x + B u + c, {bounds}"


class Kind(Protocol):
    """What every kind offers, ours and those of other packages."""

    name: str
    kind: str

    def coordinates(self) -> Iterator[tuple[Location, str]]: ...
    def compile(self, layout: Layout) -> Part: ...
    def describe(self) -> str: ...


def kinds() -> tuple[type[Strict], ...]:
    """All kinds: the built-in ones and those of the entry-point group cdiff.constraints."""
    return (Linear, Quadratic, Dcbf, Dynamics, *(entry.load() for entry in entry_points(group="cdiff.constraints")))


def file_model() -> type[Strict]:
    """The model of a whole constraint file."""
    union: Any = Annotated[Union[kinds()], Field(discriminator="kind")]  # noqa: UP007
    fields: Any = {
        "task": (str, Field(description="the task whose coordinates the constraints name")),
        "constraints": (list[union], Field(min_length=1, description="all of them hold at once")),
    }
    return create_model("ConstraintFile", __base__=Strict, **fields)


def load_constraints(
    path: Path, task: str, layout: Layout, dynamics: LinearDynamics | None = None
) -> tuple[list[Kind], Constraint]:
    """The kinds of a constraint file and the g(x) <= 0 they compile into, environment units; raises SpecError.

    dynamics   what `fit: demonstrations` stands for; None where there are none
    """
    document = Document(path)
    model = cast(Any, document.read(file_model()))
    if model.task != task:
        raise document.error(("task",), f'these are constraints of "{model.task}", the task here is "{task}"; change one of them')
    seen: set[str] = set()
    parts = []
    for i, spec in enumerate(model.constraints):
        for location, name in spec.coordinates():
            if name not in layout:
                known = ", ".join(layout)
                raise document.error(
                    ("constraints", i, *location), f'no coordinate "{name}" in {task}{suggestion(name, layout)}; it has {known}'
                )
        named = spec if spec.name else spec.model_copy(update={"name": f"{spec.kind}-{i}"})
        if named.name in seen:
            raise document.error(("constraints", i, "name"), f'the name "{named.name}" stands twice; names tell rows apart')
        seen.add(named.name)
        if isinstance(named, Dynamics) and named.fit:
            if dynamics is None:
                raise document.error(
                    ("constraints", i, "fit"),
                    "the checkpoint has no linear dynamics: too few of its demonstrations' steps are linear in state and input; "
                    "give A, B and inputs instead",
                )
            named = Dynamics.of(dynamics, layout, named.name, named.tolerance)
        parts.append(named)
    return parts, Constraint(tuple(spec.compile(layout) for spec in parts))


def enforced(kinds: Sequence[Kind], g: Constraint, safety: str) -> Constraint:
    """What sampling obeys: the parts that are to hold on segments (by their own word, else the preset's) taken so."""
    wanted = [getattr(kind, "safety", None) or safety for kind in kinds]
    each = [part.on_segments() if want == "segments" else (part,) for part, want in zip(g.parts, wanted, strict=True)]
    return Constraint(tuple(part for parts in each for part in parts))


def json_schema() -> dict[str, Any]:
    """JSON schema of a constraint file, for editors."""
    return file_model().model_json_schema()


def _vector(values: dict[str, float], layout: Layout) -> torch.Tensor:
    return torch.tensor([values.get(name, 0.0) for name in layout], dtype=torch.float64)


def _sum(values: dict[str, float]) -> str:
    return " + ".join(f"{value:g} {name}" for name, value in values.items())
