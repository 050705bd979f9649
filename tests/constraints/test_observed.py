"""Constraints with observed parameters: their YAML, binding, and the error for each mistake."""

import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.observed import Observed, require_bound
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.spec.load import enforced, file_model, json_schema, load_constraints
from cdiff_cli.constraints.state_sets import Ellipsoid, QuadricInFrame
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import CdiffError, SpecError
from cdiff_cli.projection.project import project
from cdiff_cli.yaml_files import Dumper
from tests.problems import F64, normal, pin, vec

LAYOUT = ("x", "y", "vx", "vy")
OFFERED = ("obstacle.x", "obstacle.y", "obstacle.vx", "obstacle.vy", "obstacle.radius")
DT, HORIZON = 0.1, 5
CENTRE = "centre: {x: obstacle.x, y: obstacle.y}"
BALL = f"kind: quadratic, side: outside, {CENTRE}, radius: 1.0"
VELOCITY = "velocity: {x: obstacle.vx, y: obstacle.vy}"
SEEN = {
    "obstacle.x": vec(2.0, 0.0),
    "obstacle.y": vec(0.0, 3.0),
    "obstacle.vx": vec(-1.0, 0.5),
    "obstacle.vy": vec(0.0, -2.0),
    "obstacle.radius": vec(0.5, 1.5),
}


def load(folder, *entries, observable=OFFERED, task="ball-run"):
    path = folder / "own.yaml"
    path.write_text(
        f"task: {task}\nconstraints:\n" + "".join(f"  - {entry}\n" for entry in entries)
    )
    return load_constraints(path, task, LAYOUT, None, observable)


def bound(folder, entry, horizon=HORIZON):
    _, g = load(folder, entry)
    return g.bind(SEEN, DT, horizon)


def where(plan, k, held=False):
    """The obstacle's place at waypoint k."""
    x, y, vx, vy = (float(SEEN[f"obstacle.{name}"][plan]) for name in ("x", "y", "vx", "vy"))
    return (x, y) if held else (x + k * DT * vx, y + k * DT * vy)


def states(seed):
    return normal(seed, 2, HORIZON, 4, scale=2.0)


# known answers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["distance", "squared"])
@pytest.mark.parametrize("held", [False, True])
def test_an_observed_ball_moves_on_along_its_velocity_unless_it_is_held(tmp_path, form, held):
    hold = ", hold: true" if held else ""
    g = bound(tmp_path, f"{{{BALL}, form: {form}, {VELOCITY}{hold}}}")
    x = states(0)
    for plan in range(2):
        for k in range(HORIZON):
            at = torch.tensor(where(plan, k, held), dtype=F64)
            away = (x[plan, k, :2] - at).norm()
            expected = 1 - away if form == "distance" else 1 - away**2
            torch.testing.assert_close(g(x)[plan, k], expected, atol=1e-12, rtol=1e-12)  # rounding


def test_an_observed_half_space_shifts_by_its_velocity(tmp_path):
    g = bound(
        tmp_path, "{kind: linear, a: {x: 2.0, y: 1.0}, b: obstacle.x, velocity: {x: obstacle.vx}}"
    )
    x = states(1)
    k = torch.arange(HORIZON, dtype=F64)
    expected = (
        2 * x[..., 0]
        + x[..., 1]
        - (SEEN["obstacle.x"][:, None] + 2 * k * DT * SEEN["obstacle.vx"][:, None])
    )
    torch.testing.assert_close(g(x), expected, atol=1e-12, rtol=0)


def test_any_number_of_the_kinds_may_be_observed(tmp_path):
    x = states(2)
    g = bound(tmp_path, "{kind: linear, a: {x: obstacle.vx, y: 1.0}, b: 0.5}")
    torch.testing.assert_close(
        g(x), SEEN["obstacle.vx"][:, None] * x[..., 0] + x[..., 1] - 0.5, atol=1e-12, rtol=0
    )
    radius, place = (
        SEEN["obstacle.radius"][:, None],
        torch.stack((SEEN["obstacle.x"], SEEN["obstacle.y"]), -1)[:, None],
    )
    away = (x[..., :2] - place).norm(dim=-1)
    for form, expected in (("distance", radius - away), ("squared", radius**2 - away**2)):
        g = bound(
            tmp_path,
            f"{{kind: quadratic, side: outside, {CENTRE}, radius: obstacle.radius, form: {form}}}",
        )
        torch.testing.assert_close(g(x), expected, atol=1e-12, rtol=1e-12)
        torch.testing.assert_close(g.tighten(0.1)(x), expected + 0.1, atol=1e-12, rtol=1e-12)
    g = bound(
        tmp_path,
        f"{{kind: quadratic, side: inside, {CENTRE}, semi_axes: {{x: obstacle.radius, y: 2.0}}}}",
    )
    scaled = (x[..., :2] - place) / torch.stack((radius, torch.full_like(radius, 2.0)), -1)
    torch.testing.assert_close(
        g(x), torch.minimum(radius, vec(2.0)) * (scaled.norm(dim=-1) - 1), atol=1e-12, rtol=1e-12
    )
    g = bound(
        tmp_path,
        "{kind: quadratic, side: inside, P: {x: {x: 1.0}}, q: {y: obstacle.vy}, r: obstacle.radius}",
    )
    torch.testing.assert_close(
        g(x),
        x[..., 0] ** 2 + SEEN["obstacle.vy"][:, None] * x[..., 1] - radius,
        atol=1e-12,
        rtol=1e-12,
    )


