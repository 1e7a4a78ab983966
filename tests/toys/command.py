"""`thermodrift ARGS` in this process: exit code, what it printed, what it complained of."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import NamedTuple

import pytest

from pipelines import cli


class Done(NamedTuple):
    code: int
    out: str
    err: str


Call = Callable[..., Done]


def in_process(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """A function that runs the command with its arguments."""

    def run(*args: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["thermodrift", *map(str, args)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main()
        shown = capsys.readouterr()
        return Done(int(ended.value.code or 0), shown.out, shown.err)

    return run
