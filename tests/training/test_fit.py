"""Training that resumes to the same bits, and checkpoints whose cards are checked."""

import hashlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import load_file

import cdiff_cli.machine
import cdiff_cli.models.checkpoint
import cdiff_cli.training.state
import cdiff_cli.training.system_identification
from cdiff_cli.errors import CdiffError, CheckpointError
from cdiff_cli.machine import choose_device
from cdiff_cli.models.checkpoint import (
    Checkpoint,
    card_path,
    install,
    load_checkpoint,
    read_safetensors,
    save_checkpoint,
)
from cdiff_cli.models.recipe import (
    Card,
    DemonstrationSpec,
    NetworkSpec,
    Recipe,
    TrainSpec,
    load_recipe,
)
from cdiff_cli.tasks import load_task
from cdiff_cli.tasks.maze2d import UMAZE
from cdiff_cli.training.data_statistics import data_statistics
from cdiff_cli.training.fit import train
from cdiff_cli.training.windows import end_pins
from cdiff_cli.yaml_files import load

MODELS = Path(__file__).parents[2] / "models"
SHIPPED = sorted(MODELS.glob("*/small.safetensors"))
BASES = sorted(MODELS.glob("*/plain.safetensors"))
CPU = torch.device("cpu")
TINY = TrainSpec(
    network=NetworkSpec(width=8, multipliers=(1, 2)), steps=8, batch=4, accumulate=2, bf16=False
)  # bf16 is emulated, slowly, on many CPUs