def test_a_barrier_reads_the_obstacle_of_each_waypoint(tmp_path):
    g = bound(tmp_path, f"{{kind: dcbf, alpha: 0.3, barrier: {{{BALL}}}, {VELOCITY}}}")
    x = states(3)
    h = torch.stack(
        [
            torch.stack(
                [
                    (x[i, k, :2] - torch.tensor(where(i, k), dtype=F64)).norm() - 1
                    for k in range(HORIZON)
                ]
            )
            for i in range(2)
        ]
    )
    torch.testing.assert_close(g(x), 0.7 * h[:, :-1] - h[:, 1:], atol=1e-12, rtol=1e-12)


def test_one_observation_serves_all_plans_and_each_plan_its_own(tmp_path):
    _, g = load(tmp_path, f"{{{BALL}, {VELOCITY}}}")
    x = states(4)
    both = g.bind(SEEN, DT, HORIZON)
    for i in range(2):
        alone = g.bind({name: values[i : i + 1] for name, values in SEEN.items()}, DT, HORIZON)
        torch.testing.assert_close(alone(x)[i], both(x)[i], atol=1e-12, rtol=0)


def test_executed_states_are_scored_each_against_its_own_time(tmp_path):
    _, g = load(tmp_path, f"{{kind: dcbf, alpha: 0.3, barrier: {{{BALL}}}, {VELOCITY}}}")
    level = g.bind(SEEN, DT, 1).parts[0].level
    x = states(5)[:, :1]
    expected = 1 - (
        x[..., :2] - torch.stack((SEEN["obstacle.x"], SEEN["obstacle.y"]), -1)[:, None]
    ).norm(dim=-1)
    torch.testing.assert_close(level(x), expected, atol=1e-12, rtol=0)


# binding ------------------------------------------------------------------------------------------


def test_constraint_that_observes_nothing_binds_to_itself(tmp_path):
    _, g = load(tmp_path, "{name: fixed, kind: linear, a: {x: 1.0}, b: 0.5}", observable=())
    assert g.bind(SEEN, DT, HORIZON) is g
    _, g = load(
        tmp_path, "{name: fixed, kind: linear, a: {x: 1.0}, b: 0.5}", f"{{name: seen, {BALL}}}"
    )
    both = g.bind(SEEN, DT, HORIZON)
    assert both.parts[0] is g.parts[0]
    assert isinstance(g.parts[1], Observed)
    assert both.labels(2) == ["fixed@0", "fixed@1", "seen@0", "seen@1"] == g.labels(2)


CASES = {
    "ball": f"{{{BALL}, {VELOCITY}}}",
    "squared ball": f"{{{BALL}, form: squared, {VELOCITY}}}",
    "barrier": f"{{kind: dcbf, alpha: 0.3, barrier: {{{BALL}}}, {VELOCITY}}}",
    "wall": "{kind: linear, a: {x: 1.0}, b: obstacle.x, velocity: {x: obstacle.vx}}",
}


@pytest.mark.parametrize("case", CASES)
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_operations_before_binding_are_applied_after_it(case, seed, tmp_path_factory):
    kinds, g = load(tmp_path_factory.mktemp("own"), CASES[case])
    now = g.bind(SEEN, DT, HORIZON)
    centre, scale, x = (
        normal(seed, 2, HORIZON, 4),
        normal(seed + 1, HORIZON, 4).abs() + 0.2,
        states(seed + 2),
    )
    for change in (
        lambda c: c.tighten(0.1),
        lambda c: pull_back(c, centre, scale),
        lambda c: pull_back(c.tighten(0.1), centre, scale),
        lambda c: enforced(kinds, c, "segments").tighten(0.1),
        lambda c: Constraint(tuple(part.tighten_level(0.1) for part in c.parts)),
        lambda c: c.select(torch.tensor([1, 0])),
    ):
        torch.testing.assert_close(
            change(g).bind(SEEN, DT, HORIZON)(x), change(now)(x), atol=1e-12, rtol=1e-12
        )


