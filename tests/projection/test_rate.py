"""`kind: rate`: known answers, gradients, the projection against ProxQP and its KKT conditions,
files, certificates, commands.
"""

import json

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.rate import RateLimit, rate_bounds
from cdiff_cli.constraints.spec.load import json_schema, load_constraints
from cdiff_cli.constraints.trajectory import Constraint, pull_back, stack
from cdiff_cli.errors import CdiffError, InfeasibleError, SpecError
from cdiff_cli.evaluation.metrics import rollout_metrics, unsafe_segments
from cdiff_cli.planning.start_goal import fastest
from cdiff_cli.projection.project import project
from cdiff_cli.projection.rate import RateProjection
from cdiff_cli.sampling.safediffuser import jacobian
from cdiff_cli.tasks import load_task
from tests.commands.test_cli import cdiff
from tests.commands.test_verify import make_run, verify
from tests.constraints.spec.test_load import write
from tests.problems import (
    F64,
    LAYOUT,
    ball,
    free_projection,
    half_space,
    normal,
    pin,
    qp_projection,
    waypoints,
)
from tests.projection.test_segments import segments

quick = settings(max_examples=20, deadline=None)
seeds = st.integers(0, 10_000)
CLOSE = {
    F64: 1e-7,
    torch.float32: 1e-3,
}  # of a rate: copies end within 1e-10 or 1e-6 of the path, over dt = 0.1, relaxed
SLOW = {"name": "slow", "kind": "rate", "of": ["x", "y"], "max": 2.0}
DT = 0.01  # of the mazes


def rate(dim=1, of=(0,), low=None, high=1.0, norm=False, dt=1.0, name="r"):
    one = torch.ones(dim, dtype=F64)
    low, high = rate_bounds(low, high)
    return RateLimit(
        name, torch.eye(dim, dtype=F64)[list(of)], low, high, norm, dt, torch.zeros_like(one), one
    )


def only(part):
    return Constraint((part,))


def line(*values):
    return torch.tensor(values, dtype=F64)[None, :, None]


LIMITS = {
    "slew": rate(2, (1,), low=-0.7, high=0.4, dt=0.1),
    "upper": rate(2, (0,), high=0.4, dt=0.1),
    "length": rate(2, (0, 1), high=0.5, norm=True, dt=0.1),
}


# rows ---------------------------------------------------------------------------------------------


def test_rows_are_rates_above_the_limit_in_units_per_second():
    x = line(0.0, 0.3, 0.1)  # 3 and -2 a second
    torch.testing.assert_close(
        rate(low=-1.0, high=1.0, dt=0.1)(x),
        torch.tensor([[2.0, 1.0]], dtype=F64),
        atol=1e-12,
        rtol=0,
    )
    torch.testing.assert_close(
        rate(high=4.0, dt=0.1)(x), torch.tensor([[-1.0, -6.0]], dtype=F64), atol=1e-12, rtol=0
    )
    p = torch.tensor([[[0.0, 0.0], [0.3, 0.4]]], dtype=F64)
    torch.testing.assert_close(
        LIMITS["length"](p), torch.tensor([[4.5]], dtype=F64), atol=1e-12, rtol=0
    )
    assert rate().labels(3) == ["r@0-1", "r@1-2"]


@pytest.mark.parametrize("kind", LIMITS)
@quick
@given(seed=seeds, horizon=st.integers(2, 6))
def test_pull_of_a_rate_limit_is_its_gradient_in_any_frame(kind, seed, horizon):
    g = pull_back(only(LIMITS[kind]), normal(seed + 2, 2), 0.5 + normal(seed + 3, 2).abs())
    x = normal(seed, 2, horizon, 2).requires_grad_()
    w = normal(seed + 1, 2, horizon - 1)
    rows, pull, _ = g.linearise(x)
    torch.testing.assert_close(rows, g(x), atol=0, rtol=0)
    torch.testing.assert_close(
        pull(w), torch.autograd.grad((g(x) * w).sum(), x)[0], atol=1e-9, rtol=1e-9
    )


@pytest.mark.parametrize("kind", LIMITS)
def test_row_bounds_of_a_rate_limit_bound_the_largest_eigenvalue(kind):
    """Of J J^T, for step sizes; J row by row as the QP of safediffuser takes it."""
    x = normal(0, 1, 7, 2)
    J = jacobian(LIMITS[kind], x)[0].flatten(1)
    assert (
        float(torch.linalg.eigvalsh(J @ J.T).max())
        <= float(LIMITS[kind].linearise(x)[2].max()) + 1e-9
    )


