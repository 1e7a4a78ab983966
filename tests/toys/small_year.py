"""Recordings of a small machine as CSV files: two temperatures, a driver, and displacements by a known law."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

GAIN_UM_PER_K = (3.0, -1.5)  # z per K of front and bed
NOISE_UM = 0.4
STEP_S = 300

MACHINE = """
machine: {name}
simulated: true
recording:
  files: ["*.csv", "*.xlsx"]
  time: {{column: time_s, unit: s}}
  step_s: 300
  max_gap_s: 900
  start_from_name: "%Y%m%d"
channels:
  front: {{role: temperature, unit: degC, resolution: 0.01, range: [-20, 80]}}
  bed: {{role: temperature, unit: degC, resolution: 0.01, range: [-20, 80]}}
  room: {{role: ambient, unit: degC, resolution: 0.01, range: [-20, 60]}}
  speed: {{role: driver, unit: rpm, resolution: 1, range: [0, 8000]}}
  x: {{role: error, unit: um, resolution: 0.1, range: [-300, 300]}}
  z: {{role: error, unit: um, resolution: 0.1, range: [-300, 300]}}
"""


def write_machine(path: Path, name: str) -> Path:
    """The machine file."""
    path.write_text(MACHINE.format(name=name), encoding="utf-8")
    return path


def law_um(table: pd.DataFrame) -> np.ndarray:
    """z as the temperatures of a table give it, µm."""
    front, bed = (table[c] - table[c].iloc[0] for c in ("front", "bed"))
    return (GAIN_UM_PER_K[0] * front + GAIN_UM_PER_K[1] * bed).to_numpy()


def recording(k: int) -> pd.DataFrame:
    """The k-th recording of the year, 6 h in steps of 5 min, unrounded law plus noise."""
    rng = np.random.default_rng(k)
    time_s = np.arange(0, 6 * 3600 + 1, STEP_S)
    speed_rpm = 2000.0 * (1 + k % 3)
    start_degC = 5.0 + 4.0 * k
    room = start_degC + (0.5 + 0.4 * k) * time_s / time_s[-1] + 0.2 * np.sin(time_s / (1500 + 200 * k))
    front = start_degC + speed_rpm / 400 * (1 - np.exp(-time_s / (2400 + 100 * k)))
    bed = start_degC + (1 + k % 2) * (1 - np.exp(-time_s / 9000)) + 0.3 * (room - room[0])
    table = pd.DataFrame({"time_s": time_s, "front": front, "bed": bed, "room": room, "speed": speed_rpm})
    for column in ("front", "bed", "room"):
        table[column] = (table[column] + rng.normal(0, 0.02, len(table))).round(2)
    table["x"] = (2.0 * (table["bed"] - table["bed"][0]) + rng.normal(0, NOISE_UM, len(table))).round(1)
    table["z"] = (law_um(table) + rng.normal(0, NOISE_UM, len(table))).round(1)
    return table


def write_year(folder: Path, batches: int = 6, first: int = 0) -> list[Path]:
    """Recordings `first` to `first + batches`, one a month, as YYYYMMDD.csv."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"2025{1 + k:02d}14.csv" for k in range(first, first + batches)]
    for k, path in enumerate(paths, first):
        recording(k).to_csv(path, index=False)
    return paths
