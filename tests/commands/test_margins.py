"""Which calibrated margins a rollout uses, what is said where none fits, and the file beside the checkpoint."""

import pytest
import yaml

from cdiff_cli.commands.margins import (
    Calibration,
    CalibrationFile,
    Conditions,
    Margin,
    choose,
    read_calibrations,
    write_calibration,
)
from cdiff_cli.paths import home
from cdiff_cli.sampling import complete_settings
from cdiff_cli.yaml_files import load

NOW = Conditions(
    method="alm",
    preset="recommended",
    settings={"on": "clean", "rho": 0.5},
    kernel="ddpm",
    steps=10,
    extra_steps=0,
    temperature=0.5,
    polish=True,
    execute=1,
    warm=None,
    action_noise=0.0,
    env=(),
)


def now(**changes):
    return NOW.model_copy(update=changes)


def made(margin, conditions=NOW, *, stem="easy", content="c", weights="w"):
    return Calibration(
        stem=stem,
        content=content,
        constraints={"a": "h' >= 0.15 h"},
        conditions=conditions,
        level=0.9,
        episodes=9,
        seed=5000,
        weights_sha256=weights,
        margins={"a": Margin(margin=margin, median=0.0, largest=margin)},
    )


def chosen(calibrations, conditions=NOW, content="c", stem="easy"):
    found = choose(calibrations, "w", stem, content, conditions)
    return found.margins.get("a"), found.match


def test_the_set_that_matches_in_everything_is_used():
    sets = [made(0.1), made(0.2, now(execute=4)), made(0.3, now(method="projected"))]
    assert chosen(sets) == (0.1, "exact")
    assert chosen(sets, now(execute=4)) == (0.2, "exact")
    assert chosen(sets, now(method="projected")) == (0.3, "exact")


def test_a_preset_is_what_it_stands_for():
    assert chosen([made(0.1)], now(preset="mine")) == (0.1, "exact")


@pytest.mark.parametrize(
    "change",
    [
        {"settings": {"on": "clean", "rho": 0.6}},
        {"kernel": "ddim"},
        {"steps": 5},
        {"extra_steps": 2},
        {"temperature": 1.0},
        {"polish": False},
        {"execute": 2},
        {"warm": 0.3},
        {"action_noise": 0.1},
        {"env": ("collide=false",)},
        {"returns": 2.0},
    ],
    ids=lambda change: next(iter(change)),
)
def test_each_condition_counts_and_is_named(change):
    found = choose([made(0.1)], "w", "easy", "c", now(**change))
    assert (found.match, found.margins, found.unlike) == ("other", {"a": 0.1}, tuple(change))
    note = found.note(now(**change), "easy.yaml", "cdiff rollout --calibrate")
    assert note.startswith(f"note: the margins were calibrated with {next(iter(change))} ")
    assert note.endswith("; fit margins with `cdiff rollout --calibrate`")
    assert "\n" not in note


def test_where_none_matches_the_same_method_goes_before_the_same_execution_and_the_latest_before_older_ones():
    other_method, longer = (
        made(0.1, now(method="projected", execute=4)),
        made(0.2, now(execute=2, warm=0.3)),
    )
    assert chosen([longer, other_method], now(execute=4)) == (0.2, "other")
    assert chosen([other_method], now(execute=4)) == (0.1, "other")
    assert chosen([made(0.1, now(execute=2)), made(0.2, now(execute=8))], now(execute=4)) == (
        0.2,
        "other",
    )
    assert chosen(
        [made(0.1, now(execute=2)), made(0.2, now(execute=8, warm=0.5))], now(execute=4)
    ) == (0.1, "other")


def test_another_alpha_in_the_same_file_is_a_last_resort_and_is_said():
    renumbered = made(0.1, content="other")
    assert chosen([renumbered]) == (0.1, "renumbered")
    assert chosen([renumbered, made(0.2, now(execute=8))]) == (0.2, "other")
    assert chosen([made(0.3, content="a third"), renumbered]) == (
        0.3,
        "renumbered",
    )  # which is nearer nobody knows: the safe one
    assert chosen([made(0.3, now(execute=8), content="a third"), renumbered]) == (0.1, "renumbered")
    assert chosen([renumbered], stem="hard") == (None, "none")
    assert "calibrated when easy.yaml said a: h' >= 0.15 h;" in choose(
        [renumbered], "w", "easy", "c", NOW
    ).note(NOW, "easy.yaml", "x")


def test_margins_belong_to_their_weights_and_follow_the_constraints_to_a_file_of_another_name():
    assert chosen([made(0.1, weights="others")]) == (None, "none")
    assert chosen([made(0.1)], stem="copy") == (0.1, "exact")


def test_without_margins_the_user_is_told_how_to_get_them():
    note = choose([], "w", "easy", "c", NOW).note(NOW, "easy.yaml", "cdiff rollout --calibrate")
    assert note == (
        "note: no margin was calibrated on easy.yaml, plans go up to the limit itself; fit margins with `cdiff rollout --calibrate`"
    )
    assert choose([made(0.1)], "w", "easy", "c", NOW).note(NOW, "easy.yaml", "") == ""


def test_sets_stand_side_by_side_a_new_one_replaces_its_like_and_those_of_other_weights(tmp_path):
    checkpoint = tmp_path / "small.safetensors"
    assert read_calibrations(checkpoint) == []
    stale, first, again, longer, harder = (
        made(0.9, weights="old"),
        made(0.1),
        made(0.3),
        made(0.2, now(execute=4)),
        made(0.4, stem="hard", content="d"),
    )
    for each in (stale, first, longer, harder, again):
        assert write_calibration(checkpoint, each) == tmp_path / "small.margins.yaml"
    assert read_calibrations(checkpoint) == [longer, harder, again]
    assert [path.name for path in tmp_path.iterdir()] == ["small.margins.yaml"]


def test_the_file_reads_well(tmp_path):
    """One line for the method's constants, one for each margin."""
    text = write_calibration(tmp_path / "small.safetensors", made(0.1)).read_text()
    assert "    settings: {'on': clean, rho: 0.5}\n" in text  # YAML 1.1 takes a bare on for true
    assert "    a: {margin: 0.1, median: 0.0, largest: 0.1}\n" in text
    assert yaml.safe_load(text)["calibrated"][0]["stem"] == "easy"


def test_a_set_that_says_nothing_of_returns_is_of_plans_that_were_asked_for_none(tmp_path):
    checkpoint = tmp_path / "small.safetensors"
    path = write_calibration(checkpoint, made(0.1))
    content = yaml.safe_load(path.read_text())
    del content["calibrated"][0]["conditions"]["returns"]
    path.write_text(yaml.safe_dump(content))
    assert chosen(read_calibrations(checkpoint)) == (0.1, "exact")
    assert chosen(read_calibrations(checkpoint), now(returns=2.0)) == (0.1, "other")


def test_shipped_calibrations_name_settings_that_their_methods_have():
    """One that named another would be taken for a calibration of something else."""
    for path in sorted((home() / "models").glob("*/*.margins.yaml")):
        for each in load(path, CalibrationFile).calibrated:
            now = each.conditions
            assert complete_settings(now.method, now.settings) == now.settings, path
