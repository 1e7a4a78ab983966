"""A design's batches made ready for a network: free-running from drivers and surroundings, nothing else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch
from data.errors import InputError
from models.base import Array
from models.parts.twin_folds import SUBSTEPS_K
from twin.network import Network
from twin.simulation import choose_substeps, simulate
from twin.simulation.inputs import Inputs, inputs_of
from twin.simulation.start import start_of

_REMEMBERED = 8  # simulations: every selector's cells, and every error channel, ask for the same ones


@dataclass(frozen=True)
class TwinRun:
    """Batches that can be simulated, numbered `used` among all `batches`; holes in what drives them are bridged."""

    network: Network
    batches: tuple[Batch, ...]
    used: NDArray[np.int64]
    inputs: Inputs | None
    _done: dict[bytes, tuple[Array, Array]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, network: Network, batches: Sequence[Batch]) -> TwinRun:
        """A batch without a driver or a surrounding that the network needs cannot be simulated."""
        used = np.array([k for k, b in enumerate(batches) if _runs(network, b)], np.int64)
        if not len(used):
            return cls(network, tuple(batches), used, None)
        inputs = inputs_of(network, [batches[k] for k in used], max_gap_s=math.inf)
        substeps = choose_substeps(network, network.values, inputs, "settled", SUBSTEPS_K)
        return cls(network, tuple(batches), used, inputs.refined(substeps))

    @property
    def n_rows(self) -> list[int]:
        return [b.n_rows for b in self.batches]

    def only(self, numbers: Sequence[int]) -> TwinRun:
        """Some of the batches."""
        place = {int(k): i for i, k in enumerate(self.used)}
        used = np.array([i for i, k in enumerate(numbers) if k in place], np.int64)
        inputs = self.inputs.batch([place[numbers[i]] for i in used]) if self.inputs is not None and len(used) else None
        return TwinRun(self.network, tuple(self.batches[k] for k in numbers), used, inputs)

    def start_degC(self, values: Array, start_K: Array) -> Array:
        """Start (…, used batches, N) of parameter sets (…, n_parameters): settled, and the usual deviation (…, N)."""
        assert self.inputs is not None
        return np.asarray(start_of(self.network, values, self.inputs, settled=True) + start_K[..., None, :])

    def by_batch(self, series: Array | None) -> list[Array]:
        """A series (used batches, K) as one array (n_k,) per batch, NaN for one that cannot be simulated."""
        out = [np.full(n, np.nan) for n in self.n_rows]
        for i, k in enumerate(self.used):
            assert series is not None
            out[k] = series[i, : len(out[k])]
        return out

    def rows(self, values: Array, start_K: Array, error: int) -> tuple[Array, Array]:
        """One error (F, n) and the readings (F, n, sensors) at all rows, batch after batch, of F parameter sets.

        values (F, n_parameters); start_K (F, N): by how much batches start above the state that settles with the first
        values of their surroundings. NaN in a batch that cannot be simulated.
        """
        key = values.tobytes() + start_K.tobytes()
        if key not in self._done:
            if len(self._done) >= _REMEMBERED:
                self._done.pop(next(iter(self._done)))
            self._done[key] = self._simulated(values, start_K)
        errors, readings = self._done[key]
        return errors[..., error], readings

    def _simulated(self, values: Array, start_K: Array) -> tuple[Array, Array]:
        n_sets, borders = len(values), np.cumsum([0, *self.n_rows])
        errors = np.full((n_sets, borders[-1], len(self.network.errors)), np.nan)
        readings = np.full((n_sets, borders[-1], len(self.network.readings)), np.nan)
        if self.inputs is not None:
            done = simulate(self.network, values, self.inputs, self.start_degC(values, start_K))
            for i, k in enumerate(self.used):
                rows, n = slice(borders[k], borders[k + 1]), self.batches[k].n_rows
                errors[:, rows] = done.errors[:, i, :n]
                readings[:, rows] = done.readings[:, i, :n]
        return errors, readings


def _runs(network: Network, batch: Batch) -> bool:
    try:
        inputs_of(network, [batch], max_gap_s=math.inf)
    except InputError:
        return False
    return True
