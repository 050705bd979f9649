"""Constraint files: what each kind compiles to, and what each mistake is answered with."""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import cdiff_cli.constraints.spec.kinds
import cdiff_cli.constraints.spec.load
import cdiff_cli.constraints.spec.sets
from cdiff_cli.constraints.spec.load import json_schema, load_constraints
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import SpecError
from cdiff_cli.tasks import TASKS, load_task
from cdiff_cli.yaml_files import Strict
from tests.problems import refused_at

SHIPPED = sorted((Path(__file__).parents[3] / "constraints").glob("*.yaml"))
LAYOUT = ("x", "y", "vx", "vy")
HEAD = """\
task: maze2d-umaze
constraints:
  - {name: first, kind: linear, a: {x: 1.0}, b: 1.0}
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "own.yaml"
    path.write_text(text)
    return path


def rows(folder: Path, entry: str, *states: tuple[float, float, float, float]) -> list[float]:
    """g of one constraint on one trajectory."""
    path = write(folder, f"task: maze2d-umaze\nconstraints:\n  - {entry}\n")
    _, g = load_constraints(path, "maze2d-umaze", LAYOUT)
    return g(torch.tensor([states], dtype=torch.float64))[0].tolist()


# known answers ------------------------------------------------------------------------------------

ELLIPSE = "kind: quadratic, centre: {y: 0.0, x: 0.0}, semi_axes: {x: 2.0, y: 1.0}"
BALL = "kind: quadratic, centre: {x: 1.0, y: 0.0}, radius: 2.0"
BOWL = "kind: quadratic, P: {x: {x: 1.0}, y: {y: 4.0}}, q: {x: 2.0}, r: 3.0"
VALUES = {
    "linear": ("{kind: linear, a: {x: 2.0, vy: -1.0}, b: 3.0}", (5, 9, 9, 4), 10 - 4 - 3),
    "ball outside, distance": (f"{{{BALL}, side: outside}}", (4, 0, 9, 9), 2 - 3),
    "ball inside, distance": (f"{{{BALL}, side: inside}}", (4, 0, 9, 9), 3 - 2),
    "ball outside, squared": (f"{{{BALL}, side: outside, form: squared}}", (4, 0, 9, 9), 4 - 9),
    "ball inside, squared": (f"{{{BALL}, side: inside, form: squared}}", (4, 0, 9, 9), 9 - 4),
    "ball at its centre": (f"{{{BALL}, side: outside}}", (1, 0, 0, 0), 2),
    "ellipse along its long axis": (f"{{{ELLIPSE}, side: outside}}", (4, 0, 0, 0), 1 - 2),
    "ellipse along its short axis": (f"{{{ELLIPSE}, side: outside}}", (0, 4, 0, 0), 1 - 4),
    "ellipse inside": (f"{{{ELLIPSE}, side: inside}}", (0, 4, 0, 0), 4 - 1),
    "ellipse squared": (f"{{{ELLIPSE}, side: outside, form: squared}}", (4, 0, 0, 0), 1 - 4),
    "x.P x + q.x <= r": (f"{{{BOWL}, side: inside}}", (1, 1, 0, 0), 1 + 4 + 2 - 3),
    "x.P x + q.x >= r": (f"{{{BOWL}, side: outside}}", (1, 1, 0, 0), 3 - 1 - 4 - 2),
    "P off its diagonal": (
        "{kind: quadratic, side: inside, P: {x: {vy: 2.0}}, r: 1.0}",
        (3, 0, 0, 5),
        30 - 1,
    ),
}


@pytest.mark.parametrize("case", VALUES)
def test_value_by_hand_of(case, tmp_path):
    entry, state, expected = VALUES[case]
    assert rows(tmp_path, entry, state) == pytest.approx([expected], abs=1e-12)


def test_dcbf_rows_by_hand(tmp_path):
    entry = "{kind: dcbf, alpha: 0.25, barrier: {kind: linear, a: {vy: 1.0}, b: 3.0}}"
    h = [3.0, 1.0, 0.5]  # 3 - vy
    states = [(0, 0, 0, 3 - value) for value in h]
    assert rows(tmp_path, entry, *states) == pytest.approx(
        [0.75 * 3 - 1, 0.75 * 1 - 0.5], abs=1e-12
    )


def test_dcbf_of_a_ball_uses_the_signed_distance(tmp_path):
    entry = "{kind: dcbf, alpha: 0.5, barrier: {kind: quadratic, side: outside, centre: {x: 0.0, y: 0.0}, radius: 1.0}}"
    assert rows(tmp_path, entry, (3, 0, 0, 0), (0, 1.5, 0, 0)) == pytest.approx(
        [0.5 * 2 - 0.5], abs=1e-12
    )


def test_all_constraints_of_a_file_are_stacked_and_unnamed_ones_numbered(tmp_path):
    kinds, g = load_constraints(
        write(tmp_path, HEAD + "  - {kind: linear, a: {y: 1.0}, b: 5.0}\n"), "maze2d-umaze", LAYOUT
    )
    assert [kind.name for kind in kinds] == ["first", "linear-1"]
    assert g(torch.tensor([[[3.0, 4.0, 0, 0], [0, 0, 0, 0]]], dtype=torch.float64)).tolist() == [
        [2.0, -1.0, -1.0, -5.0]
    ]
    assert g.labels(2) == ["first@0", "first@1", "linear-1@0", "linear-1@1"]


def test_whole_numbers_count_as_numbers(tmp_path):
    assert rows(tmp_path, "{kind: linear, a: {x: 1}, b: 2}", (5, 0, 0, 0)) == [3.0]


DESCRIPTIONS = {
    "{kind: linear, a: {x: 1.0, y: -1.0}, b: 1.82}": "1 x + -1 y <= 1.82",
    "{kind: quadratic, side: outside, centre: {x: 0.0, y: -0.7}, radius: 1.0}": "outside the ball at x = 0, y = -0.7, radius 1",
    "{kind: quadratic, side: inside, centre: {x: 0.0}, semi_axes: {x: 2.0}}": "inside the ellipsoid at x = 0, semi-axes 2 x",
    "{kind: quadratic, side: outside, P: {x: {x: 1.0}}, r: 4.0}": "1 x x >= 4",
    "{kind: dcbf, alpha: 0.2, barrier: {kind: linear, a: {vy: 1.0}, b: 3.0}}": "h' >= 0.8 h, h >= 0 where 1 vy <= 3",
}


@pytest.mark.parametrize("entry", DESCRIPTIONS)
def test_description_states_the_inequality(entry, tmp_path):
    path = write(tmp_path, f"task: maze2d-umaze\nconstraints:\n  - {entry}\n")
    kinds, _ = load_constraints(path, "maze2d-umaze", LAYOUT)
    assert DESCRIPTIONS[entry] in kinds[0].describe()


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_constraints_load(path):
    name = next(task for task in sorted(TASKS, key=len, reverse=True) if path.stem.startswith(task))
    layout, observable = load_task(name).layout, getattr(load_task(name), "observable", ())
    kinds, g = load_constraints(
        path, name, layout, None, observable, getattr(load_task(name), "dt", None)
    )
    g = g.bind({quantity: torch.ones(2, dtype=torch.float64) for quantity in observable}, 0.1, 3)
    assert kinds
    values = g(torch.zeros(2, 3, len(layout), dtype=torch.float64))
    assert values.shape == (2, len(g.labels(3)))
    assert values.isfinite().all()


def test_shipped_constraint_files_exist():
    assert len(SHIPPED) >= 5


# properties ---------------------------------------------------------------------------------------

reals = st.floats(-10, 10)


@settings(max_examples=30, deadline=None)
@given(reals, reals, st.floats(0.1, 5), reals, reals)
def test_both_forms_of_a_ball_agree_in_sign_and_distance_is_metric(cx, cy, radius, x, y):
    state = torch.tensor([[[x, y, 0.0, 0.0]]], dtype=torch.float64)
    distance, squared = (
        cdiff_cli.constraints.spec.sets.Quadratic(
            kind="quadratic", side="outside", centre={"x": cx, "y": cy}, radius=radius, form=form
        ).compile(LAYOUT)(state)
        for form in ("distance", "squared")
    )
    away = ((x - cx) ** 2 + (y - cy) ** 2) ** 0.5
    assert float(distance) == pytest.approx(radius - away, abs=1e-9)
    assert float(squared) == pytest.approx(
        radius**2 - away**2, abs=1e-6
    )  # a difference of squares of up to 800


@settings(max_examples=30, deadline=None)
@given(reals, reals, st.sampled_from(["outside", "inside"]))
def test_an_ellipsoid_of_equal_axes_is_the_ball(x, y, side):
    state = torch.tensor([[[x, y, 0.0, 0.0]]], dtype=torch.float64)
    shared = {"kind": "quadratic", "side": side, "centre": {"x": 0.5, "y": -1.0}}
    ball = cdiff_cli.constraints.spec.sets.Quadratic(**shared, radius=1.5).compile(LAYOUT)
    ellipsoid = cdiff_cli.constraints.spec.sets.Quadratic(
        **shared, semi_axes={"x": 1.5, "y": 1.5}
    ).compile(LAYOUT)
    assert torch.equal(ball(state), ellipsoid(state))


@settings(max_examples=30, deadline=None)
@given(st.lists(reals, min_size=2, max_size=8))
def test_dcbf_with_alpha_1_only_asks_for_h_at_the_next_waypoint(velocities):
    barrier = cdiff_cli.constraints.spec.sets.Linear(kind="linear", a={"vx": 1.0}, b=2.0)
    chain = cdiff_cli.constraints.spec.kinds.Dcbf(kind="dcbf", alpha=1.0, barrier=barrier)
    x = torch.zeros(1, len(velocities), 4, dtype=torch.float64)
    x[0, :, 2] = torch.tensor(velocities, dtype=torch.float64)
    assert torch.equal(chain.compile(LAYOUT)(x), barrier.compile(LAYOUT)(x)[:, 1:])


# mistakes -----------------------------------------------------------------------------------------


def item(*lines: str) -> str:
    """HEAD (three lines) and one more constraint, which begins at line 4."""
    return HEAD + "  - " + "\n    ".join(lines) + "\n"


DISC = ("kind: quadratic", "side: outside", "centre: {x: 0.0, y: 0.0}")
BARRIER = "barrier: {kind: linear, a: {x: 1.0}, b: 1.0}"
MISTAKES = {
    "unknown coordinate": (
        item("kind: linear", "a:", "  vxx: 1.0", "b: 1.0"),
        '6 constraints[1].a.vxx: no coordinate "vxx" in maze2d-umaze (did you mean "vx"?); it has x, y, vx, vy',
    ),
    "unknown coordinate of a barrier": (
        item(
            "kind: dcbf", "alpha: 0.5", "barrier:", "  kind: linear", "  b: 1.0", "  a: {xx: 1.0}"
        ),
        '9 constraints[1].barrier.a.xx: no coordinate "xx" in maze2d-umaze (did you mean "x"?)',
    ),
    "unknown coordinate inside P": (
        item(
            "kind: quadratic", "side: inside", "r: 1.0", "P:", "  x: {x: 1.0}", "  y:", "    z: 1.0"
        ),
        '10 constraints[1].P.y.z: no coordinate "z" in maze2d-umaze; it has x, y, vx, vy',
    ),
    "text for the bound": (
        item("kind: linear", "a: {x: 1.0}", "b: one"),
        "6 constraints[1].b: expected a valid number",
    ),
    "text for a coefficient": (
        item("kind: linear", "a: {x: '1'}", "b: 1.0"),
        "5 constraints[1].a.x: expected a valid number",
    ),
    "true for a number": (
        item("kind: linear", "a: {x: 1.0}", "b: true"),
        "6 constraints[1].b: expected a valid number",
    ),
    "NaN": (
        item("kind: linear", "a: {x: 1.0}", "b: .nan"),
        "6 constraints[1].b: expected a finite number, found nan",
    ),
    "infinity": (
        item("kind: linear", "a: {x: .inf}", "b: 1.0"),
        "5 constraints[1].a.x: expected a finite number, found inf",
    ),
    "negative radius": (
        item(*DISC, "radius: -1.0"),
        "7 constraints[1].radius: expected greater than 0, found -1.0",
    ),
    "radius 0": (
        item(*DISC, "radius: 0.0"),
        "7 constraints[1].radius: expected greater than 0, found 0.0",
    ),
    "alpha 0": (
        item("kind: dcbf", "alpha: 0.0", BARRIER),
        "5 constraints[1].alpha: expected greater than 0, found 0.0",
    ),
    "alpha 1.5": (
        item("kind: dcbf", "alpha: 1.5", BARRIER),
        "5 constraints[1].alpha: expected less than or equal to 1",
    ),
    "missing bound": (
        item("name: cut", "kind: linear", "a: {x: 1.0}"),
        "4 constraints[1].b: this field is missing",
    ),
    "missing side": (
        item("kind: quadratic", *DISC[2:], "radius: 1.0"),
        "4 constraints[1].side: this field is missing",
    ),
    "missing list": ("task: maze2d-umaze\n", "1 constraints: this field is missing"),
    "extra field": (
        item(*DISC, "radius: 1.0", "radus: 2.0"),
        "8 constraints[1].radus: no such field here",
    ),
    "extra field of the file": (HEAD + "note: 1\n", "4 note: no such field here"),
    "unknown kind": (
        item("name: pillar", "kind: quadrtic"),
        "4 constraints[1]: no kind \"quadrtic\" (did you mean \"quadratic\"?); expected one of 'linear', 'quadratic', 'dcbf'",
    ),
    "unknown kind of a barrier": (
        item("kind: dcbf", "alpha: 0.5", "barrier: {kind: linar, a: {x: 1.0}, b: 1.0}"),
        '6 constraints[1].barrier: no kind "linar" (did you mean "linear"?)',
    ),
    "no kind": (
        item("name: pillar", "b: 1.0"),
        "4 constraints[1]: it has no kind; add `kind: linear`",
    ),
    "duplicate key": (
        item("kind: linear", "a: {x: 1.0}", "b: 1.0", "b: 2.0"),
        '7: "b" stands twice; keep one',
    ),
    "duplicate coordinate": (
        item("kind: linear", "a: {x: 1.0, x: 2.0}", "b: 1.0"),
        '5: "x" stands twice; keep one',
    ),
    "duplicate name": (
        item("kind: linear", "name: first", "a: {x: 1.0}", "b: 1.0"),
        '5 constraints[1].name: the name "first" stands twice',
    ),
    "wrong task": (
        HEAD.replace("maze2d-umaze", "maze2d-large"),
        '1 task: these are constraints of "maze2d-large", the task here is "maze2d-umaze"',
    ),
    "all coefficients 0": (
        item("kind: linear", "a: {x: 0.0}", "b: 1.0"),
        "4 constraints[1]: all coefficients are 0",
    ),
    "no constraint": ("task: maze2d-umaze\nconstraints: []\n", "2 constraints: "),
    "no coefficient": (item("kind: linear", "a: {}", "b: 1.0"), "5 constraints[1].a: "),
    "centre and P": (
        item(*DISC, "radius: 1.0", "P: {x: {x: 1.0}}", "r: 1.0"),
        "4 constraints[1]: found both a centre and P, q, r",
    ),
    "P without r": (
        item(*DISC[:2], "P: {x: {x: 1.0}}"),
        "4 constraints[1]: P and r belong together",
    ),
    "radius and semi_axes": (
        item(*DISC, "radius: 1.0", "semi_axes: {x: 1.0, y: 1.0}"),
        "4 constraints[1]: expected a centre and either a radius or semi_axes",
    ),
    "centre alone": (
        item(*DISC),
        "4 constraints[1]: expected a centre and either a radius or semi_axes",
    ),
    "semi_axes of other coordinates": (
        item(*DISC, "semi_axes: {x: 1.0, vx: 1.0}"),
        "4 constraints[1]: semi_axes must name the same coordinates as centre",
    ),
    "P with a distance form": (
        item(*DISC[:2], "P: {x: {x: 1.0}}", "r: 1.0", "form: distance"),
        "4 constraints[1]: P, q, r has no distance form",
    ),
    "unknown side": (
        item("kind: quadratic", "side: left", DISC[2], "radius: 1.0"),
        "5 constraints[1].side: expected 'outside'",
    ),
    "malformed YAML": (HEAD + "  - {kind: linear\n    a: [}\n", "5: not valid YAML: "),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistake_is_answered_with_file_line_and_field(case, tmp_path):
    refused_at(write(tmp_path, MISTAKES[case][0]), MISTAKES[case][1])


def test_a_missing_constraint_file_lists_those_that_are_there(tmp_path):
    write(tmp_path, HEAD)
    with pytest.raises(SpecError, match=r"owm\.yaml: no such file; .* has own\.yaml"):
        load_constraints(tmp_path / "owm.yaml", "maze2d-umaze", LAYOUT)


def test_an_empty_constraint_file_is_called_empty(tmp_path):
    with pytest.raises(SpecError, match=r"own\.yaml: the file is empty"):
        load_constraints(write(tmp_path, ""), "maze2d-umaze", LAYOUT)


# schema and plug-ins ------------------------------------------------------------------------------


class Floor(Strict):
    """A kind as another package brings it: x >= level."""

    kind: Literal["floor"]
    name: str = ""
    level: float

    def coordinates(self) -> Iterator[tuple[tuple[str | int, ...], str]]:
        yield ("level",), "x"

    def compile(self, layout):
        a = torch.tensor([-1.0 if name == "x" else 0.0 for name in layout], dtype=torch.float64)
        return AtWaypoints(self.name, HalfSpace(a, torch.tensor(-self.level, dtype=torch.float64)))

    def describe(self) -> str:
        return f"x >= {self.level:g}"


class Entry:
    """Stands for importlib's EntryPoint."""

    def load(self) -> type[Strict]:
        return Floor


