"""Which calibrated margins a rollout uses, its note where none fits, and the margins file."""

import pytest
import yaml

from cdiff_cli.commands.margins import (
    Calibration,
    CalibrationFile,
    Margin,
    choose_margins,
    read_calibrations,
    write_calibration,
)
from cdiff_cli.models.preset import ControlSettings, Preset, SamplerSettings
from cdiff_cli.paths import home
from cdiff_cli.sampling import complete_settings
from cdiff_cli.yaml_files import load

NOW = Preset(
    sampler=SamplerSettings(steps=10, temperature=0.5, polish=True),
    control=ControlSettings(margins=True),
    methods={"alm": {"on": "clean", "rho": 0.5}},
)


def now(method="alm", **changes):
    """NOW with other values, "__" for the dot of a name; methods share their constants."""
    dotted = {name.replace("__", "."): value for name, value in changes.items()}
    return NOW.updated({"methods": {method: NOW.methods["alm"]}} | dotted)


def made(margin, preset=NOW, *, stem="easy", content="c", weights="w"):
    return Calibration(
        stem=stem,
        content=content,
        constraints={"a": "h' >= 0.15 h"},
        method=next(iter(preset.methods)),
        preset=preset,
        level=0.9,
        episodes=9,
        seed=5000,
        weights_sha256=weights,
        margins={"a": Margin(margin=margin, median=0.0, largest=margin)},
    )


def choose(calibrations, preset=NOW, content="c", stem="easy"):
    (method,) = preset.methods
    return choose_margins(calibrations, "w", stem, content, method, preset)


def chosen(calibrations, preset=NOW, content="c", stem="easy"):
    choice = choose(calibrations, preset, content, stem)
    return choice.margins.get("a"), choice.match


def test_the_set_that_matches_in_everything_is_used():
    sets = [made(0.1), made(0.2, now(control__execute=4)), made(0.3, now("projected"))]
    assert chosen(sets) == (0.1, "exact")
    assert chosen(sets, now(control__execute=4)) == (0.2, "exact")
    assert chosen(sets, now("projected")) == (0.3, "exact")


def test_whether_margins_are_used_is_no_condition():
    assert chosen([made(0.1)], now(control__margins=False)) == (0.1, "exact")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("methods", {"alm": {"on": "clean", "rho": 0.6}}),
        ("sampler.kernel", "ddim"),
        ("sampler.steps", 5),
        ("sampler.extra_steps", 2),
        ("sampler.temperature", 1.0),
        ("sampler.polish", False),
        ("sampler.return_weight", 2.0),
        ("control.execute", 2),
        ("control.warm_start", 0.3),
        ("control.carry_multipliers", True),
        ("control.action_noise", 0.1),
        ("control.env", ("collide=false",)),
        ("enforce.safety", "segments"),
        ("enforce.dynamics", True),
    ],
)
def test_each_setting_counts_and_is_named(name, value):
    changed = NOW.updated({name: value})
    fact = "settings" if name == "methods" else name.split(".")[1]
    choice = choose([made(0.1)], changed)
    assert (choice.match, choice.margins, choice.unlike) == ("other", {"a": 0.1}, (fact,))
    note = choice.note(changed, "easy.yaml", "cdiff rollout --calibrate")
    assert note.startswith(f"note: the margins were calibrated with {fact} ")
    assert note.endswith("; fit margins with `cdiff rollout --calibrate`")
    assert "\n" not in note


def test_note_says_both_values():
    changed = now(
        "projected", sampler__steps=5, control__warm_start=0.3, control__env=("collide=false",)
    )
    assert choose([made(0.1)], changed).note(changed, "easy.yaml", "x") == (
        "note: the margins were calibrated with method alm (now projected), steps 10 (now 5), "
        "warm_start none (now 0.3), env none (now collide=false); fit margins with `x`"
    )


