"""The plant at work, and its recordings: losses and effects drive the cells through all runs of a case at once; lag,
offset, drift, clock, noise and rounding give the rows of a recorder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.signal import lfilter

from data.arrays import Array
from data.batch import Batch, Channel
from data.timegrid import repair_time, to_grid
from thermodrift_exam.plants.effects.base import Effect
from thermodrift_exam.plants.options import MAX_HOLE_S, Options, stream
from thermodrift_exam.plants.runs import Now, Run, held, moments
from thermodrift_exam.plants.structure import Heat, Plant, Sensor, Source

LEAD_S, TAIL_S = 900.0, 900.0  # simulated finely about the run itself: lags settle, clocks may be off
COARSE_S = 60.0  # step in the hours before


@dataclass(frozen=True)
class Course:
    """B runs at fine steps: time_s (M,), cells_degC (M, N, B), speed and air (M, B)."""

    runs: Sequence[Run]
    time_s: Array
    cells_degC: Array
    speed_rpm: Array
    room_degC: Array
    wall_degC: Array


def simulated(
    plant: Plant, runs: Sequence[Run], effects: Sequence[Effect], step_s: float, before_h: float = 10.0
) -> Course:
    """All runs of a case, from `before_h` before their starts to `TAIL_S` beyond their ends, kept from -`LEAD_S` on.

    `step_s` divides `LEAD_S`; the runs are equally long.
    """
    s = plant.structure
    first_s = -3600.0 * before_h
    room0 = np.array([float(r.room_degC(np.array([first_s]))[0]) for r in runs])
    slow = np.zeros(s.size)
    slow[np.concatenate([s.cells[n] for n in ("bed", "column", "table")])] = 1.0
    start = room0 + slow[:, None] * np.array([r.slow_K for r in runs])

    def stretch(from_s: float, until_s: float, size_s: float, at: Array) -> Array:
        steps = round((until_s - from_s) / size_s)
        heat = heat_of(plant, runs, effects, from_s, size_s, steps)
        return s.integrate(heat, at, size_s, steps)

    before = stretch(first_s, -LEAD_S, COARSE_S, start)
    end_s = runs[0].hours * 3600.0 + TAIL_S
    cells = stretch(-LEAD_S, end_s, step_s, before[-1])
    time_s = -LEAD_S + np.arange(len(cells), dtype=np.float64) * np.float64(step_s)
    shown = moments(runs, time_s, time_s)
    speed, room, wall = (np.stack([getattr(m, n) for m in shown]) for n in ("speed_rpm", "room_degC", "wall_degC"))
    return Course(runs, time_s, cells, speed, room, wall)


def heat_of(
    plant: Plant, runs: Sequence[Run], effects: Sequence[Effect], from_s: float, step_s: float, steps: int
) -> Heat:
    """The heat into the cells other than conduction and constant convection, as the solver evaluates it."""
    at_s = from_s + np.arange(steps, dtype=np.float64) * np.float64(step_s)
    now = [moments(runs, at_s, at_s + share * step_s) for share in plant.structure.stages]
    friction = np.array([r.friction for r in runs])
    shares = np.stack([source.share for source in plant.sources.values()], axis=1)
    room = plant.structure.room_W_per_K[:, None]

    def heat_W(step: int, stage: int, cells_degC: Array) -> Array:
        moment = now[stage][step]
        watts = np.stack([
            power_W(source, moment, plant.rated_rpm, friction) * _feedback(effects, name, cells_degC, moment)
            for name, source in plant.sources.items()
        ])  # fmt: skip
        heat = np.einsum("ns,sb->nb", shares, watts) + room * moment.room_degC
        for effect in effects:
            effect.add_heat_W(heat, cells_degC, moment)
        return np.asarray(heat)

    return heat_W


def power_W(source: Source, now: Now, rated_rpm: float, friction: Array) -> Array:
    """A source's heat, W, (B,).

    Bearings after Palmgren (1959): viscous with n^(5/3), load with n; motors after Bertotti (1988).
    """
    x = now.speed_rpm / rated_rpm
    if source.law == "viscous":
        return np.asarray(source.watts[0] * x ** (5.0 / 3.0) * friction)
    if source.law == "load":
        return np.asarray(source.watts[0] * x * friction)
    idle, linear, quadratic = source.watts
    return np.asarray(source.amount * np.where(x > 0, idle + linear * x + quadratic * x**2, 0.0))


def _feedback(effects: Sequence[Effect], name: str, cells_degC: Array, now: Now) -> Array | float:
    out: Array | float = 1.0
    for effect in effects:
        out = out * effect.friction(name, cells_degC, now)
    return out


AMBIENT_LAG_S = 45.0
ERRORS = ("x", "y", "z")
ERROR_STEP_UM = 0.1
GAP_STEPS = 3.0  # a longer hole stays a hole


def written(
    plant: Plant, course: Course, effects: Sequence[Effect], seed: int, channels: Mapping[str, Channel],
    options: Options,
) -> list[pd.DataFrame]:  # fmt: skip
    """The rows that the recorder wrote, one table a run: early ones, holes and absent sensors as they were."""
    true = shown(plant, course, effects)
    ahead = {k: v for e in effects for k, v in e.ahead_s().items()}
    due_s = np.arange(0.0, course.runs[0].hours * 3600.0 + 1.0, options.step_s)
    out = []
    for b, run in enumerate(course.runs):
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
