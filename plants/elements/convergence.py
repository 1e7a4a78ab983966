"""Do the finite elements converge? A slab with a known solution; one machine on finer grids and at finer steps."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pandas as pd
from scipy import sparse
from scipy.optimize import brentq

from data.arrays import Array
from plants.drawing import plant_of
from plants.effects import EFFECTS
from plants.elements.geometry import Drawn, draw_castings
from plants.elements.layout import tool_weights_um_per_K
from plants.elements.mesh import Box, Mesh
from plants.elements.structure import conduction_W_per_K, exchange_W_per_K, integrate, storage_J_per_K
from plants.everyday import everyday
from plants.options import stream
from plants.physics import simulated
from plants.runs import plan_runs
from plants.structure import FEATURES, MATERIALS, Layout, Plant

COLUMNS = ("plant", "quantity", "refined", "size", "unit", "error", "order")
SENSED = "temperature at the sensors, K"
FEATURED = frozenset(FEATURES) - {"mandrel"}
HOURS, ROW_S, WARM_UP_H = 1.5, 300.0, 0.25
GRIDS_STEP_S = 100.0  # the same for all grids, so that it drops out of their changes
BIOT, FOURIER, START_K = 2.0, 0.4, 10.0  # of the slab: h L / k, k t / (ρ c L²), before it cools

Row = tuple[str, str, str, float, str, float, float]


def study(
    seed: int = 4, effect: str = "preload_feedback", grids: Sequence[int] = (1, 2, 4),
    steps_s: Sequence[float] = (100.0, 50.0, 25.0),
) -> pd.DataFrame:  # fmt: skip
    """Errors and the orders observed: `COLUMNS`, a row a run, the unit of an error in the name of its quantity.

    A slab against its series; a machine with everyday physics and an effect against the last of `grids` (cells cut so
    many times along each axis, `size` is the number of nodes) and against half the last of `steps_s`; root mean
    squares over rows, sensors and two runs. Grids and steps halve. The slab's order is that of its errors, the
    machine's that of the changes, log2(|u - u/2| / |u/2 - u/4|) (Roache 1998), NA before there are two. What the tool
    does by given temperatures is compared on the first two grids alone.
    """
    cells = (4, 8, 16)
    errors = [slab_error_K(n) for n in cells]
    rows = _rows("slab against its series, K", "grid", "cells", cells, errors, errors)

    drawn = [draw_castings(seed, False, finer) for finer in grids]
    nodes = [d.structure.size for d in drawn]
    rows += _changes(
        SENSED, "grid", "nodes", nodes, [sensed_degC(d, drawn[0], seed, effect, GRIDS_STEP_S) for d in drawn]
    )
    rows += _changes(
        "tool by given temperatures, um", "grid", "nodes", nodes[:2], [moved_um(d, drawn[0]) for d in drawn[:2]]
    )
    by_step = [sensed_degC(drawn[0], drawn[0], seed, effect, s) for s in (*steps_s, steps_s[-1] / 2)]
    rows += _changes(SENSED, "step", "s", (*steps_s, steps_s[-1] / 2), by_step)
    return pd.DataFrame(rows, columns=list(COLUMNS))


def sensed_degC(drawn: Drawn, plain: Drawn, seed: int, effect: str, step_s: float) -> Array:
    """Two runs on rows of `ROW_S`, at the places of the sensors of the machine with unsplit cells."""
    plant, places = _plant(drawn, seed), _plant(plain, seed).sensors
    work = [*everyday(plant, seed), EFFECTS[effect](plant, 1.0, stream(seed, f"effect {effect}"))]
    runs = plan_runs(seed, 2, HOURS, ROW_S, plant.rated_rpm, 0.0)
    course = simulated(plant, runs, work, step_s, WARM_UP_H)
    nodes_degC = course.cells_degC[np.isin(course.time_s, np.arange(0.0, 3600.0 * HOURS + 1.0, ROW_S))]
    rows = carried(plain, drawn)[[sensor.cell for sensor in places]]
    return np.stack([rows @ at for at in nodes_degC])


def carried(plain: Drawn, finer: Drawn) -> sparse.csr_matrix:
    """Values at the finer machine's nodes to values at the plain one's, which are among them."""
    a, b = plain.structure, finer.structure
    blocks = [b.meshes[name].interpolation(mesh.points_m) for name, mesh in a.meshes.items()]
    air = [] if a.air_cell is None else [sparse.identity(1)]
    return sparse.csr_matrix(sparse.block_diag([*blocks, *air]))


def moved_um(drawn: Drawn, plain: Drawn) -> Array:
    """Every channel by the plain machine's rise when each heat source alone has warmed it for good."""
    s, p = drawn.structure, plain.structure
    heat = np.stack([source.share * 100.0 for source in _plant(plain, 0).sources.values()], axis=1)
    rise = sparse.linalg.spsolve(p.losses(), heat)
    fine = [p.meshes[n].interpolation(m.points_m) @ rise[p.cells[n]] for n, m in s.meshes.items()]
    weights = tool_weights_um_per_K(drawn)
    return np.stack([w[: s.size - (s.air_cell is not None)] @ np.concatenate(fine) for w in weights.values()])


def slab_error_K(cells: int, steps: int = 2000) -> float:
    """A slab from `START_K` cooling at one face, insulated at the other, against Carslaw and Jaeger (1959), 3.11:
    the largest error over the nodes at a Fourier number of `FOURIER`."""
    side_m, length_m = 0.1, 0.2
    steel = MATERIALS["steel"]
    kg = steel.density_kg_per_m3 * length_m * side_m**2
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


def _plant(drawn: Drawn, seed: int) -> Plant:
    return plant_of(Layout(drawn.structure, ()), seed, FEATURED)


def _changes(quantity: str, refined: str, unit: str, sizes: Sequence[float], values: Sequence[Array]) -> list[Row]:
    errors = [_rms(value - values[-1]) for value in values[:-1]]
    changes = [_rms(one - other) for one, other in pairwise(values)]
    return _rows(quantity, refined, unit, sizes[:-1], errors, changes)


def _rows(
    quantity: str, refined: str, unit: str, sizes: Sequence[float], errors: Sequence[float], falling: Sequence[float]
) -> list[Row]:
    """The order is how fast `falling` falls from row to row."""
    orders = [np.nan, *(float(np.log2(a / b)) for a, b in pairwise(falling))]
    table = zip(sizes, errors, orders, strict=True)
    return [("elements", quantity, refined, float(size), unit, error, order) for size, error, order in table]


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
