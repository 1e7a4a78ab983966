"""From temperatures to what the channels show: sensors' effects, displacement chains and laws, the probe.

Every law is passed in order with its tangents, if there are any: derivatives by Q unknowns, by the complex step.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from data.arrays import Numeric
from twin.mechanisms.base import View
from twin.network import Law, Network, Port
from twin.simulation.air import Air
from twin.simulation.balance import Places
from twin.simulation.inputs import STEP, Inputs, intervals_at_rows, parameters_of, stepped

Seen = tuple[Numeric | None, Mapping[str, Numeric]]  # what a law makes something of, and its ports' temperatures


@dataclass(frozen=True)
class Tangents:
    """Derivatives by Q unknowns at the rows of the recordings, for one parameter set.

    degC (n, Q, B, K) of the places, chain (n_errors, Q, B, K) of the chains and tilts, air_K (Q, S, B, K) of the
    surroundings; `parameters` numbers Q's unknown by the parameter's number.
    """

    degC: Numeric
    chain: Numeric
    air_K: Numeric
    parameters: Mapping[int, int]


@dataclass(frozen=True)
class Rows:
    """Inputs of laws at the rows of the recordings: places (n, P, B, K) degC, surroundings, drivers, time.

    chain (n_errors, P, B, K) are the sums of chains and tilts less their first value, in the channels' units.
    """

    inputs: Inputs
    values: Numeric  # (P, n)
    degC: Numeric
    chain: Numeric
    air: Air
    places: Places

    def law(
        self, law: Law, effect: str, seen: Numeric | None, tangents: Tangents | None, d_seen: Numeric | None
    ) -> Any:
        """A law's effect (P, B, K) on its input `seen`, and, with tangents, its derivative (Q, B, K), else None."""
        if law.disabled and tangents is None:
            return seen if seen is not None else np.zeros((1, 1, 1)), None
        degC = {role: self._port(port) for role, port in law.ports.items()}
        shape = (len(self.values), *self.time_s.shape)
        out = np.broadcast_to(self._call(law, effect, seen, degC, self.values), shape)
        if tangents is None:
            return out, None
        d_out = np.zeros((tangents.degC.shape[1], *self.time_s.shape))
        if law.disabled:  # its input passes unchanged
            out, d_out = (out, d_out) if seen is None or d_seen is None else (seen, d_seen.copy())
        else:
            self._pass_on(law, effect, (seen, degC), (d_seen, self._tangents_of(law, tangents)), d_out)
        for j in set(law.parameters.values()) & set(tangents.parameters):
            moved = self._call(law, effect, seen, degC, stepped(self.values, j))
            d_out[tangents.parameters[j]] += np.broadcast_to(moved, shape)[0].imag / STEP
        return out, d_out

    def _pass_on(self, law: Law, effect: str, at: Seen, moved: Seen, d_out: Numeric) -> None:
        """Write a law's derivatives by the unknowns that change any of its inputs."""
        (seen, degC), (d_seen, d_degC) = at, moved
        moving = [d for d in (d_seen, *d_degC.values()) if d is not None]
        which = np.flatnonzero(sum((d.any(axis=(1, 2)) for d in moving), np.zeros(len(d_out), bool)))
        if not len(which):
            return
        steps = {role: d[which] for role, d in d_degC.items()}
        if d_seen is not None and law.mechanism.linear_reading:
            nothing = np.zeros((1, *self.time_s.shape))
            rest = self._call(law, effect, nothing, dict.fromkeys(steps, nothing), self.values)
            d_out[which] = self._call(law, effect, d_seen[which], steps, self.values) - rest
            return
        ahead = seen if seen is None or d_seen is None else seen + 1j * STEP * d_seen[which]
        degC = {role: degC[role] + 1j * STEP * d for role, d in steps.items()}
        d_out[which] = self._call(law, effect, ahead, degC, self.values).imag / STEP

    @cached_property
    def time_s(self) -> Numeric:
        return self.inputs.time_s[:, :: self.inputs.every]

    @cached_property
    def _clock_h(self) -> Numeric:
        if np.isnan(self.inputs.clock_h).all():
            return np.full(self.time_s.shape, np.nan)
        return np.asarray((self.inputs.clock_h[:, None] + self.time_s / 3600.0) % 24.0)

    @cached_property
    def _drivers(self) -> dict[str, Numeric]:
        """By channel what each row shows, or else what holds in the interval behind it (`intervals_at_rows`)."""
        at = intervals_at_rows(self.inputs.time_s.shape[1] - 1, self.inputs.every)
        return {channel: series[:, at] for channel, series in self.inputs.drivers.items()} | dict(self.inputs.at_rows)

    @cached_property
    def _air(self) -> list[Numeric]:
        return [self.air.borders(s, self.inputs.every) for s in range(self.air.steady_degC.shape[1])]

    def _call(
        self, law: Law, effect: str, seen: Numeric | None, degC: Mapping[str, Numeric], values: Numeric
    ) -> Numeric:
        driver = {role: self._drivers[c] for role, c in law.drivers.items()}
        view = View(degC, _Rises(degC), driver, self.time_s, self._clock_h, self._step_s)
        p = parameters_of(law, values, 2)
        method = getattr(law.mechanism, effect)
        return np.asarray(method(view, p) if seen is None else method(seen, view, p))

    def _port(self, port: Port) -> Numeric:
        return self._air[port.surrounding] if port.cells is None else self.degC[self.places.number(port.cells)]

    def _tangents_of(self, law: Law, tangents: Tangents) -> dict[str, Numeric]:
        """Derivatives (Q, B, K) of a law's ports."""
        return {
            role: tangents.air_K[:, port.surrounding]
            if port.cells is None
            else tangents.degC[self.places.number(port.cells)]
            for role, port in law.ports.items()
        }

    @cached_property
    def _step_s(self) -> float:
        """The rows' spacing, nan where it varies."""
        steps = np.diff(self.time_s, axis=1)
        even = steps.size and np.ptp(steps) < 1e-6 * steps.max()
        return float(steps[0, 0]) if even else float("nan")


