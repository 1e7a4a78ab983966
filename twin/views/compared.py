"""Simulated against recorded, channel by channel: what figures and reports of a fit are made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from twin.simulation import Simulation

RMS_COLUMNS = ("batch", "channel", "unit", "rows", "rms")


@dataclass(frozen=True)
class Compared:
    """One batch: C channels (temperatures, then errors) at K rows; nan where nothing usable is recorded.

    recorded and computed (C, K) in the channels' units, displacements from their first reading. `simulated` marks that
    the recording itself comes from a simulation.
    """

    batch_id: str
    simulated: bool
    time_s: Array
    channels: tuple[str, ...]
    units: tuple[str, ...]
    recorded: Array
    computed: Array

    @property
    def residual(self) -> Array:
        """Recorded less computed (C, K)."""
        return self.recorded - self.computed

    @property
    def rms(self) -> Array:
        """Root mean square of the residual by channel (C,); nan for a channel without a reading."""
        square = self.residual**2
        known = np.isfinite(square).sum(axis=1)
        total = np.nansum(square, axis=1)
        return np.sqrt(np.divide(total, known, out=np.full(len(known), np.nan), where=known > 0))


def compared(simulation: Simulation, batches: Sequence[Batch], which: int = 0) -> list[Compared]:
    """Every batch of a simulation with its recording, for one parameter set; without channels that a batch lacks.

    Raises:
        InputError: other batches than the simulation's, or rows that are not the recordings'.
    """
    network = simulation.network
    ids = tuple(b.batch_id for b in batches)
    if ids != simulation.batch_ids:
        raise InputError(
            f"machine {network.machine}: the simulation is of {', '.join(simulation.batch_ids)}, got recordings "
            f"{', '.join(ids)}; give the batches that were simulated, in their order"
        )
    return [_one(simulation, b, k, which) for k, b in enumerate(batches)]


def rms_table(parts: Sequence[Compared]) -> pd.DataFrame:
    """Batch × channel: `RMS_COLUMNS`, rms in the channel's unit."""
    rows = [
        (c.batch_id, channel, unit, int(np.isfinite(residual).sum()), rms)
        for c in parts
        for channel, unit, residual, rms in zip(c.channels, c.units, c.residual, c.rms, strict=True)
    ]
    return pd.DataFrame(rows, columns=list(RMS_COLUMNS))


def _one(simulation: Simulation, batch: Batch, k: int, which: int) -> Compared:
    network, n = simulation.network, batch.n_rows
    time_s = simulation.time_s[k][simulation.valid[k]]
    if len(time_s) != n or not np.allclose(time_s, batch.time_s - batch.time_s[0], atol=1e-6):
        raise InputError(
            f"batch {batch.batch_id}: the simulation has {len(time_s)} rows, the recording {n}; simulate at the "
            "rows of the recording"
        )
    channels, units, recorded, computed = [], [], [], []
    for i, r in enumerate(network.readings):
        if r.channel in batch.table.columns:
            channels.append(r.channel)
            units.append("K")
            recorded.append(batch.masked(r.channel))
            computed.append(simulation.readings[which, k, :n, i])
    for i, e in enumerate(network.errors):
        if e.channel in batch.table.columns:
            values = batch.masked(e.channel)
            known = np.flatnonzero(np.isfinite(values))
            channels.append(e.channel)
            units.append(e.unit)
            shown = simulation.errors[which, k, :n, i]
            recorded.append(values - (values[known[0]] - shown[known[0]] if len(known) else 0.0))
            computed.append(shown)
    shape = (len(channels), n)
    return Compared(
        batch.batch_id,
        batch.simulated,
        time_s,
        tuple(channels),
        tuple(units),
        np.array(recorded, float).reshape(shape),
        np.array(computed, float).reshape(shape),
    )
