"""Recordings and designs: a run with a known law, a machine file with a twin, stacked rows of a year."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pandas as pd

from data.arrays import Array
from data.batch import Batch, Channel
from data.machine import Machine, parse_machine
from features.design import Design

INPUTS = ("front", "column", "bed")
N = 72
LENGTHS = [30, 42, 25, 37, 33]
P = 7

# The twin knows three bodies and what drives them, not the law of `make_batch`.
MACHINE = """
machine: vmc
recording: {step_s: 300}
channels:
  front: {role: temperature, unit: degC, resolution: 0.1}
  column: {role: temperature, unit: degC, resolution: 0.1}
  bed: {role: temperature, unit: degC, resolution: 0.1}
  spindle: {role: driver, unit: rpm}
  z: {role: error, unit: um, resolution: 0.1}
twin:
  surroundings: {hall: {first: [bed]}}
  bodies:
    front: {capacity: {value: 30 kJ/K, spread: 0.5}}
    column: {capacity: {value: 150 kJ/K, spread: 0.5}}
    bed: {capacity: {value: 400 kJ/K, spread: 0.5}}
  links: {front-column: {value: 20 W/K, spread: 0.5}, column-bed: {value: 20 W/K, spread: 0.5}}
  exposures: {front-hall: {value: 5 W/K, spread: 0.5}, column-hall: {value: 5 W/K, spread: 0.5}, bed-hall: 10 W/K}
  mechanisms:
    belt: {law: belt_loss, drivers: spindle, into: front, parameters: {power: {value: 600 W, spread: 0.5}}}
  sensors: {front: {at: front}, column: {at: column}, bed: {at: bed}}
  errors:
    z:
      chain:
        - {body: front, gain: {value: 2 um/K, spread: 1 um/K}}
        - {body: column, gain: {value: 2 um/K, spread: 1 um/K}}
"""


@cache
def machine() -> Machine:
    return parse_machine(MACHINE, "vmc")


def make_batch(k: int) -> Batch:
    """A six-hour run, drawn with seed k, whose error follows its sensors and its load, with noise."""
    rng = np.random.default_rng(k)
    time_s = np.arange(N) * 300.0
    load, ambient = rng.uniform(0.5, 1.2), rng.uniform(5, 30)
    fast, slow = load * 18 * (1 - np.exp(-time_s / 2400)), load * 9 * (1 - np.exp(-time_s / 9000))
    drift = rng.normal(0, 2) * time_s / time_s[-1]
    table = pd.DataFrame({
        "time_s": time_s,
        "front": ambient + 0.9 * fast + 0.2 * slow + drift,
        "column": ambient + 0.2 * fast + 0.8 * slow + drift,
        "bed": ambient + 0.3 * slow + drift,
        "spindle": np.where(time_s > 0, 4000.0 * load, 0.0),
        "z": 12.0 + 1.8 * fast + 2.4 * slow + 1.5 * drift + rng.normal(0, 0.3, N),
    })  # fmt: skip
    table[list(INPUTS)] = (table[list(INPUTS)] + rng.normal(0, 0.03, (N, 3))).round(1)
    channels = {name: Channel(name, "temperature", "degC", 0.1, -20, 120) for name in INPUTS}
    channels |= {"spindle": Channel("spindle", "driver", "rpm"), "z": Channel("z", "error", "um", 0.1)}
    return Batch("vmc", f"K{k + 1}", table, channels)


def along_an_axis(batch: Batch) -> Batch:
    """The same run read at four positions in turn, after a first sweep at rest; the error grows with the position."""
    table = batch.table.assign(at=np.resize([0.0, 60.0, 120.0, 180.0], N))
    table.loc[1:3, [*INPUTS, "z"]] = table.loc[0, [*INPUTS, "z"]].to_numpy()
    table["z"] += 0.01 * table["at"] * (table["front"] - table["front"][0])
    channels = {
        **batch.channels,
        "at": Channel("at", "position", "mm"),
        "z": Channel("z", "error", "um", position="at"),
    }
    return Batch("vmc", batch.batch_id, table, channels)


def runs(along: bool, *extra: int) -> list[Batch]:
    """Five runs, and those of further seeds; `along` an axis or not."""
    made = [make_batch(k) for k in (*range(5), *extra)]
    return [along_an_axis(b) for b in made] if along else made


@cache
def design(along: bool) -> Design:
    """The five runs."""
    return Design.build(runs(along), INPUTS, "z", machine())


def stack(
    x: Array,
    y: Array,
    lengths: Sequence[int],
    inputs: tuple[str, ...] | None = None,
    step_s: float = 300.0,
    units: tuple[str, ...] = (),
) -> Design:
    """A design of rows made by hand: x (n, p) in K unless `units` says otherwise, y (n,) in µm."""
    inputs = inputs or tuple(f"t{i}" for i in range(x.shape[1]))
    ids = tuple(f"b{k}" for k in range(len(lengths)))
    time_s = np.concatenate([step_s * np.arange(n) for n in lengths])
    return Design(inputs, "z_um", ids, x, y, time_s, np.cumsum([0, *lengths]), step_s, input_units=units)


def walks(seed: int = 0, sizes: Sequence[int] = (14, 9, 12, 11, 13), p: int = 2, units: tuple[str, ...] = ()) -> Design:
    """Rises that only grow, and an error that bends with the first of them, with noise of 0.5 µm."""
    rng = np.random.default_rng(seed)
    x = np.vstack([np.cumsum(rng.uniform(0, 2, (n, p)), axis=0) for n in sizes])
    y = 3 * x[:, 0] - 2 * x[:, -1] + 8 * np.sin(x[:, 0] / 8) + rng.normal(0, 0.5, len(x))
    return stack(x, y, sizes, step_s=60.0, units=units)


NOISE_UM = 0.5


def warm_ups(
    batches: int = 8,
    rows: int = 30,
    seed: int = 0,
    own_slope: float = 0.0,
    curve_um: float = 0.0,
    units: tuple[str, ...] = ("K", "K"),
) -> Design:
    """Two rises a batch; y = 3 a − 2 b, with a curve, with a slope of the batch's own on a, with noise."""
    rng = np.random.default_rng(seed)
    x, y = [], []
    for _ in range(batches):
        end_K = rng.uniform(5, 20, 2)
        rise = end_K * (1 - np.exp(-np.arange(rows)[:, None] / rng.uniform(5, 15, 2)))
        law = 3 * rise[:, 0] - 2 * rise[:, 1] + curve_um * np.sin(rise[:, 0] / 5)
        y.append(law + own_slope * rng.normal() * rise[:, 0] + rng.normal(0, NOISE_UM, rows))
        x.append(rise)
    return stack(np.vstack(x), np.concatenate(y), [rows] * batches, step_s=60.0, units=units)


def year(seed: int = 11, p: int = P) -> tuple[Array, Array]:
    """Rises (n, p) of sensors that share three slow modes, as a machine's do, and an error (n,) made from them."""
    rng = np.random.default_rng(seed)
    modes = []
    for n in LENGTHS:
        t = 300.0 * np.arange(n)
        taus = np.array([1500.0, 6000.0, 20000.0])
        modes.append((1 - np.exp(-t[:, None] / taus)) * rng.uniform(0.3, 2.0, 3) * [1, 1, rng.choice([-1, 1])])
    m = np.concatenate(modes)
    x = m @ rng.uniform(0, 6, (3, p)) + rng.normal(0, 0.1, (len(m), p))
    return x, m @ [20.0, 9.0, -12.0] + rng.normal(0, 0.5, len(m))
