"""A short run of the fuzzing, and the inputs that once brought something else than the documented error."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from tests import fuzz


def test_damaged_input_brings_the_documented_error_only() -> None:
    rounds = iter(range(40))
    counts, failures = fuzz.fuzz(list(fuzz.TARGETS), itertools.count(1), lambda: next(rounds, None) is not None)
    assert failures == []
    assert counts == dict.fromkeys(fuzz.TARGETS, 40)


@pytest.mark.parametrize(("target", "seed"), [("recordings", 400)])
def test_what_failed_before(target: str, seed: int) -> None:
    assert fuzz.fuzz([target], iter([seed]), iter([True, False]).__next__)[1] == []


def test_the_command_reports_a_failure_and_keeps_its_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(self: fuzz.Messages, given: bytes) -> None:
        raise KeyError("a\nb")

    monkeypatch.setattr(fuzz.Messages, "run", broken)
    arguments = ["messages", "--seconds", "1", "--seed", "7", "--keep", str(tmp_path)]
    assert fuzz.main(arguments) == 1
    assert "seed 7, input in" in capsys.readouterr().out
    assert (tmp_path / "messages-7").exists() and len(list(tmp_path.iterdir())) == 1
