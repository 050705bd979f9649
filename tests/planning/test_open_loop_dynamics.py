"""Plans under the checkpoint's linear dynamics: what the polish leaves, what is saved, what an execution makes of it."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
import yaml

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.plan import plan_run
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.verify import verify_run
from cdiff_cli.constraints.dynamics import dynamics_of
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import CdiffError, SpecError
from cdiff_cli.evaluation.metrics import hits_wall
from cdiff_cli.models.checkpoint import load_checkpoint, read_safetensors, save_checkpoint
from cdiff_cli.models.preset import SamplerSettings
from cdiff_cli.paths import home
from cdiff_cli.planning.execution import follow
from cdiff_cli.planning.open_loop import plan
from cdiff_cli.planning.polish import polish_plans
from cdiff_cli.planning.problem import check_feasible
from cdiff_cli.projection.project import project_reachable
from cdiff_cli.sampling import make_method
from cdiff_cli.sampling.clean_methods import CleanProjected
from cdiff_cli.tasks.maze2d import UMAZE, Maze2D
from cdiff_cli.tasks.protocol import Tolerances

DISC = {
    "name": "disc",
    "kind": "quadratic",
    "side": "outside",
    "centre": {"x": 1.0, "y": -0.2},
    "radius": 0.2,
}
FITTED = {"name": "ball", "kind": "dynamics", "fit": "demonstrations"}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """The shipped checkpoint with the maze's own dynamics, p' = p + .00998 v + .00238 u, v' = .9976 v + .2382 u."""
    shipped = load_checkpoint(home() / "models" / "maze2d-umaze" / "small.safetensors")
    tensors, _ = read_safetensors(shipped.path, "")
    eye, o, one = torch.eye(2).double(), torch.zeros(2, 2).double(), torch.ones(2).double()
    A = torch.cat((torch.cat((eye, 0.0099762 * eye), 1), torch.cat((o, 0.99762 * eye), 1)))
    B = torch.cat((0.0023816 * eye, 0.23816 * eye))
    made = {"A": A, "B": B, "c": torch.zeros(4).double(), "low": -one, "high": one}
    tensors |= {f"dynamics.{name}": value.contiguous() for name, value in made.items()}
    path = tmp_path_factory.mktemp("checkpoint") / "small.safetensors"
    return save_checkpoint(path, tensors, shipped.card.model_dump(mode="json")).path


@pytest.fixture(scope="module")
def constraints(tmp_path_factory):
    path = tmp_path_factory.mktemp("constraints") / "own.yaml"
    path.write_text(yaml.safe_dump({"task": "maze2d-umaze", "constraints": [DISC, FITTED]}))
    return path


@pytest.fixture(scope="module")
def resolved(checkpoint, constraints):
    return resolve(
        Request(n=2, method="projected", steps=8, checkpoint=checkpoint, constraints=constraints)
    )


@pytest.fixture(scope="module")
def plans(resolved):
    return plan(resolved.problem, resolved.method, resolved.seeds, resolved.preset.sampler)


def test_a_polished_plan_is_what_its_inputs_produce_within_their_bounds(resolved, plans):
    d = dynamics_of(resolved.problem.enforced)[0].dynamics
    assert plans.u.shape == (2, 127, 2)
    x = d.rollout(torch.from_numpy(plans.x[:, 0]), torch.from_numpy(plans.u)).numpy()
    np.testing.assert_allclose(plans.x, x, atol=1e-12)
    assert np.abs(plans.u).max() <= 1.0


def test_a_polished_plan_is_safe_on_its_segments_and_reaches_the_goal(resolved, plans):
    assert float(resolved.problem.enforced(torch.from_numpy(plans.x)).max()) <= 0.0
    np.testing.assert_allclose(plans.x[:, 0], np.tile(resolved.problem.start, (2, 1)), atol=1e-12)
    np.testing.assert_allclose(
        plans.x[:, -1], np.tile(resolved.problem.goal, (2, 1)), atol=UMAZE.tolerances.clearance
    )


def test_without_dynamics_there_are_no_inputs(resolved):
    disc = replace(resolved.problem.enforced, parts=resolved.problem.enforced.parts[:1])
    z = torch.zeros(1, 128, 4, dtype=torch.float64)
    assert polish_plans(replace(resolved.problem, enforced=disc), z)[2] is None


