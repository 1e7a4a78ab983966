"""Convergence studies of the plants: one machine on finer grids and at finer steps, and a slab with a known solution.

Each study returns a table with `COLUMNS`, a row per run: error against the finest run (or the known solution), the unit
in the quantity's name, and the observed order, that of the changes from one refinement to the next, log2(|u - u/2| /
|u/2 - u/4|) (Roache 1998), NA for the first rows. Grids and steps halve.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pandas as pd
from scipy import sparse
from scipy.optimize import brentq

from data.arrays import Array
from thermodrift_exam.plants.drawing import draw_plant, plant_of
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.elements.geometry import Drawn, draw_castings
from thermodrift_exam.plants.elements.layout import tool_weights_um_per_K
from thermodrift_exam.plants.elements.mesh import Box, Mesh
from thermodrift_exam.plants.elements.structure import conduction_W_per_K, exchange_W_per_K, integrate, storage_J_per_K
from thermodrift_exam.plants.everyday import everyday
from thermodrift_exam.plants.options import Options, stream
from thermodrift_exam.plants.runs import plan_runs
from thermodrift_exam.plants.simulation import simulated
from thermodrift_exam.plants.structure import FEATURES, MATERIALS, Layout, Plant
from thermodrift_exam.plants.volumes.structure import Volumes

COLUMNS = ("plant", "quantity", "refined", "size", "unit", "error", "order")
ROW_S, WARM_UP_H = 300.0, 0.25
VOLUMES_H, VOLUMES_STEP_S = 2.0, 60.0  # the time step of all grids, so that it cancels in their differences
ELEMENTS_H, ELEMENTS_STEP_S = 1.5, 100.0
BIOT, FOURIER, START_K = 2.0, 0.4, 10.0  # of the slab: h L / k, k t / (ρ c L²), before it cools

Row = tuple[str, str, str, float, str, float, float]


def volumes_study(
    seed: int = 4, effect: str = "natural_convection",
    grids: Sequence[int] = (1, 2, 4), steps_s: Sequence[float] = (60.0, 30.0, 15.0),
) -> pd.DataFrame:  # fmt: skip
    """Finite volumes with everyday physics and an effect, against one halving more than the finest of each.

    Grids cut every cell 1, 2, 4, … times along both axes, `size` is the number of cells. `error` is the root mean
    square over all rows, sensors and two runs.
    """
    by_grid = [shown_at(seed, effect, g, VOLUMES_STEP_S) for g in (*grids, 2 * grids[-1])]
    by_step = [shown_at(seed, effect, 1, s) for s in (*steps_s, steps_s[-1] / 2)]
    cells = [_volumes_plant(seed, effect, g).structure.size for g in (*grids, 2 * grids[-1])]
    rows: list[Row] = []
    for refined, unit, sizes, shown in (
        ("grid", "cells", cells, by_grid),
        ("step", "s", [*steps_s, steps_s[-1] / 2], by_step),
    ):
        for quantity in shown[0]:
            rows += _changes("volumes", quantity, (refined, unit), sizes, [values[quantity] for values in shown])
    return pd.DataFrame(rows, columns=list(COLUMNS))


def shown_at(seed: int, effect: str, finer: int, step_s: float) -> dict[str, Array]:
    """Two runs of the finite volumes on rows of `ROW_S`, by quantity, (rows, channels or 1, runs).

    The unsplit cells of the sensors, and the error between tool and table in z.
    """
    plain, plant = _volumes_plant(seed, effect, 1), _volumes_plant(seed, effect, finer)
    cells_degC = _two_runs(plant, seed, effect, VOLUMES_H, step_s)
    weights = np.sum([g.weights_um_per_K for g in plant.growths if g.channel == "z"], axis=0)
    at = [_pieces(plant, plain, s.cell) for s in plain.sensors]
    return {
        "temperature at the sensors, K": np.stack([cells_degC[:, cells].mean(axis=1) for cells in at], axis=1),
        "error z, um": np.einsum("mnb,n->mb", cells_degC - cells_degC[0], weights)[:, None],
    }


def _volumes_plant(seed: int, effect: str, finer: int) -> Plant:
    return draw_plant(seed, EFFECTS[effect].has | {"feed"}, frozenset(), "volumes", finer=finer)


def _pieces(plant: Plant, plain: Plant, cell: int) -> Array:
    """The cells of a finer plant that an unsplit cell is cut into."""
    fine, coarse = plant.structure, plain.structure
    assert isinstance(fine, Volumes)
    name = next(n for n, own in coarse.cells.items() if cell in own)
    return fine.cells[name][fine.castings[name].block == cell - coarse.cells[name][0]]


def elements_study(
    seed: int = 4, effect: str = "preload_feedback", grids: Sequence[int] = (1, 2, 4),
    steps_s: Sequence[float] = (100.0, 50.0, 25.0),
) -> pd.DataFrame:  # fmt: skip
    """Finite elements: a slab against its series; a machine with everyday physics and an effect.

    The machine's errors are against the last of `grids` (cells cut so many times along each axis, `size` is the number
    of nodes) and against half the last of `steps_s`; root mean squares over rows, sensors and two runs. The slab's
    order is that of its errors. The tool's displacement by given temperatures is compared on the first two grids alone.
    """
    cells = (4, 8, 16)
    errors = [slab_error_K(n) for n in cells]
    rows = _rows("elements", "slab against its series, K", ("grid", "cells"), cells, errors, errors)

    sensed, nodes = "temperature at the sensors, K", ("grid", "nodes")
    drawn = [draw_castings(seed, False, finer) for finer in grids]
    sizes = [d.structure.size for d in drawn]
    by_grid = [sensed_degC(d, drawn[0], seed, effect, ELEMENTS_STEP_S) for d in drawn]
    moved = [moved_um(d, drawn[0]) for d in drawn[:2]]
    steps = (*steps_s, steps_s[-1] / 2)
    by_step = [sensed_degC(drawn[0], drawn[0], seed, effect, s) for s in steps]
    rows += _changes("elements", sensed, nodes, sizes, by_grid)
    rows += _changes("elements", "tool by given temperatures, um", nodes, sizes[:2], moved)
    rows += _changes("elements", sensed, ("step", "s"), steps, by_step)
    return pd.DataFrame(rows, columns=list(COLUMNS))


def sensed_degC(drawn: Drawn, plain: Drawn, seed: int, effect: str, step_s: float) -> Array:
    """Two runs on rows of `ROW_S`, at the places of the sensors of the machine with unsplit cells."""
    nodes_degC = _two_runs(_elements_plant(drawn, seed), seed, effect, ELEMENTS_H, step_s)
    rows = carried(plain, drawn)[[sensor.cell for sensor in _elements_plant(plain, seed).sensors]]
    return np.stack([rows @ at for at in nodes_degC])


def carried(plain: Drawn, finer: Drawn) -> sparse.csr_matrix:
    """Values at the finer machine's nodes to values at the plain one's, which are among them."""
    a, b = plain.structure, finer.structure
    blocks = [b.meshes[name].interpolation(mesh.points_m) for name, mesh in a.meshes.items()]
    air = [] if a.air_cell is None else [sparse.identity(1)]
    return sparse.csr_matrix(sparse.block_diag([*blocks, *air]))


def moved_um(drawn: Drawn, plain: Drawn) -> Array:
    """Every channel at the steady-state rise of the plain machine for each heat source alone."""
    s, p = drawn.structure, plain.structure
    heat = np.stack([source.share * 100.0 for source in _elements_plant(plain, 0).sources.values()], axis=1)
    rise = sparse.linalg.spsolve(p.losses(), heat)
    fine = [p.meshes[n].interpolation(m.points_m) @ rise[p.cells[n]] for n, m in s.meshes.items()]
    weights = tool_weights_um_per_K(drawn)
    return np.stack([w[: s.size - (s.air_cell is not None)] @ np.concatenate(fine) for w in weights.values()])


def _elements_plant(drawn: Drawn, seed: int) -> Plant:
    return plant_of(Layout(drawn.structure, ()), seed, frozenset(FEATURES) - {"mandrel"})


def slab_error_K(cells: int, steps: int = 2000) -> float:
    """A slab from `START_K` cooling at one face, insulated at the other, against Carslaw and Jaeger (1959), 3.11:
    the largest error over the nodes at a Fourier number of `FOURIER`."""
    side_m, length_m = 0.1, 0.2
    kg = MATERIALS["steel"].density_kg_per_m3 * length_m * side_m**2
    mesh = Mesh(Box("slab", "steel", kg, (0.0, 0.0, 0.0), (length_m, side_m, side_m), (cells, 1, 1)))
    k, rho_c = mesh.box.conductivity_W_per_mK, mesh.box.capacity_J_per_m3K
    points_m, area_m2 = mesh.hull([(0, 1)]).gauss()
    face = exchange_W_per_K(mesh.interpolation(points_m), BIOT * k / length_m * area_m2)
    losses = sparse.csc_matrix(conduction_W_per_K(mesh, np.arange(cells)) + face)
    start = np.full((mesh.size, 1), START_K)
    step_s = FOURIER * rho_c * length_m**2 / k / steps
    rise = integrate(sparse.csc_matrix(storage_J_per_K(mesh)), losses, lambda *_: 0.0 * start, start, step_s, steps)
    return float(np.abs(rise[-1, :, 0] - _series_K(mesh.points_m[:, 0] / length_m)).max())


def _series_K(place: Array) -> Array:
    """Σ 4 sin ζ / (2 ζ + sin 2ζ) exp(-ζ² Fo) cos(ζ x / L) with ζ tan ζ = Bi."""
    total = np.zeros_like(place)
    for n in range(30):
        zeta = brentq(lambda z: z * np.sin(z) - BIOT * np.cos(z), n * np.pi, (n + 0.5) * np.pi)
        share = 4.0 * np.sin(zeta) / (2.0 * zeta + np.sin(2.0 * zeta))
        total += share * np.exp(-(zeta**2) * FOURIER) * np.cos(zeta * place)
    return START_K * total


def _two_runs(plant: Plant, seed: int, effect: str, hours: float, step_s: float) -> Array:
    """Temperatures of all nodes on rows of `ROW_S`, (rows, N, 2)."""
    work = [*everyday(plant, seed), EFFECTS[effect](plant, 1.0, stream(seed, f"effect {effect}"))]
    runs = plan_runs(seed, Options(batches=2, hours=hours, step_s=ROW_S), plant.rated_rpm)
    course = simulated(plant, runs, work, step_s, WARM_UP_H)
    return course.cells_degC[np.isin(course.time_s, np.arange(0.0, 3600.0 * hours + 1.0, ROW_S))]


def _changes(
    plant: str, quantity: str, refined: tuple[str, str], sizes: Sequence[float], values: Sequence[Array]
) -> list[Row]:
    """Errors of all but the last of the values, against the last."""
    errors = [_rms(value - values[-1]) for value in values[:-1]]
    changes = [_rms(one - other) for one, other in pairwise(values)]
    return _rows(plant, quantity, refined, sizes[:-1], errors, changes)


def _rows(
    plant: str, quantity: str, refined: tuple[str, str], sizes: Sequence[float], errors: Sequence[float],
    falling: Sequence[float],
) -> list[Row]:  # fmt: skip
    """`refined` names the refined quantity and the unit of its size; the order is the rate of decrease of `falling`."""
    orders = [np.nan, *(float(np.log2(a / b)) for a, b in pairwise(falling))]
    what, unit = refined
    table = zip(sizes, errors, orders, strict=True)
    return [(plant, quantity, what, float(size), unit, error, order) for size, error, order in table]


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