def test_a_margin_narrows_the_limits_and_too_wide_a_one_is_refused():
    part = rate(low=-1.0, high=1.0).tighten(0.4)
    assert (part.low, part.high) == (-0.6, 0.6)
    for narrow in (rate(low=-1.0, high=1.0), rate(high=1.0, norm=True)):
        with pytest.raises(InfeasibleError, match="no rate of change"):
            narrow.tighten(1.5)


# the projection -----------------------------------------------------------------------------------


def test_two_waypoints_too_far_apart_move_equally():
    torch.testing.assert_close(
        free_projection(only(rate(low=-1.0)), line(0.0, 3.0)), line(1.0, 2.0), atol=1e-8, rtol=0
    )


def test_pinned_start_stays_and_later_waypoints_follow():
    z = line(0.0, 3.0, 3.0)
    torch.testing.assert_close(
        project(only(rate()), z, pin(z, 0)), line(0.0, 1.0, 2.0), atol=1e-8, rtol=0
    )


def test_limit_on_a_length_keeps_the_direction():
    z = torch.tensor([[[0.0, 0.0], [3.0, 4.0]]], dtype=F64)
    x = project(only(rate(2, (0, 1), norm=True)), z, pin(z, 0))
    torch.testing.assert_close(x[0, 1], torch.tensor([0.6, 0.8], dtype=F64), atol=1e-8, rtol=0)


@pytest.mark.parametrize("held", [(), (0,), (0, -1), (3,)])
@pytest.mark.parametrize("bounds", [(-0.7, 0.4), (None, 0.4), (-0.3, None)])
def test_limits_on_one_coordinate_agree_with_proxqp(held, bounds):
    """In a frame whose coordinates have different scales, as projections are used."""
    both = (
        Constraint((rate(2, (1,), low=bounds[0], high=bounds[1], dt=0.1),))
        if None in bounds
        else None
    )
    part = rate(2, (1,), low=bounds[0], high=bounds[1], dt=0.1)
    g = both or stack(
        [
            only(rate(2, (1,), high=bounds[1], dt=0.1)),
            only(rate(2, (1,), low=bounds[0], high=None, dt=0.1, name="l")),
        ]
    )
    frame = (torch.tensor([0.3, -0.2], dtype=F64), torch.tensor([2.0, 0.5], dtype=F64))
    z = 0.2 * normal(len(held), 2, 12, 2)
    z[:, :, 1] *= 0.3 if held == (0, -1) else 1.0
    pins = pin(z, *held)
    close = project(pull_back(only(part), *frame), z, pins)
    torch.testing.assert_close(
        close, qp_projection(pull_back(g, *frame), z, pins), atol=1e-6, rtol=0
    )  # ProxQP's


@quick
@given(seed=seeds, horizon=st.sampled_from([2, 3, 12, 60]), scale=st.sampled_from([0.02, 0.1, 1.0]))
def test_projection_onto_a_length_limit_satisfies_the_kkt_conditions(seed, horizon, scale):
    """x - z = D^T m, each m along its difference, not against it, and nothing where the limit is
    not reached.
    """
    part, z = LIMITS["length"], scale * normal(seed, 3, horizon, 2)
    x = free_projection(only(part), z)
    assert float(part(x).max()) <= CLOSE[F64]
    m = (x - z).cumsum(1)
    assert float(m[:, -1].abs().max()) <= 1e-7 * scale  # the sum of D^T m is nothing
    m, d = m[:, :-1], x.diff(dim=1)
    length = d.norm(dim=-1)
    along = (m * d).sum(-1) / length.clamp_min(1e-12)
    reached = part(x) >= -1e-6
    assert (
        float(m[~reached].abs().max() if bool((~reached).any()) else 0.0) <= 1e-5 * scale * horizon
    )
    torch.testing.assert_close(
        along[reached], m.norm(dim=-1)[reached], atol=1e-5 * scale * horizon, rtol=0
    )


@pytest.mark.parametrize("kind", LIMITS)
@quick
@given(
    seed=seeds, horizon=st.sampled_from([1, 2, 3, 40]), dtype=st.sampled_from([F64, torch.float32])
)
def test_projection_onto_rate_limits_is_feasible_and_idempotent(kind, seed, horizon, dtype):
    z = (0.1 * normal(seed, 2, horizon, 2)).to(dtype)
    g = only(LIMITS[kind]).to(z)
    x = free_projection(g, z)
    assert (x.dtype, x.shape) == (dtype, z.shape)
    assert horizon == 1 or float(g(x).max()) <= CLOSE[dtype]
    torch.testing.assert_close(free_projection(g, x), x, atol=CLOSE[dtype], rtol=0)


def test_slow_path_is_unchanged_to_the_bit():
    z = 1e-3 * normal(0, 4, 9, 2)
    assert torch.equal(free_projection(only(LIMITS["length"]), z), z)
    assert free_projection(only(LIMITS["length"]), z[:0]).shape == (0, 9, 2)


