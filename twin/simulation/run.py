"""Simulation: temperatures of all cells, sensor readings and displacements.

The linear part is exact (modes of every regime, drivers held, surroundings linear between rows); heat that depends on
temperature is linear within an interval and found by iteration, of second order in the interval (`twin.substeps`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from twin.network import Network
from twin.simulation.balance import Balance, HeatSource, Places, Source, balance_of, check_values, sources_of
from twin.simulation.channels import Rows, shown, watch
from twin.simulation.coupling import Coupled, Trajectory, plain_modes, solve
from twin.simulation.inputs import Inputs, at_borders
from twin.simulation.response import Response, States
from twin.simulation.start import checked_start, excess_K


@dataclass(frozen=True)
class Solved:
    """One group of parameter sets, solved: the balance, its sources and the states at every row or border."""

    balance: Balance
    sources: Sequence[Source]
    places: Places
    start_degC: Array
    response: Response
    coupled: Coupled | None
    states: States
    disabled: Sequence[HeatSource] = ()  # heat of candidates, which has no effect


@np.errstate(over="ignore", invalid="ignore")  # at values that no machine has; what is not finite is refused
def solved_balance(
    network: Network, values: Array, inputs: Inputs, start_degC: Array, tolerance_K: float, every: int = 1,
    last: Trajectory | None = None,
) -> Solved:  # fmt: skip
    """Solve P sets, values (P, n), from start temperatures (P or 1, B, N) to which the laws of the start are added.

    The states of a linear network are given at every `every`-th border, of another at all of them, by an iteration that
    begins at the `last` trajectory and replaces it.
    """
    balance, places = balance_of(network, values, inputs), Places()
    sources, disabled = sources_of(balance, places)
    n_places = len(places.rows)
    watch(network, places)
    excess = excess_K(network, values, inputs)
    if excess is not None:
        start_degC = start_degC + excess
    if not sources:
        response = Response(plain_modes(balance), balance.schedule)
        states = response.run(balance.forcing(response), start_degC, every)
        return Solved(balance, sources, places, start_degC, response, None, states, disabled)
    rows = np.array(places.rows[:n_places]).reshape(n_places, network.n_cells)
    coupled = solve(balance, sources, rows, start_degC, tolerance_K, last)
    response = Response(coupled.chord.modes, balance.schedule)
    heat = balance.forcing(response) + response.forcing(balance.directions(sources), coupled.series_W)
    return Solved(balance, sources, places, start_degC, response, coupled, response.run(heat, start_degC), disabled)


def rows_of(solved: Solved, states_every: int) -> Rows:
    """Quantities that sensors and errors depend on, at the rows; states are kept at every `states_every`-th border."""
    b, n_places, every = solved.balance, len(solved.places.rows), solved.balance.inputs.every
    matrix = seen_matrix(b.network, b.values, solved.places)
    seen = np.moveaxis(solved.states.at(matrix, every // states_every), -1, 0)
    chain = seen[n_places:] - seen[n_places:, ..., :1]
    return Rows(b.inputs, b.values, seen[:n_places], chain, b.air, solved.places)


def seen_matrix(network: Network, values: Array, places: Places) -> Array:
    """Rows over cells (P, n_places + n_errors, N): the places, then the errors' chains and tilts."""
    rows = np.array(places.rows).reshape(1, len(places.rows), network.n_cells)
    errors = [e.matrix(values)[:, None] for e in network.errors]
    return np.concatenate([np.repeat(rows, len(values), axis=0), *errors], axis=1)


_SLOW = 0.1  # rate * dt below which the difference of the exact mean would cancel


