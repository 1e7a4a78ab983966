"""A fault contradicts the drivers and the other channels; what they explain is none, however steep it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Finding
from data.checks import check_batch, check_machine, checked
from data.machine import parse_machine

BOARD = parse_machine(
    "machine: board\nrecording: {step_s: 5, max_gap_s: 30}\nchannels:\n"
    "  heater1: {role: driver, unit: '%', range: [0, 100]}\n"
    "  heater2: {role: driver, unit: '%', range: [0, 100]}\n"
    "  T1: {role: temperature, unit: degC, resolution: 0.01, range: [-20, 150]}\n"
    "  T2: {role: temperature, unit: degC, resolution: 0.01, range: [-20, 150]}\n"
    "  room: {role: ambient, unit: degC, resolution: 0.01, range: [-20, 60]}\n",
    "board",
)
STEP_S, ROWS, ON_ROW, NOISE_K = 5.0, 199, 60, 0.1
STEEPEST_K = 1.46  # of T1 in a row


def board(seed: int, second: bool = False) -> Batch:
    """995 s of a board: heater 1 steps from 5 to 85 %; T1 follows by two bodies in series, T2 by the board between."""
    rng = np.random.default_rng(seed)
    heater1 = np.where(np.arange(ROWS) < ON_ROW, 5.0, 85.0)
    heater2 = np.where(np.arange(ROWS) < 130, 0.0, 60.0 * second)
    t1, t2 = np.zeros(ROWS), np.zeros(ROWS)
    for k in range(1, ROWS):
        t1[k] = t1[k - 1] + 0.0205 * (heater1[k - 1] - t1[k - 1]) + 0.004 * (t2[k - 1] - t1[k - 1])
        t2[k] = t2[k - 1] + 0.015 * (heater2[k - 1] - t2[k - 1]) + 0.004 * (t1[k - 1] - t2[k - 1])
    t1 *= STEEPEST_K / np.diff(t1).max()
    table = pd.DataFrame({"time_s": STEP_S * np.arange(ROWS), "heater1": heater1, "heater2": heater2})
    for name, rise in (("T1", t1), ("T2", t2), ("room", np.zeros(ROWS))):
        table[name] = np.round(22.0 + rise + rng.normal(0.0, NOISE_K, ROWS), 2)
    return Batch("board", f"b{seed}", table, BOARD.batch_channels())


def masks(batch: Batch) -> list[Finding]:
    return [f for f in check_batch(batch, BOARD) if f.masks]


def with_values(batch: Batch, name: str, values: np.ndarray) -> Batch:
    return replace(batch, table=batch.table.assign(**{name: np.round(values, 2)}))


@pytest.mark.parametrize("second", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_a_heater_that_steps_is_no_fault_of_its_sensor(seed: int, second: bool) -> None:
    assert [f.message for f in check_batch(board(seed, second), BOARD)] == []


@pytest.mark.parametrize("row", [20, ON_ROW + 8, 150])
@pytest.mark.parametrize("name", ["T1", "T2"])
@pytest.mark.parametrize("size", [8.0, -8.0])
def test_a_jump_that_no_other_channel_follows_is_a_fault(name: str, row: int, size: float) -> None:
    batch = board(1)
    found = masks(with_values(batch, name, batch.values(name) + size * (np.arange(ROWS) >= row)))
    assert [(f.check, f.channel, f.end_s) for f in found] == [("jump_no_return", name, None)]
    assert abs((found[0].start_s or 0.0) - row * STEP_S) <= 2 * STEP_S


@pytest.mark.parametrize("row", [20, ON_ROW + 8, 150])
def test_a_spike_while_the_heater_works_is_a_fault(row: int) -> None:
    batch = board(2)
    found = masks(with_values(batch, "T1", batch.values("T1") + 6.0 * (np.arange(ROWS) == row)))
    assert [(f.check, f.channel, f.start_s, f.end_s) for f in found] == [("spike", "T1", row * STEP_S, row * STEP_S)]


@pytest.mark.parametrize("value", [-200.0, 850.0])
def test_an_unplugged_sensor_is_a_fault(value: float) -> None:
    batch = board(3)
    found = masks(with_values(batch, "T1", np.where(np.arange(ROWS) >= 100, value, batch.values("T1"))))
    assert {(f.check, f.channel) for f in found} == {("out_of_range", "T1")}
    assert found[0].start_s == 500.0 and found[0].end_s == batch.time_s[-1]


def test_a_held_value_while_the_board_heats_is_a_fault() -> None:
    batch = board(4)
    v = batch.values("T1").copy()
    v[ON_ROW + 5 : ON_ROW + 60] = v[ON_ROW + 5]
    found = masks(with_values(batch, "T1", v))
    assert {(f.check, f.channel) for f in found} == {("frozen", "T1")}


def test_a_sensor_that_drifts_in_one_run_is_a_fault() -> None:
    batches = [replace(board(k), batch_id=f"b{k}") for k in range(8)]
    drift = np.linspace(0.0, 12.0, ROWS)
    batches[5] = with_values(batches[5], "T2", batches[5].values("T2") + drift)
    known = check_machine([checked(b, BOARD) for b in batches], BOARD)
    assert {(k, f.check, f.channel) for k, b in enumerate(known) for f in b.findings if f.masks} == {
        (5, "offset", "T2")
    }


def slow(batch: Batch) -> Batch:
    return replace(batch, table=batch.table.assign(heater1=5.0))


@pytest.mark.parametrize("change", [slow, lambda b: with_values(b, "heater1", b.values("heater1")[::-1].copy())])
def test_the_same_rise_that_no_driver_explains_needs_no_mask_either(change: Callable[[Batch], Batch]) -> None:
    """Without the driver the rise is none of a sensor alone: it is spread over many rows."""
    assert [f.message for f in masks(change(board(5)))] == []


def test_a_bed_that_is_heated_from_the_first_row_on_is_in_degrees_Celsius() -> None:
    batch = board(6)
    heated = with_values(batch, "T2", 76.5 - (76.5 - 23.43) * np.exp(-np.arange(ROWS) / 0.6))
    assert [f.message for f in check_batch(heated, BOARD) if f.check == "wrong_unit"] == []