@dataclass(frozen=True)
class _Rises(Mapping[str, Numeric]):
    """Temperatures less their first value, computed for laws that need them."""

    degC: Mapping[str, Numeric]

    def __getitem__(self, role: str) -> Numeric:
        return np.asarray(self.degC[role] - self.degC[role][..., :1])

    def __iter__(self) -> Iterator[str]:
        return iter(self.degC)

    def __len__(self) -> int:
        return len(self.degC)


def watch(network: Network, places: Places) -> None:
    """Add the places that sensors and errors depend on."""
    laws = [law for r in network.readings for law in r.effects]
    laws += [law for e in network.errors for law in (*e.effects, *e.readings)]
    for r in network.readings:
        places.number(r.cells)
    for law in laws:
        for port in law.ports.values():
            if port.cells is not None:
                places.number(port.cells)


def shown(rows: Rows, network: Network, tangents: Tangents | None = None) -> tuple[Numeric, Numeric, Numeric, Numeric]:
    """Readings (P, B, K, n_sensors) and errors (P, B, K, n_errors), and their tangents (Q, B, K, …) or empty arrays."""
    n_unknowns = 0 if tangents is None else tangents.degC.shape[1]
    out = []
    for group, work in ((network.readings, _reading), (network.errors, _error)):
        seen = np.empty((len(group), len(rows.values), *rows.time_s.shape))
        d_seen = np.empty((len(group), n_unknowns, *rows.time_s.shape))
        for k in range(len(group)):
            seen[k], slope = work(rows, network, k, tangents)
            if slope is not None:
                d_seen[k] = slope
        out.append((np.moveaxis(seen, 0, -1), np.moveaxis(d_seen, 0, -1)))
    (readings, d_readings), (errors, d_errors) = out
    return readings, errors, d_readings, d_errors


def _reading(rows: Rows, network: Network, k: int, tangents: Tangents | None) -> tuple[Numeric, Numeric | None]:
    given = network.readings[k]
    place = rows.places.number(given.cells)
    seen, d_seen = rows.degC[place], None if tangents is None else tangents.degC[place]
    for law in given.effects:
        seen, d_seen = rows.law(law, "reading", seen, tangents, d_seen)
    return seen, d_seen


def _error(rows: Rows, network: Network, k: int, tangents: Tangents | None) -> tuple[Numeric, Numeric | None]:
    """Chain and tilts, then the laws that displace, then what the probe makes of the sum."""
    given = network.errors[k]
    seen, d_seen = rows.chain[k], None if tangents is None else tangents.chain[k]
    for law in given.effects:
        moved, d_moved = rows.law(law, "displacement", None, tangents, None)
        seen = seen + moved
        d_seen = None if d_seen is None or d_moved is None else d_seen + d_moved
    for law in given.readings:
        seen, d_seen = rows.law(law, "reading", seen, tangents, d_seen)
    return seen, d_seen
