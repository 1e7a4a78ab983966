"""Where a search for places is linearised, and how it moves nearer to what the places found leave."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from data.errors import WorkError
from twin.calibration.fit_noise import Noise
from twin.calibration.fit_problem import Array
from twin.calibration.problem import CalibrationProblem
from twin.diagnosis.places.fit_rows import FitRows
from twin.diagnosis.places.forced import ForcedNetwork, Hats, on_channels
from twin.diagnosis.places.free_series import Basis
from twin.diagnosis.places.place_search import Held, PlaceSearch

LONGEST_STEP = 3.0  # prior sd: beyond it a linearised model says little
SAME_STEP = 0.3  # prior sd: parameters that move by less are where they were


@dataclass(frozen=True)
class Point:
    """A network linearised at parameters x (p,) and nuisances by batch, and the search there.

    A calibration that lacks an effect bends its parameters. Beside what is found they move back, without the effect in
    the network: its own response then stays what it is, and does not trade its size against capacities.
    """

    problem: CalibrationProblem
    x: Array
    nuisance: tuple[Array, ...]
    hats: Hats
    forced: ForcedNetwork
    search: PlaceSearch
    last_step: float = np.inf  # prior sd of the parameter that moved most to come here

    @classmethod
    def of(cls, problem: CalibrationProblem, x: Array, nuisance: Sequence[Array], hats: Hats, noise: Noise) -> Point:
        """Linearised anew.

        Raises:
            WorkError: the simulation fails there.
        """
        forced = ForcedNetwork.of(problem, x, nuisance)
        search = PlaceSearch(FitRows.of(problem, x, nuisance), tuple(_bases(problem, forced, hats)), noise)
        return cls(problem, x, tuple(nuisance), hats, forced, search)

    @property
    def settled(self) -> bool:
        return self.last_step < SAME_STEP

    def moved(self, held: Sequence[Held]) -> Point:
        """To the optimum beside what is held, with the noise that is left there; with nothing held, the noise alone."""
        optimum = self.search.optimum(held)
        here = replace(self, search=PlaceSearch(self.search.fitted, self.search.bases, optimum.noise), last_step=0.0)
        if not held:
            return here
        step = float(np.abs(optimum.dz).max(initial=0.0))
        dz = optimum.dz * min(1.0, LONGEST_STEP / max(step, 1e-9))
        low, high = np.array([(u.low, u.high) for u in self.problem.unknowns]).T
        x = np.clip(self.x + self.search.fitted.spread * dz, low, high)
        nuisance = [v[:q] for v, q in zip(optimum.nuisance, self.problem.nuisance_sizes, strict=True)]
        try:
            return replace(Point.of(self.problem, x, nuisance, self.hats, optimum.noise), last_step=step)
        except WorkError:  # too far: what was found stands as it is
            return here


def _bases(problem: CalibrationProblem, forced: ForcedNetwork, hats: Hats) -> Iterator[Basis]:
    network, sensors = problem.network, len(problem.network.readings)
    errors = range(sensors, len(problem.channels))
    yield Basis("heat", tuple(network.bodies), ("W",) * len(network.bodies), hats, forced.responses(hats))
    if len(errors):
        yield Basis("displacement", *_named(problem, errors), hats, on_channels(problem, hats, errors))
    if sensors:
        yield Basis("sensor", *_named(problem, range(sensors)), hats, on_channels(problem, hats, range(sensors)))


def _named(problem: CalibrationProblem, channels: Sequence[int]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    return tuple(problem.channels[c] for c in channels), tuple(problem.units[c] for c in channels)
