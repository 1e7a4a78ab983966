"""Runs of a plant in several variants at once, the readings of its channels, and the rows of the recorder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from data.arrays import Array, Mask
from data.batch import Batch, Channel
from data.timegrid import repair_time, to_grid
from thermodrift_exam.plants.kinds.effects.base import Effect, Seen, lagged
from thermodrift_exam.plants.kinds.engine import integrate
from thermodrift_exam.plants.kinds.plant import KindPlant
from thermodrift_exam.plants.kinds.runs import KindRun, Now, driven
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.runs import held

LEAD_S, TAIL_S = 600.0, 330.0  # simulated finely about the runs: lags settle, clocks may be off
AMBIENT_LAG_S = 40.0
GAP_ROWS = 3.0  # a longer hole stays a hole


@dataclass(frozen=True)
class Course:
    """V variants of B runs: time_s (M,); watched quantities by name, (M, V, B); air and drivers (M, B)."""

    runs: Sequence[KindRun]
    time_s: Array
    watched: Mapping[str, Array]
    air_degC: Mapping[str, Array]
    drive: Mapping[str, Array]


def simulated(
    plant: KindPlant, runs: Sequence[KindRun], effects: Sequence[Effect], sizes: Array, step_s: float,
    before_h: float | None = None, watching: Sequence[Effect] = (),
) -> Course:  # fmt: skip
    """All runs with every row of `sizes` (V, effects), from `before_h` before their starts to beyond their ends.

    `step_s` divides the rows' step. Quantities that the effects in `watching` request are kept too.
    """
    s, set_up = plant.solid, plant.setting
    before_s = 3600.0 * (set_up.before_h if before_h is None else before_h)
    lead_s = set_up.row_s * np.ceil(LEAD_S / set_up.row_s)
    coarse_steps = max(int(np.ceil((before_s - lead_s) / set_up.before_step_s)), 1)
    first_s = -lead_s - coarse_steps * set_up.before_step_s
    end_s = 3600.0 * max(r.hours for r in runs) + set_up.row_s * np.ceil(TAIL_S / set_up.row_s)
    watch = _watched(plant, [*effects, *watching])
    rows = np.stack(list(watch.values())) if watch else np.zeros((0, s.size))
    air0 = np.array([float(next(iter(r.air.values()))(np.array([first_s]))[0]) for r in runs])
    slow = np.array([r.slow_K for r in runs])
    start = np.tile(air0 + _heavy(plant)[:, None] * slow, (1, len(sizes)))
    strength = [np.repeat(column, len(runs)) for column in sizes.T]

    def stretch(from_s: float, size_s: float, steps: int, at: Array) -> tuple[Array, Array]:
        forcing = Forcing(plant, runs, effects, strength, from_s, size_s, steps)
        return integrate(s, forcing.heat_W, at, size_s, steps, rows, forcing.slowness)

    _, at_lead = stretch(first_s, set_up.before_step_s, coarse_steps, start)
    steps = round((end_s + lead_s) / step_s)
    seen, _ = stretch(-lead_s, step_s, steps, at_lead)
    time_s = -lead_s + step_s * np.arange(steps + 1)
    shaped = seen.reshape(steps + 1, len(rows), len(sizes), len(runs))
    air = {n: np.stack([r.air[n](time_s) for r in runs], axis=1) for n in plant.airs}
    watched = {name: shaped[:, k] for k, name in enumerate(watch)}
    return Course(runs, time_s, watched, air, driven(runs, list(plant.drivers), time_s))


def _watched(plant: KindPlant, effects: Sequence[Effect]) -> dict[str, Array]:
    out = {}
    for sensor in plant.sensors:
        out[f"sensor {sensor.channel}"] = np.eye(1, plant.solid.size, sensor.cell)[0]
    out |= {f"growth {name}": growth.weights_um_per_K for name, growth in plant.growths.items()}
    return out | {f"{e.key} {name}": row for e in effects for name, row in e.watch.items()}


def _heavy(plant: KindPlant) -> Array:
    """1 in the cells of bodies that take long to follow the air, else 0, (N,)."""
    capacity = {b: plant.solid.capacity_J_per_K[c].sum() for b, c in plant.bodies.items()}
    out = np.zeros(plant.solid.size)
    for body, cells in plant.bodies.items():
        out[cells] = float(capacity[body] > np.median(list(capacity.values())))
    return out


class Forcing:
    """All heat of a stretch of steps other than conduction and constant films, for columns variants × runs."""

    def __init__(
        self, plant: KindPlant, runs: Sequence[KindRun], effects: Sequence[Effect], strength: Sequence[Array],
        from_s: float, step_s: float, steps: int,
    ) -> None:  # fmt: skip
        self.plant, self.effects, self.strength = plant, effects, strength
        variants = len(strength[0]) // len(runs) if len(strength) else 1
        begin_s = from_s + step_s * np.arange(steps, dtype=np.float64)
        drive = {n: np.tile(v, variants) for n, v in driven(runs, list(plant.drivers), begin_s).items()}
        scatter = np.tile([r.scatter for r in runs], variants)
        self.names = list(plant.sources)
        self.shares = np.stack([x.share for x in plant.sources.values()], axis=1)
        self.power_W = np.stack([x.power_W(drive) * scatter for x in plant.sources.values()])
        edges_s = from_s + step_s * np.arange(steps + 1, dtype=np.float64)
        air = {n: np.tile(np.stack([r.air[n](edges_s) for r in runs], 1), variants) for n in plant.airs}
        ground = np.tile([r.ground_degC for r in runs], variants)
        clock = np.tile([r.clock_h for r in runs], variants)
        self.now = [
            tuple(
                Now(
                    float(edges_s[k + stage]), {n: v[k] for n, v in drive.items()},
                    {n: v[k + stage] for n, v in air.items()}, ground, (clock + edges_s[k + stage] / 3600.0) % 24.0,
                )
                for stage in (0, 1)
            )
            for k in range(steps)
        ]  # fmt: skip

    def heat_W(self, step: int, stage: int, cells_degC: Array) -> Array:
        now = self.now[step][stage]
        watts = self.power_W[:, step].copy()
        for effect, size in zip(self.effects, self.strength, strict=True):
            for k, name in enumerate(self.names):
                more = effect.factor(name, cells_degC, now, size)
                if more is not None:
                    watts[k] *= more
        out = self.shares @ watts + self.plant.solid.film_heat_W(cells_degC, now.air_degC)
        for effect, size in zip(self.effects, self.strength, strict=True):
            effect.heat_W(out, cells_degC, now, size)
        return out

    def slowness(self, cells_degC: Array) -> Array | None:
        out: Array | None = None
        for effect, size in zip(self.effects, self.strength, strict=True):
            own = effect.slowness(cells_degC, size)
            out = own if out is None else out if own is None else out * own
        return out


def shown(
    plant: KindPlant, course: Course, effects: Sequence[Effect], sizes: Sequence[float], variant: int
) -> dict[str, Array]:
    """Every temperature, ambient and error channel of a variant before clocks, noise and rounding, (M, B)."""
    zero = int(np.argmin(np.abs(course.time_s)))
    own = {name: values[:, variant] for name, values in course.watched.items()}
    step_s = float(course.time_s[1] - course.time_s[0])
    out = {s.channel: lagged(own[f"sensor {s.channel}"], step_s, s.lag_s) + s.offset_K for s in plant.sensors}
    errors = dict.fromkeys(plant.errors, np.zeros_like(next(iter(course.air_degC.values()))))
    for name, growth in plant.growths.items():
        errors[growth.channel] = errors[growth.channel] + own[f"growth {name}"] - own[f"growth {name}"][zero]
    for effect, size in zip(effects, sizes, strict=True):
        seen = seen_by(effect, course, out, own)
        for channel, moved in effect.displaced(seen, size).items():
            errors[channel] = errors[channel] + moved - moved[zero]
        out |= effect.reads(seen, size)
    for name, air in course.air_degC.items():
        out[name] = lagged(air, step_s, AMBIENT_LAG_S)
    return out | errors


def seen_by(effect: Effect, course: Course, temps_degC: Mapping[str, Array], own: Mapping[str, Array]) -> Seen:
    """The view of a variant for an effect; `own` holds its watched quantities."""
    watched = {name: own[f"{effect.key} {name}"] for name in effect.watch}
    zero = int(np.argmin(np.abs(course.time_s)))
    return Seen(course.time_s, dict(temps_degC), watched, course.air_degC, course.drive, zero)


def prepared(plant: KindPlant, runs: Sequence[KindRun], effects: Sequence[Effect], wanted: Sequence[float]) -> None:
    """Passes the plant without effects to those that need it."""
    if not any(e.needs_clean for e in effects):
        return
    course = simulated(plant, runs, [], np.zeros((1, 0)), coarse_s(plant), watching=effects)
    temps = shown(plant, course, [], [], 0)
    own = {name: values[:, 0] for name, values in course.watched.items()}
    of_sensors = {s.channel: temps[s.channel] for s in plant.sensors}
    for effect, sigma in zip(effects, wanted, strict=True):
        if effect.needs_clean:
            noise_K = noise_of(plant, plant.sensors[0].channel)
            effect.prepare(seen_by(effect, course, of_sensors, own), sigma * noise_K)


def coarse_s(plant: KindPlant) -> float:
    """A step for trials: near three of the solver's, an even part of a row's."""
    s = plant.setting
    return float(s.row_s / np.ceil(s.row_s / (3.0 * s.solver_s)))


def on_rows(
    course: Course, true: Mapping[str, Array], ahead_s: Mapping[str, float], b: int, rows_s: Array
) -> dict[str, Array]:
    """The channels of run b at the recorder's rows, its clocks as they go."""
    return {n: np.interp(rows_s + ahead_s.get(n, 0.0), course.time_s, v[:, b]) for n, v in true.items()}


