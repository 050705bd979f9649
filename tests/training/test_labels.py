"""Labels of windows, classifier-free guidance, training from an unconditional planner."""

import shutil

import pytest
import torch

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.plan import plan_both
from cdiff_cli.commands.resolve import resolve
from cdiff_cli.constraints.spec.load import kinds_sha256, load_constraints
from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import Constraint
from cdiff_cli.constraints.waypoints import AtWaypoints
from cdiff_cli.errors import CdiffError, CheckpointError
from cdiff_cli.evaluation.metrics import violation
from cdiff_cli.models.denoiser import guided
from cdiff_cli.models.networks import ResidualMlp, TemporalUnet
from cdiff_cli.paths import home
from cdiff_cli.training.labels import ConstraintLabel, drop
from tests.problems import generator, normal, num, vec
from tests.training.test_fit import TINY, fit, own_minari, same  # noqa: F401  own_minari keeps the user's datasets untouched

SIZES = {
    "unet": lambda k: TemporalUnet(4, 8, (1, 2), conditions=k),
    "mlp": lambda k: ResidualMlp(4, 8, 16, 2, k),
}


def condition(b=0.5):
    """x <= b."""
    return ConstraintLabel(
        "x", Constraint((AtWaypoints("x", HalfSpace(vec(1.0, 0.0, 0.0, 0.0), num(b))),)), "abc"
    )


def test_label_of_a_window_is_its_largest_g_clipped():
    x = torch.zeros(4, 3, 4)
    x[:, 1, 0] = torch.tensor([0.4, 0.5, 0.75, 9.0])
    assert condition().label(x).tolist() == [[1.0, 0.0], [1.0, 0.0], [-1.0, 0.25], [-1.0, 1.0]]


def test_a_quarter_of_the_labels_are_dropped_whole():
    label = torch.tensor([[1.0, 0.25]]).expand(4000, -1)
    kept = drop(label, 0.25, generator(0))
    assert set(map(tuple, kept.tolist())) == {(1.0, 0.25), (0.0, 0.0)}
    assert float((kept[:, 0] == 0).float().mean()) == pytest.approx(
        0.25, abs=0.03
    )  # four standard errors


@pytest.mark.parametrize("size", SIZES)
def test_untrained_condition_and_zero_label_change_nothing(size):
    net, x, t = SIZES[size](2), normal(0, 3, 8, 4).float(), torch.tensor([1.0, 2.0, 3.0])
    free = net(x, t)
    assert torch.equal(net(x, t, torch.tensor([[1.0, 0.5]]).expand(3, -1)), free)
    torch.nn.init.ones_(net.condition.weight)
    assert torch.equal(net(x, t, torch.zeros(3, 2)), free)
    assert not torch.equal(net(x, t, torch.ones(3, 2)), free)


@pytest.mark.parametrize("size", SIZES)
def test_condition_layer_does_not_change_the_initial_weights_of_the_others(size):
    made = []
    for conditions in (0, 2):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            made.append(SIZES[size](conditions).state_dict())
    assert set(made[1]) - set(made[0]) == {"condition.weight"}
    assert all(torch.equal(made[1][name], value) for name, value in made[0].items())


class _Means(torch.nn.Module):
    """Estimates of 0.1 without a label and 0.3 with one."""

    def forward(self, x, t, label):
        return torch.zeros_like(x) + 0.1 + 0.2 * label[:, :1, None]


@pytest.mark.parametrize(("weight", "answer"), [(1.0, 0.3), (2.0, 0.5), (0.5, 0.2), (9.0, 1.0)])
def test_guidance_extrapolates_from_the_free_to_the_conditional_estimate_and_clips(weight, answer):
    out = guided(_Means(), weight)(torch.zeros(2, 3, 4), 5)
    torch.testing.assert_close(out, torch.full((2, 3, 4), answer))  # one clip: 0.1 + 9 * 0.2 = 1.9


