"""Fill the generated blocks of README.md and docs/: `make pages` writes them, tests/test_docs.py fails when they drift.

A block stands between `<!-- NAME -->` and `<!-- end -->`; NAME is one of BLOCKS:

table ...        a table of results from the rows in runs/reference/
kinds            the constraint kinds, one row each
kind-reference   every field of every kind, from the pydantic classes
commands         the commands, one row each
command-help     the help of every command, from Typer
program ...      a program of tests/api/, which the test suite runs
"""

import json
import re
import sys
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import yaml

from cdiff_cli.commands import run_directory
from cdiff_cli.evaluation import columns, tables
from cdiff_cli.evaluation.comparison import compare

ROOT = Path(__file__).parent.parent
REFERENCE = ROOT / "runs" / "reference"
PROGRAMS = ROOT / "tests" / "api"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
MARKED = re.compile(r"(<!-- (?!end )([a-z0-9 _-]+?) -->\n).*?(<!-- end -->)", re.DOTALL)

# --- Results ---------------------------------------------------------------------------------------------------------

PAPER = (
    *(
        "distance",
        "distance_paper",
        "violation",
        "violation_paper",
        "worst_segment",
        "unsafe_segments",
    ),
    *("jump", "torn", "wall", "calls"),
)
FEW = ("distance", "wall", "residual", "effort", "safe_segments", "safe_executed", "success")
SAFETY = (*columns.SAFETY_TABLE[:-2], "torn", "distance")
BRIEF = ("distance", "violation_paper", "unsafe_segments", "torn", "wall")
CONTROL_BRIEF = ("reward", "violation_rate", "executed_violation", "safe_executed", "fell")
CONTROL = (
    "reward",
    "plan_violation",
    "violation_rate",
    "executed_violation",
    "executed_worst",
    "safe_executed",
    "fell",
    "calls",
)
BALL = (
    "reward",
    "violation_rate",
    "executed_violation",
    "executed_worst",
    "safe_executed",
    "contacts",
    "braked",
    "calls",
)
BALL_BRIEF = ("reward", "violation_rate", "executed_violation", "safe_executed", "contacts")
QUALITY = (
    "wall",
    "smooth",
    "success",
    "jump",
    "residual",
    "acceleration",
    "effort",
    "goal_distance",
)

MAZES = (
    *(
        ("diffuser", "paper"),
        ("conditional", "paper"),
        ("safediffuser", "paper"),
        ("projected", "paper"),
    ),
    *(
        ("primal-dual", "released"),
        ("alm", "released"),
        ("projected", "recommended"),
        ("alm", "recommended"),
    ),
)
THREE = (("diffuser", "recommended"), ("projected", "paper"), ("alm", "recommended"))
ACTING = (
    *(("diffuser", "recommended"), ("conditional", "paper"), ("projected", "paper")),
    *(("alm", "released"), ("alm", "recommended")),
)
BALLS = (
    *(("diffuser", "recommended"), ("conditional", "paper"), ("projected", "paper")),
    *(
        ("primal-dual", "paper"),
        ("alm", "paper"),
        ("projected", "recommended"),
        ("alm", "recommended"),
    ),
)


@cache
def rows_of(name: str) -> tuple[columns.Row, ...]:
    """The rows of runs/reference/NAME/rows.csv."""
    return tuple(run_directory.read_rows(REFERENCE / name / "rows.csv"))


def comparison(name: str, columns: tuple[str, ...], paper: bool = False) -> str:
    """A comparison of the rows in runs/reference/NAME/rows.csv."""
    values = tables.read_paper(REFERENCE / "paper.csv") if paper else None
    return tables.render(compare(rows_of(name)), columns, "markdown", values)


def excerpt(
    names: tuple[str, ...],
    columns: tuple[str, ...],
    shown: tuple[tuple[str, str], ...],
    paper: bool = False,
) -> str:
    """A comparison of several row files that shows these pairs of method and preset only, per constraint file."""
    values = tables.read_paper(REFERENCE / "paper.csv") if paper else None
    groups = [group for name in names for group in compare(rows_of(name))]
    by_key = {group.key: group for group in groups}
    keys = [
        (*files, *pair)
        for files in dict.fromkeys(group.key[:2] for group in groups)
        for pair in shown
    ]
    return tables.render(
        [by_key[key] for key in keys if key in by_key], columns, "markdown", values
    )


