"""YAML into models: what the errors say, and at which line."""

from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from cdiff_cli.errors import SpecError
from cdiff_cli.yaml_files import Document, Strict, load


class Leg(Strict):
    name: str
    length: float = 1.0


class Robot(Strict):
    """The model all files here are read into."""

    title: str
    legs: list[Leg]


GOOD = """\
# a robot
title: walker
legs:
  - {name: left, length: 0.5}
  - name: right
    length: 0.25
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "robot.yaml"
    path.write_text(text)
    return path


def message(path: Path) -> str:
    with pytest.raises(SpecError) as caught:
        load(path, Robot)
    return str(caught.value)


def test_a_valid_file_becomes_the_model(tmp_path):
    robot = load(write(tmp_path, GOOD), Robot)
    assert robot == Robot(
        title="walker", legs=[Leg(name="left", length=0.5), Leg(name="right", length=0.25)]
    )


def test_models_are_immutable(tmp_path):
    robot = load(write(tmp_path, GOOD), Robot)
    with pytest.raises(ValueError, match="frozen"):
        robot.title = "runner"


def test_line_is_that_of_the_value_or_of_the_closest_thing_around_it(tmp_path):
    document = Document(write(tmp_path, GOOD))
    assert document.line(("title",)) == 2
    assert document.line(("legs",)) == 4
    assert document.line(("legs", 0, "length")) == 4
    assert document.line(("legs", 1)) == 5
    assert document.line(("legs", 1, "length")) == 6
    assert document.line(("legs", 1, "colour")) == 5
    assert document.line(("legs", 9)) == 4


BAD = {
    "a wrong type": (
        GOOD.replace("0.25", "long"),
        "6 legs[1].length: expected a valid number",
        "'long'",
    ),
    "a missing field": (
        GOOD.replace("name: right\n    ", ""),
        "5 legs[1].name: this field is missing",
        "",
    ),
    "an unknown field": (
        GOOD + "    colour: red\n",
        "7 legs[1].colour: no such field here",
        "mend its name",
    ),
    "NaN": (GOOD.replace("0.25", ".nan"), "6 legs[1].length: expected a finite number", "nan"),
    "infinity": (
        GOOD.replace("0.25", "-.inf"),
        "6 legs[1].length: expected a finite number",
        "-inf",
    ),
    "a list in place of a mapping": ("- 1\n- 2\n", "1: expected a valid dictionary", "[1, 2]"),
    "text in place of a mapping": ("robot\n", "1: expected a valid dictionary", "'robot'"),
    "a number in place of a list": (
        "title: a\nlegs: 4\n",
        "2 legs: expected a valid list",
        "found 4",
    ),
    "a duplicate key": (GOOD + "    name: again\n", '7: "name" stands twice', "keep one"),
    "a duplicate key in braces": (
        "title: a\nlegs: [{name: a, name: b}]\n",
        '2: "name" stands twice',
        "keep one",
    ),
    "malformed YAML": (GOOD + "  - {name: a\n  - b: 1\n", "8: not valid YAML", ""),
    "a tab": ("title: a\n\tlegs: []\n", "2: not valid YAML", "cannot start any token"),
    "two documents": (GOOD + "---\ntitle: b\n", "7: not valid YAML", "another document"),
    "a Python object": (
        "title: !!python/name:os.system x\nlegs: []\n",
        "1: not valid YAML",
        "python/name",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_error_names_file_line_and_field_for(case, tmp_path):
    text, start, also = BAD[case]
    path = write(tmp_path, text)
    said = message(path)
    assert said.startswith(f"{path}:{start}"), said
    assert also in said


@pytest.mark.parametrize("text", ["", "# only a comment\n"])
def test_an_empty_file_is_called_empty(text, tmp_path):
    path = write(tmp_path, text)
    assert message(path) == f"{path}: the file is empty"


def test_a_missing_file_lists_the_yaml_files_that_are_there(tmp_path):
    write(tmp_path, GOOD)
    (tmp_path / "arm.yaml").write_text(GOOD)
    (tmp_path / "notes.txt").write_text("no")
    assert (
        message(tmp_path / "leg.yaml")
        == f"{tmp_path / 'leg.yaml'}: no such file; {tmp_path} has arm.yaml, robot.yaml"
    )


def test_a_missing_file_in_a_missing_folder_says_so(tmp_path):
    folder = tmp_path / "none"
    assert (
        message(folder / "leg.yaml")
        == f"{folder / 'leg.yaml'}: no such file; {folder} has no YAML file"
    )


def test_a_folder_or_a_binary_file_cannot_be_read_as_text(tmp_path):
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x80")
    assert "cannot be read as text" in message(tmp_path)
    assert message(binary).startswith(f"{binary}: cannot be read as text")


@pytest.mark.parametrize(
    "text", ["title: 2020-13-01\nlegs: []\n", "title: a\nlegs: &all\n  - *all\n", "a: &a [*a]\n"]
)
def test_impossible_dates_and_aliases_of_themselves_are_spec_errors(text, tmp_path):
    path = write(tmp_path, text)
    assert message(path).startswith(f"{path}: not valid YAML")


def test_long_values_are_shortened_in_errors(tmp_path):
    said = message(write(tmp_path, f"title: a\nlegs: {'x' * 500}\n"))
    assert "..." in said
    assert len(said) < 200 + len(str(tmp_path))


@settings(max_examples=30, deadline=None)
@given(above=st.integers(0, 40), between=st.integers(0, 40))
def test_the_line_counts_blank_and_comment_lines(above, between, tmp_path_factory):
    path = write(
        tmp_path_factory.getbasetemp(),
        "# c\n" * above + "title: a\nlegs:\n" + "\n" * between + "  - {name: 3}\n",
    )
    assert message(path).startswith(f"{path}:{above + between + 3} legs[0].name: ")


@settings(max_examples=30, deadline=None)
@given(value=st.floats(allow_nan=False, allow_infinity=False))
def test_every_finite_number_survives_yaml(value, tmp_path_factory):
    content = {"title": "a", "legs": [{"name": "left", "length": value}]}
    path = write(tmp_path_factory.getbasetemp(), yaml.safe_dump(content))
    assert load(path, Robot).legs[0].length == value
