"""The plant at work: losses of the spindle and all effects drive the cells through every run of a case at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data.arrays import Array
from plants.effects.base import Effect
from plants.runs import Now, Run, moments
from plants.structure import Heat, Plant, Source

LEAD_S, TAIL_S = 900.0, 900.0  # simulated finely about the run itself: lags settle, clocks may be off
COARSE_S = 60.0  # step in the hours before


@dataclass(frozen=True)
class Course:
    """Everything at fine steps of B batches: time_s (M,), cells_degC (M, N, B), speed and room (M, B)."""

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
    return Course(time_s, cells, speed, room, wall)


def heat_of(
    plant: Plant, runs: Sequence[Run], effects: Sequence[Effect], from_s: float, step_s: float, steps: int
) -> Heat:
    """The heat into the cells beside conduction and constant convection, as the solver asks for it."""
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
