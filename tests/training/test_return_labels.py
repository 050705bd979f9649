"""Labels of the return, training with them, and plans for the highest return."""

import h5py
import numpy as np
import pytest
import torch
from pydantic import ValidationError

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.commands.rollout import controller
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import CdiffError, CheckpointError
from cdiff_cli.models.checkpoint import install
from cdiff_cli.models.denoiser import calls_a_step, guided
from cdiff_cli.models.recipe import DemonstrationSpec, MlpSpec, Recipe, ReturnSpec, load_recipe
from cdiff_cli.tasks.ball_run.task import BALL_RUN
from cdiff_cli.training.demonstrations import demonstrations, load_rewards
from cdiff_cli.training.fit import train
from cdiff_cli.training.labels import ConstraintLabel
from cdiff_cli.training.return_labels import ReturnLabel, mean_rewards
from cdiff_cli.training.windows import TrainingSet
from tests.problems import generator, num, vec
from tests.training.test_fit import same
from tests.training.test_fit_control import TINY

DISCOUNT = 0.75  # four steps must remain for a label


def walk(steps, rate=1.0):
    """States of one walk, all different."""
    return np.arange(steps + 1.0)[:, None] + rate


# labels -------------------------------------------------------------------------------------------


def test_constant_reward_is_its_mean_and_the_last_steps_of_a_walk_have_none():
    (found,) = mean_rewards([walk(10)], [np.full(10, 0.3)], DISCOUNT)
    np.testing.assert_allclose(found[:7], 0.3, rtol=1e-12)  # rounding of sums and their quotient
    assert np.isnan(found[7:]).all()


def test_mean_reward_by_hand():
    (found,) = mean_rewards([walk(4)], [np.array([1.0, 0.0, 4.0, 0.0])], DISCOUNT)
    assert found[0] == pytest.approx((1 + 4 * 0.75**2) / (1 + 0.75 + 0.75**2 + 0.75**3))


def test_walk_cut_into_episodes_counts_as_one_walk():
    rng = np.random.default_rng(0)
    x, r = walk(30), rng.normal(size=30)
    (whole,) = mean_rewards([x], [r], DISCOUNT)
    cut = mean_rewards([x[:11], x[10:13], x[12:]], [r[:10], r[10:12], r[12:]], DISCOUNT)
    np.testing.assert_array_equal(
        np.concatenate([part[: len(part) - 1] for part in cut]), whole[:-1]
    )


def test_walks_do_not_affect_each_other():
    rng = np.random.default_rng(0)
    x, y, r, s = walk(20), walk(20, 0.5), rng.normal(size=20), rng.normal(size=20)
    alone = [*mean_rewards([x], [r], DISCOUNT), *mean_rewards([y], [s], DISCOUNT)]
    for one, other in zip(mean_rewards([x, y], [r, s], DISCOUNT), alone, strict=True):
        np.testing.assert_array_equal(one, other)


def test_reward_of_the_last_state_counts():
    (found,) = mean_rewards([walk(4)], [np.array([0.0, 0.0, 0.0, 0.0, 1.0])], DISCOUNT)
    assert found[0] > 0


def test_labels_run_from_low_to_high_quantile_and_are_zero_if_unknown():
    episodes = [walk(5, 10.0 * k) for k in range(101)]
    returns = ReturnLabel.from_episodes(
        episodes, [np.full(5, k / 100) for k in range(101)], DISCOUNT
    )
    assert (returns.low, returns.high) == (pytest.approx(0.02), pytest.approx(0.98))
    label = returns.label.reshape(101, 6, 2)
    assert label[0, 0].tolist() == [-1.0, 2.0]
    assert label[100, 0].tolist() == [1.0, 0.0]
    torch.testing.assert_close(
        label[50, 1], torch.tensor([0.0, 1.0]), atol=1e-6, rtol=0
    )  # float32; a middle return has a label too
    assert label[:, 2:].abs().max() == 0
    assert returns.record(DISCOUNT) == {
        "discount": 0.75,
        "low": 0.02,
        "high": 0.98,
        "labelled": pytest.approx(1 / 3, abs=1e-4),
    }


