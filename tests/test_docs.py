"""README and docs/: generated blocks are current, commands run, links lead somewhere, the site builds."""

import importlib.util
import inspect
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cdiff_cli.cli import app
from cdiff_cli.evaluation.columns import COLUMNS

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


def load(path):
    """A script of docs/ as a module."""
    spec = importlib.util.spec_from_file_location(f"docs_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


generate = load(DOCS / "generate.py")
README = ROOT / "README.md"
PAGES = {str(page.relative_to(ROOT)): page for page in (*generate.PAGES, ROOT / "CONTRIBUTING.md")}
each_page = pytest.mark.parametrize("page", PAGES.values(), ids=PAGES.keys())


# --- Generated blocks ------------------------------------------------------------------------------------------------


@each_page
def test_generated_blocks_are_current(page):
    missing = []
    assert generate.filled(page.read_text(), missing) == page.read_text(), "run `make pages`"
    assert missing == []


def test_every_block_has_a_place():
    placed = {
        name for page in PAGES.values() for _, name, _ in generate.MARKED.findall(page.read_text())
    }
    assert placed == set(generate.BLOCKS)


def test_every_column_is_defined():
    text = (DOCS / "results.md").read_text()
    assert [name for name, column in COLUMNS.items() if f"| {column.title} |" not in text] == []


def test_a_block_whose_program_is_missing_stays_and_is_reported(monkeypatch, tmp_path):
    monkeypatch.setattr(generate, "PROGRAMS", tmp_path)
    monkeypatch.setattr(generate, "ROOT", tmp_path)
    text, missing = "<!-- program any_denoiser -->\nas it was\n<!-- end -->", []
    assert generate.filled(text, missing) == text
    assert missing == ["any_denoiser.py does not exist; its block was left as it is"]


# --- Commands --------------------------------------------------------------------------------------------------------


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def block_commands(page):
    """The `cdiff` lines of a page's bash blocks, without their comments."""
    lines = [
        line
        for block in blocks(page, "bash")
        for line in block.splitlines()
        if line.startswith("cdiff ")
    ]
    return [re.split(r"\s+#", line)[0] for line in lines]


def inline_commands(page):
    """`cdiff ...` in running text and tables; a line break in it is a space."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    spans = [" ".join(span.split()) for span in re.findall(r"(?<!`)`(cdiff [^`]+)`", text)]
    return [span for span in spans if not span.startswith("cdiff --") and "..." not in span]


ALL_COMMANDS = sorted(
    {
        command
        for page in PAGES.values()
        for command in (*block_commands(page), *inline_commands(page))
    }
)


@pytest.mark.parametrize("command", ALL_COMMANDS)
def test_command_has_only_options_that_exist(command):
    """The same line with --help is accepted, and its constraint files exist."""
    words = shlex.split(command)[1:]
    result = CliRunner().invoke(app, [*words, "--help"])
    assert result.exit_code == 0, result.output + result.stderr
    files = [word for word in words if word.endswith(".yaml")]
    assert [file for file in files if file != "mine.yaml" and not (ROOT / file).is_file()] == []


def test_commands_of_the_readme_run_and_print_what_it_shows(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (written,) = blocks(README, "yaml")
    Path("mine.yaml").write_text(written)
    printed = ""
    for command in block_commands(README):
        result = CliRunner().invoke(app, shlex.split(command)[1:])
        assert result.exit_code == 0, (
            command + result.output + result.stderr + repr(result.exception)
        )
        printed += result.output
    shown, error = blocks(README, "text")[-2:]
    stamp = re.compile(r"\d{8}-\d{6}")
    for line in shown.splitlines():
        assert stamp.sub("", line) in stamp.sub("", printed)
    Path("mine.yaml").write_text(written.replace("a: {x:", "a: {xx:"))
    refused = CliRunner().invoke(app, ["check", "mine.yaml"])
    assert (refused.exit_code, refused.stderr) == (2, error)


def test_the_yaml_on_the_site_front_is_that_of_the_readme():
    assert blocks(DOCS / "index.md", "yaml") == blocks(README, "yaml")


@each_page
def test_scripts_and_make_targets_exist(page):
    text = page.read_text()
    scripts = re.findall(r"python\s+((?:tests|docs)/\S+?\.py)", text)
    assert [script for script in scripts if not (ROOT / script).is_file()] == []
    targets = re.findall(r"`make ([a-z]+)`|^make ([a-z]+)", text, re.MULTILINE)
    known = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert {first or second for first, second in targets} <= known


# --- Links and text --------------------------------------------------------------------------------------------------


def anchors(page):
    """Anchors of a page's headings, as GitHub and MkDocs make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings
    }


@each_page
def test_links_lead_to_files_and_headings(page):
    broken = []
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        if not file.is_file() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    assert broken == []


def prose(page):
    """Sentences of a page outside of generated blocks, code, tables and headings; a code span counts as one word."""
    text = re.sub(
        r"^```.*?^```",
        "",
        generate.MARKED.sub("", page.read_text()),
        flags=re.DOTALL | re.MULTILINE,
    )
    text = re.sub(r"`[^`]+`", "CODE", text)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    text = re.sub(r"^(#|\||!\[).*$", "\n", text, flags=re.MULTILINE)
    paragraphs = re.split(r"\n\s*\n|\n(?=\s*[-*] )", text)
    return [
        sentence
        for each in paragraphs
        for sentence in re.split(r"(?<=[.?!])\**\s+", " ".join(each.split()))
    ]


@each_page
def test_no_sentence_is_over_35_words(page):
    assert [sentence for sentence in prose(page) if len(sentence.split()) > 35] == []


def test_the_readme_is_short():
    assert len(README.read_bytes()) <= 10_240


def test_contributing_lists_the_package_as_it_is():
    tree = next(
        block
        for block in blocks(ROOT / "CONTRIBUTING.md", "text")
        if block.startswith("cdiff_cli/")
    )
    listed = {
        name
        for line in tree.splitlines()[1:]
        for name in re.findall(r"(?:^  |  )(\w+\.py|\w+/)(?=\s|$)", line)
    }
    package = ROOT / "cdiff_cli"
    found = {
        path.name + "/" * path.is_dir()
        for path in package.iterdir()
        if path.name not in ("__pycache__", "py.typed")
    }
    assert listed == found


# --- Public names and the site ---------------------------------------------------------------------------------------


def test_every_public_name_is_documented():
    import cdiff_cli

    page = (DOCS / "python.md").read_text().split("## Names", 1)[1]
    names = set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE))
    assert names == set(cdiff_cli.__all__)
    values = {name: getattr(cdiff_cli, name) for name in cdiff_cli.__all__}
    code = [
        name
        for name, v in values.items()
        if inspect.isroutine(v) or inspect.isclass(v) or inspect.ismodule(v)
    ]
    assert [name for name in code if not values[name].__doc__] == []


def test_the_site_builds_without_a_warning_and_loads_nothing_from_the_network(tmp_path):
    config = DOCS / "site" / "mkdocs.yml"
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--strict",
        "-f",
        str(config),
        "-d",
        str(tmp_path),
    ]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(command, capture_output=True, text=True, check=False, env=quiet)
    assert built.returncode == 0, built.stdout + built.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > len(list(DOCS.rglob("*.md")))  # and 404.html
    loaded = [
        found
        for page in pages
        for found in re.findall(r'(?:src|href)="((?:https?:)?//[^"]*)"', page.read_text())
    ]
    assert loaded == []
