"""A page of the documentation as a session: its files are written, its code and its commands run, its output compared.

A fenced block with ``title="NAME"`` is a file; where NAME lies in a package, the package finds it. One with
``title="MODULE.py: REGISTRY"`` is a line of a registry. Other ``python`` blocks run one after the other in one
namespace; a ``text`` block behind one is what it prints. ``console`` blocks hold ``$ command`` and what it prints. Of
printed lines the page may leave some out; … stands for any text, and numbers may differ a little from computer to
computer.
"""

from __future__ import annotations

import importlib
import io
import re
import shlex
import subprocess
import textwrap
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from toys.command import Call

ROOT = Path(__file__).parents[1]
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>\w*)(?P<rest>[^\n`]*)\n(?P<text>.*?)^(?P=indent)```\s*$", re.M | re.S
)
_NUMBER = r"(\d+(?:\.\d+)?)"
TOLERANCE = 0.05  # of a number, and 0.2 where it has decimals


@dataclass(frozen=True)
class Block:
    """A fenced block; `line` is that of its fence, from 1."""

    page: Path
    line: int
    language: str
    title: str
    text: str

    @property
    def where(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page, with files of the repository in place of ``--8<-- "FILE"``."""
    text = page.read_text(encoding="utf-8")
    found = []
    for m in FENCE.finditer(text):
        title = re.search(r'title="([^"]*)"', m["rest"])
        body = textwrap.dedent(m["text"])
        if include := re.fullmatch(r'--8<-- "([^"]+)"\n', body):
            body = (ROOT / include[1]).read_text(encoding="utf-8")
        line = text.count("\n", 0, m.start()) + 1
        found.append(Block(page, line, m["language"], title[1] if title else "", body))
    return found


def commands(block: Block) -> Iterator[tuple[str, list[str]]]:
    """Each command of a console block with the lines that it prints."""
    command, printed = "", []
    for line in block.text.splitlines():
        if line.startswith("$ "):
            if command:
                yield command, printed
            command, printed = line[2:], []
        elif command.endswith("\\"):
            command = command[:-1] + line.strip()
        elif line.strip():
            printed.append(line)
    if command:
        yield command, printed


def differs(expected: list[str], printed: str) -> str:
    """The first expected line that no printed line is like; "" where there is none."""
    lines = [" ".join(line.split()) for line in printed.splitlines()]
    for line in expected:
        wanted = " ".join(line.split())
        if wanted != "…" and not any(_alike(wanted, got) for got in lines):
            return wanted
    return ""


def _alike(wanted: str, got: str) -> bool:
    parts = re.split(r"(…|\d+(?:\.\d+)?)", wanted)  # every second one is … or a number
    kinds = [".*" if p == "…" else _NUMBER if k % 2 else re.escape(p) for k, p in enumerate(parts)]
    found = re.fullmatch("".join(kinds), got)
    numbers = [p for p in parts[1::2] if p != "…"]
    return bool(found) and all(_close(a, b) for a, b in zip(numbers, found.groups(), strict=True))


def _close(wanted: str, got: str) -> bool:
    decimals = len(wanted.partition(".")[2])
    slack = 0.2 if decimals else 0.0
    return abs(float(wanted) - float(got)) <= max(TOLERANCE * abs(float(wanted)), slack)


def _expanded(argument: str) -> list[str]:
    """What a shell makes of an argument with a wildcard."""
    return sorted(map(str, Path().glob(argument))) or [argument] if "*" in argument else [argument]


class Session:
    """One page, run in the folder that is the working directory."""

    def __init__(self, page: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
        self._page, self._call, self._patch = page, call, monkeypatch
        self._names: dict[str, Any] = {"__name__": "page"}
        self._printed = ""

    def run(self) -> int:
        """Runs every block that can run; the number of those that did. Fails with page and line."""
        ran = 0
        before = ""
        for block in blocks(self._page):
            if block.title:
                self._file(block)
            elif block.language == "python":
                self._python(block)
            elif block.language == "console":
                self._console(block)
            elif block.language == "text" and before == "python":
                line = differs(block.text.splitlines(), self._printed)
                assert not line, f"{block.where}: not printed: {line!r}\ngot:\n{self._printed}"
            ran += block.language in ("python", "console") or bool(block.title)
            before = "" if block.title else block.language
        return ran

    def _file(self, block: Block) -> None:
        name, separator, registry = block.title.partition(": ")
        if separator:
            module = importlib.import_module(name.removesuffix(".py").removesuffix("/__init__").replace("/", "."))
            key, _, where = block.text.strip().rstrip(",").partition(": ")
            members = getattr(module, registry)._members
            self._patch.setitem(members, key.strip('"'), where.strip('"'))
            assert getattr(module, registry)[key.strip('"')], block.where
            return
        path = Path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(block.text, encoding="utf-8")
        package = ".".join(path.parent.parts)
        if path.suffix == ".py" and (ROOT / path.parent / "__init__.py").exists() and package:
            found = importlib.import_module(package)
            self._patch.setattr(found, "__path__", [*found.__path__, str(path.parent.resolve())])

    def _python(self, block: Block) -> None:
        printed = io.StringIO()
        with redirect_stdout(printed):
            exec(compile(block.text, block.where, "exec"), self._names)
        self._printed = printed.getvalue()

    def _console(self, block: Block) -> None:
        for command, expected in commands(block):
            program, *arguments = shlex.split(command, comments=True)
            if program == "thermodrift":
                done = self._call(*(name for given in arguments for name in _expanded(given)))
                code, printed = done.code, done.out + "\n" + done.err
            else:
                shell = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
                code, printed = shell.returncode, shell.stdout + shell.stderr
            assert code == 0, f"{block.where}: {command}: exit code {code}\n{printed}"
            line = differs(expected, printed)
            assert not line, f"{block.where}: {command}: not printed: {line!r}\ngot:\n{printed}"