def rows_of(run: KindRun, row_s: float) -> Array:
    return np.arange(0.0, run.hours * 3600.0 + 0.5 * row_s, row_s)


@dataclass(frozen=True)
class Recorder:
    """Habits of the recorder: rows up to `early_s` before they are due, a chance of a hole, a share of lost samples."""

    early_s: float = 0.0
    hole: float = 0.0
    lost: float = 0.0


def written(
    plant: KindPlant, course: Course, true: Mapping[str, Array], ahead_s: Mapping[str, float], seed: int,
    channels: Mapping[str, Channel], recorder: Recorder,
) -> list[pd.DataFrame]:  # fmt: skip
    """The rows that the recorder wrote, one table a run."""
    s = plant.setting
    out = []
    for b, run in enumerate(course.runs):
        rng, habits = stream(seed, f"noise {run.batch_id}"), stream(seed, f"recorder {run.batch_id}")
        rows_s, kept = _rows_s(rows_of(run, s.row_s), habits, recorder)
        values = on_rows(course, true, ahead_s, b, rows_s)
        table = {"time_s": rows_s}
        for c in channels.values():
            if c.role == "driver":
                table[c.name] = held(run.blocks.get(c.name, ()), rows_s)
                continue
            noise, step = (s.noise_um, s.step_um) if c.role == "error" else (s.noise_K, s.step_K)
            noisy = values[c.name] + noise * rng.standard_normal(len(rows_s))
            lost = habits.random(len(rows_s)) < recorder.lost
            rounded = np.rint(noisy / step) * step + 0.0 if step else noisy
            table[c.name] = np.where(lost, np.nan, np.round(rounded, 5))
        out.append(pd.DataFrame(table)[kept].reset_index(drop=True))
    return out