def definitions() -> str:
    """The definition of each column."""
    lines = [
        f"| {column.title} | {column.meaning.replace('|', '&#124;')} |"
        for column in columns.COLUMNS.values()
    ]
    return "\n".join(["| column | definition |", "| --- | --- |", *lines])


SUMMARY = {
    "U-maze, 4 constraint files": "safety-umaze",
    "large maze, 4 constraint files": "safety-large",
    "Hopper, 2 limits": "table2-hopper",
    "Swimmer, 2 limits": "table2-swimmer",
    "ball run, solid and ghost": "table3",
}


def summary() -> str:
    """Episodes without an unsafe state, per task and method, all constraint files of the task together."""
    lines = []
    for title, name in SUMMARY.items():
        cells = []
        for method, preset in THREE:
            safe = [
                row["safe_executed"]
                for row in rows_of(name)
                if (row["method"], row["preset"]) == (method, preset)
            ]
            cells.append(f"{sum(safe):.0f} of {len(safe)}")
        lines.append(f"| {title} | {' | '.join(cells)} |")
    head = [
        "| task | no constraint (`diffuser`) | `projected`, `paper` | `alm`, `recommended` |",
        "| --- | ---: | ---: | ---: |",
    ]
    return "\n".join([*head, *lines])


TABLES: dict[str, Callable[[], str]] = {
    "summary": summary,
    "safety-short": lambda: excerpt(
        ("safety-umaze", "safety-large"), (*SAFETY[:4], "distance"), THREE
    ),
    "table1-short": lambda: excerpt(("table1-umaze", "table1-large"), BRIEF, MAZES, paper=True),
    "table2-short": lambda: excerpt(
        ("table2-hopper", "table2-swimmer"), CONTROL_BRIEF, ACTING, paper=True
    ),
    "table3-short": lambda: excerpt(("table3",), BALL_BRIEF, BALLS, paper=True),
    "table1-umaze": lambda: comparison("table1-umaze", PAPER, paper=True),
    "table1-large": lambda: comparison("table1-large", PAPER, paper=True),
    "safety-umaze": lambda: comparison("safety-umaze", SAFETY),
    "safety-large": lambda: comparison("safety-large", SAFETY),
    "table2-hopper": lambda: comparison("table2-hopper", CONTROL, paper=True),
    "table2-swimmer": lambda: comparison("table2-swimmer", CONTROL, paper=True),
    "table3": lambda: comparison("table3", BALL, paper=True),
    "few-steps": lambda: comparison("few-steps", FEW),
    "fresh": lambda: comparison("fresh", CONTROL_BRIEF),
    "quality": lambda: comparison("quality", QUALITY),
    "metrics": definitions,
}

# --- Constraint kinds ------------------------------------------------------------------------------------------------

EXAMPLES = {
    "linear": "{name: cut-corner, kind: linear, a: {x: 1, y: -1}, b: 1.9}",
    "quadratic": "{name: pillar, kind: quadratic, side: outside, centre: {x: 1.35, y: 0.1}, radius: 0.3}",
    "dcbf": "{name: upward-speed, kind: dcbf, alpha: 0.2, barrier: {kind: linear, a: {vy: 1}, b: 3}}",
    "rate": "{name: slow, kind: rate, of: [x, y], max: 2.5}",
    "dynamics": "{name: motor, kind: dynamics, fit: demonstrations}",
}
"""One constraint of each kind on maze2d-umaze. Each is loaded before it is printed."""

MEANINGS = {
    "name": "name of the constraint in tables and errors; default: KIND-NUMBER",
    "side": "which side of the boundary is allowed",
    "centre": "centre of the ball or ellipsoid, per coordinate",
    "radius": "radius of the ball",
    "semi_axes": "semi-axes of the ellipsoid, per coordinate of `centre`",
    "P": "symmetric matrix of a general quadric, row by row",
    "q": "linear part of a general quadric",
    "r": "right-hand side of a general quadric",
    "form": "distance: signed distance to the surface; squared: difference of squares",
    "look_ahead": "another barrier in the place of h, which an input changes at once",
    "barrier": "the constraint that defines h = -g",
    "c": "constant part of the dynamics, per coordinate; left out: 0",
}
"""What a field means, where its class does not say so."""


