"""Presets as values: changed fields, one method's share, facts, and `like` in a recipe."""

import pytest
from pydantic import ValidationError

from cdiff_cli.errors import CdiffError
from cdiff_cli.models.preset import ControlSettings, Enforce, Preset, SamplerSettings
from cdiff_cli.models.recipe import load_recipe, merged
from tests.models.test_recipe import recipe

PRESET = Preset(
    sampler=SamplerSettings(kernel="ddim", steps=10, extra_steps=7),
    control=ControlSettings(execute=2, margins=True),
    methods={"alm": {"rho": 0.5}, "projected": {"on": "clean"}},
    extra_steps={"projected": 0, "safediffuser": 3},
)


# updated ------------------------------------------------------------------------------------------


def test_updated_changes_the_named_fields_alone():
    changed = PRESET.updated({"sampler.kernel": "ddpm", "control.env": ("pattern=chaser",)})
    assert changed.sampler == PRESET.sampler.model_copy(update={"kernel": "ddpm"})
    assert changed.control == PRESET.control.model_copy(update={"env": ("pattern=chaser",)})
    assert (changed.enforce, changed.methods) == (PRESET.enforce, PRESET.methods)
    assert PRESET.sampler.kernel == "ddim"


def test_updated_with_nothing_is_the_preset_itself():
    assert PRESET.updated({}) == PRESET


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sampler.kernel", "euler"),
        ("sampler.steps", 0),
        ("sampler.extra_steps", -1),
        ("sampler.temperature", -0.1),
        ("sampler.temperature", 1.5),
        ("sampler.return_weight", -1.0),
        ("control.execute", 0),
        ("control.warm_start", 0.0),
        ("control.warm_start", 1.5),
        ("control.action_noise", -0.1),
        ("enforce.safety", "everywhere"),
        ("sampler.kernal", "ddpm"),
    ],
)
def test_updated_checks_what_it_is_given(name, value):
    with pytest.raises(ValidationError, match=name.replace(".", r"\.")):
        PRESET.updated({name: value})


# one method ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "constants", "extra_steps"),
    [
        ("alm", {"rho": 0.5}, 7),
        ("projected", {"on": "clean"}, 0),
        ("safediffuser", {}, 3),
        ("diffuser", {}, 7),
    ],
)
def test_of_method_holds_that_methods_constants_and_extra_steps_alone(
    method, constants, extra_steps
):
    one = PRESET.of_method(method)
    assert one.methods == {method: constants}
    assert (one.sampler.extra_steps, one.extra_steps) == (extra_steps, {})
    assert one.updated({"sampler.extra_steps": 7}).sampler == PRESET.sampler
    assert (one.control, one.enforce) == (PRESET.control, PRESET.enforce)
    assert one.of_method(method) == one


def test_extra_steps_of_other_methods_make_no_difference():
    other = PRESET.updated({"extra_steps": {"safediffuser": 50}, "methods": {"alm": {"rho": 0.5}}})
    assert PRESET.of_method("alm") == other.of_method("alm")


# facts --------------------------------------------------------------------------------------------


def test_facts_name_the_method_its_settings_and_every_field_but_margins():
    facts = PRESET.of_method("alm").facts()
    fields = [
        name
        for section in (SamplerSettings, ControlSettings, Enforce)
        for name in section.model_fields
    ]
    assert len(set(fields)) == len(fields)  # a name of two sections would hide one of them
    assert set(facts) == {"method", "settings", *fields} - {"margins"}
    assert (facts["method"], facts["settings"]) == ("alm", {"rho": 0.5})
    assert (facts["kernel"], facts["execute"], facts["safety"]) == ("ddim", 2, "waypoints")


def test_differences_name_the_facts_that_differ_in_both_directions():
    alm = PRESET.of_method("alm")
    other = alm.updated({"sampler.kernel": "ddpm", "enforce.dynamics": True})
    assert alm.differences(alm) == []
    assert alm.differences(other) == other.differences(alm) == ["kernel", "dynamics"]
    assert alm.differences(alm.updated({"control.margins": False})) == []
    assert alm.differences(PRESET.of_method("projected")) == ["method", "settings", "extra_steps"]