@pytest.fixture
def plugged(monkeypatch) -> None:
    monkeypatch.setattr(
        cdiff_cli.constraints.spec.load,
        "entry_points",
        lambda group: [Entry()] if group == "cdiff.constraints" else [],
    )


def test_json_schema_knows_every_kind_and_refuses_further_fields():
    schema = json_schema()
    assert schema["type"] == "object"
    assert set(schema["required"]) == {"task", "constraints"}
    assert schema["additionalProperties"] is False
    mapping = schema["properties"]["constraints"]["items"]["discriminator"]["mapping"]
    assert set(mapping) == {"linear", "quadratic", "dcbf", "dynamics", "rate"}
    for reference in mapping.values():
        kind = schema["$defs"][reference.removeprefix("#/$defs/")]
        assert kind["additionalProperties"] is False
        assert kind["description"]


@pytest.mark.usefixtures("plugged")
def test_a_kind_of_another_package_loads_compiles_and_enters_the_schema(tmp_path):
    assert rows(tmp_path, "{kind: floor, level: 2.0}", (5, 0, 0, 0), (1, 0, 0, 0)) == [-3.0, 1.0]
    assert (
        "floor" in json_schema()["properties"]["constraints"]["items"]["discriminator"]["mapping"]
    )


@pytest.mark.usefixtures("plugged")
def test_mistakes_in_a_kind_of_another_package_are_answered_alike(tmp_path):
    path = write(tmp_path, item("kind: floor", "level: high"))
    with pytest.raises(SpecError) as caught:
        load_constraints(path, "maze2d-umaze", LAYOUT)
    assert str(caught.value).startswith(f"{path}:5 constraints[1].level: expected a valid number")
