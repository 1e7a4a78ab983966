"""What the lake relies on, for every registered check of recordings; that it finds its fault is a test of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from data.batch import Batch, Finding
from data.checks import CHECKS
from data.checks.base import Check
from tests.toys.recordings import toy_batch, toy_machine

CLEAN = [toy_batch(seed) for seed in range(6)]


def changed(**values: Callable[[np.ndarray], np.ndarray]) -> Batch:
    batch = toy_batch(len(CLEAN))
    return replace(batch, table=batch.table.assign(**{n: change(batch.values(n)) for n, change in values.items()}))


def after(row: int, um: float, rows: int = 100) -> Callable[[np.ndarray], np.ndarray]:
    return lambda v: v + um * ((np.arange(len(v)) >= row) & (np.arange(len(v)) < row + rows))


RECORDINGS = {
    "clean": changed(),
    "jump": changed(bed=after(30, 12.0), x=after(25, 40.0)),
    "spike": changed(column=after(20, 8.0, 1), z=after(20, 40.0, 1), rear=after(40, 850.0, 5)),
    "held": changed(front=lambda v: np.full(len(v), v[0]), z=lambda v: np.where(np.arange(len(v)) > 30, v[30], v)),
    "copied": replace(CLEAN[2], batch_id="b06"),
}


@pytest.fixture(params=CHECKS, name="c")
def check(request: pytest.FixtureRequest) -> Check:
    check: Check = CHECKS[request.param]()
    return check


def found(c: Check, batch: Batch) -> list[Finding]:
    """In one recording, alone and among clean ones."""
    across = c.across([*CLEAN, batch], toy_machine())
    return [*c.batch(batch, toy_machine()), *across.get(len(CLEAN), [])]


@pytest.mark.parametrize("name", RECORDINGS)
def test_findings_have_key_channel_time_and_message_and_change_nothing(c: Check, name: str) -> None:
    batch = RECORDINGS[name]
    before, end_s = batch.table.copy(), float(batch.time_s[-1])
    findings = found(c, batch)
    for f in findings:
        assert f.check == c.key and (f.channel is None or f.channel in batch.channels)
        assert 0.0 <= (f.start_s or 0.0) <= (end_s if f.end_s is None else f.end_s) <= end_s
        assert f.message and "\n" not in f.message and isinstance(c.habit(batch, f), str)
    assert name != "clean" or not findings
    assert found(c, batch) == findings and batch.table.equals(before) and not batch.findings


def test_little_is_survived(c: Check) -> None:
    """A logger that stops at once, a sensor that never sends, a machine with one run, or with none."""
    whole = RECORDINGS["held"]
    lost = ["front", "spindle_rpm"]
    fewer = {n: s for n, s in whole.channels.items() if n not in lost}
    for batch in (
        replace(whole, table=whole.table.iloc[:2].reset_index(drop=True)),
        replace(whole, table=whole.table.assign(front=np.nan, spindle_rpm=np.nan)),
        replace(whole, table=whole.table.drop(columns=lost), channels=fewer),
    ):
        found(c, batch)
        c.across([batch], toy_machine())
    c.across([], toy_machine())