def test_planned_inputs_fed_forward_keep_the_execution_on_the_plan(resolved, plans):
    """A millimetre where no wall is touched; what float32 forces and the simulator's own steps leave is far less."""
    task = resolved.task
    assert not hits_wall(plans.x, [0, 1], task.walls()).any()
    done = follow(task, plans.x, resolved.seeds, hold=5, planned=plans.u)
    np.testing.assert_allclose(done.x[:, :128, :2], plans.x[..., :2], atol=1e-3)
    assert done.success.all()
    assert float(resolved.problem.declared.parts[0](torch.from_numpy(done.x)).max()) <= 0.0


def test_a_goal_out_of_reach_is_missed_in_the_plan_that_is_kept(resolved):
    """From rest to 2 m away in 16 steps: the plan remains one that the inputs make, and its end is where they lead."""
    short = replace(resolved.planner, horizon=16)
    problem = replace(resolved.problem, planner=short)
    z = torch.zeros(1, 16, 4, dtype=torch.float64)
    x, _, u = polish_plans(problem, z)
    x = problem.normaliser.decode(x).numpy()
    assert np.isfinite(x).all()
    assert np.abs(u).max() <= 1.0
    assert np.linalg.norm(x[0, -1, :2] - problem.goal[:2]) > 1.0


def test_a_run_with_fitted_dynamics_saves_its_inputs_and_is_verified_from_its_arrays(
    resolved, checkpoint, tmp_path, monkeypatch
):
    done = plan_run(resolved, tmp_path, lambda *_: None)
    with np.load(done.path / "plan.npz") as arrays:
        assert arrays["u"].shape == (2, 127, 2)
    assert done.counts["safe_on_segments"] == 2
    monkeypatch.setattr(
        "cdiff_cli.models.checkpoint.load_checkpoint", None
    )  # nothing of it is needed
    found = verify_run(done.path)
    assert found.mismatch == ()
    assert found.holds(waypoints_only=False)
    assert {entry["constraint"] for entry in found.recomputed["entries"]} == {"disc", "ball"}


def test_fit_without_dynamics_in_the_checkpoint_is_refused_with_its_line(
    checkpoint, constraints, tmp_path
):
    tensors, _ = read_safetensors(checkpoint, "")
    bare = {name: value for name, value in tensors.items() if not name.startswith("dynamics.")}
    card = load_checkpoint(checkpoint).card.model_dump(mode="json")
    path = save_checkpoint(tmp_path / "small.safetensors", bare, card).path
    with pytest.raises(
        SpecError,
        match=r"own\.yaml:\d+ constraints\[1\]\.fit: the checkpoint has no linear dynamics",
    ):
        resolve(Request(checkpoint=path, constraints=constraints))


def test_a_goal_closer_to_the_boundary_than_the_clearance_is_planned_for(resolved):
    """The goal obeys the constraint by a millimetre, less than what plans keep while they are made."""
    ceiling = torch.tensor(resolved.problem.goal[1] + 1e-3, dtype=torch.float64)
    level = HalfSpace(torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64), ceiling)
    g = Constraint((AtWaypoints("near", level),))
    problem = replace(
        resolved.problem,
        declared=g,
        enforced=Constraint((*g.parts, *dynamics_of(resolved.problem.enforced))),
    )
    for method in (CleanProjected(), make_method("alm", {})):
        plans = plan(problem, method, [0], SamplerSettings(polish=True))
        assert np.abs(plans.x[0, -1] - problem.goal).max() < 1e-3


def test_a_start_closer_to_the_boundary_than_the_clearance_does_not_cost_the_goal(resolved, plans):
    """No plan is 5 mm inside a step after a start that is a millimetre inside: the polish takes one that is inside at all."""
    floor = torch.tensor(1e-3 - resolved.problem.start[1], dtype=torch.float64)
    near = AtWaypoints(
        "near", HalfSpace(torch.tensor([0.0, -1.0, 0.0, 0.0], dtype=torch.float64), floor)
    )
    problem = replace(
        resolved.problem, enforced=Constraint((near, *dynamics_of(resolved.problem.enforced)))
    )
    x, _, u = polish_plans(problem, problem.normaliser.encode(torch.from_numpy(plans.x)))
    x = problem.normaliser.decode(x)
    assert float(near(x).max()) <= 0.0
    assert np.abs(u).max() <= 1.0
    np.testing.assert_allclose(x[:, -1].numpy(), np.tile(problem.goal, (2, 1)), atol=1e-3)


