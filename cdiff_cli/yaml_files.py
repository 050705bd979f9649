"""Reads YAML files into pydantic models; every error names file, line and field."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from cdiff_cli.errors import SpecError, suggestion

M = TypeVar("M", bound=BaseModel)


class Strict(BaseModel):
    """Base of all models that are read from YAML.

    Models are immutable. Unknown fields, NaN and infinity are errors, and so is a value of another
    type.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True
    )


class Loader(yaml.SafeLoader):
    """SafeLoader with the booleans and floats of YAML 1.2.

    `on: clean` has the key "on", and 1e-3 is a number.
    """


Loader.yaml_implicit_resolvers = {
    first: [
        (tag, pattern)
        for tag, pattern in resolvers
        if tag != "tag:yaml.org,2002:bool" or first in "tTfF"
    ]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}


class Dumper(yaml.SafeDumper):
    """SafeDumper that quotes every text that Loader reads as a number.

    A constraint may be named "1e3".
    """


for _yaml in (Loader, Dumper):
    _yaml.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"^[-+]?(\.\d+|\d+(\.\d*)?)[eE][-+]?\d+$"),
        list("-+.0123456789"),
    )


class Document:
    """A parsed YAML file with the line of each value.

    path    the file
    value   its content
    node    its syntax tree, which has the lines
    """

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
        except (ValueError, RecursionError) as error:
            # ValueError: an impossible date; RecursionError: an alias that contains itself
            raise SpecError(f"{path}: not valid YAML: {error}") from None
        if node is None:
            raise SpecError(f"{path}: the file is empty")
        self.node: yaml.Node = node

    def line(self, location: Sequence[str | int]) -> int:
        """Line of the value at a location; if there is none, the line of what contains it.

        location   keys and list indices from the top, as in pydantic errors
        """
        node = self.node
        for step in location:
            child = _child(node, step)
            if child is not None:  # a union's tag is in the path of pydantic, not in the file
                node = child
        return int(node.start_mark.line) + 1

    def error(self, location: Sequence[str | int], message: str) -> SpecError:
        """A SpecError whose message begins with file, line and field of a location."""
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
        """The validated content; raises SpecError."""
        try:
            return model.model_validate(self.value)
        except ValidationError as error:
            first = error.errors()[0]
            raise self.error(first["loc"], _explain(dict(first))) from None

    def _refuse_duplicates(self, node: yaml.Node | None) -> None:
        if isinstance(node, yaml.MappingNode):
            keys: set[str] = set()
            for key, value in node.value:
                if key.value in keys:
                    where = f"{self.path}:{key.start_mark.line + 1}"
                    raise SpecError(f'{where}: "{key.value}" stands twice; keep one')
                keys.add(key.value)
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
    """What was found and what was expected, from an error of pydantic."""
    kind, context = error["type"], error.get("ctx", {})
    if kind == "missing":
        return "this field is missing"
    if kind == "extra_forbidden":
        return "no such field here; remove it or mend its name"
    if kind == "union_tag_invalid":
        tag, known = str(context.get("tag")), str(context.get("expected_tags"))
        names = known.replace("'", "").split(", ")
        return f'no kind "{tag}"{suggestion(tag, names)}; expected one of {known}'
    if kind == "union_tag_not_found":
        return "it has no kind; add `kind: linear` or another"
    if kind == "value_error":
        return str(context.get("error", error["msg"]))
    message = error["msg"].removeprefix("Value error, ").replace("Input should be", "expected")
    return f"{message}, found {_short(error.get('input'))}"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _near(path: Path) -> str:
    """The YAML files in the folder of a missing one."""
    names = sorted(p.name for p in path.parent.glob("*.yaml")) if path.parent.is_dir() else []
    if names:
        return f"; {path.parent} has {', '.join(names)}"
    return f"; {path.parent} has no YAML file"
