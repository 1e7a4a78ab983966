"""Compensation and receiver in closed loop: nothing breaks, and what `tests.control` counts as broken is found."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from compensation.runtime import Compensator
from tests import control, hostile
from tests.compensation.test_any_order import InMemory

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc to compile the receiver")


def test_hostile_streams_break_nothing(tmp_path: Path) -> None:
    loops = control.run(tmp_path, 60, 0, 1)
    assert [loop.broken for loop in loops] == [()] * 60
    (row,) = control.summary(loops)
    assert row["active_samples"] > 0.3 * row["samples"] and row["restarts"] > 60
    assert row["largest_step_of_limit"] == pytest.approx(1.0)  # the limits are reached, so that they are tried


@needs_gcc
def test_the_compiled_receiver_is_its_reference(tmp_path: Path) -> None:
    compiled, reference = hostile.receiver(hostile.LIMITS, tmp_path), hostile.Reference(hostile.LIMITS)
    for number in range(10):
        one, other = (hostile.Stream(number, 2, r).run() for r in (compiled, reference))
        assert replace(one, share=0.0) == replace(other, share=0.0)
        assert one.share == pytest.approx(other.share, abs=1e-6)


def broken(receiver: hostile.Receiver) -> set[str]:
    return {b.partition(":")[0] for k in range(12) for b in hostile.Stream(k, 3, receiver).run().broken}


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"rate_um_per_s": 0.06}, {"step"}),
        ({"step_um": 1.1}, {"step"}),
        ({"hold_s": 4000.0}, {"not at 0"}),
        ({"stale_s": 1e6, "rate_um_per_s": 0.001}, {"dead sender", "not at 0"}),
    ],
)
def test_a_receiver_with_other_limits_is_found(change: dict[str, float], found: set[str]) -> None:
    assert broken(hostile.Reference(replace(hostile.LIMITS, **change))) == found


def test_a_larger_correction_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    wide = replace(hostile.LIMITS, max_offset_um=25.0)
    axis = replace(hostile.toy.MODEL, limits=replace(wide, max_offset_um=15.0))
    monkeypatch.setattr(hostile, "LIMITS", replace(hostile.LIMITS, max_offset_um=10.0))
    monkeypatch.setattr(hostile.toy, "MODEL", axis)
    assert "size" in broken(hostile.Reference(wide))


def test_a_model_that_stands_still_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    moves: Callable[..., None] = Compensator._rows

    def once(self: Compensator, time_s: float, rows: Any) -> None:
        before_s = self._grid_s
        moves(self, time_s, rows)
        self._grid_s = time_s if before_s is None else before_s

    monkeypatch.setattr(Compensator, "_rows", once)
    assert "stands still" in broken(hostile.Reference(hostile.LIMITS))


def test_a_restart_that_stays_off_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    loads: Callable[..., Mapping[str, Any] | None] = InMemory.load

    def stopped(self: InMemory, log: Callable[[str], None] = print) -> Mapping[str, Any] | None:
        known = loads(self, log)
        return None if known is None else {**known, "stopped": True}

    monkeypatch.setattr(InMemory, "load", stopped)
    assert broken(hostile.Reference(hostile.LIMITS)) == {"not active again"}


@pytest.mark.slow  # warm-up lasts a minute
@pytest.mark.integration
def test_a_command_that_ends_in_every_way_is_active_again(tmp_path: Path) -> None:
    loops = control.run(tmp_path, 0, 4, 1)
    assert sorted(loop.what for loop in loops) == sorted(control.ENDS)
    assert [loop.broken for loop in loops] == [()] * 4
    assert all(loop.active_s is not None and loop.active_s >= control.SENDER.warm_up_s for loop in loops)
