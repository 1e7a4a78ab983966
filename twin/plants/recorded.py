"""From the course of a plant to a recording: lag, offset, drift, clock, noise and rounding; rows and channels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from scipy.signal import lfilter

from data.batch import Batch, Channel
from twin.plants.casting import Array
from twin.plants.effects.base import Effect
from twin.plants.machine import Plant, Sensor
from twin.plants.options import Options
from twin.plants.physics import Course
from twin.plants.runs import Run, held
from twin.plants.seeds import stream

AMBIENT_LAG_S = 45.0
ERRORS = ("x", "y", "z")
ERROR_STEP_UM = 0.1


def recordings(
    plant: Plant, runs: Sequence[Run], course: Course, effects: Sequence[Effect], seed: int, name: str,
    channels: Mapping[str, Channel], options: Options,
) -> list[Batch]:  # fmt: skip
    """What the instruments show, one batch a run; `channels` says which there are, in this order."""
    true = shown(plant, course, effects)
    ahead = {k: v for e in effects for k, v in e.ahead_s().items()}
    rows_s = np.arange(0.0, runs[0].hours * 3600.0 + 1.0, options.step_s)
    out = []
    for b, run in enumerate(runs):
        rng = stream(seed, f"noise {b}")
        table = {"time_s": rows_s}
        for c in channels.values():
            if c.role == "driver":
                table[c.name] = held(
                    {"spindle_rpm": run.speed, "feed": run.feed, "coolant": run.coolant}[c.name], rows_s
                )
                continue
            seen = np.interp(rows_s + ahead.get(c.name, 0.0), course.time_s, true[c.name][:, b])
            table[c.name] = _measured(seen, c, rng, options)
        out.append(
            Batch(
                name, run.batch_id, pd.DataFrame(table), channels, start=run.start, simulated=True, source="simulated"
            )
        )
    return out


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