def test_where_none_matches_the_method_goes_before_the_rest_and_the_latest_before_older_ones():
    other_method, longer = (
        made(0.1, now("projected", control__execute=4)),
        made(0.2, now(control__execute=2, control__warm_start=0.3)),
    )
    assert chosen([longer, other_method], now(control__execute=4)) == (0.2, "other")
    assert chosen([other_method], now(control__execute=4)) == (0.1, "other")
    assert chosen(
        [made(0.1, now(control__execute=2)), made(0.2, now(control__execute=8))],
        now(control__execute=4),
    ) == (
        0.2,
        "other",
    )
    assert chosen(
        [
            made(0.1, now(control__execute=2)),
            made(0.2, now(control__execute=8, control__warm_start=0.5)),
        ],
        now(control__execute=4),
    ) == (0.1, "other")


def test_another_alpha_in_the_same_file_is_a_last_resort_and_is_said():
    renumbered = made(0.1, content="other")
    assert chosen([renumbered]) == (0.1, "renumbered")
    assert chosen([renumbered, made(0.2, now(control__execute=8))]) == (0.2, "other")
    assert chosen([made(0.3, content="a third"), renumbered]) == (
        0.3,
        "renumbered",
    )  # which is nearer nobody knows: the safe one
    assert chosen([made(0.3, now(control__execute=8), content="a third"), renumbered]) == (
        0.1,
        "renumbered",
    )
    assert chosen([renumbered], stem="hard") == (None, "none")
    assert "calibrated when easy.yaml said a: h' >= 0.15 h;" in choose([renumbered]).note(
        NOW, "easy.yaml", "x"
    )


def test_margins_belong_to_their_weights_and_follow_the_constraints_to_a_file_of_another_name():
    assert chosen([made(0.1, weights="others")]) == (None, "none")
    assert chosen([made(0.1)], stem="copy") == (0.1, "exact")


def test_without_margins_the_user_is_told_how_to_get_them():
    note = choose([]).note(NOW, "easy.yaml", "cdiff rollout --calibrate")
    assert note == (
        "note: no margin was calibrated on easy.yaml, plans go up to the limit itself; "
        "fit margins with `cdiff rollout --calibrate`"
    )
    assert choose([made(0.1)]).note(NOW, "easy.yaml", "") == ""


def test_sets_stand_side_by_side_a_new_one_replaces_its_like_and_those_of_other_weights(tmp_path):
    checkpoint = tmp_path / "small.safetensors"
    assert read_calibrations(checkpoint) == []
    stale, first, again, longer, harder = (
        made(0.9, weights="old"),
        made(0.1),
        made(0.3),
        made(0.2, now(control__execute=4)),
        made(0.4, stem="hard", content="d"),
    )
    for each in (stale, first, longer, harder, again):
        assert write_calibration(checkpoint, each) == tmp_path / "small.margins.yaml"
    assert read_calibrations(checkpoint) == [longer, harder, again]
    assert [path.name for path in tmp_path.iterdir()] == ["small.margins.yaml"]


def test_the_file_reads_well(tmp_path):
    """One line for the method's constants, one for each margin."""
    text = write_calibration(tmp_path / "small.safetensors", made(0.1)).read_text()
    assert "      alm: {'on': clean, rho: 0.5}\n" in text  # YAML 1.1 takes a bare on for true
    assert "    a: {margin: 0.1, median: 0.0, largest: 0.1}\n" in text
    assert yaml.safe_load(text)["calibrated"][0]["stem"] == "easy"


def test_a_set_that_says_nothing_of_returns_is_of_plans_that_were_asked_for_none(tmp_path):
    checkpoint = tmp_path / "small.safetensors"
    path = write_calibration(checkpoint, made(0.1))
    content = yaml.safe_load(path.read_text())
    del content["calibrated"][0]["preset"]["sampler"]["return_weight"]
    path.write_text(yaml.safe_dump(content))
    assert chosen(read_calibrations(checkpoint)) == (0.1, "exact")
    assert chosen(read_calibrations(checkpoint), now(sampler__return_weight=2.0)) == (0.1, "other")


def test_shipped_calibrations_name_settings_that_their_methods_have():
    """One that named another would be taken for a calibration of something else."""
    for path in sorted((home() / "models").glob("*/*.margins.yaml")):
        for one in load(path, CalibrationFile).calibrated:
            (method, constants), *others = one.preset.methods.items()
            assert (method, others, one.preset.extra_steps) == (one.method, [], {}), path
            assert complete_settings(method, constants) == constants, path