def test_tighten_level_tightens_h_whatever_alpha(tmp_path):
    """A calibrated margin: h >= 0.1 in place of h >= 0."""
    for entry in (CASES["barrier"], CASES["barrier"].replace("alpha: 0.3", "alpha: 0.3, order: 2")):
        _, g = load(tmp_path, entry)
        (part,) = g.parts[0].tighten_level(0.1).bind(SEEN, DT, HORIZON)
        plain = g.bind(SEEN, DT, HORIZON).parts[0]
        x = states(0)
        torch.testing.assert_close(part.level(x), plain.level(x) + 0.1, atol=1e-12, rtol=0)


@pytest.mark.parametrize("safety", ["waypoints", "segments"])
def test_a_moving_ball_is_kept_on_segments_as_a_ball_whatever_its_form(tmp_path, safety):
    kinds, g = load(tmp_path, CASES["squared ball"])
    part = enforced(kinds, g, safety).bind(SEEN, DT, HORIZON).parts[0]
    if safety == "waypoints":
        assert isinstance(part, AtWaypoints)
        assert isinstance(part.level, QuadricInFrame)
    else:
        assert isinstance(part, OnSegments)
        assert isinstance(part.level, Ellipsoid)
        assert part.level.is_ball


def test_a_bound_barrier_is_projected_onto_in_a_window_relative_to_the_present(tmp_path):
    """As the control loop does it: float32, a scale a waypoint, the present state pinned."""
    g = bound(tmp_path, CASES["barrier"], 16)
    scale = torch.linspace(0.05, 0.4, 16, dtype=F64)[:, None].expand(16, 4)
    back = pull_back(g, normal(0, 2, 16, 4), scale).to(torch.zeros(1))
    z = normal(1, 2, 16, 4, scale=3.0).float()
    x = project(back, z, pin(z, 0))
    assert torch.equal(x[:, 0], z[:, 0])
    assert float(back(x).max()) <= 2e-6  # float32


def test_bound_barrier_recovers_from_an_obstacle_that_already_overlaps(tmp_path):
    g = bound(tmp_path, CASES["barrier"])
    x = states(0)
    x[:, 0, :2] = torch.stack((SEEN["obstacle.x"], SEEN["obstacle.y"]), -1) + vec(0.2, 0.1)
    found = project(g, x, pin(x, 0))
    h = -g.parts[0].level(found)
    assert bool((h[:, 0] < 0).all())
    assert (
        float((0.7**4 * h[:, 0] - h[:, 4]).max()) <= 1e-12
    )  # after four waypoints .7^4 of it is left


# mistakes -----------------------------------------------------------------------------------------

