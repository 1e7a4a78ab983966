"""Clean recordings of a simulated machine, as a data check must leave them."""

from __future__ import annotations

import numpy as np
import pandas as pd

from data.batch import Batch
from data.machine import Machine, parse_machine

MACHINE = """
machine: toy
recording: {step_s: 300, max_gap_s: 900}
channels:
  front: {role: temperature, unit: degC, resolution: 0.1, range: [-20, 90]}
  rear: {role: temperature, unit: degC, resolution: 0.1, range: [-20, 90]}
  head: {role: temperature, unit: degC, resolution: 0.1, range: [-20, 90]}
  column: {role: temperature, unit: degC, resolution: 0.1, range: [-20, 90]}
  bed: {role: temperature, unit: degC, resolution: 0.1, range: [-20, 90]}
  room: {role: ambient, unit: degC, resolution: 0.1, range: [-20, 50]}
  spindle_rpm: {role: driver, unit: rpm, resolution: 1}
  x: {role: error, unit: um, resolution: 1, range: [-500, 500]}
  z: {role: error, unit: um, resolution: 1, range: [-500, 500]}
"""
THERMAL = ("front", "rear", "head", "column", "bed")
AIR = (*THERMAL, "room")
TAU_S = np.array([1200.0, 1800.0, 3600.0, 10000.0, 28000.0])
GAIN_K = np.array([20.0, 14.0, 10.0, 6.0, 2.0])  # at 6000 rpm
OFFSET_K = np.array([0.1, -0.1, 0.2, -0.2, 0.1])
STANDING_S, STOP_S, STEP_S = 300.0, 6 * 3600.0, 300.0


def toy_machine(**changes: object) -> Machine:
    return parse_machine(MACHINE, "toy").model_copy(update=changes)


def toy_batch(seed: int, step_s: float = STEP_S) -> Batch:
    """A clean run of 6 h and a stop of 2 h: first-order parts, quantised 0.1 K and 1 µm, speed shift, 0.7 µm noise."""
    rng = np.random.default_rng(seed)
    machine = toy_machine()
    time_s = np.arange(0.0, 8 * 3600.0 + 1.0, step_s)
    share = rng.choice([1 / 3, 2 / 3, 1.0])
    speed = np.where((time_s >= STANDING_S) & (time_s < STOP_S), 6000.0 * share, 0.0)
    start = rng.uniform(3.0, 32.0)
    drift = rng.uniform(-1.0, 5.0)
    room = start + drift * time_s / time_s[-1] + 0.3 * np.sin(2 * np.pi * time_s / rng.uniform(1500, 5000))
    rise = np.zeros((len(time_s), 5))
    now = rng.uniform(-2.0, 4.0) * np.array([0.0, 0.0, 0.2, 0.6, 1.0])
    gain = GAIN_K * share**1.4 * rng.uniform(0.85, 1.15)
    for i in range(len(time_s)):
        rise[i] = now
        air = np.array([0.2, 0.2, 0.4, 0.6, 0.7]) * (room[i] - start)
        goal = gain * (speed[i] > 0) + air
        now = goal + (now - goal) * np.exp(-step_s / TAU_S)
    truth = start + rise
    table = pd.DataFrame({"time_s": time_s})
    for j, name in enumerate(THERMAL):
        table[name] = np.round(truth[:, j] + OFFSET_K[j], 1)
    table["room"] = np.round(room, 1)
    table["spindle_rpm"] = speed
    shift = 4.0 * (speed / 6000.0) ** 2
    x = 0.8 * rise[:, 2] - 1.5 * rise[:, 3]
    z = 2.0 * rise[:, 0] + 2.5 * rise[:, 2] - 2.0 * rise[:, 3] - shift
    for name, error in (("x", x), ("z", z)):
        samples = np.round((error - error[0])[:, None] + rng.normal(0, 0.7, (len(time_s), 5)))
        table[name] = samples.mean(axis=1)  # five samples of 1 µm a row
    return Batch("toy", f"b{seed:02d}", table[["time_s", *machine.channels]], machine.batch_channels())