def _rows_s(due_s: Array, rng: np.random.Generator, recorder: Recorder) -> tuple[Array, Mask]:
    rows_s, kept = due_s.copy(), np.ones(len(due_s), bool)
    rows_s[1:-1] -= np.round(recorder.early_s * rng.random(len(due_s) - 2), 1)
    if len(due_s) > 12 and rng.random() < recorder.hole:
        first = int(rng.integers(2, len(due_s) - 8))
        kept[first : first + int(rng.integers(1, 6))] = False
    return rows_s, kept


def gridded(machine: str, run: KindRun, table: pd.DataFrame, channels: Mapping[str, Channel], row_s: float) -> Batch:
    """The batch that a reader makes of a recorder's rows."""
    values = {n: table[n].to_numpy(np.float64) for n in channels if n in table}
    drivers = [c.name for c in channels.values() if c.role == "driver"]
    time_s = repair_time(table["time_s"].to_numpy(np.float64), GAP_ROWS * row_s).time_s
    grid = to_grid(time_s, values, drivers, row_s, GAP_ROWS * row_s, run.batch_id)
    nothing = np.full(len(grid.time_s), np.nan)
    frame = pd.DataFrame({"time_s": grid.time_s, **{n: grid.columns.get(n, nothing) for n in channels}})
    return Batch(machine, run.batch_id, frame, channels, start=run.start, simulated=True, source="simulated")


def noise_of(plant: KindPlant, channel: str) -> float:
    """The sd of a channel's noise with its rounding."""
    s = plant.setting
    noise, step = (s.noise_um, s.step_um) if channel in plant.errors else (s.noise_K, s.step_K)
    return float(np.hypot(noise, step / np.sqrt(12.0)))


def without(plant: KindPlant, effects: Sequence[Effect]) -> KindPlant:
    """The plant without the features that its effects withhold or replace."""
    gone = {name for e in effects for name in e.withholds}
    sources = {k: v for k, v in plant.sources.items() if k not in gone}
    growths = {k: v for k, v in plant.growths.items() if k not in gone}
    return replace(plant, sources=sources, growths=growths)
