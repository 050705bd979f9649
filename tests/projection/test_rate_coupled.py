"""Limits on several rates together: where they share coordinates, where they contradict each other,
beside dynamics.
"""

import json

import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st

from cdiff_cli.constraints.rate import check_rates
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.errors import InfeasibleError
from cdiff_cli.projection.project import project
from tests.commands.test_cli import cdiff
from tests.commands.test_verify import verify
from tests.constraints.spec.test_load import write
from tests.problems import F64, free_projection, normal, pin, qp_projection
from tests.projection.test_rate import CLOSE, LIMITS, only, quick, rate, seeds


def test_uncoupled_limits_are_projected_to_the_nearest_point():
    z, both = (
        0.3 * normal(0, 2, 20, 2),
        Constraint((LIMITS["upper"], rate(2, (1,), high=0.7, dt=0.1, name="other"))),
    )
    assert all(bool((part(z) > 0).any()) for part in both.parts)
    x = project(both, z, pin(z, 0))
    torch.testing.assert_close(
        x, qp_projection(both, z, pin(z, 0)), atol=1e-6, rtol=0
    )  # ProxQP's own accuracy


def test_order_of_coordinates_does_not_matter():
    z = 0.1 * normal(0, 2, 9, 3)
    named, turned = (
        free_projection(only(rate(3, of, high=0.5, norm=True, dt=0.1)), z)
        for of in ((0, 2), (2, 0))
    )
    torch.testing.assert_close(named, turned, atol=1e-8, rtol=0)


def test_length_limit_and_limit_of_one_coordinate_are_satisfied_at_their_crossing():
    z = torch.tensor([[[0.0, 0.0], [3.0, 4.0]]], dtype=F64)
    x = project(
        Constraint((rate(2, (0, 1), norm=True), rate(2, (0,), high=0.3, name="x"))), z, pin(z, 0)
    )
    torch.testing.assert_close(
        x[0, 1], torch.tensor([0.3, 0.91**0.5], dtype=F64), atol=1e-8, rtol=0
    )


@pytest.mark.parametrize("held", [(), (0,), (0, -1)])
def test_limits_on_the_same_coordinates_agree_with_proxqp(held):
    g = Constraint(
        tuple(
            rate(2, of, high=high, dt=0.1, name=f"{of}")
            for of, high in (((0,), 0.4), ((0,), 0.9), ((1,), 0.5))
        )
    )
    frame = (torch.tensor([0.3, -0.2], dtype=F64), torch.tensor([2.0, 0.5], dtype=F64))
    z = 0.2 * normal(len(held), 2, 12, 2)
    z = 0.3 * z if held == (0, -1) else z
    pins, g = pin(z, *held), pull_back(g, *frame)
    torch.testing.assert_close(
        project(g, z, pins), qp_projection(g, z, pins), atol=1e-6, rtol=0
    )  # ProxQP's


@quick
@given(seed=seeds, horizon=st.sampled_from([2, 5, 40]))
def test_no_trajectory_within_all_limits_is_nearer_than_the_projection_onto_them(seed, horizon):
    """(z - x).(y - x) <= 0 for every y of a convex set."""
    g = Constraint((LIMITS["length"], LIMITS["slew"], LIMITS["upper"]))
    z = 0.1 * normal(seed, 3, horizon, 2)
    x = free_projection(g, z)
    assert float(g(x).max()) <= CLOSE[F64]
    y = free_projection(g, x + 0.1 * normal(seed + 1, 3, horizon, 2))
    assert (
        float(((z - x) * (y - x)).sum((1, 2)).max()) <= 1e-7 * horizon
    )  # each entry within 1e-9, of x and of y, over 0.1


CONTRARY = {
    "bounds": (rate(low=2.0, high=None, name="a"), rate(high=1.0, name="b")),
    "length": (rate(2, (0, 1), norm=True, name="a"), rate(2, (1,), low=1.5, high=None, name="b")),
    "falling": (rate(2, (0, 1), norm=True, name="a"), rate(2, (1,), high=-1.5, name="b")),
}


@pytest.mark.parametrize("kind", CONTRARY)
def test_limits_that_contradict_each_other_are_refused_by_name(kind):
    a, b = CONTRARY[kind]
    z = normal(0, 1, 4, len(a.centre))
    with pytest.raises(
        InfeasibleError,
        match=r'no rate of change is within the limits of both "\w" and "\w"; relax one',
    ):
        free_projection(Constraint((a, b)), z)


def test_limits_that_allow_one_rate_are_no_contradiction():
    check_rates(
        Constraint(
            (
                rate(2, (0, 1), norm=True),
                rate(2, (1,), low=1.0, high=None),
                rate(2, (0,), low=-1.0, high=1.0),
            )
        )
    )


SEVERAL = {
    "around a disc": [
        {
            "name": "disc",
            "kind": "quadratic",
            "side": "outside",
            "centre": {"x": 1.3, "y": 0.0},
            "radius": 0.3,
        },
        {"name": "speed", "kind": "rate", "of": ["x", "y"], "max": 2.9},
        {"name": "sideways", "kind": "rate", "of": "x", "min": -2.5, "max": 2.5},
        {"name": "push", "kind": "rate", "of": ["vx", "vy"], "max": 20.0},
    ],
    "with a chain": [
        {
            "name": "brake",
            "kind": "dcbf",
            "alpha": 0.05,
            "barrier": {"kind": "linear", "a": {"x": 1.0}, "b": 1.45},
        },
        {"name": "speed", "kind": "rate", "of": ["x", "y"], "max": 3.5},
        {"name": "push", "kind": "rate", "of": "vy", "min": -20.0, "max": 20.0},
    ],
}


@pytest.mark.parametrize("kind", SEVERAL)
@pytest.mark.parametrize("option", [(), ("--no-dynamics",)])
def test_several_limits_are_satisfied_with_and_without_dynamics(kind, option, tmp_path):
    """At the shipped start and goal, where most of them bind."""
    path = write(tmp_path, yaml.safe_dump({"task": "maze2d-umaze", "constraints": SEVERAL[kind]}))
    cdiff(
        "plan",
        "--method",
        "alm",
        "--constraints",
        path,
        "--n",
        2,
        "--steps",
        8,
        "--runs",
        tmp_path / "runs",
        *option,
    )
    (run,) = (tmp_path / "runs").iterdir()
    assert {
        entry["status"] for entry in json.loads((run / "certificate.json").read_text())["entries"]
    } == {"safe"}
    verify(run, code=0)
