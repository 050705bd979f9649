"""The constraint g(x) <= 0 of a task from a YAML file."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any, Protocol, Union, cast

from pydantic import Field, create_model

from cdiff_cli.constraints.dynamics import LinearDynamics
from cdiff_cli.constraints.spec.kinds import Dcbf, Dynamics, RateSpec
from cdiff_cli.constraints.spec.sets import Layout, Linear, Location, Quadratic
from cdiff_cli.constraints.trajectory import Constraint, TrajectoryConstraint
from cdiff_cli.errors import suggestion
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


def file_model() -> type[Strict]:
    """The model of a whole constraint file."""
    union: Any = Annotated[Union[kinds()], Field(discriminator="kind")]  # noqa: UP007
    fields: Any = {
        "task": (str, Field(description="the task whose coordinates the constraints name")),
        "constraints": (list[union], Field(min_length=1, description="all of them hold at once")),
    }
    return create_model("ConstraintFile", __base__=Strict, **fields)


def load_constraints(
    path: Path,
    task: str,
    layout: Layout,
    dynamics: LinearDynamics | None = None,
    observable: Sequence[str] = (),
    dt: float | None = None,
) -> tuple[list[Kind], Constraint]:
    """The constraints of a file, and the g(x) <= 0 that they compile into, environment units.

    Raises SpecError for a file that does not fit the task.

    dynamics     what `fit: demonstrations` stands for; None where there are none
    observable   names of the quantities that constraints of the task may observe
    dt           seconds between waypoints; None where waypoints are not in time
    """
    document = Document(path)
    model = cast(Any, document.read(file_model()))
    if model.task != task:
        raise document.error(
            ("task",),
            f'these are constraints of "{model.task}", the task here is "{task}"; change one of'
            " them",
        )
    names: set[str] = set()
    specs = []
    for i, spec in enumerate(model.constraints):
        _check_names(document, i, spec, task, layout, observable)
        named = spec if spec.name else spec.model_copy(update={"name": f"{spec.kind}-{i}"})
        if named.name in names:
            raise document.error(
                ("constraints", i, "name"),
                f'the name "{named.name}" stands twice; names tell rows apart',
            )
        names.add(named.name)
        if isinstance(named, Dynamics) and named.fit:
            named = _fitted(document, i, named, dynamics, layout)
        if isinstance(named, RateSpec):
            named = _timed(document, i, named, dt, task)
        specs.append(named)
    return specs, Constraint(tuple(spec.compile(layout) for spec in specs))


def _check_names(
    document: Document, i: int, spec: Any, task: str, layout: Layout, observable: Sequence[str]
) -> None:
    """Raise SpecError for a coordinate or an observed quantity that the task does not have."""
    for location, name in spec.coordinates():
        if name not in layout:
            known = ", ".join(layout)
            raise document.error(
                ("constraints", i, *location),
                f'no coordinate "{name}" in {task}{suggestion(name, layout)}; it has {known}',
            )
    for location, name in spec.observes() if hasattr(spec, "observes") else ():
        if name not in observable:
            raise document.error(
                ("constraints", i, *location), _not_observable(name, task, observable)
            )


def _fitted(
    document: Document, i: int, spec: Dynamics, dynamics: LinearDynamics | None, layout: Layout
) -> Dynamics:
    """The kind with the fitted dynamics in the place of `fit: demonstrations`."""
    if dynamics is None:
        raise document.error(
            ("constraints", i, "fit"),
            "the checkpoint has no linear dynamics: too few of its demonstrations' steps are linear"
            " in state and input; give A, B and inputs instead",
        )
    return Dynamics.from_dynamics(dynamics, layout, spec.name, spec.tolerance)


def _timed(document: Document, i: int, spec: RateSpec, dt: float | None, task: str) -> RateSpec:
    """The kind with the time between the task's waypoints."""
    if dt is None:
        raise document.error(
            ("constraints", i, "kind"),
            f"the waypoints of {task} are not in time; a rate has no meaning there",
        )
    if spec.dt not in (None, dt):
        raise document.error(
            ("constraints", i, "dt"),
            f"the waypoints of {task} are {dt:g} s apart; leave `dt` out",
        )
    return spec.model_copy(update={"dt": dt})


def _not_observable(name: str, task: str, observable: Sequence[str]) -> str:
    if not observable:
        return f'expected a valid number, found "{name}"; {task} has no quantities to observe'
    known = ", ".join(observable)
    return (
        f'expected a valid number or an observed quantity, found "{name}"'
        f"{suggestion(name, observable)}; {task} offers {known}"
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
