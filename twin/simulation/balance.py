"""The heat balance of a network on given inputs: conductances by regime, surroundings, and every watt that is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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
from twin.simulation.schedule import Schedule

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Balance:
    """``C dT/dt = -K T + q`` of P parameter sets on B batches; what depends on temperature is not in q.

    capacity (P, N), conductance (P, R, N, N) and into (P, R, S, N), the heat per kelvin of each surrounding.
    """

    network: Network
    values: Array  # (P, n)
    inputs: Inputs
    regimes: Regimes
    capacity_J_per_K: Array
    conductance_W_per_K: Array
    into_W_per_K: Array
    air: Air

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
        steady_W = np.einsum("prsn,ps->prn", self.into_W_per_K, self.air.steady_degC)
        slots, watts = self._driven()
        watts += steady_W[:, :, None]  # slots that a regime lacks are never 1
        terms = [(watts, slots[None])]
        if len(moving):
            into = self.into_W_per_K[:, :, moving] * self.air.follow[:, None, moving, None]
            terms.append((into, self.air.recorded_degC[None, moving]))
        if self.air.extra_K is not None:
            terms.append((self.into_W_per_K, self.air.extra_K))
        timed = [h for h in self._independent if not self._static(h)]
        if timed:
            series = np.stack([self.driven_W(h) for h in timed], axis=1)
            terms.append((self.directions(timed), series))
        return tuple(terms)

    def forcing(self, response: Response) -> Forcing:
        """The known heat for a response on this balance's schedule."""
        out = Forcing()
        for directions, series in self.known:
            out = out + response.forcing(directions, series)
        return out

    def directions(self, heats: list[Heat]) -> Array:
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
        shape = (len(values), *self.inputs.valid.shape)
        if along:
            return np.broadcast_to(np.broadcast_to(out, shape)[..., None], (*shape, 2))
        return np.moveaxis(np.broadcast_to(out, (shape[0], shape[1], 2, shape[2])), 2, 3)

    @cached_property
    def _independent(self) -> list[Heat]:
        return [h for h in self.network.heats if not h.temperature_dependent]

    @cached_property
    def _tuples(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Distinct (regime, drivers of the heats) and where each first occurs; empty where there are too many."""
        laws = [law for h in self._independent if not _timed(h) for law in (h.law, *h.factors)]
        return distinct(self.inputs, [c for law in laws for c in law.drivers.values()], self.regimes.of)

    def _static(self, heat: Heat) -> bool:
        """Whether a heat takes few values, so that it needs no series of its own."""
        return not _timed(heat) and len(self._tuples[1]) <= MOST

    def _driven(self) -> tuple[Array, Array]:
        """Heats of few values: indicator series (J, B, M, 2), of which one is 1 at a time, and watts (P, R, J, N).

        Within a regime each tuple of drivers has a slot; mostly a regime has one tuple, and J is 1.
        """
        number, first = self._tuples
        heats = [h for h in self._independent if self._static(h)]
        if len(first) > MOST:
            number, first = np.zeros_like(number), first[:1]
        regime = self.regimes.of.ravel()[first]
        order = np.argsort(regime, kind="stable")
        slot = np.empty_like(regime)
        slot[order] = np.arange(len(first)) - np.searchsorted(regime[order], regime[order])
        n_slots = int(slot.max(initial=0)) + 1
        watts = np.zeros((len(self.values), self.regimes.count, n_slots, self.network.n_cells))
        for heat in heats:
            at = heat_W(heat, lambda law, effect: at_tuples(law, effect, self.values, self.inputs, first))
            watts[:, regime, slot] += at[..., None] * heat.direction(self.values)[:, None]
        if n_slots == 1:
            return np.ones((1, *self.inputs.valid.shape, 2)), watts
        chosen = slot[number][None] == np.arange(n_slots)[:, None, None]
        return np.repeat(chosen[..., None].astype(float), 2, axis=-1), watts


def balance_of(network: Network, values: Array, inputs: Inputs, offsets_K: Array | None = None) -> Balance:
    """The heat balance at parameter values (P, n); `offsets_K` (P or 1, B, S) of each batch's surroundings.

    Raises:
        InputError: parameter values of another length, or that are not finite.
    """
    check_values(network, values)
    regimes = regimes_of(network, values, inputs)
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
    )


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