def test_rate_limit_in_a_frame_per_plan_equals_each_plan_alone():
    z, scale = 0.1 * normal(0, 3, 6, 2), 0.5 + normal(1, 3, 1, 2).abs()
    part = LIMITS["slew"].pull_back(torch.zeros(3, 1, 2, dtype=F64), scale)
    x = free_projection(only(part), z)
    for b in range(3):
        alone = free_projection(
            only(LIMITS["slew"].pull_back(torch.zeros(2, dtype=F64), scale[b, 0])), z[b : b + 1]
        )
        torch.testing.assert_close(x[b : b + 1], alone, atol=1e-8, rtol=0)


def test_warm_started_projection_ends_at_the_same_point():
    z, part = 0.1 * normal(0, 2, 30, 2), LIMITS["length"]
    slowed = RateProjection([part], Pins.none(z))
    slowed(z + 0.01 * normal(1, 2, 30, 2))
    torch.testing.assert_close(slowed(z), free_projection(only(part), z), atol=1e-8, rtol=0)


def test_disc_wall_and_rate_limit_are_satisfied_together():
    s = torch.linspace(-2, 2, 41, dtype=F64)
    z = torch.stack((s, 0.2 + 0 * s), -1)[None]
    g = stack(
        [
            segments(ball("outside", centre=(0.0, 0.0), radius=0.5)),
            waypoints(half_space((0.0, 1.0), 0.9), "wall"),
        ]
    )
    around = project(g, z, pin(z, 0, 40))
    limit = rate(2, (0, 1), high=0.115, norm=True)
    assert float(limit(around).max()) > 0
    both = stack([g, only(limit)])
    x = project(both, z, pin(z, 0, 40))
    assert float(both(x).max()) <= 1e-7  # what project promises
    assert torch.equal(x[:, [0, -1]], z[:, [0, -1]])


def test_pinned_ends_that_the_limit_cannot_join_are_refused_by_name():
    z = line(0.0, 0.0, 3.0)
    with pytest.raises(
        InfeasibleError,
        match=r'"r" excludes the pinned waypoints 0 and 2: .* takes a mean rate of 1.5 .* limit is 1',
    ):
        project(only(rate()), z, pin(z, 0, 2))
    with pytest.raises(InfeasibleError, match=r"mean rate of -1.5 .* limit is -1"):
        project(only(rate(low=-1.0)), -z, pin(-z, 0, 2))


# files --------------------------------------------------------------------------------------------


def load(folder, entry):
    return load_constraints(
        write(folder, yaml.safe_dump({"task": "maze2d-umaze", "constraints": [entry]})),
        "maze2d-umaze",
        LAYOUT,
        dt=DT,
    )


def test_a_list_limits_the_length_and_a_name_the_signed_change(tmp_path):
    (kind,), g = load(tmp_path, SLOW)
    assert (kind.dt, kind.describe()) == (DT, "|rate of x, y| <= 2 per second between waypoints")
    x = torch.tensor([[[0.0, 0, 0, 0], [0.03, 0.04, 9, 9]]], dtype=F64)
    torch.testing.assert_close(g(x), torch.tensor([[3.0]], dtype=F64), atol=1e-12, rtol=0)
    (kind,), g = load(tmp_path, {"kind": "rate", "of": "vx", "min": -5.0, "max": 3.0})
    assert kind.describe() == "-5 <= rate of vx <= 3 per second between waypoints"
    torch.testing.assert_close(g(x), torch.tensor([[897.0]], dtype=F64), atol=1e-9, rtol=0)
    (kind,), _ = load(tmp_path, {"kind": "rate", "of": "vx", "min": -5.0})
    assert kind.describe() == "-5 <= rate of vx per second between waypoints"
    assert "RateSpec" in json_schema()["$defs"]