def test_hash_of_constraints_depends_on_numbers_not_comments(tmp_path):
    text = "task: maze2d-umaze\nconstraints:\n  - {name: cut, kind: linear, a: {x: 1.0}, b: 1.0}\n"
    hashes = []
    for i, variant in enumerate((text, "# a comment\n" + text, text.replace("b: 1.0", "b: 1.1"))):
        (tmp_path / f"{i}.yaml").write_text(variant)
        hashes.append(
            kinds_sha256(
                load_constraints(tmp_path / f"{i}.yaml", "maze2d-umaze", ("x", "y", "vx", "vy"))[0]
            )
        )
    assert hashes[0] == hashes[1] != hashes[2]


# training -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A home with one trained unconditional planner, `tiny`."""
    root = tmp_path_factory.mktemp("home")
    base = fit(root / "base")
    folder = root / "models" / "maze2d-umaze"
    folder.mkdir(parents=True)
    for name in ("model.safetensors", "model.card.yaml"):
        shutil.copy(base.path.parent / name, folder / name.replace("model", "tiny"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cdiff_cli.training.fit.home", lambda: root)
        yield base


LABELLED = TINY.model_copy(
    update={"network": TINY.network.model_copy(update={"conditions": 2}), "begin": "tiny"}
)


def test_conditional_planner_starts_from_the_unconditional_one(place, tmp_path):
    made = fit(
        tmp_path, LABELLED.model_copy(update={"learning_rate": 1e-12}), condition=condition()
    )
    assert made.card.recipe == "conditional-x"
    assert made.card.constraints == "abc"
    ours, base = made.net.state_dict(), place.net.state_dict()
    for name, value in base.items():
        torch.testing.assert_close(
            ours[name], value, atol=1e-6, rtol=1e-3
        )  # kept in half precision once more
    assert float(ours["condition.weight"].abs().max()) < 1e-6


@pytest.mark.usefixtures("place")
def test_training_with_labels_changes_the_condition_and_resumes_to_the_same_bits(tmp_path):
    whole = fit(tmp_path / "whole", LABELLED, condition=condition())
    assert float(whole.net.condition.weight.abs().max()) > 0

    def stop(status):
        if status.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(tmp_path / "part", LABELLED, condition=condition(), on_step=stop)
    assert same(
        fit(tmp_path / "part", LABELLED, condition=condition(), resume=True).path, whole.path
    )


@pytest.mark.usefixtures("place")
@pytest.mark.parametrize(
    ("spec", "asked", "message"),
    [
        (TINY, condition(), 'recipe "tiny" of maze2d-umaze: expected conditions: 2 in its network'),
        (LABELLED, None, 'recipe "tiny" of maze2d-umaze: expected --conditional FILE'),
        (
            LABELLED.model_copy(update={"begin": "none"}),
            condition(),
            "none.safetensors: no such checkpoint",
        ),
    ],
)
def test_recipe_that_does_not_fit_the_condition_is_refused_in_one_line(
    spec, asked, message, tmp_path
):
    with pytest.raises((CdiffError, CheckpointError), match=message):
        fit(tmp_path, spec, condition=asked)


@pytest.mark.usefixtures("place")
def test_base_of_another_network_is_refused(tmp_path):
    wider = LABELLED.network.model_copy(update={"width": 16})
    with pytest.raises(CheckpointError, match="its network differs from the one of this recipe"):
        fit(tmp_path / "a", LABELLED.model_copy(update={"network": wider}), condition=condition())


# planning -----------------------------------------------------------------------------------------


def test_shipped_conditional_planner_violates_less_and_counts_both_calls():
    """With 64 steps and seeds 0-9, 0.004 of the violation is left; this test plans 16 steps."""
    resolved = resolve(Request(method="conditional", preset="paper", n=4, steps=16))
    plans, free = plan_both(resolved, lambda *_: None)
    left, before = (violation(resolved.declared, each.x).sum() for each in (plans, free))
    assert left < 0.6 * before
    assert plans.calls == 2 * free.calls


def test_constraints_edited_since_training_are_refused(tmp_path):
    file = tmp_path / "maze2d-umaze.yaml"
    text = (home() / "constraints" / "maze2d-umaze.yaml").read_text()
    file.write_text(text.replace("b: 1.82", "b: 1.83"))
    with pytest.raises(CheckpointError, match="trained for other constraints than"):
        resolve(Request(method="conditional", constraints=file))
    file.write_text("# a comment\n" + text)
    assert resolve(Request(method="conditional", constraints=file)).conditional is not None
