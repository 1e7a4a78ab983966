"""The checks judge seconds, not rows: one recording, thinned from 10 Hz to once a minute, shows the same faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Finding
from data.checks import check_batch
from data.machine import parse_machine
from tests.toys import recordings
from tests.toys.recordings import AIR, GAIN_K, TAU_S, THERMAL

MACHINE = parse_machine(
    recordings.MACHINE.replace("step_s: 300", "step_s: 0.1").replace("resolution: 0.1", "resolution: 0.01"), "toy"
)
STOP_S, END_S, FAULT_S = 6000.0, 8000.0, 3000.0
RATES_S = [0.1, 1.0, 60.0]


def recorded(step_s: float, noise_K: float = 0.02) -> Batch:
    """100 min of running and 33 min of stop in closed form with white noise; every step_s / 0.1 s-th row."""
    rng = np.random.default_rng(0)
    time_s = np.arange(0.0, END_S, 0.1)
    on, off = np.minimum(time_s, STOP_S)[:, None], np.maximum(time_s - STOP_S, 0.0)[:, None]
    rise = GAIN_K * (1.0 - np.exp(-on / TAU_S)) * np.exp(-off / TAU_S)
    table = pd.DataFrame({"time_s": time_s})
    for j, name in enumerate(THERMAL):
        table[name] = np.round(20.0 + rise[:, j] + rng.normal(0.0, noise_K, len(time_s)), 2)
    table["room"] = np.round(20.0 + 0.3 * np.sin(time_s / 600.0) + rng.normal(0.0, noise_K, len(time_s)), 2)
    table["spindle_rpm"] = np.where(time_s < STOP_S, 6000.0, 0.0)
    for name, error in (("x", 0.8 * rise[:, 2]), ("z", 2.0 * rise[:, 0] - rise[:, 3])):
        table[name] = np.round(error + rng.normal(0.0, 0.7, len(time_s)))
    return Batch("toy", "b", table.iloc[:: round(step_s / 0.1)].reset_index(drop=True), MACHINE.batch_channels())


def stepped(batch: Batch, sizes: dict[str, float], spread_s: float) -> Batch:
    """Channels that step at FAULT_S, at once or along a ramp of spread_s."""
    share = np.clip((batch.time_s - FAULT_S) / max(spread_s, 1e-9), 0.0, 1.0)
    new = {n: np.round(batch.values(n) + size * share, 2) for n, size in sizes.items()}
    return replace(batch, table=batch.table.assign(**new))


def findings(batch: Batch) -> tuple[Finding, ...]:
    return check_batch(batch, MACHINE)


@pytest.mark.parametrize("step_s", RATES_S)
@pytest.mark.parametrize("noise_K", [0.0, 0.02, 0.3])
def test_a_clean_recording_is_clean_at_every_rate(step_s: float, noise_K: float) -> None:
    assert [f.message for f in findings(recorded(step_s, noise_K))] == []


@pytest.mark.parametrize(("step_s", "spread_s"), [(0.1, 0.0), (1.0, 0.0), (60.0, 0.0), (60.0, 4.0)])
@pytest.mark.parametrize(("name", "size"), [("bed", 6.0), ("x", 60.0)])
def test_a_jump_within_a_sampling_interval_is_found(name: str, size: float, spread_s: float, step_s: float) -> None:
    found = findings(stepped(recorded(step_s), {name: size}, spread_s))
    assert [(f.check, f.channel, f.end_s) for f in found] == [("jump_no_return", name, None)]
    assert FAULT_S - max(step_s, 10.0) <= (found[0].start_s or 0.0) <= FAULT_S + max(step_s, 0.5)


@pytest.mark.parametrize("minute", [0.0, 30.0])
def test_a_steep_warm_up_is_no_jump(minute: float) -> None:
    """98 µm in one minute and never more than 6.3 µm in 2 s: a slope of many rows."""
    batch = recorded(2.0)
    since_s = np.maximum(batch.time_s - 60.0 * minute, 0.0)
    z = np.round(130.0 * (1.0 - np.exp(-since_s / 42.0)), 1)
    assert 97.0 < z[round(30 * minute) + 30] < 99.5 and np.abs(np.diff(z)).max() < 6.3
    assert [f for f in findings(replace(batch, table=batch.table.assign(z=z))) if f.masks] == []


@pytest.mark.parametrize("spread_s", [0.0, 5.0])
def test_an_interruption_is_found_though_interpolation_spreads_it(spread_s: float) -> None:
    together = {name: 3.0 + 0.4 * k for k, name in enumerate(AIR)}
    found = findings(stepped(recorded(0.1), together, spread_s))
    assert {(f.check, f.channel) for f in found} == {("interruption", "x"), ("interruption", "z")}
    assert all(FAULT_S - 20.0 <= (f.start_s or 0.0) <= FAULT_S for f in found)


@pytest.mark.parametrize("step_s", RATES_S)
def test_a_spike_is_masked_alone(step_s: float) -> None:
    batch = recorded(step_s)
    row = round(FAULT_S / step_s)
    values = batch.values("column").copy()
    values[row] += 5.0
    found = findings(replace(batch, table=batch.table.assign(column=values)))
    assert [(f.check, f.channel) for f in found] == [("spike", "column")]
    assert found[0].start_s == found[0].end_s == batch.time_s[row]
