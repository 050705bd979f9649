"""`kind: dynamics` and `safety:` in a constraint file: what they compile to, mistakes, records,
`cdiff check`, `cdiff verify`.
"""

import dataclasses

import numpy as np
import pytest
import torch
import yaml
from rich.console import Console

import cdiff_cli.commands.check
from cdiff_cli.commands.verify import verify_run
from cdiff_cli.constraints.barrier import DiscreteBarrier
from cdiff_cli.constraints.dynamics import LinearDynamics, LinearDynamicsConstraint
from cdiff_cli.constraints.segments import OnSegments
from cdiff_cli.constraints.spec.kinds import Dynamics
from cdiff_cli.constraints.spec.load import enforced, json_schema, load_constraints
from cdiff_cli.constraints.state_sets import Ellipsoid
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.evaluation.certificate import Saved, certificate
from cdiff_cli.evaluation.metrics import rollout_metrics
from cdiff_cli.tasks import load_task
from tests.commands.test_verify import edit, make_run, verify
from tests.constraints.spec.test_load import BALL, LAYOUT, item, write
from tests.problems import refused_at

GIVEN = {
    "kind": "dynamics",
    "name": "ball",
    "A": {
        "x": {"x": 1.0, "vx": 0.5},
        "y": {"y": 1.0, "vy": 0.5},
        "vx": {"vx": 1.0},
        "vy": {"vy": 1.0},
    },
    "B": {"vx": {"right": 1.0}, "vy": {"up": 2.0}},
    "c": {"vy": -0.25},
    "inputs": {"right": [-1.0, 1.0], "up": [0.0, 2.0]},
}
FITTED = LinearDynamics(
    torch.tensor(
        [[1.0, 0, 0.1, 0], [0, 1, 0, 0.1], [0, 0, 0.97, 0], [0, 0, 0, 0.97]], dtype=torch.float64
    ),
    torch.tensor([[0.0, 0], [0, 0], [1 / 3, 0], [0, 0.1]], dtype=torch.float64),
    torch.tensor([0.0, 0.0, 0.1, 2 / 3], dtype=torch.float64),
    torch.tensor([-1.0, -0.7], dtype=torch.float64),
    torch.tensor([1.0, 0.3], dtype=torch.float64),
)


def load(folder, *entries, dynamics=None):
    path = write(folder, yaml.safe_dump({"task": "maze2d-umaze", "constraints": list(entries)}))
    return load_constraints(path, "maze2d-umaze", LAYOUT, dynamics)


# what they compile to -----------------------------------------------------------------------------


def test_given_dynamics_by_hand(tmp_path):
    """From (0, 0, 2, 4) with inputs (1, 0.5): x = 1, y = 2, vx = 3, vy = 4 + 1 - .25; up = -1 is
    beyond its bound 0, by 2 in vy.
    """
    (kind,), g = load(tmp_path, GIVEN)
    x = torch.tensor([[[0, 0, 2, 4], [1, 2, 3, 4.75], [2.5, 4.375, 3, 2.5]]], dtype=torch.float64)
    torch.testing.assert_close(
        g(x), torch.tensor([[0, 2.0]], dtype=torch.float64) - 1e-5, atol=1e-12, rtol=0
    )
    assert g.labels(3) == ["ball@0-1", "ball@1-2"]
    assert (
        kind.describe() == "each step satisfies x' = A x + B u + c, -1 <= right <= 1, 0 <= up <= 2"
    )


def test_tolerance_of_dynamics_is_read_from_the_file(tmp_path):
    _, g = load(tmp_path, GIVEN | {"tolerance": 0.5})
    x = torch.tensor([[[0, 0, 2, 4], [1, 2, 3.5, 4.75]]], dtype=torch.float64)
    torch.testing.assert_close(g(x), torch.tensor([[0.0]], dtype=torch.float64), atol=1e-12, rtol=0)


