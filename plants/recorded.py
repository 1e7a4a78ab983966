"""From the course of a plant to a recording: lag, offset, drift, clock, noise and rounding; rows and channels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.signal import lfilter

from data.arrays import Array
from data.batch import Batch, Channel
from data.timegrid import repair_time, to_grid
from plants.effects.base import Effect
from plants.options import MAX_HOLE_S, Options, stream
from plants.physics import Course
from plants.runs import Run, held
from plants.structure import Plant, Sensor

AMBIENT_LAG_S = 45.0
ERRORS = ("x", "y", "z")
ERROR_STEP_UM = 0.1
GAP_STEPS = 3.0  # a longer hole stays a hole


def written(
    plant: Plant, runs: Sequence[Run], course: Course, effects: Sequence[Effect], seed: int,
    channels: Mapping[str, Channel], options: Options,
) -> list[pd.DataFrame]:  # fmt: skip
    """The rows that the recorder wrote, one table a run: early ones, holes and absent sensors as they were."""
    true = shown(plant, course, effects)
    ahead = {k: v for e in effects for k, v in e.ahead_s().items()}
    due_s = np.arange(0.0, runs[0].hours * 3600.0 + 1.0, options.step_s)
    out = []
    for b, run in enumerate(runs):
        rng, recorder = stream(seed, f"noise {b}"), stream(seed, f"recorder {b}")
        rows_s, kept = _rows_s(due_s, recorder, options)
        drivers = {"spindle_rpm": run.speed, "feed": run.feed, "coolant": run.coolant, **run.idle}
        table = {"time_s": rows_s}
        for c in channels.values():
            if c.role == "driver":
                table[c.name] = held(drivers[c.name], rows_s)
                continue
            seen = np.interp(rows_s + ahead.get(c.name, 0.0), course.time_s, true[c.name][:, b])
            measured = _measured(seen, c, rng, options)
            if c.role != "temperature" or recorder.random() >= options.absent:
                table[c.name] = measured
        out.append(pd.DataFrame(table)[kept].reset_index(drop=True))
    return out


def gridded(name: str, run: Run, table: pd.DataFrame, channels: Mapping[str, Channel], options: Options) -> Batch:
    """The batch that a reader makes of a recorder's rows."""
    values = {n: table[n].to_numpy(np.float64) for n in channels if n in table}
    drivers = [c.name for c in channels.values() if c.role == "driver"]
    max_gap_s = GAP_STEPS * options.step_s
    time_s = repair_time(table["time_s"].to_numpy(np.float64), max_gap_s).time_s
    grid = to_grid(time_s, values, drivers, options.step_s, max_gap_s, run.batch_id)
    nothing = np.full(len(grid.time_s), np.nan)
    whole = {"time_s": grid.time_s, **{n: grid.columns.get(n, nothing) for n in channels}}
    frame = pd.DataFrame(whole)
    return Batch(name, run.batch_id, frame, channels, start=run.start, simulated=True, source="simulated")


def _rows_s(due_s: Array, recorder: np.random.Generator, options: Options) -> tuple[Array, NDArray[np.bool_]]:
    """When the rows came, s, and which there are; the first and the last are always there and on time."""
    inner = np.zeros(len(due_s))
    inner[1:-1] = 1.0
    rows_s = due_s - np.round(options.early_s * inner * recorder.random(len(due_s)), 1)
    kept = np.ones(len(due_s), bool)
    for _ in range(recorder.poisson(options.gaps)):
        rows = int(recorder.integers(1, max(2, int(MAX_HOLE_S // options.step_s))))
        first = int(recorder.integers(1, max(2, len(due_s) - rows - 1)))
        if kept[first - 1 : first + rows + 1].all():
            kept[first : first + rows] = False
    kept[-1] = True
    return rows_s, kept


def shown(plant: Plant, course: Course, effects: Sequence[Effect]) -> dict[str, Array]:
    """Every temperature, ambient and error channel before noise and rounding, (M, B)."""
    sensors = plant.sensors
    for effect in effects:
        sensors = effect.sensed(sensors)
    out = {s.channel: reading(s, course.cells_degC[:, s.cell], course.time_s) for s in sensors}
    for name, air in (("room", course.room_degC), ("wall", course.wall_degC)):
        out[name] = reading(Sensor(name, "", -1, AMBIENT_LAG_S, 0.0), air, course.time_s)
    zero = int(np.argmin(np.abs(course.time_s)))
    for channel in ERRORS:
        weights = np.zeros(plant.structure.size)
        for growth in (g for g in plant.growths if g.channel == channel):
            weights += growth.amount * growth.weights_um_per_K
        out[channel] = np.einsum("mnb,n->mb", course.cells_degC - course.cells_degC[zero], weights)
    for effect in effects:
        for channel, moved in effect.displaced_um(course.speed_rpm).items():
            out[channel] = out[channel] + moved - moved[zero]
    return out


def reading(sensor: Sensor, true_degC: Array, time_s: Array) -> Array:
    """A first-order lag that starts settled, then offset and drift from the run's start; (M, B)."""
    step_s = time_s[1] - time_s[0]
    keep = np.exp(-step_s / max(sensor.lag_s, 1e-9))
    seen = lfilter([1 - keep], [1, -keep], true_degC, axis=0, zi=keep * true_degC[:1])[0]
    drift_K = sensor.drift_K_per_h * np.clip(time_s, 0.0, None) / 3600.0
    return np.asarray(seen + sensor.offset_K + drift_K[:, None])


def _measured(seen: Array, channel: Channel, rng: np.random.Generator, options: Options) -> Array:
    """Noise, rounding to the instrument's step, and lost samples; + 0.0 turns a negative zero into zero."""
    noise = options.noise_um if channel.role == "error" else options.noise_K
    noisy = seen + noise * rng.standard_normal(len(seen))
    lost = rng.random(len(seen)) < options.missing
    step = channel.resolution or 0.0
    rounded = np.rint(noisy / step) * step + 0.0 if step else noisy
    return np.where(lost, np.nan, np.round(rounded, 6))