def bulge_K(solved: Solved, cells_degC: Array) -> Array:
    """Mean over each interval less the mean of its two borders, (P, B, M, N), from all borders (P, B, M + 1, N).

    A mode's mean is exactly ``(mean heat - change / dt) / rate``; where it hardly decays, the trapezoid corrected by
    the end slopes (Euler and Maclaurin) is right to ``(rate dt)^4 / 720``.
    """
    balance, modes = solved.balance, solved.response.modes
    terms = list(balance.known)
    if solved.coupled is not None:
        terms.append((balance.directions(solved.sources), solved.coupled.series_W))
    out = np.zeros((*cells_degC.shape[:2], *balance.inputs.dt_s.shape[1:], balance.network.n_cells))
    for r in range(balance.regimes.count):
        here = (balance.regimes.of == r) & balance.inputs.valid
        dt_s = balance.inputs.dt_s[here][:, None]
        rate, shape = modes.rate_per_s[:, None, r], modes.shape[:, r]
        inverse = np.swapaxes(modes.inverse[:, r], -1, -2)
        before, after = cells_degC[:, :, :-1][:, here] @ inverse, cells_degC[:, :, 1:][:, here] @ inverse
        heat = np.zeros((2, *before.shape))
        for directions, series in terms:
            heat += np.moveaxis(series[:, :, here], (1, 3), (3, 0)) @ (directions[:, r] @ shape)
        change = (after - before) / dt_s
        mean = (heat.mean(axis=0) - change) / np.where(rate > 0, rate, 1.0)
        slopes = heat[0] - rate * before - (heat[1] - rate * after)
        bulge = np.where(rate * dt_s < _SLOW, dt_s / 12.0 * slopes, mean - (before + after) / 2.0)
        out[:, here] = bulge @ np.swapaxes(shape, -1, -2)
    return out


TOLERANCE_K = 1e-3
CHUNK_BYTES = 256 << 20  # of the series that one group of parameter sets works on


@dataclass(frozen=True)
class Simulation:
    """P parameter sets on B batches at the K rows of the recordings; behind a batch's end the last values are held.

    readings (P, B, K, n_sensors) degC and errors (P, B, K, n_errors) in the network's order and units, errors from
    the first row; time_s and valid (B, K). If cells were kept: cells_degC (P, B, K, N), air_degC (P, B, K, S), and by
    heat heat_W (P, B, K), what flows at a row (before it, where a driver jumps), and heat_J since the start.
    """

    network: Network
    batch_ids: tuple[str, ...]
    time_s: Array
    valid: NDArray[np.bool_]
    readings: Array
    errors: Array
    iterations: int = 0
    windows: int = 1
    message: str = ""
    cells_degC: Array | None = None
    air_degC: Array | None = None
    heat_W: Mapping[str, Array] = field(default_factory=dict)
    heat_J: Mapping[str, Array] = field(default_factory=dict)

    @property
    def shown(self) -> Array:
        """Readings, then errors, (P, B, K, n_sensors + n_errors)."""
        return np.concatenate([self.readings, self.errors], axis=-1)


def simulate(
    network: Network,
    values: Array,
    inputs: Inputs,
    start_degC: Array | str | None = None,
    tolerance_K: float = TOLERANCE_K,
    keep_cells: bool = False,
    last: Trajectory | None = None,
) -> Simulation:
    """Simulate B batches at P parameter sets, values (P, n) or (n,), in one array pass.

    `start_degC` (P or 1, B, N), "settled" (the steady state with the surroundings) or None (`start_of`). `tolerance_K`
    is that of the iteration, which begins at the `last` trajectory of near parameters and replaces it. Time steps, rows
    of the result (`every`) and offsets of the surroundings are the inputs'.

    Raises:
        InputError: arrays of a wrong shape or not finite; heat that is stiff beyond the step control.
    """
    values = np.atleast_2d(np.asarray(values, float))
    check_values(network, values)
    start = checked_start(network, values, inputs, start_degC)
    values = _sets(network, values, start, inputs.offsets_K)
    parts = []
    for part in _chunks(network, len(values), inputs):
        own = start if len(start) == 1 else start[part]
        offset = inputs.offsets_K
        given = inputs if offset is None or len(offset) == 1 else inputs.with_own(inputs.times, offset[part])
        solved = solved_balance(network, values[part], given, own, tolerance_K, inputs.every, last)
        parts.append(_simulated(solved, tolerance_K, keep_cells))
    return parts[0] if len(parts) == 1 else _joined(parts)