@cache
def constraint_schema() -> dict[str, Any]:
    from cdiff_cli.constraints.spec.load import json_schema

    return json_schema()


def checked_example(kind: str) -> str:
    """The example of a kind as YAML, after the file model has accepted it."""
    from cdiff_cli.constraints.spec.load import file_model

    if kind not in EXAMPLES:
        raise SystemExit(
            f'docs/generate.py: the constraint kind "{kind}" has no example; add one to EXAMPLES'
        )
    file_model().model_validate(
        {"task": "maze2d-umaze", "constraints": [yaml.safe_load(EXAMPLES[kind])]}
    )
    return EXAMPLES[kind]


def kind_classes() -> list[tuple[str, type]]:
    """(kind, class) of the built-in kinds."""
    from cdiff_cli.constraints.spec.load import kinds

    return [
        (cls.model_fields["kind"].annotation.__args__[0], cls)
        for cls in kinds()
        if cls.__module__.startswith("cdiff_cli")
    ]


def lead_and_rest(doc: str) -> tuple[str, str]:
    """The first paragraph of a docstring on one line, and what follows with its line breaks."""
    lines = [line.removeprefix("    ") for line in doc.strip().splitlines()]
    lead, _, rest = "\n".join(lines).partition("\n\n")
    return " ".join(lead.split()), rest.strip("\n")


def kinds_table() -> str:
    lines = [
        f"| `{kind}` | {in_cell(lead_and_rest(cls.__doc__ or '')[0])} | `{checked_example(kind)}` |"
        for kind, cls in kind_classes()
    ]
    return "\n".join(["| kind | it means | example |", "| --- | --- | --- |", *lines])


def in_cell(text: str) -> str:
    return re.sub(r"<(?=\w)", "&lt;", text.replace("|", "&#124;"))


def type_of(field: dict[str, Any]) -> str:
    """A short name of a field's JSON schema."""
    if "anyOf" in field:
        return " or ".join(
            dict.fromkeys(type_of(each) for each in field["anyOf"] if each.get("type") != "null")
        )
    if "oneOf" in field:
        return " or ".join(type_of(each) for each in field["oneOf"])
    if "$ref" in field:
        return field["$ref"].rsplit("/", 1)[-1]
    if "const" in field:
        return f'"{field["const"]}"'
    if "enum" in field:
        return " or ".join(json.dumps(value) for value in field["enum"])
    if field.get("type") == "object":
        values = field.get("additionalProperties")
        return f"map to {type_of(values)}" if isinstance(values, dict) else "map"
    if field.get("type") == "array":
        items = field.get("prefixItems") or [field.get("items", {})]
        return f"list of {type_of(items[0])}" + (
            f", {len(items)} of them" if "prefixItems" in field else ""
        )
    limits = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
    bounds = ", ".join(f"{sign} {field[name]:g}" for name, sign in limits.items() if name in field)
    name = {"string": "name" if "observed" in field.get("description", "") else "text"}.get(
        field.get("type", ""), field.get("type")
    )
    return f"{name or 'any'}{' ' + bounds if bounds else ''}"


def fields_table(schema: dict[str, Any]) -> str:
    required = set(schema.get("required", ()))
    lines = []
    for name, field in schema["properties"].items():
        default = (
            "required"
            if name in required
            else ""
            if field.get("default") in (None, "")
            else f"`{json.dumps(field['default'])}`"
        )
        meaning = field.get("description") or MEANINGS.get(name, "")
        if name == "kind":
            meaning = "which kind this is"
        if not meaning:
            raise SystemExit(
                f'docs/generate.py: the field "{name}" has no description; give its Field one'
            )
        lines.append(f"| `{name}` | {in_cell(type_of(field))} | {default} | {in_cell(meaning)} |")
    return "\n".join(["| field | type | default | meaning |", "| --- | --- | --- | --- |", *lines])


def kind_reference() -> str:
    """Every field of every kind: type, default, meaning, example."""
    definitions = constraint_schema()["$defs"]
    parts, own = [], {cls.__name__ for _, cls in kind_classes()}
    for kind, cls in kind_classes():
        schema, (first, rest) = definitions[cls.__name__], lead_and_rest(cls.__doc__ or "")
        parts += [f"### `{kind}`", in_cell(first), *([f"```text\n{rest}\n```"] if rest else [])]
        parts += [f"```yaml\n- {checked_example(kind)}\n```", fields_table(schema)]
        for name in sorted(nested_models(schema, definitions) - own):
            first, _ = lead_and_rest(definitions[name].get("description", ""))
            parts += [f"`{name}`: {in_cell(first)}", fields_table(definitions[name])]
    return "\n\n".join(parts)


