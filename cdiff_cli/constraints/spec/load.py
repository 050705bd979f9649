"""The constraint g(x) <= 0 of a task from a YAML file."""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, Protocol, Union, cast

from pydantic import Field, TypeAdapter, ValidationError, create_model

from cdiff_cli.constraints.dynamics import LinearDynamics
from cdiff_cli.constraints.spec.kinds import Dcbf, Dynamics, RateSpec
from cdiff_cli.constraints.spec.sets import Layout, Linear, Location, Quadratic
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.errors import SpecError, suggestion
from cdiff_cli.yaml_files import Document, Strict


class Kind(Protocol):
    """What every kind of constraint offers, built-in ones and those of other packages."""

    name: str
    kind: str

    def coordinates(self) -> Iterator[tuple[Location, str]]: ...
    def compile(self, layout: Layout) -> TrajectoryConstraint: ...
    def describe(self) -> str: ...


def kinds() -> tuple[type[Strict], ...]:
    """All kinds: the built-in ones and those of the entry-point group cdiff.constraints."""
    return (
        Linear,
        Quadratic,
        Dcbf,
        Dynamics,
        RateSpec,
        *(entry.load() for entry in entry_points(group="cdiff.constraints")),
    )


def _list_of_any_kind() -> Any:
    """The type of a list of constraints of any kind, told apart by `kind`."""
    union: Any = Annotated[Union[kinds()], Field(discriminator="kind")]  # noqa: UP007
    return list[union]


def file_model() -> type[Strict]:
    """The model of a whole constraint file."""
    fields: Any = {
        "task": (str, Field(description="the task whose coordinates the constraints name")),
        "constraints": (
            _list_of_any_kind(),
            Field(min_length=1, description="all of them hold at once"),
        ),
    }
    return create_model("ConstraintFile", __base__=Strict, **fields)


@dataclass(frozen=True)
class Space:
    """What the constraints of a file are about.

    layout       names of a state's coordinates, in order
    dt           seconds between waypoints; None where they are not in time
    dynamics     what `fit: demonstrations` stands for; None where nothing was fitted
    observable   quantities that constraints may observe
    name         of the task, for messages
    """

    layout: Layout
    dt: float | None = None
    dynamics: LinearDynamics | None = None
    observable: Sequence[str] = ()
    name: str = "this space"


def load_constraints(
    path: Path,
    task: str,
    layout: Layout,
    dynamics: LinearDynamics | None = None,
    observable: Sequence[str] = (),
    dt: float | None = None,
) -> tuple[list[Kind], Constraint]:
    """The kinds of a constraint file and the g(x) <= 0 they compile into, environment units.

    The other arguments are the fields of the task's Space.
    Raises SpecError, which names file and line.
    """
    space = Space(layout, dt, dynamics, observable, task)
    document = Document(path)
    model = cast(Any, document.read(file_model()))
    if model.task != task:
        raise document.error(
            ("task",),
            f'these are constraints of "{model.task}", the task here is "{task}"; '
            "change one of them",
        )

    def refuse(location: Location, problem: str) -> SpecError:
        return document.error(("constraints", *location), problem)

    return compile_kinds(model.constraints, space, refuse)


def make_constraints(values: Sequence[Any], space: Space) -> tuple[list[Kind], Constraint]:
    """The same from a list of mappings, as they stand under `constraints:` in a file.

    Raises SpecError, which names the place in the list.
    """
    try:
        specs: list[Any] = TypeAdapter(_list_of_any_kind()).validate_python(list(values))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(step) for step in first["loc"])
        raise SpecError(f"constraints.{place}: {first['msg']}") from None

    def refuse(location: Location, problem: str) -> SpecError:
        return SpecError(f"constraints.{'.'.join(map(str, location))}: {problem}")

    return compile_kinds(specs, space, refuse)


Refuse = Callable[[Location, str], SpecError]
"""(place below `constraints`, what is wrong and what to do) -> the error to raise."""


def compile_kinds(
    specs: Sequence[Any], space: Space, refuse: Refuse
) -> tuple[list[Kind], Constraint]:
    """Kinds with names, checked against the space, and the constraint they compile into."""
    names: set[str] = set()
    kinds = []
    for i, spec in enumerate(specs):
        for location, name in spec.coordinates():
            if name not in space.layout:
                raise refuse(
                    (i, *location),
                    f'no coordinate "{name}" in {space.name}{suggestion(name, space.layout)}; '
                    f"it has {', '.join(space.layout)}",
                )
        for location, name in spec.observes() if hasattr(spec, "observes") else ():
            if name not in space.observable:
                raise refuse((i, *location), _not_observable(name, space))
        named = spec if spec.name else spec.model_copy(update={"name": f"{spec.kind}-{i}"})
        if named.name in names:
            raise refuse(
                (i, "name"), f'the name "{named.name}" stands twice; names tell rows apart'
            )
        names.add(named.name)
        kinds.append(_completed(i, named, space, refuse))
    return kinds, Constraint(tuple(spec.compile(space.layout) for spec in kinds))


def _completed(i: int, spec: Any, space: Space, refuse: Refuse) -> Any:
    """A kind with what the space knows: fitted dynamics, the time between waypoints."""
    if isinstance(spec, Dynamics) and spec.fit:
        if space.dynamics is None:
            raise refuse(
                (i, "fit"),
                "the checkpoint has no linear dynamics: too few of its demonstrations' steps are "
                "linear in state and input; give A, B and inputs instead",
            )
        return Dynamics.from_dynamics(space.dynamics, space.layout, spec.name, spec.tolerance)
    if isinstance(spec, RateSpec):
        if space.dt is None:
            raise refuse(
                (i, "kind"),
                f"the waypoints of {space.name} are not in time; a rate has no meaning there",
            )
        if spec.dt not in (None, space.dt):
            raise refuse(
                (i, "dt"),
                f"the waypoints of {space.name} are {space.dt:g} s apart; leave `dt` out",
            )
        return spec.model_copy(update={"dt": space.dt})
    return spec


def _not_observable(name: str, space: Space) -> str:
    if not space.observable:
        return f'expected a valid number, found "{name}"; {space.name} has no quantities to observe'
    return (
        f"expected a valid number or an observed quantity, "
        f'found "{name}"{suggestion(name, space.observable)}; '
        f"{space.name} offers {', '.join(space.observable)}"
    )


def enforced(kinds: Sequence[Kind], g: Constraint, safety: str) -> Constraint:
    """The constraint that sampling enforces: g with some parts kept on segments.

    safety   "segments" or "waypoints", for kinds whose file does not state it
    """
    parts: list[TrajectoryConstraint] = []
    for kind, part in zip(kinds, g.parts, strict=True):
        on_segments = (getattr(kind, "safety", None) or safety) == "segments"
        parts += part.on_segments() if on_segments else (part,)
    return Constraint(tuple(parts))


def kinds_sha256(kinds: Sequence[Any]) -> str:
    """The hash of the constraints as read, which comments in their file do not change."""
    content = [kind.model_dump(mode="json", exclude_none=True) for kind in kinds]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def json_schema() -> dict[str, Any]:
    """The JSON schema of a constraint file, for editors."""
    return file_model().model_json_schema()
