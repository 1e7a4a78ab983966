"""Copies of recordings that are not stored as one batch: trimmed, continued, shifted in time."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch
from data.checks.copies import Copied
from data.machine import parse_machine

MACHINE = parse_machine("{machine: toy, channels: {t0: {role: temperature, unit: degC}}}", "test")


def part(batch: Batch, rows: slice, batch_id: str) -> Batch:
    table = batch.table.iloc[rows].reset_index(drop=True)
    table["time_s"] -= table["time_s"].iloc[0]
    return replace(batch, batch_id=batch_id, table=table, start=pd.Timestamp("2026-01-01"))


@pytest.mark.parametrize(("rows", "n"), [(slice(7, None), 53), (slice(0, 30), 30), (slice(0, 60), 60)])
def test_a_part_of_another_batch_is_found(rows: slice, n: int, toy_batches: Callable[..., list[Batch]]) -> None:
    batches = toy_batches()
    found = Copied().across([*batches, part(batches[2], rows, "copy")], MACHINE)
    (finding,) = found.pop(len(batches))
    assert not found and not finding.masks and finding.channel is None
    assert finding.message.startswith(f"{n} of {n} rows, from 0 min to ") and "as batch b02:" in finding.message
    assert "`thermodrift lake withdraw toy copy --reason TEXT`" in finding.message


def test_a_run_that_is_exported_with_the_next_one(toy_batches: Callable[..., list[Batch]]) -> None:
    a, b, *others = toy_batches()
    both = replace(a, batch_id="both", table=pd.concat([a.table, b.table.assign(time_s=b.time_s + 18000)]))
    (finding,) = Copied().across([*others, b, both], MACHINE)[len(others) + 1]
    assert (finding.start_s, finding.end_s) == (18000.0, float(18000 + b.time_s[-1]))


def test_machines_at_rest_and_small_differences_are_no_copies(toy_batches: Callable[..., list[Batch]]) -> None:
    batches = toy_batches()
    at_rest = [replace(b, table=b.table.assign(**dict.fromkeys(b.channels, 20.0))) for b in batches[:2]]
    noisy = replace(batches[2], table=batches[2].table + 1e-9 * np.arange(60)[:, None])
    assert Copied().across([*batches, *at_rest, noisy], MACHINE) == {}
    assert Copied().across([], MACHINE) == {} and Copied().across([part(batches[0], slice(0, 9), "a")], MACHINE) == {}