@pytest.mark.parametrize(
    ("rewards", "said"),
    [
        (
            np.full(10, 0.3),
            "all demonstrations return the same, 0.3 per step, so that none is better",
        ),
        (np.zeros(10), "all demonstrations return the same, 0 per step"),
        (
            np.arange(3.0),
            r"no demonstration is 4 steps long, as a return at discount 0\.75 needs; "
            "lower the discount",
        ),
    ],
)
def test_equal_returns_are_refused(rewards, said):
    with pytest.raises(CdiffError, match=said):
        ReturnLabel.from_episodes([walk(len(rewards))], [rewards], DISCOUNT)


# rewards ------------------------------------------------------------------------------------------


def rewards_file(path, **columns):
    with h5py.File(path / "own.hdf5", "w") as file:
        for name, values in columns.items():
            file[name] = values
    return str(path / "own.hdf5")


def test_rewards_of_a_file_are_cut_like_its_states(tmp_path):
    source = rewards_file(tmp_path, rewards=np.arange(6.0), timeouts=[0, 0, 1, 0, 0, 0])
    assert [r.tolist() for r in load_rewards(source, [walk(2), walk(2)])] == [
        [0.0, 1.0, 2.0],
        [3.0, 4.0, 5.0],
    ]


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (
            {"actions": np.zeros(6)},
            "it needs rewards and timeouts, "
            "because its recipe conditions the planner on the return",
        ),
        (
            {"rewards": np.full(6, np.nan)},
            "rewards hold NaN or inf; repair or choose another dataset",
        ),
        ({"rewards": np.zeros((6, 2))}, "rewards of 12 steps for 6 states; expected one per step"),
        ({"rewards": np.zeros(4)}, "rewards of 4 steps for 6 states; expected one per step"),
        (
            {"rewards": np.zeros(6), "timeouts": [0, 0, 0, 1, 0, 0]},
            "2 episodes of rewards for 1 of states",
        ),
    ],
)
def test_dataset_with_bad_rewards_is_refused_in_one_line(columns, said, tmp_path):
    source = rewards_file(tmp_path, **columns)
    with pytest.raises(CdiffError, match=said) as caught:
        load_rewards(source, [walk(5)])
    assert str(caught.value).startswith(f"{source}: ")
    assert "\n" not in str(caught.value)


# guidance -----------------------------------------------------------------------------------------


class _Counted(torch.nn.Module):
    """Estimates of 0.1 without a label and 0.3 for the highest return; records its batches."""

    def __init__(self):
        torch.nn.Module.__init__(self)
        self.batches = []

    def forward(self, x, t, label=None):
        self.batches.append(len(x))
        return torch.zeros_like(x) + 0.1 + (0.0 if label is None else 0.2 * label[:, :1, None])


@pytest.mark.parametrize(
    ("weight", "answer", "batches"),
    [(0.0, 0.1, [2]), (1.0, 0.3, [2]), (2.0, 0.5, [4]), (0.5, 0.2, [4])],
)
def test_weight_0_is_the_unconditional_estimate_and_only_weights_beyond_1_take_two_calls(
    weight, answer, batches
):
    net = _Counted()
    torch.testing.assert_close(
        guided(net, weight)(torch.zeros(2, 3, 4), 5), torch.full((2, 3, 4), answer)
    )
    assert net.batches == batches
    assert calls_a_step(weight) == sum(batches) // 2


# training -----------------------------------------------------------------------------------------

TOLD = TINY.model_copy(
    update={
        "network": MlpSpec(kind="mlp", width=16, depth=1, conditions=2),
        "returns": ReturnSpec(discount=0.9),
        "steps": 8,
    }
)
BEGUN = TOLD.model_copy(
    update={"returns": None, "begin": "tiny", "learning_rate": 1e-12, "inverse": None}
)
OWN = {
    "demonstrations": DemonstrationSpec(steps=1000),
    "train": {"tiny": TOLD, "conditional": BEGUN},
}
RECIPE = load_recipe("ball-run").model_copy(update=OWN)


