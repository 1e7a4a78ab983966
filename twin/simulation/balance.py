"""The heat balance of a network on given inputs: conductances by regime, surroundings, and every watt that is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError
from twin.network import Heat, Law, Network
from twin.simulation.air import Air, air_of
from twin.simulation.inputs import Inputs
from twin.simulation.law_calls import along_time, heat_W, parameters_of, reads_time
from twin.simulation.regimes import MOST, Regimes, at_tuples, distinct, regimes_of
from twin.simulation.response import Forcing, Response
from twin.simulation.schedule import Drive, Schedule

Array = NDArray[np.float64]

LASTING = 64  # intervals of a regime; below it one more series costs less than one more block


@dataclass(frozen=True)
class Balance:
    """``C dT/dt = -K T + q`` of P parameter sets on B batches; what depends on temperature is not in q.

    capacity (P, N), conductance (P, R, N, N) and into (P, R, S, N), the heat per kelvin of each surrounding. Regimes
    tell the drivers of heats apart too, so that held_W (P, R, N) holds within one; `alike` (R,) has one number for all
    of the same conductances, from 0. Driven heats that follow the clock or take too many values are `timed`.
    """

    network: Network
    values: Array  # (P, n)
    inputs: Inputs
    regimes: Regimes
    capacity_J_per_K: Array
    conductance_W_per_K: Array
    into_W_per_K: Array
    air: Air
    held_W: Array
    alike: NDArray[np.int64]
    timed: tuple[Heat, ...]

    @cached_property
    def schedule(self) -> Schedule:
        """Cut into pieces once for all runs on the same inputs."""
        kept, key = self.inputs.kept, ("schedule", id(self.regimes.of))  # the regimes are kept there too
        if key not in kept:
            kept[key] = Schedule(self.inputs.dt_s, self.regimes.of, self.inputs.n_intervals)
        schedule: Schedule = kept[key]
        return schedule

    @cached_property
    def known(self) -> tuple[tuple[Array, Array], ...]:
        """Directions (P or 1, R, J, N) and series (P or 1, J, B, M, 2) of surroundings and driven heats."""
        moving = self.air.moving
        steady_W = self.held_W + np.einsum("prsn,ps->prn", self.into_W_per_K, self.air.steady_degC)
        into = self.into_W_per_K[:, :, moving] * self.air.follow[:, None, moving, None]
        terms = [(np.concatenate([steady_W[:, :, None], into], axis=2), self._recorded.series)]
        if self.air.extra_K is not None:
            terms.append((self.into_W_per_K, self.air.extra_K))
        if self.timed:
            series = np.stack([self.driven_W(h) for h in self.timed], axis=1)
            terms.append((self.directions(self.timed), series))
        return tuple(terms)

    def forcing(self, response: Response) -> Forcing:
        """The known heat for a response on this balance's schedule."""
        (directions, _), *others = self.known
        out = response.forcing(directions, self._recorded)
        for directions, series in others:
            out = out + response.forcing(directions, series)
        return out

    @cached_property
    def _recorded(self) -> Drive:
        """A series of ones, for what holds, and the recorded surroundings; sorted once for all runs."""
        kept, key = self.inputs.kept, ("recorded", id(self.schedule), id(self.air.recorded_degC))
        if key not in kept:
            moving = self.air.recorded_degC[self.air.moving]
            kept[key] = self.schedule.drive(np.concatenate([np.ones((1, *moving.shape[1:])), moving])[None])
        drive: Drive = kept[key]
        return drive

    def directions(self, heats: Sequence[Heat]) -> Array:
        """Where heats go, (P, R, J, N), the same in every regime."""
        rows = np.stack([h.direction(self.values) for h in heats], axis=1)
        return np.repeat(rows[:, None], self.regimes.count, axis=1)

    def driven_W(self, heat: Heat, values: Array | None = None) -> Array:
        """Watts (P or 1, B, M, 2) of a heat that does not depend on temperature, at both ends of every interval."""
        along, values = along_time(heat), self.values if values is None else values
        views = self.inputs.intervals

        def call(law: Law, effect: str) -> Array:
            p = parameters_of(law, values, 2 if along else 3)
            return np.asarray(getattr(law.mechanism, effect)(views.view(law, along), p))

        out = heat_W(heat, call)
        times = self.inputs.times.get(heat.law.name)
        if times is not None:
            out = out * times.reshape(-1, *(1,) * (1 if along else 2))
        shape = (len(values), *self.inputs.valid.shape)
        if along:
            return np.broadcast_to(np.broadcast_to(out, shape)[..., None], (*shape, 2))
        return np.moveaxis(np.broadcast_to(out, (shape[0], shape[1], 2, shape[2])), 2, 3)


def balance_of(network: Network, values: Array, inputs: Inputs, offsets_K: Array | None = None) -> Balance:
    """The heat balance at parameter values (P, n); `offsets_K` (P or 1, B, S) of each batch's surroundings.

    Raises:
        InputError: parameter values of another length, or that are not finite.
    """
    check_values(network, values)
    regimes, held_W, alike, timed = _finer(network, values, inputs, regimes_of(network, values, inputs))
    spread = np.repeat(values[:, None], regimes.count, axis=1)
    return Balance(
        network,
        values,
        inputs,
        regimes,
        network.capacity_J_per_K(values),
        network.conductance_W_per_K(spread, regimes.factor),
        network.surrounding_W_per_K(spread, regimes.factor),
        air_of(network, values, inputs, offsets_K),
        held_W,
        alike,
        timed,
    )


def _finer(
    network: Network, values: Array, inputs: Inputs, regimes: Regimes
) -> tuple[Regimes, Array, NDArray[np.int64], tuple[Heat, ...]]:
    """Regimes in which driven heats hold as well; their watts, the given regime of each, and the heats left over."""
    driven = [h for h in network.heats if not h.temperature_dependent and not h.asleep]
    held = [h for h in driven if not _timed(h) and h.law.name not in inputs.times]
    number, first = distinct(
        inputs, [c for h in held for law in (h.law, *h.factors) for c in law.drivers.values()], regimes.of
    )
    short = len(first) > regimes.count and inputs.valid.sum() < LASTING * len(first)
    if len(first) > MOST or short:
        held, number, first = [], *distinct(inputs, (), regimes.of)
    alike = regimes.of.ravel()[first]
    watts = np.zeros((len(values), len(first), network.n_cells))
    for heat in held:
        at = heat_W(heat, lambda law, effect: at_tuples(law, effect, values, inputs, first))
        watts += at[..., None] * heat.direction(values)[:, None]
    timed = tuple(h for h in driven if all(h is not other for other in held))
    return replace(regimes, of=number, factor=regimes.factor[:, alike]), watts, alike, timed


def check_values(network: Network, values: Array) -> None:
    if values.ndim != 2 or values.shape[1] != len(network.parameters):
        raise InputError(
            f"machine {network.machine}: parameter values have shape {values.shape}, expected (sets, "
            f"{len(network.parameters)})"
        )
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        p, j = bad[0]
        raise InputError(
            f"machine {network.machine}: parameter {network.parameters[j].name} is {values[p, j]:g} "
            f"{network.parameters[j].unit} in set {p}, expected a finite number; correct its value"
        )


def _timed(heat: Heat) -> bool:
    effects: list[tuple[Law, str]] = [(heat.law, "heat_W"), *((f, "factor") for f in heat.factors)]
    check: Callable[[Law, str], bool] = reads_time
    return any(check(law, effect) for law, effect in effects)
