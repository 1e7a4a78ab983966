"""The surroundings' temperatures during a simulation: recorded, constant or first readings, offsets and laws."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from twin.network import CompiledSurrounding, Law, Network
from twin.simulation.inputs import Inputs, at_borders


@dataclass(frozen=True)
class Air:
    """S surroundings at both ends of every interval: follow * recorded (the same for all sets) + steady + extra.

    recorded_degC (S, B, M, 2), zero where nothing is recorded; `moving` numbers those that are; follow (P, S) is 1 but
    for ground that follows in part; steady_degC (P, S) constants and offsets; extra_K (P or 1, S, B, M, 2) of laws and
    of batches' own offsets, or None.
    """

    recorded_degC: Array
    moving: NDArray[np.int64]
    follow: Array
    steady_degC: Array
    extra_K: Array | None

    def ends(self, s: int, part: slice = slice(None)) -> Array:
        """Temperature of surrounding s (P, B, M, 2) in some intervals."""
        extra = None if self.extra_K is None else self.extra_K[:, s][:, :, part]
        return self._sum(s, self.recorded_degC[s][:, part], extra)

    def borders(self, s: int, every: int = 1) -> Array:
        """The same at the interval borders ``::every`` (P, B, K): where it jumps, as it was before the jump."""
        extra_K = None if self.extra_K is None else at_borders(self.extra_K[:, s])[..., ::every]
        return self._sum(s, at_borders(self.recorded_degC[s])[..., ::every], extra_K)

    def _sum(self, s: int, recorded_degC: Array, extra_K: Array | None) -> Array:
        axes = (slice(None), s, *(None,) * recorded_degC.ndim)
        out: Array = self.follow[axes] * recorded_degC + self.steady_degC[axes]
        return out if extra_K is None else out + extra_K


def air_of(network: Network, values: Array, inputs: Inputs) -> Air:
    """The surroundings at parameter values (P, n).

    Raises:
        InputError: offsets of another shape.
    """
    recorded, moving = _recorded(network, inputs)
    steady = np.zeros((len(values), len(network.surroundings)))
    follow = np.ones_like(steady)
    for s, given in enumerate(network.surroundings):
        if s not in moving and given.value is not None:
            steady[:, s] += values[:, given.value]
        if follows(given, inputs) and given.value is not None:
            follow[:, s] = values[:, given.follow]
            steady[:, s] += (1.0 - follow[:, s]) * values[:, given.value]
        if given.offset is not None:
            steady[:, s] += values[:, given.offset]
    out = Air(recorded, moving, follow, steady, None)
    return replace(out, extra_K=_extra(network, values, inputs, out))


def recorded_degC(given: CompiledSurrounding, inputs: Inputs) -> Array | None:
    """What is recorded of a surrounding at the borders (B, M + 1); None for a constant that a parameter gives."""
    if given.channel is not None:
        return inputs.recorded[given.channel]
    if given.name in inputs.recorded:  # a plan's word for what the machine file holds constant
        return inputs.recorded[given.name]
    if given.first:
        first = np.nanmean(np.stack([inputs.first[c] for c in given.first]), axis=0)
        return np.repeat(first[:, None], inputs.time_s.shape[1], axis=1)
    return None


def _recorded(network: Network, inputs: Inputs) -> tuple[Array, NDArray[np.int64]]:
    """What is recorded of all surroundings, and the numbers of those; the same for all parameters, so kept."""
    key = ("surroundings", tuple((s.name, s.channel, s.first) for s in network.surroundings))
    if key not in inputs.kept:
        borders = {s: recorded_degC(given, inputs) for s, given in enumerate(network.surroundings)}
        moving = np.array([s for s, b in borders.items() if b is not None], int)
        recorded = np.zeros((len(borders), *inputs.valid.shape, 2))
        for s, b in borders.items():
            if b is not None:
                recorded[s, ..., 0], recorded[s, ..., 1] = b[:, :-1], b[:, 1:]
        inputs.kept[key] = recorded, moving
    kept: tuple[Array, NDArray[np.int64]] = inputs.kept[key]
    return kept


def follows(given: CompiledSurrounding, inputs: Inputs) -> bool:
    """Whether a surrounding is a constant that follows the first readings in part; a plan's word overrides it."""
    return given.follow is not None and given.name not in inputs.recorded


def effect_K(law: Law, values: Array, inputs: Inputs, air: Air) -> Array:
    """What a law adds to a surrounding, at both ends of every interval, (P or 1, B, M, 2)."""
    along = law.mechanism.along_time
    degC, rise_K = {}, {}
    for role, port in law.ports.items():
        if port.cells is not None:
            raise InputError(
                f"mechanism {law.name}: {law.mechanism.key} changes a surrounding by a body's temperature at port "
                f"{role!r}; make the surrounding a body instead"
            )
        ends = air.ends(port.surrounding)
        degC[role] = ends[..., 0] if along else np.moveaxis(ends, -1, -2)
        rise_K[role] = degC[role] - (degC[role][..., :1] if along else degC[role][..., :1, :1])
    out = inputs.intervals.call(law, "surrounding_K", values, along, degC=degC, rise_K=rise_K)
    return inputs.intervals.ends(out, len(values), along)


def _extra(network: Network, values: Array, inputs: Inputs, air: Air) -> Array | None:
    offsets_K, (n_batches, n_intervals) = inputs.offsets_K, inputs.valid.shape
    n_surroundings = len(network.surroundings)
    if offsets_K is None and not any(s.effects for s in network.surroundings):
        return None
    lead = len(values) if any(s.effects for s in network.surroundings) else 1
    if offsets_K is not None:
        if offsets_K.ndim != 3 or offsets_K.shape[1:] != (n_batches, n_surroundings):
            raise InputError(
                f"machine {network.machine}: offsets of surroundings have shape {offsets_K.shape}, expected (sets, "
                f"batches, surroundings) = (…, {n_batches}, {n_surroundings})"
            )
        lead = max(lead, len(offsets_K))
    out = np.zeros((lead, n_surroundings, n_batches, n_intervals, 2))
    if offsets_K is not None:
        out += np.moveaxis(offsets_K, 2, 1)[..., None, None]
    for s, given in enumerate(network.surroundings):
        for law in given.effects:
            out[:, s] += effect_K(law, values, inputs, air)
    return out
