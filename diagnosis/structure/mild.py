"""Mild physics that every machine has and no file states: columns of the covariance, no claims.

A film that is stated as a constant follows its temperature difference, and no heat and no film is the same in every
run. Without them these would pass for missing physics.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from data.arrays import Array
from data.batch import Batch
from data.machine import Machine
from diagnosis.candidates.discretisation import films_W_per_K, from_run_to_run
from diagnosis.candidates.library import candidates, driver_channels
from diagnosis.contracts import Candidate, Fitted
from diagnosis.policy import POLICY
from diagnosis.screening.linearisation import asleep, columns_of
from diagnosis.structure.policy import STRUCTURE
from diagnosis.structure.rows import Linear
from twin.calibration.problem import CalibrationProblem
from twin.schema import TwinPart


def varying_columns(fitted: Fitted, linear: Linear) -> Array:
    """Columns (n, k): every stated heat and film by its run-to-run sd, each run on its own."""
    rows, out = linear.rows, []
    for k, sd in from_run_to_run(fitted).items():
        column = linear.jacobian[:, k] * (sd / fitted.problem.unknowns[k].spread)
        for b in range(rows.batches):
            own = np.zeros(rows.n)
            own[rows.batch(b)] = column[rows.batch(b)]
            out.append(own)
    return np.array(out).T if out else np.zeros((rows.n, 0))


def law_columns(
    machine: Machine, part: TwinPart, problem: CalibrationProblem, batches: Sequence[Batch], nuisance: list[Array]
) -> Array:
    """Columns (n, k), per prior sd: natural convection where the file states a constant film, a heat that is not quite
    in proportion to its own driver, and the clocks of channels: each a little, all of them by up to a row, since a
    driver that is held from row to row may have changed anywhere between."""
    every = candidates(machine, part, ("natural_convection", "supply_sag", "time_skew"))
    sd: dict[str, float] = dict(mild_laws(part, problem, problem.network.values, every))
    step_s = max(b.step_s for b in batches)
    clocks = {c.name for c in every if c.mechanism == "time_skew" and c.amplitudes}
    sd |= dict.fromkeys(clocks, STRUCTURE.clock_sd_rows * step_s)
    chosen = [c for c in every if c.name in sd]
    if not chosen:
        return np.zeros((sum(len(m.row) for m in problem.measured), 0))
    found = asleep(machine, part, chosen)
    kept = [c for c in chosen if c.name in found.amplitudes]
    numbers = [found.amplitudes[c.name][0] for c in kept]
    columns = columns_of(problem, batches, found.network, np.zeros(len(problem.unknowns)), nuisance, numbers)
    together = columns[:, [c.name in clocks for c in kept]].sum(axis=1, keepdims=True)
    return np.hstack([columns * [sd[c.name] for c in kept], together * (STRUCTURE.common_clock_sd_rows * step_s)])


def mild_laws(
    part: TwinPart, problem: CalibrationProblem, values: Array, every: Collection[Candidate]
) -> Mapping[str, float]:
    """Prior sd of the amplitude of what the file states a little differently, by candidate: m² or a share."""
    return {**stated_films(part, problem, values, every), **_own_driver(part, every)}


def _own_driver(part: TwinPart, every: Collection[Candidate]) -> dict[str, float]:
    """Heats that sag with the driver that makes them."""
    out = {}
    for c in every:
        if c.mechanism == "supply_sag" and c.part is not None and isinstance(c.part.acts_on, str):
            heat = part.mechanisms.get(c.part.acts_on)
            if heat is not None and driver_channels(c.part) & driver_channels(heat):
                out[c.name] = STRUCTURE.heat_shape_sd
    return out


def stated_films(
    part: TwinPart, problem: CalibrationProblem, values: Array, every: Collection[Candidate]
) -> Mapping[str, float]:
    """Prior sd, m², of natural convection at the bodies whose film the file states as a constant, by candidate."""
    conductance = {e.name: 0.0 for e in problem.network.edges}
    for e in problem.network.edges:
        conductance[e.name] += float(e.conductance(values))
    film = films_W_per_K(part, conductance)
    out = {}
    for c in every:
        if c.mechanism == "natural_convection" and c.part is not None and isinstance(c.part.at, Mapping):
            stated = film.get((c.where.name, str(c.part.at["air"])), 0.0)
            if stated > 0:
                out[c.name] = POLICY.film_area_sd * stated
    return out
