"""Convergence study of the finite volumes: a machine with everyday physics and an effect, on finer grids and steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import pandas as pd

from data.arrays import Array
from thermodrift_exam.plants.drawing import draw_plant
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.everyday import everyday
from thermodrift_exam.plants.options import Options, stream
from thermodrift_exam.plants.runs import plan_runs
from thermodrift_exam.plants.simulation import simulated
from thermodrift_exam.plants.structure import Plant
from thermodrift_exam.plants.volumes.structure import Volumes

COLUMNS = ("plant", "quantity", "refined", "size", "unit", "error", "order")
HOURS, ROW_S, WARM_UP_H = 2.0, 300.0, 0.25
STEP_S = 60.0  # of the grids
QUANTITIES = {"temperature at the sensors": "K", "error z": "um"}

Shown = dict[str, Array]  # of every quantity: (rows, channels or 1, runs)


def study(
    seed: int = 4, effect: str = "natural_convection",
    grids: Sequence[int] = (1, 2, 4), steps_s: Sequence[float] = (60.0, 30.0, 15.0),
) -> pd.DataFrame:  # fmt: skip
    """Errors against one halving more than the finest of each, and the orders observed: `COLUMNS`, a row per run.

    Grids cut every cell 1, 2, 4, … times along both axes, `size` is the number of cells; `steps_s` halve. `error` is
    the root mean square over all rows, sensors and two runs, in the unit of the quantity's name. The order is that of
    the changes from one refinement to the next, log2(|u - u/2| / |u/2 - u/4|) (Roache 1998), NA in the first row.
    """
    by_grid = {float(g): shown_at(seed, effect, g, STEP_S) for g in (*grids, 2 * grids[-1])}
    by_step = {s: shown_at(seed, effect, 1, s) for s in (*steps_s, steps_s[-1] / 2)}
    cells = {float(g): float(_plant(seed, effect, g).structure.size) for g in grids}
    rows = _rows("grid", "cells", by_grid, cells) + _rows("step", "s", by_step, {s: s for s in steps_s})
    return pd.DataFrame(rows, columns=list(COLUMNS))


def shown_at(seed: int, effect: str, finer: int, step_s: float) -> Shown:
    """Two runs of the machine on rows of `ROW_S`: the unsplit cells of its sensors, and the error between tool and
    table in z."""
    plain, plant = _plant(seed, effect, 1), _plant(seed, effect, finer)
    work = [*everyday(plant, seed), EFFECTS[effect](plant, 1.0, stream(seed, f"effect {effect}"))]
    runs = plan_runs(seed, Options(batches=2, hours=HOURS, step_s=ROW_S), plant.rated_rpm)
    course = simulated(plant, runs, work, step_s, WARM_UP_H)
    cells_degC = course.cells_degC[np.isin(course.time_s, np.arange(0.0, 3600.0 * HOURS + 1.0, ROW_S))]
    weights = np.sum([g.weights_um_per_K for g in plant.growths if g.channel == "z"], axis=0)
    at = [_pieces(plant, _structure(plain), s.cell) for s in plain.sensors]
    return {
        "temperature at the sensors": np.stack([cells_degC[:, cells].mean(axis=1) for cells in at], axis=1),
        "error z": np.einsum("mnb,n->mb", cells_degC - cells_degC[0], weights)[:, None],
    }


def _plant(seed: int, effect: str, finer: int) -> Plant:
    return draw_plant(seed, EFFECTS[effect].has | {"feed"}, frozenset(), "volumes", finer=finer)


def _structure(plant: Plant) -> Volumes:
    assert isinstance(plant.structure, Volumes)
    return plant.structure


def _pieces(plant: Plant, plain: Volumes, cell: int) -> Array:
    """The cells of a finer plant that an unsplit cell is cut into."""
    name = next(n for n, own in plain.cells.items() if cell in own)
    s = _structure(plant)
    return s.cells[name][s.castings[name].block == cell - plain.cells[name][0]]


def _rows(
    refined: str, unit: str, shown: Mapping[float, Shown], size: Mapping[float, float]
) -> list[tuple[str | float, ...]]:
    out: list[tuple[str | float, ...]] = []
    every = list(shown)
    *tried, finest = every
    for quantity, measure in QUANTITIES.items():
        change = [_rms(shown[a][quantity] - shown[b][quantity]) for a, b in pairwise(every)]
        for k, at in enumerate(tried):
            error = _rms(shown[at][quantity] - shown[finest][quantity])
            order = float(np.log2(change[k - 1] / change[k])) if k else np.nan
            out.append(("volumes", f"{quantity}, {measure}", refined, size[at], unit, error, order))
    return out


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
