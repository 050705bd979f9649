"""YAML files into pydantic models, with errors that name file, line and field."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from cdiff_cli.errors import SpecError, suggestion

M = TypeVar("M", bound=BaseModel)


class Strict(BaseModel):
    """Base of all models read from YAML: immutable, no unknown fields, no NaN or inf, no silent conversions of type."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True
    )


class Loader(yaml.SafeLoader):
    """SafeLoader with the booleans and floats of YAML 1.2: `on: clean` has the key "on", and 1e-3 is a number."""


Loader.yaml_implicit_resolvers = {
    first: [
        (tag, pattern)
        for tag, pattern in resolvers
        if tag != "tag:yaml.org,2002:bool" or first in "tTfF"
    ]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


class Dumper(yaml.SafeDumper):
    """SafeDumper that also quotes the texts that Loader takes for numbers: a constraint may be named "1e3"."""


for _yaml in (Loader, Dumper):
    _yaml.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"^[-+]?(\.\d+|\d+(\.\d*)?)[eE][-+]?\d+$"),
        list("-+.0123456789"),
    )


class Document:
    """A parsed YAML file that still knows the line of each value."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            raise SpecError(f"{path}: no such file{_near(path)}") from None
        except (OSError, UnicodeDecodeError) as error:
            raise SpecError(f"{path}: cannot be read as text: {error}") from None
        try:
            node = yaml.compose(text, Loader=Loader)
            self.value = yaml.load(text, Loader=Loader)
            if node is not None:
                self._refuse_duplicates(node)
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
            line = f":{mark.line + 1}" if mark else ""
            problem = getattr(error, "problem", None) or str(error).splitlines()[0]
            raise SpecError(f"{path}{line}: not valid YAML: {problem}") from None
        except (
            ValueError,
            RecursionError,
        ) as error:  # an impossible date, an alias that contains itself
            raise SpecError(f"{path}: not valid YAML: {error}") from None
        if node is None:
            raise SpecError(f"{path}: the file is empty")
        self.node: yaml.Node = node

    def line(self, location: Sequence[str | int]) -> int:
        """Line of the value at that location, or of the closest thing around it that exists."""
        node = self.node
        for step in location:
            child = _child(node, step)
            node = (
                child if child is not None else node
            )  # pydantic puts the union's tag in the path: no such node
        return int(node.start_mark.line) + 1

    def error(self, location: Sequence[str | int], message: str) -> SpecError:
        """A SpecError at that location."""
        shown, node = "", self.node
        for step in location:
            child = _child(node, step)
            if child is None and step != location[-1]:
                continue
            if child is None and isinstance(step, str) and _is_tag(node, step):
                continue
            shown += f"[{step}]" if isinstance(step, int) else f".{step}" if shown else str(step)
            node = child if child is not None else node
        where = f"{self.path}:{self.line(location)}"
        return SpecError(f"{where} {shown}: {message}" if shown else f"{where}: {message}")

    def read(self, model: type[M]) -> M:
        try:
            return model.model_validate(self.value)
        except ValidationError as error:
            first = error.errors()[0]
            raise self.error(first["loc"], _explain(dict(first))) from None

    def _refuse_duplicates(self, node: yaml.Node | None) -> None:
        if isinstance(node, yaml.MappingNode):
            seen: set[str] = set()
            for key, value in node.value:
                if key.value in seen:
                    raise SpecError(
                        f'{self.path}:{key.start_mark.line + 1}: "{key.value}" stands twice; keep one'
                    )
                seen.add(key.value)
                self._refuse_duplicates(value)
        elif isinstance(node, yaml.SequenceNode):
            for value in node.value:
                self._refuse_duplicates(value)


def load(path: Path, model: type[M]) -> M:
    """The validated content of a YAML file; raises SpecError."""
    return Document(path).read(model)


def _child(node: yaml.Node, step: str | int) -> yaml.Node | None:
    if isinstance(node, yaml.MappingNode):
        return next((value for key, value in node.value if key.value == str(step)), None)
    if isinstance(node, yaml.SequenceNode) and isinstance(step, int) and step < len(node.value):
        child: yaml.Node = node.value[step]
        return child
    return None


def _is_tag(node: yaml.Node, step: str) -> bool:
    kind = _child(node, "kind")
    return kind is not None and kind.value == step


def _explain(error: dict[str, Any]) -> str:
    """What was found, what was expected."""
    found, kind, context = error.get("input"), error["type"], error.get("ctx", {})
    if kind == "missing":
        return "this field is missing"
    if kind == "extra_forbidden":
        return "no such field here; remove it or mend its name"
    if kind == "union_tag_invalid":
        tag, known = str(context.get("tag")), str(context.get("expected_tags"))
        names = known.replace("'", "").split(", ")
        return f'no kind "{tag}"{suggestion(tag, names)}; expected one of {known}'
    if kind == "union_tag_not_found":
        return "it has no kind; add `kind: linear`, `quadratic`, `dcbf` or `dynamics`"
    if kind == "value_error":
        return str(context.get("error", error["msg"]))
    message = error["msg"].removeprefix("Value error, ").replace("Input should be", "expected")
    return f"{message}, found {_short(found)}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _near(path: Path) -> str:
    """The YAML files that do exist beside a missing one."""
    there = sorted(p.name for p in path.parent.glob("*.yaml")) if path.parent.is_dir() else []
    return (
        f"; {path.parent} has {', '.join(there)}"
        if there
        else f"; {path.parent} holds no YAML file"
    )
