"""Code that runs at every diffusion step or plan sets the device of every tensor.

The tests need no GPU: the default device is `meta`, whose tensors have no values, so that a tensor
without a device cannot be used. Tensors that stay on the host on purpose, such as matrices of the
solvers, are made by a first call.
"""

from pathlib import Path

import pytest
import torch

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.constraints.dynamics import split
from cdiff_cli.constraints.observed import Observed
from cdiff_cli.constraints.pins import Pins
from cdiff_cli.constraints.spec.load import load_constraints
from cdiff_cli.constraints.trajectory import Constraint, pull_back
from cdiff_cli.models.schedule import Schedule
from cdiff_cli.projection.project import project
from cdiff_cli.sampling import make_method
from cdiff_cli.sampling.kernels import ddpm
from cdiff_cli.sampling.sampler import sample
from cdiff_cli.tasks import load_task
from tests.problems import F64, normal

CONSTRAINTS = Path(__file__).parents[2] / "constraints"
FILES = sorted(path.stem for path in CONSTRAINTS.glob("maze2d-umaze*.yaml"))
CPU = torch.device("cpu")


def resolved(file, method):
    file = CONSTRAINTS / f"{file}.yaml"
    return resolve(Request(task="maze2d-umaze", constraints=file, method=method, n=2, steps=4))


def twice(work):
    """The same work, the second time with `meta` as the default device."""
    with torch.inference_mode():
        first = work()
        with torch.device("meta"):
            second = work()
    assert torch.equal(first, second)


@pytest.mark.parametrize(
    "method", ["diffuser", "projected", "primal-dual", "alm", "safediffuser", "terminal"]
)
@pytest.mark.parametrize("file", FILES)
def test_sampling_sets_the_device_of_every_tensor(file, method):
    asked = resolved(file, method)
    problem = asked.problem
    g = pull_back(
        split(problem.enforced)[0], problem.normaliser.centre, problem.normaliser.scale
    ).to(torch.empty(0))
    pins, noise = (
        problem.pins(2, device=CPU),
        normal(0, 5, 2, problem.planner.horizon, 4, scale=0.5).float(),
    )

    def work():
        draws = iter(noise)
        return sample(
            lambda x, _: 0.9 * x,
            problem.planner.schedule,
            asked.method,
            g,
            pins,
            lambda: next(draws),
            kernel=ddpm,
        ).x

    twice(work)


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("dynamics", [True, False])
def test_final_projection_sets_the_device_of_every_tensor(file, dynamics):
    problem = resolved(file, "alm").problem
    g = problem.enforced if dynamics else split(problem.enforced)[0]
    g = pull_back(g, problem.normaliser.centre, problem.normaliser.scale)
    pins = problem.pins(2, F64, CPU)
    z = pins.paint(normal(1, 2, problem.planner.horizon, 4, scale=0.3).cumsum(1) / 8)
    twice(lambda: project(g, z, pins, strict=False))


@pytest.mark.parametrize("method", ["projected", "primal-dual", "alm"])
@pytest.mark.parametrize("task", ["hopper", "swimmer", "ball-run"])
def test_receding_horizon_plans_set_the_device_of_every_tensor(task, method):
    """Discrete barriers over a short window, bound to the observed obstacle of the ball run."""
    made = load_task(task)
    observable = tuple(getattr(made, "observable", ()))
    _, g = load_constraints(
        CONSTRAINTS / f"{task}.yaml", task, made.layout, None, observable, made.dt
    )
    seen = {name: torch.full((2,), 0.5, dtype=F64) for name in observable}
    parts = [
        part.bind(seen, made.dt, 16) if isinstance(part, Observed) else (part,) for part in g.parts
    ]
    g = Constraint(tuple(part for some in parts for part in some)).to(torch.empty(0))
    draws = normal(2, 9, 2, 16, len(made.layout), scale=3.0).float()
    mask = torch.zeros(16, len(made.layout), dtype=torch.bool)
    mask[0] = True
    pins, schedule = Pins(mask, draws[0]), Schedule.cosine(8)

    def work():
        left = iter(draws)
        return sample(
            lambda x, _: 0.9 * x,
            schedule,
            make_method(method, {}),
            g,
            pins,
            lambda: next(left),
            kernel=ddpm,
        ).x

    twice(work)
