"""Training for receding-horizon control, from demonstrations to a checkpoint."""

import pytest
import torch

from cdiff_cli.models.checkpoint import load_checkpoint
from cdiff_cli.models.recipe import DemonstrationSpec, InverseSpec, MlpSpec, TrainSpec, load_recipe
from cdiff_cli.tasks.ball_run.task import BALL_RUN
from cdiff_cli.training.fit import train

TINY = TrainSpec(
    network=MlpSpec(kind="mlp", width=16, depth=1),
    steps=6,
    batch=8,
    smoothness=0,
    bf16=False,
    inverse=InverseSpec(width=8, steps=4),
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """(checkpoint as loaded again, reported steps)."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        changes = {"demonstrations": DemonstrationSpec(steps=1000), "train": {"tiny": TINY}}
        recipe, told, work = (
            load_recipe("ball-run").model_copy(update=changes),
            [],
            tmp_path_factory.mktemp("work"),
        )
        made = train(
            BALL_RUN,
            recipe,
            "tiny",
            seed=0,
            device=torch.device("cpu"),
            work=work,
            on_step=lambda s: told.append((s.what, s.step)),
        )
        return load_checkpoint(made.path, "ball-run"), told


def test_planner_is_trained_before_the_inverse_dynamics(trained):
    assert trained[1] == [("training", k) for k in range(1, 7)] + [
        ("inverse dynamics", k) for k in range(1, 5)
    ]


def test_checkpoint_of_a_control_task_has_frame_and_inverse_dynamics(trained):
    checkpoint = trained[0]
    assert checkpoint.frame is not None
    assert checkpoint.frame.mean.shape == (16, 4)
    assert checkpoint.frame.used.tolist() == [False, True, True, True]
    assert checkpoint.inverse is not None
    assert set(checkpoint.card.inverse) == {"windows", "branches"}
    x = checkpoint.demonstrations.double()
    z = checkpoint.frame.encode(x)
    torch.testing.assert_close(
        checkpoint.frame.at(x[:, 0]).decode(z), x, atol=1e-6, rtol=0
    )  # float32 windows
    u = checkpoint.inverse(x[:, 0].float(), x[:, 1].float())
    assert u.shape == (len(x), 2)
    assert float(u.abs().max()) <= 1.0
