"""What the design forbids: imports that point backwards, heavy imports, long files, drawers for odds and ends."""

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
RANKS = {
    "errors": 0,
    "progress": 0,
    "inference": 0,
    "nonnegative_qp": 0,
    "config": 1,
    "levels": 1,
    "affine_rows": 1,
    "tangents": 1,
    "approach": 2,
    "constraint": 2,
    "networks": 3,
    "segments": 3,
    "closed_forms": 3,
    "chains": 3,
    "opaque": 3,
    "rates": 3,
    "trips": 4,
    "observed": 3,
    "spec_levels": 4,
    "dynamics": 3,
    "tracking": 0,
    "active_set": 1,
    "reaching": 4,
    "cones": 0,
    "stages": 0,
    "interior": 1,
    "pacing": 4,
    "diffusion": 3,
    "recipe": 3,
    "spec": 5,
    "projection": 5,
    "conditioning": 6,
    "safediffuser": 6,
    "baselines": 6,
    "tasks": 6,
    "methods": 7,
    "data": 7,
    "metrics": 7,
    "frames": 8,
    "returns": 8,
    "inverse": 8,
    "examples": 9,
    "checkpoint": 9,
    "margins": 3,
    "calibrations": 3,
    "episodes": 8,
    "resumed": 10,
    "control": 11,
    "control_figures": 12,
    "closed_loop": 15,
    "planning": 10,
    "training": 10,
    "figures": 11,
    "runs": 11,
    "certificate": 11,
    "tables": 12,
    "request": 12,
    "comparison": 13,
    "explain": 12,
    "verify": 12,
    "experiment": 14,
    "sweep": 16,
    "cli": 17,
}
"""A room may import only rooms of a lower rank (the files within tasks/ are one room)."""


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path: Path) -> Iterator[tuple[str, int]]:
    """(dotted module, line) of every import, deferred ones too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            module = node.module or ""
            names = [f"{module}.{alias.name}" for alias in node.names] if module == "cdiff_cli" else [module]
            yield from ((name, node.lineno) for name in names)


def rooms_imported(path: Path) -> set[str]:
    return {name.split(".")[1] for name, _ in imports(path) if name.startswith("cdiff_cli.")}


def test_every_room_has_a_rank():
    assert {room(path) for path in FILES} - {"__init__"} == set(RANKS)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_one_way(path):
    mine = room(path)
    wrong = {other for other in rooms_imported(path) - {mine} if RANKS[other] >= RANKS.get(mine, 0)}
    assert wrong == set(), f"{path.name} (rank {RANKS.get(mine, 0)}) imports {wrong}"


def test_the_import_check_sees_both_ways_of_importing():
    assert "training" in rooms_imported(PACKAGE / "cli.py")
    assert "runs" in rooms_imported(PACKAGE / "tables.py")


@pytest.mark.parametrize(
    "name", ["methods", "safediffuser", "baselines", "constraint", "projection", "diffusion", "networks", "spec"]
)
def test_the_mathematics_knows_no_environment(name):
    path = PACKAGE / f"{name}.py"
    outside = {module.split(".")[0] for module, _ in imports(path)}
    assert outside & {"gymnasium", "gymnasium_robotics", "minari", "mujoco", "pybullet"} == set()
    assert "tasks" not in rooms_imported(path)


@pytest.mark.parametrize("modules", ["cdiff_cli.runs, cdiff_cli.tables", "cdiff_cli.cli"])
def test_no_torch_is_loaded_by(modules):
    code = f"import {modules}, sys; assert 'torch' not in sys.modules"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_file_is_over_400_lines(path):
    assert len(path.read_text().splitlines()) <= 400


def test_there_are_no_drawers_for_odds_and_ends():
    names = {path.stem for path in PACKAGE.rglob("*")}
    assert names & {"utils", "util", "helpers", "helper", "common", "misc", "manager", "factory"} == set()


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_network_address_stands_in(path):
    assert re.findall(r"(?:https?|ftp|wss?|s3|gs)://|\bwww\.", path.read_text()) == []


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_nothing_talks_to_the_network_or_unpickles(path):
    outside = {module.split(".")[0] for module, _ in imports(path)}
    forbidden = {"requests", "urllib", "http", "socket", "httpx", "pickle", "dill", "joblib", "ray", "dask"}
    # a sweep hands its jobs to processes of the same user, here or on the cluster that was named; it reads no pickle from a file
    allowed = {"joblib", "ray", "dask"} if room(path) == "sweep" else set()
    assert outside & forbidden <= allowed


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_unsafe_yaml_eval_or_global_seed_stands_in(path):
    called = {ast.unparse(node.func) for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)}
    assert called & {"eval", "exec", "yaml.unsafe_load", "yaml.full_load", "np.random.seed", "random.seed"} == set()