@pytest.fixture(scope="module", autouse=True)
def own_minari(tmp_path_factory):
    """A Minari folder for this file, with one small set of demonstrations for all its tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        yield


def recipe(spec: TrainSpec = TINY, horizon: int = 32, n_steps: int = 16) -> Recipe:
    changes = {
        "horizon": horizon,
        "n_steps": n_steps,
        "demonstrations": DemonstrationSpec(steps=4000),
        "train": {"tiny": spec},
    }
    return load_recipe("maze2d-umaze").model_copy(update=changes)


def fit(
    work: Path, spec: TrainSpec = TINY, seed: int = 0, horizon: int = 32, n_steps: int = 16, **more
) -> Checkpoint:
    return train(
        UMAZE, recipe(spec, horizon, n_steps), "tiny", seed=seed, device=CPU, work=work, **more
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Checkpoint:
    """An uninterrupted training."""
    return fit(tmp_path_factory.mktemp("whole"))


def same(a: Path, b: Path) -> bool:
    ours, theirs = load_file(a), load_file(b)
    return ours.keys() == theirs.keys() and all(
        torch.equal(ours[name], theirs[name]) for name in ours
    )


def stop_at(step: int, error: type[BaseException] = KeyboardInterrupt):
    def on_step(status):
        if status.step == step:
            raise error

    return on_step


# resuming -----------------------------------------------------------------------------------------


def test_training_repeats_with_its_seed_and_differs_with_another(whole, tmp_path):
    assert same(fit(tmp_path / "again").path, whole.path)
    assert not same(fit(tmp_path / "other", seed=1).path, whole.path)


@pytest.mark.parametrize(
    ("step", "error"), [(1, KeyboardInterrupt), (5, ValueError), (8, KeyboardInterrupt)]
)
def test_interrupted_training_resumes_to_the_same_bits(whole, step, error, tmp_path):
    with pytest.raises(error):
        fit(tmp_path, on_step=stop_at(step, error))
    assert not (tmp_path / "model.safetensors").exists()
    resumed = fit(tmp_path, resume=True)
    assert same(resumed.path, whole.path)
    assert same(tmp_path / "state.safetensors", whole.path.with_name("state.safetensors"))
    assert (resumed.card.loss, resumed.card.mse, resumed.card.steps) == (
        whole.card.loss,
        whole.card.mse,
        8,
    )


@pytest.mark.parametrize(
    ("place", "save_every"),
    [
        ("cdiff_cli.training.state.training_loss", 500),
        ("torch.nn.utils.clip_grad_norm_", 500),
        ("torch.optim.Adam.step", 2),
    ],
)
def test_interruption_within_a_step_resumes_to_the_same_bits(whole, place, save_every, tmp_path):
    """Ctrl-C nearly always comes after the random draws of a step and before its update is done."""
    module, _, name = place.rpartition(".")
    owner = {
        "cdiff_cli.training.state": cdiff_cli.training.state,
        "torch.nn.utils": torch.nn.utils,
        "torch.optim.Adam": torch.optim.Adam,
    }[module]
    original, calls = getattr(owner, name), []

    def interrupted(*args, **kwargs):
        result = original(*args, **kwargs)
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return result

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(owner, name, interrupted)
        with pytest.raises(KeyboardInterrupt):
            fit(tmp_path, save_every=save_every)
    assert same(fit(tmp_path, resume=True).path, whole.path)


def test_state_is_saved_every_so_many_steps(tmp_path):
    saved = []
    fit(
        tmp_path,
        save_every=3,
        on_step=lambda status: saved.append(
            (status.step, (tmp_path / "state.safetensors").exists())
        ),
    )
    assert saved == [(step, step > 3) for step in range(1, 9)]


REFUSED = {
    "seed": {"seed": 1},
    "horizon": {"horizon": 64},
    "n_steps": {"n_steps": 8},
    "spec": {"spec": TINY.model_copy(update={"steps": 9})},
}


@pytest.mark.parametrize("field", REFUSED)
def test_resuming_with_another(field, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        fit(tmp_path, on_step=stop_at(2))
    with pytest.raises(CheckpointError, match=f"state.safetensors: its {field} is .*--resume"):
        fit(tmp_path, resume=True, **REFUSED[field])


def test_resuming_without_or_with_a_damaged_state_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match=r"no such checkpoint; .*--resume"):
        fit(tmp_path, resume=True)
    (tmp_path / "state.safetensors").write_bytes(b"half a file")
    with pytest.raises(CheckpointError, match=r"damaged or not a checkpoint.*--resume"):
        fit(tmp_path, resume=True)


# fitting ------------------------------------------------------------------------------------------


def test_loss_decreases(tmp_path):
    losses = []
    spec = TINY.model_copy(
        update={
            "steps": 25,
            "accumulate": 1,
            "batch": 8,
            "schedule": "constant",
            "learning_rate": 5e-3,
        }
    )
    fit(tmp_path, spec, on_step=lambda status: losses.append(status.loss))
    assert np.mean(losses[-5:]) < 0.7 * np.mean(losses[:5])


def test_nan_loss_is_an_error(tmp_path, monkeypatch):
    nan = torch.tensor(float("nan"), requires_grad=True)
    monkeypatch.setattr(cdiff_cli.training.state, "training_loss", lambda *_: (nan, nan.detach()))
    with pytest.raises(
        CdiffError, match="the loss is nan at step 0: training diverged; lower learning_rate"
    ):
        fit(tmp_path)


def test_unknown_size_error_names_the_closest(tmp_path):
    with pytest.raises(
        CdiffError, match=r'no recipe "tinny" \(did you mean "tiny"\?\); maze2d-umaze has tiny'
    ):
        train(UMAZE, recipe(), "tinny", seed=0, device=CPU, work=tmp_path)


def test_only_the_whole_first_and_last_state_are_pinned():
    assert end_pins(4, 2).tolist() == [[True, True], [False, False], [False, False], [True, True]]


@pytest.mark.parametrize("name", ["cuda:99", "toaster"])
def test_unusable_device_is_an_error_with_advice(name):
    with pytest.raises(
        CdiffError, match=f'device "{name}" cannot be used here: .*; try --device cpu'
    ):
        choose_device(name)


def test_usable_devices_are_chosen():
    assert choose_device("cpu") == CPU
    assert choose_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")


def test_data_statistics_by_hand():
    n = np.arange(6.0)[:, None]
    steady = np.hstack((0.02 * n, 0 * n, 0 * n + 2.0, 0 * n))  # 2 m/s in x, dt 0.01
    facts = data_statistics(UMAZE, [steady, steady[:2]], horizon=4)
    assert facts["jump_q999"] == facts["jump_max"] == 0.02
    assert facts["acceleration_max"] == 0.0
    assert facts["speed_q50"] == facts["speed_q95"] == facts["speed_max"] == 2.0


def test_episodes_shorter_than_a_window_do_not_count_for_the_speeds():
    n = np.arange(6.0)[:, None]
    steady = np.hstack((0.02 * n, 0 * n, 0 * n + 2.0, 0 * n))
    facts = data_statistics(UMAZE, [steady, *[steady[:2]] * 20], horizon=4)
    assert facts["speed_q50"] == 2.0


# checkpoints --------------------------------------------------------------------------------------


def copy(checkpoint: Checkpoint, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "small.safetensors"
    path.write_bytes(checkpoint.path.read_bytes())
    card_path(path).write_bytes(card_path(checkpoint.path).read_bytes())
    return path


def test_card_describes_the_checkpoint(whole):
    card = whole.card
    assert (card.task, card.recipe, card.horizon, card.n_steps, card.seed, card.steps) == (
        "maze2d-umaze",
        "tiny",
        32,
        16,
        0,
        8,
    )
    assert card.network == TINY.network
    assert card.parameters == sum(p.numel() for p in whole.net.parameters())
    assert card.dataset == "cdiff/maze2d-umaze-v0"
    assert card.weights_sha256 == hashlib.sha256(whole.path.read_bytes()).hexdigest()
    assert load(card_path(whole.path), Card) == card


def test_checkpoint_round_trips(whole, tmp_path):
    path = copy(whole, tmp_path)
    again = load_checkpoint(path, "maze2d-umaze")
    x = torch.linspace(-1, 1, 2 * 32 * 4).reshape(2, 32, 4)
    t = torch.tensor([1.0, 9.0])
    assert torch.equal(again.net(x, t), whole.net(x, t))
    assert torch.equal(again.normaliser.centre, whole.normaliser.centre)
    assert torch.equal(again.normaliser.scale, whole.normaliser.scale)
    assert torch.equal(again.demonstrations, whole.demonstrations)
    assert again.demonstrations.shape[1:] == (32, 4)
    assert not any(p.requires_grad for p in again.net.parameters())
    tensors, _ = read_safetensors(path, "")
    saved = save_checkpoint(
        tmp_path / "twice.safetensors", tensors, again.card.model_dump(mode="json")
    )
    assert saved.card == again.card


def test_demonstrations_in_the_checkpoint_are_in_the_maze(whole):
    points = whole.demonstrations[..., :2].double().reshape(-1, 2).numpy()
    assert np.abs(points).max() < 1.5  # the umaze's free cells


def test_no_partial_file_stays_beside_a_checkpoint(whole):
    names = {path.name for path in whole.path.parent.iterdir()}
    assert names == {"model.safetensors", "model.card.yaml", "state.safetensors"}


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def alter(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)


def lose_card(path: Path) -> None:
    card_path(path).unlink()


def lose(path: Path) -> None:
    path.unlink()


def damage_honestly(path: Path) -> None:
    """A file that is no safetensors, with a card of the right hash."""
    path.write_bytes(b"not safetensors")
    card = yaml.safe_load(card_path(path).read_text())
    card["weights_sha256"] = hashlib.sha256(b"not safetensors").hexdigest()
    card_path(path).write_text(yaml.safe_dump(card))


HARM = {
    truncate: r"small\.safetensors: truncated or altered: sha256 .* restore it, or train one",
    alter: r"small\.safetensors: truncated or altered: sha256 .* restore it, or train one",
    lose_card: r"small\.card\.yaml: the checkpoint's card is missing; train one",
    lose: r"small\.safetensors: no such checkpoint; train one",
    damage_honestly: r"small\.safetensors: damaged or not a checkpoint .*; train one",
}


@pytest.mark.parametrize("harm", HARM, ids=lambda harm: harm.__name__)
def test_damaged_checkpoint_is_refused_with_advice(harm, whole, tmp_path):
    path = copy(whole, tmp_path)
    harm(path)
    with pytest.raises(CheckpointError, match=HARM[harm]) as caught:
        load_checkpoint(path, "maze2d-umaze")
    assert "`cdiff train --task maze2d-umaze`, or name another with --checkpoint" in str(
        caught.value
    )


def test_checkpoint_of_another_task_is_refused_with_advice(whole):
    message = (
        "a checkpoint of maze2d-umaze, asked for was maze2d-large; "
        "train one with `cdiff train --task maze2d-large`"
    )
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(whole.path, "maze2d-large")


def test_install_keeps_the_previous_checkpoint(whole, tmp_path, monkeypatch):
    monkeypatch.setattr(cdiff_cli.models.checkpoint, "home", lambda: tmp_path)
    folder = tmp_path / "models" / "maze2d-umaze"
    folder.mkdir(parents=True)
    target = install(whole)
    assert target == folder / "tiny.safetensors"
    assert {path.name for path in folder.iterdir()} == {"tiny.safetensors", "tiny.card.yaml"}
    other = fit(tmp_path / "work", seed=1)
    install(other)
    assert load_checkpoint(target).card.seed == 1
    assert load_checkpoint(folder / "tiny.previous.safetensors").card == whole.card
    assert same(target, other.path)
    assert len(list(folder.iterdir())) == 4


@pytest.mark.parametrize(
    "path", [*SHIPPED, *BASES], ids=lambda path: f"{path.parent.name}-{path.stem}"
)
def test_shipped_checkpoint_loads_is_small_and_matches_its_card(path):
    checkpoint = load_checkpoint(path, path.parent.name)
    own = load(path.parent / "recipe.yaml", Recipe)
    assert path.stat().st_size <= 10 * 2**20
    assert checkpoint.card.weights_sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert (checkpoint.card.horizon, checkpoint.card.n_steps) == (own.horizon, own.n_steps)
    assert checkpoint.card.network == own.train[path.stem].network
    assert bool(checkpoint.card.returns) == bool(own.train[path.stem].returns)
    base = own.train[path.stem].begin
    assert (
        base is None
        or load_checkpoint(path.with_name(f"{base}.safetensors")).card.data_sha256
        == checkpoint.card.data_sha256
    )
    assert checkpoint.demonstrations.shape[1:] == (
        own.horizon,
        len(load_task(path.parent.name).layout),
    )
    assert all(p.isfinite().all() for p in checkpoint.net.parameters())


def test_checkpoints_are_shipped_for_every_task_that_is_trained():
    trained = sorted(
        path.parent.name for path in MODELS.glob("*/recipe.yaml") if load(path, Recipe).train
    )
    assert [path.parent.name for path in SHIPPED] == trained


def test_commit_is_none_without_git(monkeypatch):
    def missing(*_, **__):
        raise FileNotFoundError("git")

    monkeypatch.setattr(
        cdiff_cli.machine, "subprocess", SimpleNamespace(run=missing, CalledProcessError=OSError)
    )
    assert cdiff_cli.machine.git_commit() == "none"


def test_loading_a_checkpoint_does_not_change_the_global_generator(whole):
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    load_checkpoint(whole.path)
    assert torch.equal(torch.rand(2), expected)


def test_dynamics_that_explain_too_little_are_not_saved(monkeypatch, tmp_path):
    """The card still says how much they explain."""
    module = cdiff_cli.training.system_identification
    fitted = module.fit
    monkeypatch.setattr(module, "fit", lambda *data: (fitted(*data)[0], 0.98))
    checkpoint = fit(tmp_path)
    assert checkpoint.dynamics is None
    assert checkpoint.card.linear == 0.98


def test_maze_checkpoint_has_dynamics(whole):
    assert whole.dynamics is not None
    assert whole.card.linear > 0.99


# recipes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("network", "complaint"),
    [
        ("{width: 20}", "multiple of 8"),
        ("{multipliers: []}", "at least 1 item"),
        ("{multipliers: [1, 2, 2, 2, 2, 2, 2, 2, 2]}", "the horizon 128 does not divide by 256"),
    ],
)
def test_recipe_refuses_a_network_that_cannot_be_built(network, complaint, tmp_path):
    text = (MODELS / "maze2d-umaze" / "recipe.yaml").read_text()
    path = tmp_path / "recipe.yaml"
    path.write_text(
        text.replace("{width: 48, multipliers: [1, 2, 4], patch: 4, octaves: 3}", network)
    )
    with pytest.raises(CdiffError, match=complaint):
        load(path, Recipe)