@pytest.fixture(scope="module", autouse=True)
def own_minari(tmp_path_factory):
    """A Minari folder for this file, so that the user's datasets do not change."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        yield


def fit(work, size="tiny", recipe=RECIPE, **more):
    return train(BALL_RUN, recipe, size, seed=0, device=torch.device("cpu"), work=work, **more)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return fit(tmp_path_factory.mktemp("whole"))


def test_card_records_the_return_labels(whole):
    told = whole.card.returns
    assert told["discount"] == 0.9
    assert told["low"] < told["high"]
    assert 0.5 < told["labelled"] < 1.0
    assert whole.card.network.conditions == 2
    assert float(whole.net.condition.weight.abs().max()) > 0


def test_training_with_returns_resumes_to_the_same_bits(whole, tmp_path):
    def stop(status):
        if status.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(tmp_path, on_step=stop)
    assert same(fit(tmp_path, resume=True).path, whole.path)


def test_windows_have_the_label_of_their_first_state_or_none():
    episodes = demonstrations(BALL_RUN, 1000, 0)
    count = sum(map(len, episodes))
    labels = torch.stack((torch.arange(count) + 1.0, -torch.arange(count) - 1.0), 1)
    data = TrainingSet.from_episodes(
        BALL_RUN, RECIPE, TOLD, episodes, None, 0, ReturnLabel(labels, 0.0, 1.0)
    )
    _, label = data.draw(4000, generator(0))
    index = data.windows.pick(4000, generator(0))  # the same numbers, drawn first
    shown = label[:, 0] != 0
    torch.testing.assert_close(label[shown], labels[data.windows.starts[index]][shown])
    assert float((~shown).float().mean()) == pytest.approx(
        TOLD.dropout, abs=0.03
    )  # four standard errors


def test_conditional_planner_starts_from_it_without_its_label_weights(whole, tmp_path, monkeypatch):
    (tmp_path / "models" / "ball-run").mkdir(parents=True)
    monkeypatch.setattr("cdiff_cli.training.fit.home", lambda: tmp_path)
    monkeypatch.setattr("cdiff_cli.models.checkpoint.home", lambda: tmp_path)
    install(whole)
    side = ConstraintLabel(
        "side", Constraint((AtWaypoints("y", HalfSpace(vec(0.0, 1.0, 0.0, 0.0), num(0.5))),)), "abc"
    )
    made = fit(tmp_path / "work", "conditional", condition=side)
    assert (made.card.recipe, made.card.returns) == ("conditional-side", None)
    assert float(made.net.condition.weight.abs().max()) < 1e-6  # the rate is 1e-12
    torch.testing.assert_close(
        made.net.head[2].weight, whole.net.head[2].weight, atol=1e-6, rtol=1e-3
    )  # kept in half precision


def test_base_of_other_demonstrations_error_names_its_recipe(whole, tmp_path, monkeypatch):
    (tmp_path / "models" / "ball-run").mkdir(parents=True)
    monkeypatch.setattr("cdiff_cli.training.fit.home", lambda: tmp_path)
    monkeypatch.setattr("cdiff_cli.models.checkpoint.home", lambda: tmp_path)
    install(whole)
    rng = np.random.default_rng(0)
    columns = {
        "observations": rng.normal(size=(200, 4)),
        "actions": np.zeros((200, 2)),
        "rewards": rng.normal(size=200),
    }
    begun = {"tiny": TOLD.model_copy(update={"begin": "tiny"})}
    with pytest.raises(
        CheckpointError,
        match=r"trained on other demonstrations, .* train it on these first, with --recipe tiny",
    ):
        fit(
            tmp_path / "work",
            recipe=RECIPE.model_copy(update={"train": begun}),
            dataset=rewards_file(tmp_path, **columns),
        )


@pytest.mark.parametrize(
    ("change", "asked", "said"),
    [
        (
            {"network": MlpSpec(kind="mlp", width=16, depth=1)},
            False,
            "expected conditions: 2 in its network; choose another",
        ),
        ({}, True, "expected no --conditional FILE beside its returns"),
    ],
)
def test_recipe_that_does_not_fit_its_returns_is_refused_in_one_line(change, asked, said, tmp_path):
    side = ConstraintLabel(
        "side", Constraint((AtWaypoints("y", HalfSpace(vec(0.0, 1.0, 0.0, 0.0), num(0.5))),)), "abc"
    )
    recipe = RECIPE.model_copy(update={"train": {"tiny": TOLD.model_copy(update=change)}})
    with pytest.raises(CdiffError, match=f'recipe "tiny" of ball-run: {said}'):
        fit(tmp_path, recipe=recipe, condition=side if asked else None)


def test_dataset_without_rewards_is_refused_before_training(tmp_path):
    columns = {
        "observations": np.random.default_rng(0).normal(size=(200, 4)),
        "actions": np.zeros((200, 2)),
    }
    with pytest.raises(CdiffError, match=r"own\.hdf5: .*it needs rewards and timeouts"):
        fit(tmp_path / "work", dataset=rewards_file(tmp_path, **columns))
    assert not (tmp_path / "work").exists()


def test_recipe_of_whole_plans_refuses_returns():
    content = load_recipe("maze2d-umaze").model_dump()
    content["train"]["small"]["returns"] = {"discount": 0.9}
    with pytest.raises(
        ValidationError, match=r"train\.small\.returns: for control tasks \(frame: relative\)"
    ):
        Recipe.model_validate(content)


# acting -------------------------------------------------------------------------------------------


@pytest.fixture
def asking(monkeypatch):
    """The recipe of the ball run, guided to the highest return with that weight."""

    def patch(weight):
        read = RECIPE.model_copy(
            update={"returns": weight, "train": load_recipe("ball-run").train | RECIPE.train}
        )
        monkeypatch.setattr("cdiff_cli.commands.resolve.load_recipe", lambda _: read)

    return patch


@pytest.mark.parametrize(("weight", "calls"), [(0.0, 20), (1.0, 20), (2.0, 40)])
def test_return_weight_of_the_recipe_sets_the_network_calls(weight, calls, whole, asking):
    asking(weight)
    for method, tries in (("diffuser", 1), ("alm", 1), ("best-of-k", 8)):
        found = resolve(
            Request(task="ball-run", method=method, checkpoint=whole.path, device="cpu")
        )
        assert found.preset.sampler.return_weight == weight
        assert found.record()["preset"]["sampler"]["return_weight"] == weight
        assert controller(found).calls == tries * calls


def test_every_method_and_preset_plans_for_the_highest_return(whole, asking):
    asking(2.0)
    x = torch.randn(3, 16, 4, generator=generator(0))
    wanted = guided(whole.net, 2.0, whole.limit)(x, 5)
    assert not torch.equal(wanted, guided(whole.net, 0.0, whole.limit)(x, 5))
    for method, preset in (
        ("diffuser", "recommended"),
        ("projected", "paper"),
        ("alm", "recommended"),
    ):
        found = resolve(
            Request(
                task="ball-run", method=method, preset=preset, checkpoint=whole.path, device="cpu"
            )
        )
        assert torch.equal(controller(found).planner.denoiser(x, 5), wanted)


def test_checkpoint_without_return_labels_is_not_guided(asking):
    asking(2.0)
    found = resolve(Request(task="ball-run", device="cpu"))
    assert found.preset.sampler.return_weight == 0.0
    assert controller(found).calls == 20


def test_conditional_method_uses_the_constraint_label_not_the_return(asking, whole):
    asking(2.0)
    found = resolve(
        Request(task="ball-run", method="conditional", checkpoint=whole.path, device="cpu")
    )
    assert found.preset.sampler.return_weight == 0.0