# like ---------------------------------------------------------------------------------------------

BASE = """presets:
  first:
    sampler: {steps: 6, polish: true}
    methods:
      alm: {rho: 0.5, c: 1.02}
      projected: {on: clean}
    extra_steps: {diffuser: 0}
  second:
    like: first
    sampler: {kernel: ddim}
    methods:
      alm: {c: 1.5}
  third:
    like: second
    extra_steps: {alm: 4}
"""


def test_like_takes_from_another_preset_what_the_preset_does_not_say(tmp_path):
    presets = recipe(tmp_path, BASE).presets
    assert presets["first"].sampler == SamplerSettings(steps=6, polish=True)
    assert presets["second"] == presets["first"].updated(
        {
            "sampler.kernel": "ddim",
            "methods": {"alm": {"rho": 0.5, "c": 1.5}, "projected": {"on": "clean"}},
        }
    )
    assert presets["third"] == presets["second"].updated({"extra_steps": {"diffuser": 0, "alm": 4}})


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        (
            ("like: first", "like: frist"),
            "second.like: expected a preset above it, found 'frist'; above it are: first",
        ),
        (
            ("like: first", "like: second"),
            "second.like: expected a preset above it, found 'second'; above it are: first",
        ),
        (
            ("  first:\n", "  first:\n    like: second\n"),
            "first.like: expected a preset above it, found 'second'; above it are: none",
        ),
        (
            ("like: first", "like: [first]"),
            "second.like: expected a preset above it, found ['first']; above it are: first",
        ),
    ],
)
def test_like_another_than_a_preset_above_is_one_clear_line(wrong, complaint, tmp_path):
    with pytest.raises(CdiffError) as error:
        recipe(tmp_path, BASE.replace(*wrong))
    path, like = tmp_path / "recipe.yaml", wrong[1].splitlines()[-1].strip()
    lines = [line.strip() for line in path.read_text().splitlines()]
    line = lines.index(like) + 1
    assert str(error.value) == f"{path}:{line} presets.{complaint}"
    assert "\n" not in str(error.value)


def test_an_unknown_field_of_a_preset_that_is_like_another_names_its_line(tmp_path):
    with pytest.raises(CdiffError) as error:
        recipe(tmp_path, BASE.replace("{kernel: ddim}", "{kernal: ddim}"))
    assert "presets.second.sampler.kernal" in str(error.value)
    assert "\n" not in str(error.value)


def test_merged_takes_nested_mappings_entry_by_entry_and_leaves_both_as_they_were():
    base, over = {"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"c": 4}, "d": {"e": 5}, "f": [6]}
    assert merged(base, over) == {"a": {"b": 1, "c": 4}, "d": {"e": 5}, "f": [6]}
    assert base == {"a": {"b": 1, "c": 2}, "d": 3}
    assert over == {"a": {"c": 4}, "d": {"e": 5}, "f": [6]}


@pytest.mark.parametrize(
    ("task", "name", "like"),
    [
        ("maze2d-umaze", "fast", "recommended"),
        ("maze2d-large", "fast", "recommended"),
        ("maze2d-umaze", "released", "paper"),
        ("maze2d-large", "released", "paper"),
        ("hopper", "released", "paper"),
    ],
)
def test_shipped_presets_that_are_like_another_differ_in_what_they_say(task, name, like):
    presets = load_recipe(task).presets
    if name == "fast":
        assert presets[name] == presets[like].updated({"sampler.steps": 16})
        return
    for method in ("primal-dual", "alm"):
        constants = presets[name].methods[method]
        assert constants["coefficient"] == "one"
        assert set(constants) == set(presets[like].methods[method])
    assert presets[name].of_method("diffuser").sampler == presets[like].sampler
    assert presets[name].of_method("alm").sampler.extra_steps > 0
