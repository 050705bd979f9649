"""A constraint answers for itself: who may ask for its type, and what its answers promise."""

import ast
from pathlib import Path

import pytest
import torch

import cdiff_cli
from cdiff_cli.constraints.dynamics import LinearDynamics, LinearDynamicsConstraint
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import RateLimit
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.errors import InfeasibleError
from tests.problems import F64, KINDS, ball, half_space, normal, num, pin, vec, waypoints

PACKAGE = Path(cdiff_cli.__file__).parent
CONSTRAINTS = PACKAGE / "constraints"


def classes(path: Path) -> set[str]:
    return {node.name for node in ast.walk(ast.parse(path.read_text())) if _is_class(node)}


def _is_class(node: ast.AST) -> bool:
    return isinstance(node, ast.ClassDef)


def inspected(path: Path) -> set[str]:
    """The names of the classes that `isinstance` is called with."""
    return {
        name.id if isinstance(name, ast.Name) else name.attr
        for call in ast.walk(ast.parse(path.read_text()))
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "isinstance"
        for name in ast.walk(call.args[1])
        if isinstance(name, ast.Name | ast.Attribute)
    }


def test_only_the_projections_ask_for_the_type_of_a_constraint():
    """Within constraints/, a file may ask for the classes it defines; spec/ asks for YAML kinds."""
    known = {name for path in CONSTRAINTS.glob("*.py") for name in classes(path)}
    assert {"RateLimit", "HalfSpace", "Observed"} <= known
    assert "RateLimit" in inspected(PACKAGE / "projection" / "rate_dynamics.py")
    asking = {
        str(path.relative_to(PACKAGE)): names
        for path in PACKAGE.rglob("*.py")
        if not path.is_relative_to(PACKAGE / "projection")
        and not path.is_relative_to(CONSTRAINTS / "spec")
        and (
            names := inspected(path)
            & known - (classes(path) if path.parent == CONSTRAINTS else set())
        )
    }
    assert asking == {}


# answers ------------------------------------------------------------------------------------------


def rate():
    return RateLimit(
        "rate", torch.eye(2, dtype=F64)[:1], -1.0, 1.0, False, 0.5, vec(0.0, 0.0), vec(1.0, 1.0)
    )


def dynamics():
    one, zero = torch.eye(2, dtype=F64), vec(0.0, 0.0)
    model = LinearDynamics(one, one, zero, zero - 1, zero + 1)
    return LinearDynamicsConstraint.from_dynamics("dynamics", model, 1e-4)


PARTS = {
    **{name: g.parts[0] for name, g in KINDS.items()},
    "segments": OnSegments("s", ball("outside")),
    "rate": rate(),
    "dynamics": dynamics(),
}


@pytest.mark.parametrize("kind", PARTS)
def test_a_row_depends_on_its_support_alone(kind):
    """Row k uses the waypoints k to k + support - 1: moving any other one leaves it as it is."""
    part = PARTS[kind]
    if not part.support:
        return
    x = normal(0, 2, 7, 2)
    rows = part(x)
    assert rows.shape[1] == 7 - part.support + 1
    for tau in range(7):
        moved = x.clone()
        moved[:, tau] += 0.5
        others = [k for k in range(rows.shape[1]) if not k <= tau < k + part.support]
        assert torch.equal(part(moved)[:, others], rows[:, others])


@pytest.mark.parametrize("kind", PARTS)
def test_restricting_a_part_to_its_coordinates_leaves_its_rows_as_they_are(kind):
    part, x = PARTS[kind], normal(1, 3, 5, 2)
    columns = part.coordinates(2)
    torch.testing.assert_close(part.restrict(columns)(x[..., columns]), part(x))


def test_a_wall_in_one_coordinate_depends_on_that_one_alone():
    wall = waypoints(half_space((0.0, 2.0), 0.3)).parts[0]
    assert wall.coordinates(2) == [1]
    assert wall.restrict([1])(vec(0.15).reshape(1, 1, 1)).item() == pytest.approx(0.0)


@pytest.mark.parametrize("kind", PARTS)
def test_the_largest_value_of_a_segment_is_at_its_argmax(kind):
    """Where a state set is, f at that point is segment_max; without one there is no such point."""
    part, x = PARTS[kind], normal(2, 4, 6, 2)
    share = part.segment_argmax(x)
    if share is None:
        assert part.level is None
        return
    assert share.shape == (4, 5)
    if part.level is not None:
        point = torch.lerp(x[:, :-1], x[:, 1:], share[..., None])
        torch.testing.assert_close(part.level(point), part.segment_max(x))


# pins ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["half-space", "dcbf over outside ball", "segments", "dynamics"])
def test_pinned_waypoints_that_violate_a_row_are_refused_by_its_label(kind):
    x = normal(3, 1, 8, 2, scale=3.0)
    part = PARTS[kind]
    row = int((part(x)[0] > 0.01).nonzero()[0])
    part.check_pins(Pins.none(x), 1e-6)
    with pytest.raises(InfeasibleError) as caught:
        part.check_pins(pin(x, *range(row, row + part.support)), 1e-6)
    assert f"violates {part.labels(8)[row]};" in str(caught.value)


def test_rows_with_a_free_waypoint_are_not_refused():
    x = normal(3, 1, 8, 2, scale=3.0)
    PARTS["dcbf over outside ball"].check_pins(pin(x, 0, 2, 4, 6), 1e-6)


def test_pinned_waypoints_that_a_rate_cannot_join_are_refused():
    x = torch.zeros(1, 4, 2, dtype=F64)
    x[:, -1, 0] = 1.5  # in 1.5 s at 1 per second
    rate().check_pins(Pins.ends(x), 1e-6)
    x[:, -1, 0] = num(1.6)
    with pytest.raises(InfeasibleError, match="excludes the pinned waypoints 0 and 3"):
        rate().check_pins(Pins.ends(x), 1e-6)
