"""From a YAML file of constraints to the constraint g(x) <= 0 of a task."""

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
    """What every kind offers, ours and those of other packages."""

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
    """The kinds of a constraint file and the g(x) <= 0 they compile into, environment units; raises SpecError.

    dynamics     what `fit: demonstrations` stands for; None where there are none
    observable   names of the quantities that the task lets constraints observe
    dt           seconds between its waypoints; None where they have none
    """
    document = Document(path)
    model = cast(Any, document.read(file_model()))
    if model.task != task:
        raise document.error(
            ("task",),
            f'these are constraints of "{model.task}", the task here is "{task}"; change one of them',
        )
    seen: set[str] = set()
    parts = []
    for i, spec in enumerate(model.constraints):
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
        named = spec if spec.name else spec.model_copy(update={"name": f"{spec.kind}-{i}"})
        if named.name in seen:
            raise document.error(
                ("constraints", i, "name"),
                f'the name "{named.name}" stands twice; names tell rows apart',
            )
        seen.add(named.name)
        if isinstance(named, Dynamics) and named.fit:
            if dynamics is None:
                raise document.error(
                    ("constraints", i, "fit"),
                    "the checkpoint has no linear dynamics: too few of its demonstrations' steps are linear in state and input; "
                    "give A, B and inputs instead",
                )
            named = Dynamics.from_dynamics(dynamics, layout, named.name, named.tolerance)
        if isinstance(named, RateSpec):
            if dt is None:
                raise document.error(
                    ("constraints", i, "kind"),
                    f"the waypoints of {task} are not in time; a rate has no meaning there",
                )
            if named.dt not in (None, dt):
                raise document.error(
                    ("constraints", i, "dt"),
                    f"the waypoints of {task} are {dt:g} s apart; leave `dt` out",
                )
            named = named.model_copy(update={"dt": dt})
        parts.append(named)
    return parts, Constraint(tuple(spec.compile(layout) for spec in parts))


def _not_observable(name: str, task: str, observable: Sequence[str]) -> str:
    if not observable:
        return f'expected a valid number, found "{name}"; {task} has no quantities to observe'
    known = ", ".join(observable)
    return f'expected a valid number or an observed quantity, found "{name}"{suggestion(name, observable)}; {task} offers {known}'


def enforced(kinds: Sequence[Kind], g: Constraint, safety: str) -> Constraint:
    """What sampling obeys: the parts that are to hold on segments (by their own word, else the preset's) taken so."""
    wanted = [getattr(kind, "safety", None) or safety for kind in kinds]
    each = [
        part.on_segments() if want == "segments" else (part,)
        for part, want in zip(g.parts, wanted, strict=True)
    ]
    return Constraint(tuple(part for parts in each for part in parts))


def kinds_sha256(kinds: Sequence[Any]) -> str:
    """Hash of the constraints as read, so that a comment in their file changes nothing."""
    said = [kind.model_dump(mode="json", exclude_none=True) for kind in kinds]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def json_schema() -> dict[str, Any]:
    """JSON schema of a constraint file, for editors."""
    return file_model().model_json_schema()