def test_fit_demonstrations_stands_for_the_checkpoints_dynamics_in_full(tmp_path):
    (kind,), g = load(
        tmp_path, {"kind": "dynamics", "fit": "demonstrations", "tolerance": 0.25}, dynamics=FITTED
    )
    (part,) = g.parts
    assert isinstance(part, LinearDynamicsConstraint)
    assert (kind.name, kind.fit, part.tolerance) == ("dynamics-0", None, 0.25)
    for name, value in vars(FITTED).items():
        assert torch.equal(getattr(part.dynamics, name), value), name
    again = Dynamics.model_validate(
        yaml.safe_load(yaml.safe_dump(kind.model_dump(mode="json", exclude_none=True)))
    ).compile(LAYOUT)
    for name, value in vars(FITTED).items():
        assert torch.equal(getattr(again.dynamics, name), value), name


# mistakes -----------------------------------------------------------------------------------------

A = "A: {x: {x: 1.0}, y: {y: 1.0}, vx: {vx: 1.0}, vy: {vy: 1.0}}"
B = "B: {vx: {right: 1.0}}"
INPUTS = "inputs: {right: [-1.0, 1.0]}"
MISTAKES = {
    "both": (
        item("kind: dynamics", "fit: demonstrations", A, B, INPUTS),
        "4 constraints[1]: found both `fit` and matrices",
    ),
    "both, of matrices c alone": (
        item("kind: dynamics", "fit: demonstrations", "c: {x: 1.0}"),
        "4 constraints[1]: found both",
    ),
    "neither": (
        item("kind: dynamics"),
        "4 constraints[1]: expected `fit: demonstrations`, or A, B and inputs",
    ),
    "no inputs": (
        item("kind: dynamics", A, B),
        "4 constraints[1]: expected `fit: demonstrations`, or A, B and inputs",
    ),
    "another fit": (
        item("kind: dynamics", "fit: data"),
        "5 constraints[1].fit: expected 'demonstrations'",
    ),
    "an input not bounded": (
        item("kind: dynamics", A, "B: {vx: {right: 1.0, up: 1.0}}", INPUTS),
        '4 constraints[1]: B.vx names the input "up", which `inputs` does not bound',
    ),
    "bounds upside down": (
        item("kind: dynamics", A, B, "inputs: {right: [1.0, -1.0]}"),
        "4 constraints[1]: inputs.right: the lowest value, 1, is not below the highest, -1",
    ),
    "bounds that meet": (
        item("kind: dynamics", A, B, "inputs: {right: [1.0, 1.0]}"),
        "4 constraints[1]: inputs.right: the lowest",
    ),
    "one bound": (
        item("kind: dynamics", A, B, "inputs: {right: [1.0]}"),
        "7 constraints[1].inputs.right",
    ),
    "a bound that is no number": (
        item("kind: dynamics", A, B, "inputs:", "  right: [-1.0, wide]"),
        "8 constraints[1].inputs.right",
    ),
    "no tolerance at all": (
        item("kind: dynamics", A, B, INPUTS, "tolerance: 0.0"),
        "8 constraints[1].tolerance: expected greater",
    ),
    "unknown coordinate of x'": (
        item("kind: dynamics", "A: {x: {x: 1.0}}", "B:", "  wx: {right: 1.0}", INPUTS),
        '7 constraints[1].B.wx: no coordinate "wx" in maze2d-umaze',
    ),
    "unknown coordinate of x": (
        item("kind: dynamics", "A:", "  x:", "    vxx: 1.0", B, INPUTS),
        '7 constraints[1].A.x.vxx: no coordinate "vxx" in maze2d-umaze (did you mean "vx"?)',
    ),
    "unknown coordinate of c": (
        item("kind: dynamics", A, B, INPUTS, "c: {z: 1.0}"),
        '8 constraints[1].c.z: no coordinate "z"',
    ),
    "a checkpoint without dynamics": (
        item("name: own", "kind: dynamics", "fit: demonstrations"),
        "6 constraints[1].fit: the checkpoint has no linear dynamics",
    ),
    "an unknown safety": (
        item("kind: linear", "a: {x: 1.0}", "b: 1.0", "safety: everywhere"),
        "7 constraints[1].safety: expected 'waypoints'",
    ),
    "safety of dynamics": (
        item("kind: dynamics", "fit: demonstrations", "safety: segments"),
        "6 constraints[1].safety: no such field here",
    ),
    "no kind": (
        item("name: own"),
        "4 constraints[1]: it has no kind; add `kind: linear` or another",
    ),
    "unknown kind": (
        item("kind: dynamic"),
        '4 constraints[1]: no kind "dynamic" (did you mean "dynamics"?)',
    ),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistake_is_answered_with_file_line_and_field(case, tmp_path):
    refused_at(write(tmp_path, MISTAKES[case][0]), MISTAKES[case][1])


def test_the_schema_knows_dynamics_and_safety():
    schema = json_schema()
    mapping = schema["properties"]["constraints"]["items"]["discriminator"]["mapping"]
    fields = {
        kind: schema["$defs"][ref.removeprefix("#/$defs/")]["properties"]
        for kind, ref in mapping.items()
    }
    assert set(fields["dynamics"]) == {"kind", "name", "fit", "A", "B", "c", "inputs", "tolerance"}
    assert all(
        fields[kind]["safety"]["anyOf"][0]["enum"] == ["waypoints", "segments"]
        for kind in ("linear", "quadratic", "dcbf")
    )


# safety -------------------------------------------------------------------------------------------

DISC = f"{{{BALL}, side: outside}}"
SAFETY = {
    "linear": (
        "{kind: linear, a: {x: 1.0}, b: 1.0}",
        [AtWaypoints],
    ),  # its waypoints' safety is its segments' safety
    "outside a ball": (DISC, [OnSegments]),
    "inside a ball": (DISC.replace("outside", "inside"), [AtWaypoints]),
    "barrier outside a ball": (
        f"{{kind: dcbf, alpha: 0.5, barrier: {DISC}}}",
        [DiscreteBarrier, OnSegments],
    ),
}


@pytest.mark.parametrize("preset", ["waypoints", "segments"])
@pytest.mark.parametrize("own", [None, "waypoints", "segments"])
@pytest.mark.parametrize("case", SAFETY)
def test_safety_in_the_file_overrides_the_preset(case, own, preset, tmp_path):
    entry, on_segments = SAFETY[case]
    kinds, g = load(tmp_path, yaml.safe_load(entry) | ({"safety": own} if own else {}))
    wanted = on_segments if (own or preset) == "segments" else [type(part) for part in g.parts]
    assert [type(part) for part in enforced(kinds, g, preset).parts] == wanted


@pytest.mark.parametrize("preset", ["waypoints", "segments"])
def test_dynamics_are_the_same_whatever_the_safety(preset, tmp_path):
    kinds, g = load(tmp_path, GIVEN, yaml.safe_load(DISC) | {"safety": "waypoints"})
    assert enforced(kinds, g, preset) == g


def test_squared_ball_is_kept_on_segments_as_a_ball(tmp_path):
    kinds, g = load(tmp_path, yaml.safe_load(DISC) | {"form": "squared"})
    (part,) = enforced(kinds, g, "segments").parts
    (ball,) = enforced(*load(tmp_path, yaml.safe_load(DISC)), "segments").parts
    assert isinstance(part, OnSegments)
    assert isinstance(part.level, Ellipsoid)
    for name in ("which", "centre", "axes", "m"):
        torch.testing.assert_close(
            getattr(part.level, name), getattr(ball.level, name), atol=1e-12, rtol=0
        )
    x = torch.randn(50, 1, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 3
    assert torch.equal(part.level(x) > 0, g(x) > 0)


# records and commands -----------------------------------------------------------------------------

STEPS = [
    (0.0, 0.0, 2.0, 4.0),
    (1.0, 2.0, 3.0, 4.75),
    (2.5, 4.375, 2.0, 4.5),
]  # right = 1, -1; up = 0.5, 0
TORN = [STEPS[0], (1.0, 2.0, 3.0, 5.75), (9.0, 9.0, 9.0, 9.0)]


def test_run_that_satisfies_dynamics_is_certified_and_a_torn_one_is_not(tmp_path):
    result = verify(make_run(tmp_path / "whole", STEPS, kinds=(GIVEN,)), code=0)
    assert "1 of 1 plans safe at the waypoints, 1 of 1 between them" in result.stdout
    result = verify(make_run(tmp_path / "torn", STEPS, TORN, kinds=(GIVEN,)), code=1)
    assert "1 of 2 plans safe at the waypoints, 1 of 2 between them" in result.stdout


def test_a_run_of_fitted_dynamics_is_verified_without_its_checkpoint(tmp_path):
    """run.yaml records the matrices that `fit` stood for, to the last bit."""
    fitted = Dynamics.from_dynamics(FITTED, LAYOUT, "fitted").model_dump(
        mode="json", exclude_none=True
    )
    x = FITTED.rollout(
        torch.zeros(1, 4, dtype=torch.float64),
        torch.tensor([[[1.0, 0.3], [-1.0, -0.7]]], dtype=torch.float64),
    )
    run = make_run(tmp_path / "run", x[0].tolist(), kinds=(fitted,))
    kinds, _ = load(
        tmp_path, {"kind": "dynamics", "fit": "demonstrations", "name": "fitted"}, dynamics=FITTED
    )
    assert yaml.safe_load((run / "run.yaml").read_text())["constraints"]["content"] == [
        kind.model_dump(mode="json", exclude_none=True) for kind in kinds
    ]
    verify(run, code=0)
    assert verify_run(run).mismatch == ()
    edit(
        run / "certificate.json", lambda proof: proof["entries"][0]["segments"].update(exact=False)
    )
    assert "entries[0].segments.exact says false, recomputed true" in verify(run, code=1).stdout


def test_dynamics_restrict_no_point_between_waypoints(tmp_path):
    _, g = load(tmp_path, GIVEN)
    task = dataclasses.replace(load_task("maze2d-umaze"))
    proof = certificate(
        task, {"file": "", "content": []}, g, Saved(np.array([STEPS, TORN]), [0, 1], "")
    )
    whole, torn = proof["entries"]
    assert (whole["status"], torn["status"]) == ("safe", "unsafe at waypoints")
    assert (torn["waypoints"]["label"], torn["waypoints"]["tau"]) == ("ball@1-2", 2)
    assert [entry["segments"]["safe"] for entry in proof["entries"]] == [True, False]
    assert all(entry["segments"]["exact"] for entry in proof["entries"])
    assert proof["counts"]["safe_on_segments"] == 1


def test_an_executed_step_that_dynamics_do_not_explain_marks_the_state_it_leads_to(tmp_path):
    _, g = load(tmp_path, GIVEN)
    x = np.array([[*STEPS[:2], (9.0, 9.0, 9.0, 9.0)]])
    (row,) = rollout_metrics(g, x, np.zeros((1, 2)), np.array([True]), np.zeros(1))
    assert row["violation_rate"] == pytest.approx(100 / 3)


@pytest.mark.parametrize(
    "entry", [GIVEN, {"kind": "dynamics", "fit": "demonstrations"}], ids=["given", "fitted"]
)
def test_check_shows_dynamics(entry, tmp_path, monkeypatch):
    shipped = cdiff_cli.commands.check.load_checkpoint
    monkeypatch.setattr(
        cdiff_cli.commands.check,
        "load_checkpoint",
        lambda *words: dataclasses.replace(shipped(*words), dynamics=FITTED),
    )
    load(tmp_path, entry, yaml.safe_load(DISC), dynamics=FITTED)
    out = Console(record=True, width=240)
    cdiff_cli.commands.check.check(tmp_path / "own.yaml", tmp_path / "own.png", out)
    text = out.export_text()
    assert "each step satisfies x' = A x + B u + c" in text
    assert "active set" in text
    assert "127" in text  # one row per step
    assert (tmp_path / "own.png").exists()
