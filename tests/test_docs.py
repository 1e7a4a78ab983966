"""The documentation keeps its word: examples run, pages run as sessions, every command exists, references are whole."""

from __future__ import annotations

import re
import runpy
import shlex
import sys
from pathlib import Path
from types import ModuleType

import pytest
from documented import Block, Session, blocks, commands, differs
from toys.command import in_process

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
EXAMPLES = sorted(DOCS.glob("[0-9]*.py"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
SESSIONS = sorted((DOCS / "how-to").glob("*.md"))
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))


@pytest.fixture(autouse=True)
def _registry_as_before(monkeypatch):
    from models.families import FAMILIES

    monkeypatch.setattr(FAMILIES, "_members", dict(FAMILIES._members))


@pytest.fixture
def call(monkeypatch, capsys, tmp_path, copied_stores):
    """Commands in an empty folder, as a new user has it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("THERMODRIFT_HOME", raising=False)
    monkeypatch.setenv("COLUMNS", "120")
    return in_process(monkeypatch, capsys)


@pytest.fixture(scope="module")
def build() -> ModuleType:
    """The hook of mkdocs, which needs nothing of mkdocs to make the pages."""
    sys.path.insert(0, str(ROOT))
    from docs import build

    return build


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda p: p.stem)
def test_example(example, capsys) -> None:
    runpy.run_path(str(example), run_name="__main__")
    assert capsys.readouterr().out.strip()


def test_there_are_examples() -> None:
    assert [p.stem for p in EXAMPLES] == ["01_by_hand", "02_add_a_family"]


@pytest.mark.parametrize("page", SESSIONS, ids=lambda p: p.stem)
def test_a_how_to_runs_as_written(page, call, monkeypatch) -> None:
    assert Session(page, call, monkeypatch).run()


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda p: p.stem)
def test_a_tutorial_runs_as_written(page, call, monkeypatch) -> None:
    assert Session(page, call, monkeypatch).run() >= 5


def test_output_may_be_abridged_and_vary_a_little_and_no_more() -> None:
    printed = "z: S 3.06 µm, below 5.23 µm\nversion 1 of 20260101"
    assert not differs(["z: S 3.1 µm, …", "…", "version 1 …"], printed)
    assert differs(["z: S 3.5 µm, below 5.23 µm"], printed)
    assert differs(["version 2 …"], printed)
    assert differs(["z: R 3.06 µm, …"], printed)


# Commands


def _command_lines(block: Block) -> list[list[str]]:
    """The arguments of every `thermodrift` in a block, placeholders of continuation and pipes resolved."""
    text = block.text.replace("\\\n", " ")
    if block.language == "console":
        text = "\n".join(command for command, _ in commands(block))
    lines = [shlex.split(line.strip().removeprefix("$ "), comments=True) for line in text.splitlines()
             if re.match(r"\s*(\$ )?thermodrift ", line)]  # fmt: skip
    return [line[1 : line.index("|") if "|" in line else None] for line in lines]


def _shown() -> list[Block]:
    return [b for page in PAGES for b in blocks(page) if b.language in ("", "sh", "console")]


def _parameters(arguments: list[str]) -> list[str]:
    """What is wrong with a command line: an unknown command, an unknown option."""
    from pipelines.cli import program

    command = program()
    while getattr(command, "commands", None) and arguments and arguments[0] in command.commands:
        command, arguments = command.commands[arguments[0]], arguments[1:]
    if getattr(command, "commands", None) and not getattr(command, "invoke_without_command", False):
        return [f"no command {arguments[:1]}"]
    known = {"--help", *(o for p in command.params for o in (*p.opts, *p.secondary_opts))}
    return [a for a in arguments if a.startswith("--") and a.split("=")[0] not in known]


def test_every_command_of_the_documentation_exists_with_its_options() -> None:
    lines = [(b.where, line) for b in _shown() for line in _command_lines(b)]
    assert len(lines) > 50
    wrong = [(where, bad) for where, line in lines if (bad := _parameters(line))]
    assert not wrong


def test_an_unknown_command_or_option_is_noticed() -> None:
    assert _parameters(["trian", "--machine", "x"]) and _parameters(["train", "--machin", "x"])
    assert not _parameters(["lake", "show", "mill", "1"])


# Python blocks outside of sessions


@pytest.mark.parametrize("page", [p for p in PAGES if p not in SESSIONS + TUTORIALS], ids=lambda p: p.stem)
def test_python_on_other_pages_compiles_and_its_names_exist(page) -> None:
    import thermodrift as td

    for block in blocks(page):
        if block.language == "python":
            compile(block.text, block.where, "exec")
            unknown = {n for n in re.findall(r"\btd\.(\w+)", block.text) if n not in td.__all__}
            assert not unknown, block.where


# Generated reference


def test_every_registered_member_has_its_place_in_the_reference(build) -> None:
    from compensation.exports import EXPORTS
    from data.checks import CHECKS
    from features.selectors import SELECTORS
    from models.families import FAMILIES
    from twin.mechanisms import MECHANISMS

    made = build.pages()
    for key in MECHANISMS:
        assert f"\n### {key}\n" in made["reference/mechanisms.md"]
        for spec in MECHANISMS[key].parameters:
            assert f"| `{spec.name}` |" in made["reference/mechanisms.md"]
    for key in (*SELECTORS, *FAMILIES):
        assert f"\n| `{key}` |" in made["reference/selectors_families.md"]
    for key in (*CHECKS, *EXPORTS):
        assert f"\n| `{key}` |" in made["reference/recordings_exports.md"]


def test_every_command_and_option_is_in_the_reference(build) -> None:
    from pipelines.cli import program

    text = build.cli_page()
    sections = dict(re.findall(r"^## (thermodrift [\w -]+)\n(.*?)(?=^## |\Z)", text, flags=re.M | re.S))
    for name, command in build._commands("thermodrift", program()):
        assert all(f"`{o}`" in sections[name] for p in command.params for o in p.opts if o.startswith("-")), name


def test_every_key_of_the_yaml_files_is_in_the_reference(build) -> None:
    from data.machine import Machine
    from pipelines import settings
    from twin.schema import TwinPart

    for page, *roots in ((build.machine_file_page(), Machine, TwinPart), (build.settings_page(), settings._File)):
        for model in (m for root in roots for m in build._contained(root)):
            assert all(f"| `{key}` |" in page for key in model.model_fields), model


def test_comments_of_the_source_explain_the_keys(build) -> None:
    from twin.schema import Body

    assert build._comments(Body)["capacity"] == "J/K, of the whole body"


def test_a_page_that_loads_from_the_network_is_found(build, tmp_path) -> None:
    page = tmp_path / "page.html"
    page.write_text(
        '<link rel="stylesheet" href="https://fonts.example/a.css"><script src="//cdn.example/b.js"></script>'
        '<style>@import "https://c.example/c.css"; a { background: url(https://d.example/d.png) }</style>'
        '<a href="https://fine.example">a link loads nothing</a><link rel="canonical" href="https://fine.example">'
    )
    found = build.loaded_from_network(page)
    assert len(found) == 4 and not any("fine" in f for f in found)
    page.write_text('<script src="assets/a.js"></script><a href="https://fine.example">x</a>')
    assert not build.loaded_from_network(page)


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_needs_no_network(tmp_path) -> None:
    """`make docs` without the pictures; strict: a broken link or a page outside the navigation fails."""
    import subprocess

    pytest.importorskip("material", reason="mkdocs-material is not installed; pip install 'thermodrift[docs]'")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    assert (tmp_path / "site" / "reference" / "mechanisms.html").exists()