def test_the_trace_counts_the_constraints_as_they_are_scored_and_not_the_dynamics(resolved):
    scored = Constraint(
        tuple(
            part
            for part in resolved.problem.declared.parts
            if part not in dynamics_of(resolved.problem.declared)
        )
    )
    problem = replace(resolved.problem, declared=scored)
    plans = plan(problem, resolved.method, [0])
    noisy = [float(scored(torch.from_numpy(x)).clamp_min(0).sum()) for x in plans.chain[:-1]]
    np.testing.assert_allclose(
        plans.trace[:, 0, 0], noisy, rtol=1e-4, atol=1e-4
    )  # the trace is kept in float32


class Careful(Maze2D):
    """The maze with tolerances of its own."""

    tolerances = Tolerances(position=100.0, clearance=0.05, velocity_weight=0.5)
    footprint = 0.25


@pytest.fixture
def careful(resolved, checkpoint, constraints, monkeypatch):
    """The same problem of that task."""
    task = Careful(**{f.name: getattr(UMAZE, f.name) for f in fields(UMAZE)})
    monkeypatch.setattr("cdiff_cli.commands.resolve.load_task", lambda _: task)
    return resolve(
        Request(n=2, method="projected", steps=8, checkpoint=checkpoint, constraints=constraints)
    )


def test_a_task_weighs_velocities_its_own_way(resolved, careful):
    assert UMAZE.tolerances == Tolerances(position=1e-3, clearance=5e-3, velocity_weight=0.02)
    assert dynamics_of(resolved.problem.enforced)[0].weight.tolist() == [1.0, 1.0, 0.02, 0.02]
    assert dynamics_of(careful.problem.enforced)[0].weight.tolist() == [1.0, 1.0, 0.5, 0.5]


def test_a_task_keeps_its_own_clearance(resolved, careful, plans):
    """A ceiling that the plans cross by 2 cm and less."""
    z = torch.from_numpy(plans.x)
    ceiling = z[..., 1].max() - 0.02
    near = AtWaypoints(
        "near", HalfSpace(torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64), ceiling)
    )
    assert float(near(z).max()) > 0.0
    for kept, clearance in ((resolved, 5e-3), (careful, 0.05)):
        enforced = Constraint((near, *dynamics_of(kept.problem.enforced)))
        problem = replace(kept.problem, enforced=enforced, goal=None)
        x = problem.normaliser.decode(polish_plans(problem, problem.normaliser.encode(z))[0])
        assert float(near(x).max()) == pytest.approx(-clearance, abs=2e-3)


def test_a_task_says_how_near_to_its_pins_a_plan_must_end(resolved, careful, monkeypatch):
    """A goal out of reach: tried with ever finer tolerances, unless the task is content."""
    tolerances = []

    def counted(*words):
        tolerances.append(words[-1])
        return project_reachable(*words)

    monkeypatch.setattr("cdiff_cli.planning.polish.project_reachable", counted)
    z = torch.zeros(1, 16, 4, dtype=torch.float64)
    short = replace(careful.planner, horizon=16)
    polish_plans(replace(careful.problem, planner=short), z)
    assert tolerances == [5e-4]
    polish_plans(replace(resolved.problem, planner=short), z)
    assert tolerances[1:] == [5e-4, 5e-5, 5e-6, 5e-6]


def test_a_start_is_free_where_the_task_has_room_for_its_footprint(resolved, careful):
    """0.2 m from the outer wall on the left, x = -1.5."""
    assert UMAZE.footprint == 0.1
    start, g = np.array([-1.3, 1.0, 0.0, 0.0]), Constraint(())
    check_feasible(replace(resolved.problem, start=start, declared=g), resolved.task)
    with pytest.raises(CdiffError, match="inside a wall or touches one"):
        check_feasible(replace(careful.problem, start=start, declared=g), careful.task)