MISTAKES = {
    "an unknown quantity": (
        "{kind: linear, a: {x: 1.0}, b: obstacle.z}",
        '3 constraints[0].b: expected a valid number or an observed quantity, found "obstacle.z" (did you mean "obstacle.',
    ),
    "in a barrier": (
        f"{{kind: dcbf, alpha: 0.3, barrier: {{{BALL.replace('obstacle.x', 'ball.x')}}}}}",
        '3 constraints[0].barrier.centre.x: expected a valid number or an observed quantity, found "ball.x"',
    ),
    "in a velocity": (
        f"{{{BALL}, velocity: {{x: speed}}}}",
        '3 constraints[0].velocity.x: expected a valid number or an observed quantity, found "speed"',
    ),
    "a velocity of what is not observed": (
        "{kind: linear, a: {x: 1.0}, b: 1.0, velocity: {x: 0.5}}",
        "3 constraints[0]: `velocity` says how an observed set moves on, and nothing here is observed",
    ),
    "a velocity of another coordinate": (
        f"{{{BALL}, velocity: {{vx: obstacle.vx}}}}",
        '3 constraints[0]: `velocity` moves "vx", on which the set does not depend; it has x, y',
    ),
    "a velocity within the barrier": (
        f"{{kind: dcbf, alpha: 0.3, barrier: {{{BALL}, {VELOCITY}}}}}",
        "3 constraints[0]: `velocity` and `hold` of a barrier stand beside it",
    ),
    "a list for a number": (
        "{kind: linear, a: {x: 1.0}, b: [1.0]}",
        "3 constraints[0].b: expected a valid number",
    ),
    "a negative radius": (
        "{kind: quadratic, side: outside, centre: {x: 0.0}, radius: -1.0}",
        "3 constraints[0].radius: expected greater than 0",
    ),
    "alpha2 of order 1": (
        f"{{kind: dcbf, alpha: 0.3, alpha2: 0.5, barrier: {{{BALL}}}}}",
        "3 constraints[0]: `alpha2` belongs to `order: 2`",
    ),
    "order 3": (
        f"{{kind: dcbf, alpha: 0.3, order: 3, barrier: {{{BALL}}}}}",
        "3 constraints[0].order: expected 1 or 2",
    ),
    "a look-ahead without all rates": (
        f"{{kind: dcbf, alpha: 0.3, look_ahead: {{time: 0.1, velocity: {{x: vx}}}}, barrier: {{{BALL}}}}}",
        "3 constraints[0]: `look_ahead.velocity` must name a rate of its own for each of x, y",
    ),
    "a look-ahead along an unknown coordinate": (
        f"{{kind: dcbf, alpha: 0.3, look_ahead: {{time: 0.1, velocity: {{x: vx, y: vz}}}}, barrier: {{{BALL}}}}}",
        '3 constraints[0].look_ahead.velocity.y: no coordinate "vz" in ball-run',
    ),
    "a look-ahead of a squared barrier": (
        f"{{kind: dcbf, alpha: 0.3, look_ahead: {{time: 0.1, velocity: {{x: vx, y: vy}}}}, barrier: {{{BALL}, form: squared}}}}",
        "3 constraints[0]: `look_ahead` takes a linear barrier or a quadratic one of `form: distance`",
    ),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistake_is_answered_with_file_line_and_field(case, tmp_path):
    entry, start = MISTAKES[case]
    with pytest.raises(SpecError) as caught:
        load(tmp_path, entry)
    assert str(caught.value).startswith(f"{tmp_path / 'own.yaml'}:{start}"), str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_quantities_that_a_task_offers_are_named(tmp_path):
    with pytest.raises(
        SpecError, match=r"ball-run offers obstacle\.x, obstacle\.y, obstacle\.vx, obstacle\.vy"
    ):
        load(tmp_path, "{kind: linear, a: {x: 1.0}, b: wall}")
    with pytest.raises(SpecError, match="maze2d-umaze has no quantities to observe"):
        load(tmp_path, "{kind: linear, a: {x: 1.0}, b: wall}", observable=(), task="maze2d-umaze")


def test_a_quantity_that_was_not_observed_is_named(tmp_path):
    _, g = load(tmp_path, f"{{name: disc, {BALL}}}")
    with pytest.raises(
        CdiffError, match=r'"disc" observes obstacle\.y; what is observed here is obstacle\.x$'
    ):
        g.bind({"obstacle.x": vec(0.0)}, DT, HORIZON)


def test_a_constraint_that_waits_for_observations_has_no_values(tmp_path):
    _, g = load(tmp_path, f"{{name: disc, {BALL}}}")
    x = states(0)
    for use in (g, g.linearise, g.parts[0].segment_max, lambda _: require_bound(g)):
        with pytest.raises(
            CdiffError,
            match=r'"disc" observes obstacle\.x, obstacle\.y, which is known only while acting: use',
        ):
            use(x)
    require_bound(g.bind(SEEN, DT, HORIZON))


# files --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", CASES)
def test_a_recorded_constraint_reads_as_it_was_written(case, tmp_path):
    kinds, g = load(tmp_path, CASES[case])
    content = yaml.safe_load(
        yaml.dump(
            [kind.model_dump(mode="json", exclude_none=True) for kind in kinds], Dumper=Dumper
        )
    )
    again = file_model().model_validate({"task": "ball-run", "constraints": content})
    part = again.constraints[0].compile(LAYOUT)
    x = states(0)
    assert torch.equal(Constraint((part,)).bind(SEEN, DT, HORIZON)(x), g.bind(SEEN, DT, HORIZON)(x))


def test_the_schema_lets_a_name_stand_for_a_number():
    linear = json_schema()["$defs"]["Linear"]["properties"]
    assert {each["type"] for each in linear["b"]["anyOf"]} == {"number", "string"}
    assert {each["type"] for each in linear["a"]["additionalProperties"]["anyOf"]} == {
        "number",
        "string",
    }


def test_description_of_a_moving_set_names_its_velocity(tmp_path):
    (kind,), _ = load(tmp_path, CASES["ball"])
    assert "centre" not in kind.describe()
    assert "x = obstacle.x, y = obstacle.y, radius 1" in kind.describe()
    assert kind.describe().endswith("moving on at obstacle.vx x, obstacle.vy y per second")
    (kind,), _ = load(tmp_path, CASES["ball"].replace("}}", "}, hold: true}"))
    assert kind.describe().endswith("held where it is observed")


def test_dcbf_compiles_to_a_discrete_barrier(tmp_path):
    assert isinstance(bound(tmp_path, CASES["barrier"]).parts[0], DiscreteBarrier)
