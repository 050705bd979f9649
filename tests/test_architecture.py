"""The layers of the package, and what must not stand in it."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "cdiff_cli"
FILES = sorted(PACKAGE.rglob("*.py"))
LAYERS = [
    {"arrays", "errors", "progress"},
    {"yaml_files", "paths", "machine"},
    {"constraints"},
    {"projection", "models"},
    {"sampling", "tasks"},
    {"planning", "training"},
    {"evaluation"},
    {"commands", "api"},
    {"cli"},
]
"""A folder or file imports from lower layers only; those of one layer do not import each other."""

SIMULATORS = {"gymnasium", "gymnasium_robotics", "minari", "mujoco", "pybullet"}


def module(path: Path) -> str:
    """Dotted name below the package; "" for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module(path): path for path in FILES}


def imports(path: Path) -> Iterator[tuple[str, str]]:
    """(dotted module, name) of every import, deferred ones too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            yield from ((node.module or "", alias.name) for alias in node.names)


def own(path: Path) -> Iterator[tuple[str, str]]:
    """(module of the package, name) of its imports from the package; name is "" where a module is imported."""
    for dotted, name in imports(path):
        if dotted.split(".")[0] != "cdiff_cli":
            continue
        base = dotted.removeprefix("cdiff_cli").removeprefix(".")
        whole = f"{base}.{name}".strip(".")
        yield (whole, "") if whole in MODULES else (base, name)


def outside(path: Path) -> set[str]:
    return {dotted.split(".")[0] for dotted, _ in imports(path)} - {"cdiff_cli"}


def test_imports_point_down():
    rank = {room: level for level, rooms in enumerate(LAYERS) for room in rooms}
    rooms = {name.split(".")[0] for name in MODULES} - {""}
    assert rooms == set(rank)
    arrows = {
        (name.split(".")[0], other.split(".")[0])
        for name, path in MODULES.items()
        if name
        for other, _ in own(path)
        if other  # the version, which stands in the package itself
    }
    assert ("commands", "evaluation") in arrows  # the check sees imports
    assert [f"{a} imports {b}" for a, b in sorted(arrows) if a != b and rank[a] <= rank[b]] == []


def test_no_two_files_import_each_other():
    graph = {
        name: {other for other, _ in own(path) if other} for name, path in MODULES.items() if name
    }
    done: set[str] = set()
    while free := {
        name for name, needs in graph.items() if name not in done and not (needs - {name} - done)
    }:
        done |= free
    assert sorted(set(graph) - done) == []


def test_private_names_stay_in_their_folder():
    crossing = [
        f"{name} takes {other}.{taken}"
        for name, path in MODULES.items()
        for other, taken in own(path)
        if taken.startswith("_")
        and not taken.startswith("__")
        and name.rpartition(".")[0] != other.rpartition(".")[0]
    ]
    assert crossing == []


def test_solvers_know_no_constraint():
    for path in (PACKAGE / "projection" / "solvers").glob("*.py"):
        assert {name for name, _ in own(path)} <= {"arrays"} | {
            module(p) for p in path.parent.glob("*.py")
        }, path.name


def test_the_mathematics_knows_no_environment():
    for folder in ("constraints", "projection", "sampling"):
        for path in (PACKAGE / folder).rglob("*.py"):
            assert outside(path) & SIMULATORS == set(), path
            assert not any(name.startswith("tasks") for name, _ in own(path)), path


@pytest.mark.parametrize(
    "modules",
    [
        "cdiff_cli",
        "cdiff_cli.cli",
        "cdiff_cli.sampling",
        "cdiff_cli.yaml_files, cdiff_cli.paths, cdiff_cli.machine",
        "cdiff_cli.commands.compare, cdiff_cli.commands.run_directory",
        "cdiff_cli.commands.list_names",
        "cdiff_cli.commands.options, cdiff_cli.commands.names, cdiff_cli.commands.rerun",
        "cdiff_cli.evaluation.columns, cdiff_cli.evaluation.comparison, cdiff_cli.evaluation.statistics, cdiff_cli.evaluation.tables",
    ],
)
def test_no_torch_is_loaded_by(modules):
    code = f"import {modules}, sys; assert 'torch' not in sys.modules"
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr


def test_no_file_is_over_400_lines():
    assert [str(path) for path in FILES if len(path.read_text().splitlines()) > 400] == []


def test_there_are_no_drawers_for_odds_and_ends():
    names = {path.stem for path in PACKAGE.rglob("*")}
    assert (
        names & {"utils", "util", "helpers", "helper", "common", "misc", "manager", "factory"}
        == set()
    )


def test_nothing_talks_to_the_network_or_unpickles():
    forbidden = {
        "requests",
        "urllib",
        "http",
        "socket",
        "httpx",
        "pickle",
        "dill",
        "joblib",
        "ray",
        "dask",
    }
    for name, path in MODULES.items():
        # a sweep hands its jobs to processes of the same user, here or on the cluster that was named; it reads no pickle from a file
        allowed = {"joblib", "ray", "dask"} if name == "commands.sweep" else set()
        assert outside(path) & forbidden <= allowed, name
        assert re.findall(r"(?:https?|ftp|wss?|s3|gs)://|\bwww\.", path.read_text()) == [], name


def test_no_unsafe_yaml_eval_or_global_seed():
    forbidden = {
        "eval",
        "exec",
        "yaml.unsafe_load",
        "yaml.full_load",
        "np.random.seed",
        "random.seed",
    }
    for name, path in MODULES.items():
        called = {
            ast.unparse(node.func)
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Call)
        }
        assert called & forbidden == set(), name


# functions ---------------------------------------------------------------------------------------

MOST_LOCALS, MOST_BRANCHES = 20, 15
TOO_LARGE = {
    "commands.check.check",
    "commands.compare.print_comparison",
    "constraints.spec.sets.Quadratic._one_shape",
    "planning.receding_horizon.rollout",
    "projection.solvers.active_set._active_rows",
}
"""Functions above a limit, each to be split; none may be added."""

FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
BRANCHES = (ast.If, ast.For, ast.While, ast.ExceptHandler, ast.IfExp)


def functions(name: str, node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """(dotted name, definition) of every function below a node, nested ones too."""
    for child in ast.iter_child_nodes(node):
        inner = f"{name}.{child.name}" if isinstance(child, (*FUNCTIONS, ast.ClassDef)) else name
        if isinstance(child, FUNCTIONS):
            yield inner, child
        yield from functions(inner, child)


def body(function: ast.AST) -> Iterator[ast.AST]:
    """All nodes of a function, without those of functions inside it."""
    for child in ast.iter_child_nodes(function):
        if not isinstance(child, (*FUNCTIONS, ast.Lambda)):
            yield child
            yield from body(child)


def local_names(function: ast.AST) -> int:
    """Names that a function assigns, those of its comprehensions included, without parameters."""
    nodes = list(body(function))
    names = {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    return len(names | {n.name for n in nodes if isinstance(n, ast.ExceptHandler) and n.name})


def branches(function: ast.AST) -> int:
    """Places where a function decides."""
    count = 0
    for node in body(function):
        if isinstance(node, BRANCHES):
            count += 1
        elif isinstance(node, ast.BoolOp):
            count += len(node.values) - 1
        elif isinstance(node, ast.comprehension):
            count += len(node.ifs)
    return count


def test_branches_and_local_names_are_counted():
    source = """