def _simulated(solved: Solved, tolerance_K: float, keep_cells: bool) -> Simulation:
    network, every = solved.balance.network, solved.balance.inputs.every
    states_every = every if solved.coupled is None else 1
    readings, errors, _, _ = shown(rows_of(solved, states_every), network)
    return simulation_of(solved, readings, errors, tolerance_K, states_every if keep_cells else None)


def simulation_of(
    solved: Solved, readings: Array, errors: Array, tolerance_K: float, cells_every: int | None = None
) -> Simulation:
    """The result of a solved group; with cells where `cells_every` gives the number of intervals between its states."""
    balance, coupled = solved.balance, solved.coupled
    inputs, network, every = balance.inputs, balance.network, balance.inputs.every
    rows = np.arange(inputs.time_s.shape[1])[::every]
    kept: dict[str, Any] = {}
    if cells_every is not None:
        shape = (len(balance.values), inputs.n_batches, len(rows))
        air = [np.broadcast_to(balance.air.borders(s, every), shape) for s in range(len(network.surroundings))]
        heat_W, heat_J = _heats(solved, every)
        kept = {
            "cells_degC": solved.states.at(np.eye(network.n_cells)[None], every // cells_every),
            "air_degC": np.stack(air, axis=-1) if air else np.zeros((*shape, 0)),
            "heat_W": heat_W,
            "heat_J": heat_J,
        }
    return Simulation(
        network,
        inputs.batch_ids,
        inputs.time_s[:, ::every],
        rows <= inputs.n_intervals[:, None],
        readings,
        errors,
        0 if coupled is None else coupled.rounds,
        1 if coupled is None else len(coupled.windows),
        _words(coupled, tolerance_K),
        **kept,
    )


def _words(coupled: Coupled | None, tolerance_K: float) -> str:
    if coupled is None:
        return "linear: exact"
    windows = f" in {len(coupled.windows)} windows" if len(coupled.windows) > 1 else ""
    return f"converged to {tolerance_K / 10:g} K after {coupled.rounds} rounds{windows}"


def _heats(solved: Solved, every: int) -> tuple[dict[str, Array], dict[str, Array]]:
    """Watts at the rows and joules since the start, of every heat and of exchange that varies, by name.

    Where a chord took part in the solution, what it delivered beyond the law's straight lines counts to the heat.
    """
    balance = solved.balance
    inputs = balance.inputs
    series = {h.law.name: balance.driven_W(h) for h in balance.network.heats if not h.temperature_dependent}
    if solved.coupled is not None:
        every_interval, chord = slice(0, inputs.valid.shape[1]), solved.coupled.chord
        if chord.used:
            bulge = bulge_K(solved, solved.states.at(np.eye(balance.network.n_cells)[None]))
        for k, source in enumerate(solved.sources):
            watts = np.moveaxis(source.watts(solved.coupled.borders, every_interval), -2, -1)
            if chord.used:
                own = np.einsum("pbmn,pn->pbm", bulge, source.direction)
                watts = watts - (chord.slope_W_per_K[:, balance.regimes.of, k] * own)[..., None]
            series[source.name] = series.get(source.name, 0.0) + watts
    n_sets = len(balance.values)
    dt_s = np.where(inputs.valid, inputs.dt_s, 0.0)
    watts_at, joules_at = {}, {}
    for name, ends in series.items():
        ends = np.broadcast_to(ends, (n_sets, *ends.shape[1:]))
        at = at_borders(ends)
        total = np.cumsum(ends.mean(axis=-1) * dt_s, axis=-1)
        watts_at[name] = at[..., ::every]
        joules_at[name] = np.concatenate([np.zeros_like(total[..., :1]), total], axis=-1)[..., ::every]
    return watts_at, joules_at


def choose_substeps(
    network: Network, values: Array, inputs: Inputs, start_degC: Array | str | None = None, tolerance_K: float = 0.01
) -> int:
    """Into how many parts each interval must be cut (1, 2, 4, … 32) for places and chains to be right to tolerance_K.

    Compares each step with half of it (Richardson's estimate for second order, a third of their difference; for laws
    along time, of first order, all of it). A linear network needs none.

    Raises:
        InputError: 32 do not suffice; names the batch and the remedy.
    """
    values = np.atleast_2d(np.asarray(values, float))
    start = checked_start(network, values, inputs, start_degC)
    values = _sets(network, values, start, inputs.offsets_K)

    def cells(n: int) -> tuple[Solved, Array]:
        finer = inputs.refined(n)
        solved = solved_balance(network, values, finer, start, tolerance_K / 10)
        return solved, solved.states.at(np.eye(network.n_cells)[None], n)

    solved, coarse = cells(1)
    if solved.coupled is None:
        return 1
    share = 1.0 if any(s.along for s in solved.sources) else 1.0 / 3.0
    valid = (np.arange(coarse.shape[2]) <= inputs.n_intervals[:, None])[..., None]
    for n in (2, 4, 8, 16, 32, 64):
        fine = cells(n)[1]
        gap = share * np.where(valid, np.abs(fine - coarse), 0.0).max(axis=(0, 2, 3))
        if gap.max() <= tolerance_K:
            return n // 2
        coarse = fine
    worst = int(np.argmax(gap))
    raise InputError(
        f"machine {network.machine}: batch {inputs.batch_ids[worst]}: even steps of "
        f"{inputs.dt_s[worst, 0] / 64:.3g} s leave {gap[worst]:.2g} K, more than the {tolerance_K:g} K allowed; "
        "check the parameters of heat that depends on temperature, or allow more"
    )


def _sets(network: Network, values: Array, start: Array, offsets_K: Array | None) -> Array:
    """The values with as many sets as the largest of the three; starts and offsets shared by all stay one."""
    counts = {"parameter values": len(values), "start temperatures": len(start)}
    if offsets_K is not None:
        counts["offsets of surroundings"] = len(offsets_K)
    n_sets = max(counts.values())
    for name, n in counts.items():
        if n not in (1, n_sets):
            raise InputError(f"machine {network.machine}: {name} come in {n} sets, expected 1 or {n_sets}")
    return np.repeat(values, n_sets, axis=0) if len(values) < n_sets else values


def _chunks(network: Network, n_sets: int, inputs: Inputs) -> Iterator[slice]:
    n_dependent = sum(h.temperature_dependent for h in network.heats) + sum(bool(e.factors) for e in network.edges)
    per_set = 8 * inputs.valid.size * (network.n_cells + 8 + 16 * n_dependent)
    size = max(int(CHUNK_BYTES // per_set), 1)
    return (slice(lo, min(lo + size, n_sets)) for lo in range(0, n_sets, size))


def _joined(parts: Sequence[Simulation]) -> Simulation:
    """The simulations of several groups of parameter sets as one."""

    def cat(name: str) -> Array | None:
        each = [getattr(p, name) for p in parts]
        return None if each[0] is None else np.concatenate(each)

    worst = max(parts, key=lambda p: p.iterations)
    joined = {name: cat(name) for name in ("readings", "errors", "cells_degC", "air_degC")}
    by_heat = {
        name: {k: np.concatenate([getattr(p, name)[k] for p in parts]) for k in getattr(parts[0], name)}
        for name in ("heat_W", "heat_J")
    }
    return replace(worst, **joined, **by_heat)  # type: ignore[arg-type]
