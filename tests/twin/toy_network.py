"""A random thermal network and its brute-force solution, for tests of the linear response."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from twin.simulation.modes import modes_of
from twin.simulation.response import Response, Schedule


class Toy:
    """A random network with everything that a run needs; small enough to solve by brute force."""

    def __init__(self, seed: int, n_nodes: int = 4, n_regimes: int = 2, n_series: int = 3, n_sets: int = 1) -> None:
        rng = np.random.default_rng(seed)
        self.rng, self.n_nodes = rng, n_nodes
        self.capacity = np.exp(rng.uniform(np.log(500), np.log(5e4), (n_sets, n_nodes)))
        links = rng.uniform(0, 20, (n_sets, n_regimes, n_nodes, n_nodes)) * (rng.random((n_nodes, n_nodes)) < 0.6)
        links = np.triu(links, 1) + np.triu(links, 1).swapaxes(-1, -2)
        self.conductance = -links
        diagonal = np.arange(n_nodes)
        self.conductance[..., diagonal, diagonal] = links.sum(-1) + rng.uniform(0, 3, (n_sets, n_regimes, n_nodes))
        self.directions = rng.normal(0, 30, (n_sets, n_regimes, n_series, n_nodes))
        self.modes = modes_of(self.capacity, self.conductance)

    def series(self, n_batches: int, n_intervals: int, n_sets: int = 1) -> np.ndarray:
        return self.rng.normal(size=(n_sets, self.directions.shape[2], n_batches, n_intervals, 2))

    def temperatures(
        self, schedule: Schedule, series: np.ndarray, start_degC: np.ndarray, every: int = 1
    ) -> np.ndarray:
        response = Response(self.modes, schedule)
        return response.run(response.forcing(self.directions, series), start_degC, every).at(
            np.eye(self.n_nodes)[None], 1
        )

    def by_expm(self, dt_s: np.ndarray, regime: np.ndarray, series: np.ndarray, start_degC: np.ndarray) -> np.ndarray:
        """Node temperatures (M + 1, N) of one batch by the exponential of the network with its ramps as states."""
        n, n_series = self.n_nodes, self.directions.shape[2]
        states = [start_degC]
        for dt, r, values in zip(dt_s, regime, series.swapaxes(0, 1), strict=True):
            full = np.zeros((n + 2 * n_series,) * 2)
            full[:n, :n] = -self.conductance[0, r] / self.capacity[0][:, None]
            full[:n, n : n + n_series] = (self.directions[0, r] / self.capacity[0]).T
            full[n : n + n_series, n + n_series :] = np.eye(n_series) / dt
            state = np.concatenate([states[-1], values[:, 0], values[:, 1] - values[:, 0]])
            states.append((expm(full * dt) @ state)[:n])
        return np.array(states)


def one_schedule(dt_s: float, n_intervals: int, n_batches: int = 1) -> Schedule:
    return Schedule(np.full((n_batches, n_intervals), dt_s), np.zeros((n_batches, n_intervals), int))