def f(x, y):
    a = [b for b in x if b and y or not b]
    for c in a if x else y:
        try:
            d, e = c
        except ValueError as g:
            return lambda h: h if h else (k := 3)
    def inner():
        z = 1 if x else 2
"""
    ((_, outer), _) = functions("", ast.parse(source))
    assert local_names(outer) == 6  # a, b, c, d, e, g
    assert branches(outer) == 6  # comprehension if, and, or, for, ternary, except


def test_functions_are_small():
    large = {
        name
        for module_name, path in MODULES.items()
        for name, function in functions(module_name, ast.parse(path.read_text()))
        if local_names(function) > MOST_LOCALS or branches(function) > MOST_BRANCHES
    }
    assert large - TOO_LARGE == set(), "split them"
    assert TOO_LARGE - large == set(), "they are small now: take them off the list"


# the host process --------------------------------------------------------------------------------

HOST = """
import importlib, logging, os, random, warnings
import matplotlib, numpy, torch

for name in {third_party!r}:
    importlib.import_module(name)

def host():
    return {{
        "matplotlib": dict.copy(matplotlib.rcParams),
        "warnings": list(warnings.filters),
        "threads": (torch.get_num_threads(), torch.get_num_interop_threads()),
        "torch": (torch.get_default_dtype(), torch.is_grad_enabled()),
        "numpy": (numpy.geterr(), numpy.get_printoptions()),
        "random": (random.getstate(), str(numpy.random.get_state()), torch.get_rng_state().tolist()),
        "logging": (logging.root.level, list(logging.root.handlers)),
        "environment": dict(os.environ),
        "folder": os.getcwd(),
    }}

before = host()
for name in {modules!r}:
    importlib.import_module(name)
import cdiff_cli
for name in cdiff_cli.__all__:
    getattr(cdiff_cli, name)
after = host()
assert "cdiff_cli.evaluation.figures.plans" in {modules!r}
assert before.keys() == after.keys()
changed = [name for name in before if str(before[name]) != str(after[name])]
assert changed == [], changed
"""


def imported_on_import(path: Path) -> set[str]:
    """Modules from outside that a file imports when it is imported itself."""
    names: set[str] = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(node.module or "")
    return {name for name in names if name.split(".")[0] != "cdiff_cli"}


def test_importing_the_package_changes_nothing_in_the_host():
    modules = [
        f"cdiff_cli.{name}".rstrip(".")
        for name in MODULES
        if name != "cli" and not name.startswith("tasks.")
    ]
    outer = {name for path in FILES for name in imported_on_import(path)}
    third_party = sorted(name for name in outer if name.split(".")[0] not in SIMULATORS)
    code = HOST.format(third_party=third_party, modules=modules)
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr


# prose -------------------------------------------------------------------------------------------

THING = (
    "row|plan|step|call|waypoint|segment|episode|file|seed|batch|task|method|constraint|pass|gait"
)
BARE_RATES = (
    rf"\b(a|an|one) (network )?({THING}) (a|an) ({THING}|second|minute)\b",
    rf"\b({THING.replace('|', 's|')}s|passes|batches|seconds|ms) (a|an) ({THING}|minute)\b",
    r"\b(steps|frames|calls|plans|metres|rows) a second\b",
)
"""Rates with a bare article, as in "a row a segment"; write "one row per segment"."""


def test_rates_say_per():
    def rates(text: str) -> list[str]:
        flat = re.sub(r"\s+(#\s+)?", " ", text)
        return [match[0] for rate in BARE_RATES for match in re.finditer(rate, flat)]

    assert rates("a row a segment, two calls\n    # a plan") == ["a row a segment", "calls a plan"]
    assert rates("one row per segment, calls per plan, a step. A plan") == []
    assert {name: rates(path.read_text()) for name, path in MODULES.items()} == {
        name: [] for name in MODULES
    }
