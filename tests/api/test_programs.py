"""The three programs of the pages run as printed, on a model and a robot made here."""

import runpy
import sys
from pathlib import Path
from types import ModuleType

import gymnasium
import numpy as np
import pytest
import torch

import cdiff_cli as cdiff

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
PROGRAMS = ("project_trajectories", "any_denoiser", "own_environment")


def run(name, monkeypatch, **modules):
    """The program's variables at its end; modules stand for what the reader brings."""
    for module, values in modules.items():
        brought = ModuleType(module)
        vars(brought).update(values)
        monkeypatch.setitem(sys.modules, module, brought)
    return runpy.run_path(str(HERE / f"{name}.py"))


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_has_at_most_fifteen_lines(name):
    lines = (HERE / f"{name}.py").read_text().splitlines()
    assert len([line for line in lines if line.strip()]) <= 15


def test_trajectories_are_projected_as_arrays(tmp_path, monkeypatch):
    """Straight lines down the right-hand corridor, through the disc at (1.3, 0)."""
    tau = np.linspace(0, 1, 40)
    x = np.zeros((3, 40, 4))
    x[..., 0], x[..., 1] = np.array([[1.2], [1.25], [1.35]]), 1 - 2 * tau
    np.save(tmp_path / "my_trajectories.npy", x)
    (tmp_path / "constraints").symlink_to(ROOT / "constraints")
    monkeypatch.chdir(tmp_path)
    program = run("project_trajectories", monkeypatch)
    y, g = program["y"], program["g"]
    assert isinstance(y, np.ndarray)
    assert (g.worst(x) > 0.1).all()
    assert (g.worst(y) <= 1e-6).all()
    np.testing.assert_array_equal(y[:, [0, -1]], x[:, [0, -1]])
    as_torch = cdiff.project(g.on_segments(), torch.from_numpy(x), program["pins"])
    np.testing.assert_array_equal(as_torch.numpy(), y)


def test_any_denoiser_is_constrained(monkeypatch):
    """A network that predicts the noise of straight lines from (-2, 0) to (2, 0), exactly."""
    steps = 20
    a = np.cos((np.arange(1, steps + 1) / steps + 0.008) / 1.008 * np.pi / 2) ** 2
    a = np.maximum(a, 1e-3) * np.linspace(1, 0.9, steps)
    line = torch.linspace(-2, 2, 64)[:, None] * torch.tensor([1.0, 0.0]) / 3

    def network(x_t, t):
        level = torch.as_tensor(a, dtype=x_t.dtype)[t][:, None, None]
        return (x_t - level.sqrt() * line) / (1 - level).sqrt()

    program = run(
        "any_denoiser", monkeypatch, my_model={"network": network, "alphas_cumprod": a.tolist()}
    )
    plans = program["plans"]
    assert plans.x.shape == (10, 64, 2)
    certificate = cdiff.certify(program["g"], plans.x, ("x", "y"))
    assert certificate.safe
    assert certificate.counts["safe_on_segments"] == 10
    np.testing.assert_allclose(plans.x[:, 0], [[-2, 0]] * 10, atol=1e-6)
    free = cdiff.plan(program["planner"], program["g"], "diffuser", start=(-2, 0), goal=(2, 0))
    assert cdiff.certify(program["g"], free.x, ("x", "y")).counts["safe_at_waypoints"] == 0


class Cart(gymnasium.Env):
    """A cart on a line, v' = v + 0.1 u, and a wall that it observes."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = np.array([0.0, 0.0])
        return self.x.copy(), self.info()

    def info(self):
        return {"wall.x": 1.0}

    def step(self, u):
        self.x = self.x + 0.1 * np.array([self.x[1], float(u[0])])
        return self.x.copy(), 0.0, False, False, self.info()


def test_a_controller_acts_in_a_loop_of_ones_own(monkeypatch):
    """The planner speeds up for ever; the speed limit holds it at half the wall's distance."""
    mean = torch.stack((torch.zeros(6), 0.2 * torch.arange(6.0)), 1)

    def denoiser(z, t):
        return torch.cat((z[:, :1], (z[:, :1] + mean[None, 1:])), 1)

    g = cdiff.make_constraints(
        [{"kind": "linear", "a": {"v": 1.0}, "b": "wall.x"}], ("x", "v"), 0.1, ("wall.x",)
    )
    planner = cdiff.Planner(
        denoiser=denoiser,
        schedule=cdiff.Schedule.cosine(4),
        normaliser=cdiff.Normaliser.from_limits([-1, -1], [1, 1]),
        horizon=6,
        coordinates=("x", "v"),
        dt=0.1,
    )
    env = Cart()
    robot = {
        "env": env,
        "g": g,
        "planner": planner,
        "inverse_dynamics": lambda x, y: (y[:, 1:] - x[:, 1:]) / 0.1,
    }
    program = run("own_environment", monkeypatch, my_robot=robot)
    did = program["did"]
    assert not did.used_fallback.any()
    assert did.predicted_levels.shape == (1, 1)
    assert 0.5 < env.x[1] <= 1.0 + 1e-5
    unconstrained = cdiff.controller(
        planner, g, "diffuser", inverse_dynamics=robot["inverse_dynamics"]
    )
    state, x = unconstrained.init([0]), np.array([0.0, 0.0])
    for _ in range(20):
        u, state, _ = unconstrained.act(state, x, {"wall.x": 1.0})
        x = x + 0.1 * np.array([x[1], u[0, 0]])
    assert x[1] > 2.0


def test_the_shipped_planner_plans_by_three_lines():
    planner = cdiff.load_planner("maze2d-umaze")
    g = cdiff.load_constraints(ROOT / "constraints" / "maze2d-umaze.yaml", planner)
    fast = cdiff.SamplerSettings(steps=8, polish=True)
    plans = cdiff.plan(
        planner, g, seeds=[0, 1], start=(0.32, -1.22, 0, 0), goal=(0.1, 0.9, 0, 0), sampler=fast
    )
    assert cdiff.certify(g, plans.x, planner.coordinates, planner.dt).safe
    assert plans.u.shape == (2, 127, 2)


def test_bad_input_is_refused_in_words():
    g = cdiff.make_constraints([{"kind": "linear", "a": {"x": 1.0}, "b": 0.0}], ("x", "y"))
    with pytest.raises(cdiff.CdiffError, match=r"project: expected x of shape \[n, horizon, dim\]"):
        cdiff.project(g, np.zeros((4, 2)))
    with pytest.raises(cdiff.CdiffError, match=r'constraints.0.a.z: no coordinate "z"'):
        cdiff.make_constraints([{"kind": "linear", "a": {"z": 1.0}, "b": 0.0}], ("x", "y"))
    with pytest.raises(cdiff.CdiffError, match=r"constraints.0"):
        cdiff.make_constraints([{"kind": "lineal"}], ("x", "y"))
    with pytest.raises(cdiff.CdiffError, match='no method "almm"'):
        cdiff.controller(cdiff.load_planner("hopper"), g, "almm")
    with pytest.raises(AttributeError, match="no attribute 'plam'"):
        _ = cdiff.plam


def test_every_public_name_exists_and_is_documented():
    for name in cdiff.__all__:
        value = getattr(cdiff, name)
        assert name in ("__version__", "METHODS") or (value.__doc__ or "").strip(), name
    assert set(dir(cdiff)) >= set(cdiff.__all__)


def test_the_distribution_has_a_version():
    assert cdiff.__version__