def nested_models(schema: Any, definitions: dict[str, Any]) -> set[str]:
    """Names of the models that a schema refers to."""
    return {
        name for name in re.findall(r'"#/\$defs/(\w+)"', json.dumps(schema)) if name in definitions
    }


# --- Commands --------------------------------------------------------------------------------------------------------

COMMAND_EXAMPLES = {
    "train": "cdiff train --task maze2d-umaze --recipe small",
    "plan": "cdiff plan --method alm --constraints mine.yaml",
    "rollout": "cdiff rollout --task hopper --method alm --episodes 10",
    "verify": "cdiff verify runs",
    "compare": "cdiff compare --against alm --intervals",
    "sweep": "cdiff sweep --methods diffuser,alm --seeds 10 --jobs 2",
    "check": "cdiff check mine.yaml",
    "list": "cdiff list tasks",
    "rerun": "cdiff rerun RUN",
}


def commands_table() -> str:
    import typer

    from cdiff_cli.cli import app

    lines = []
    for name, command in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
        if name not in COMMAND_EXAMPLES:
            raise SystemExit(
                f'docs/generate.py: the command "{name}" has no example; add one to COMMAND_EXAMPLES'
            )
        sentence = re.split(r"(?<=[a-z])[.;:] ", " ".join((command.help or "").split()))[0].rstrip(
            "."
        )
        lines.append(f"| `{COMMAND_EXAMPLES[name]}` | {in_cell(sentence)} |")
    return "\n".join(["| command | what it does |", "| --- | --- |", *lines])


def command_help() -> str:
    """What `python -m typer cdiff_cli.cli utils docs` prints, without its title."""
    from typer.cli import app as typer_app
    from typer.testing import CliRunner

    printed = CliRunner().invoke(typer_app, ["cdiff_cli.cli", "utils", "docs", "--name", "cdiff"])
    if printed.exit_code:
        raise SystemExit(f"docs/generate.py: Typer printed no help: {printed.output}")
    return printed.stdout.split("\n", 1)[1].strip().replace("```console\n$ ", "```text\n")


# --- Programs --------------------------------------------------------------------------------------------------------


class MissingProgramError(Exception):
    """A page shows a program that tests/api/ does not have."""


def program(name: str) -> str:
    """The program tests/api/NAME.py as the test suite runs it."""
    path = PROGRAMS / f"{name}.py"
    if not path.is_file():
        raise MissingProgramError(
            f"{path.relative_to(ROOT)} does not exist; its block was left as it is"
        )
    return f"```python\n{path.read_text().strip()}\n```"


NAMES_OF_PROGRAMS = ("project_trajectories", "any_denoiser", "own_environment")

# --- Filling ---------------------------------------------------------------------------------------------------------

BLOCKS: dict[str, Callable[[], str]] = {
    **{f"table {name}": make for name, make in TABLES.items()},
    **{f"program {name}": partial(program, name) for name in NAMES_OF_PROGRAMS},
    "kinds": kinds_table,
    "kind-reference": kind_reference,
    "commands": commands_table,
    "command-help": command_help,
}


def filled(text: str, missing: list[str] | None = None) -> str:
    """The text with every marked block made anew.

    missing   collects a message for each block that cannot be made, which then stays as it is; None: raise MissingProgramError
    """

    def made(block: re.Match[str]) -> str:
        try:
            return f"{block[1]}{BLOCKS[block[2]]()}\n{block[3]}"
        except MissingProgramError as error:
            if missing is None:
                raise
            missing.append(str(error))
            return block[0]

    return MARKED.sub(made, text)


def main(pages: Sequence[Path] = PAGES) -> int:
    missing: list[str] = []
    for page in pages:
        old = page.read_text()
        new = filled(old, missing)
        if new != old:
            page.write_text(new)
            sys.stderr.write(f"{page.relative_to(ROOT)}: rewritten\n")
    for message in dict.fromkeys(missing):
        sys.stderr.write(f"error: {message}\n")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