@pytest.mark.parametrize(
    ("entry", "complaint"),
    [
        ("{kind: rate, of: vx}", "expected `min`, `max` or both"),
        ("{kind: rate, of: vx, min: 2.0, max: 1.0}", "min, 2, is not below max, 1"),
        ("{kind: rate, of: [x, y]}", "expected `max` above 0 and no `min`"),
        ("{kind: rate, of: [x, y], max: -1.0}", "expected `max` above 0 and no `min`"),
        ("{kind: rate, of: [x, y], min: 0.0, max: 1.0}", "expected `max` above 0 and no `min`"),
        ("{kind: rate, of: [x, x], max: 1.0}", "`of` names a coordinate twice"),
        ("{kind: rate, of: [x, z], max: 1.0}", 'no coordinate "z" in maze2d-umaze'),
        ("{kind: rate, of: vz, max: 1.0}", 'no coordinate "vz" in maze2d-umaze'),
        (
            "{kind: rate, of: vx, max: 1.0, dt: 0.5}",
            "the waypoints of maze2d-umaze are 0.01 s apart; leave `dt` out",
        ),
    ],
)
def test_mistake_in_a_rate_is_one_line_with_its_place(entry, complaint, tmp_path):
    path = write(tmp_path, f"task: maze2d-umaze\nconstraints:\n  - {entry}\n")
    with pytest.raises(SpecError) as caught:
        load_constraints(path, "maze2d-umaze", LAYOUT, dt=DT)
    assert str(caught.value).startswith(f"{path}:3 constraints[0]")
    assert complaint in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_waypoints_that_are_not_in_time_have_no_rate(tmp_path):
    path = write(
        tmp_path, "task: gaussian2d\nconstraints:\n  - {kind: rate, of: [x, y], max: 1.0}\n"
    )
    with pytest.raises(SpecError, match="not in time"):
        load_constraints(path, "gaussian2d", ("x", "y"))


def test_rate_limit_is_refused_for_a_receding_horizon_task(tmp_path):
    layout = load_task("hopper").layout
    path = write(
        tmp_path, f"task: hopper\nconstraints:\n  - {{kind: rate, of: {layout[0]}, max: 1.0}}\n"
    )
    with pytest.raises(CdiffError, match="`kind: rate` is for whole plans"):
        resolve(Request(task="hopper", constraints=path))


# certificates, metrics ----------------------------------------------------------------------------

STILL, FAST = (
    [(0.0, 0.0, 0, 0), (0.01, 0.0, 0, 0), (0.02, 0.01, 0, 0)],
    [(0.0, 0.0, 0, 0), (0.01, 0.0, 0, 0), (0.04, 0.04, 0, 0)],
)


def test_the_certificate_names_the_worst_segment_and_is_exact(tmp_path):
    run = make_run(tmp_path / "run", STILL, FAST, kinds=(SLOW,))
    slow, fast = json.loads((run / "certificate.json").read_text())["entries"]
    assert (slow["status"], fast["status"]) == ("safe", "unsafe at waypoints")
    assert fast["waypoints"]["label"] == "slow@1-2"
    assert (fast["segments"]["segment"], fast["segments"]["time"], fast["segments"]["exact"]) == (
        1,
        0.01,
        True,
    )
    assert abs(fast["segments"]["worst"] - 3.0) <= 1e-9
    verify(run, code=1)
    verify(make_run(tmp_path / "slow", STILL, kinds=(SLOW,)), code=0)


def test_metrics_count_only_steps_that_are_too_fast(tmp_path):
    _, g = load(tmp_path, SLOW)
    x = np.array([[*FAST, (0.05, 0.04, 0, 0)]], dtype=np.float64)
    assert unsafe_segments(g, x).tolist() == [1.0]
    (row,) = rollout_metrics(g, x, np.zeros((1, 3)), np.array([True]), np.zeros(1))
    assert (row["safe_executed"], row["violation_rate"]) == (0.0, 25.0)


# commands -----------------------------------------------------------------------------------------


def test_a_plan_under_a_speed_limit_obeys_it_and_verifies(tmp_path):
    cdiff(
        "plan",
        "--method",
        "alm",
        "--constraints",
        "constraints/maze2d-umaze-rate.yaml",
        "--n",
        2,
        "--steps",
        8,
        "--runs",
        tmp_path,
    )
    (run,) = tmp_path.iterdir()
    x = np.load(run / "plan.npz")["x"]
    assert np.linalg.norm(np.diff(x[..., :2], axis=1), axis=-1).max() / DT <= 2.5
    verify(run, code=0)


def test_check_describes_a_rate(tmp_path):
    out = cdiff(
        "check", "constraints/maze2d-umaze-rate.yaml", "--picture", tmp_path / "check.png"
    ).stdout
    assert "ADMM" in out
    assert "127" in out  # one row per segment


def test_pinned_ends_too_far_apart_end_in_one_line(tmp_path):
    path = write(
        tmp_path,
        "task: maze2d-umaze\nconstraints:\n  - {name: slow, kind: rate, of: [x, y], max: 0.5}\n",
    )
    line = cdiff(
        "plan", "--method", "alm", "--constraints", path, "--runs", tmp_path / "runs", code=2
    ).stderr.strip()
    assert line.startswith('error: "slow" excludes the pinned waypoints 0 and 127')
    assert not (tmp_path / "runs").exists()


def test_random_pairs_can_be_joined_within_the_speed_limit(tmp_path):
    task = load_task("maze2d-umaze")
    _, g = load(tmp_path, SLOW)
    assert fastest(task, g) == 2.0
    assert fastest(task, only(rate(4, (2,)))) == float("inf")
