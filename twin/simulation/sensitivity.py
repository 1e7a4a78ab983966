"""Forward sensitivities: derivatives of every channel by parameters, start temperatures and offsets.

The derivative of the heat balance is a heat balance with other heat, one right-hand side per unknown, so all unknowns
are solved in one linear run with the simulation's own modes (Tomovic and Vukobratovic 1972, General Sensitivity
Theory); the response of temperature-dependent heat is solved interval by interval. Factors of a temperature are linear
within an interval, so derivatives are of second order in it, like the simulation itself.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError, WorkError
from twin.network import Edge, Heat, Network
from twin.simulation.air import effect_K, follows
from twin.simulation.balance import Balance, Borders, HeatSource, Source
from twin.simulation.channels import Rows, Tangents, shown
from twin.simulation.coupling import Answer, Trajectory
from twin.simulation.inputs import STEP, Inputs, at_borders, stepped
from twin.simulation.response import Response
from twin.simulation.run import (
    TOLERANCE_K,
    Simulation,
    Solved,
    bulge_K,
    rows_of,
    seen_matrix,
    simulation_of,
    solved_balance,
)
from twin.simulation.schedule import factor_series
from twin.simulation.start import checked_start, excess_K


@dataclass
class Unknown:
    """One right-hand side: heat as pairs of a direction (R, N) and a series (B, M, 2), and further derivatives.

    A capacity's derivative is the sum of what the heat makes and of ``-ratio (T - T(0))``: so the heat follows the
    temperatures, which are smooth, and not their rates, which jump. `start_K` (B, N), `air_K` by surrounding (B, M, 2).
    """

    parameter: int = -1
    pairs: list[tuple[Array, Array]] = field(default_factory=list)
    ratio: Array | None = None  # (N,) dC/C per cell
    start_K: Array | None = None
    air_K: dict[int, Array] = field(default_factory=dict)

    @property
    def thermal(self) -> bool:
        return bool(self.pairs or self.air_K) or self.ratio is not None or self.start_K is not None


class UnknownsOf:
    """Builds the unknowns of one solved parameter set; `cells_degC` (B, M + 1, N) at all borders.

    A series of temperatures is a straight line whose mean over the interval is right, not one through the borders:
    that makes the derivatives of a linear network accurate to the fourth order in the interval.
    """

    def __init__(self, solved: Solved, cells_degC: Array) -> None:
        self.solved, self.balance, self.cells_degC = solved, solved.balance, cells_degC
        self.network, self.values = solved.balance.network, solved.balance.values
        self.bulge_K = bulge_K(solved, cells_degC[None])[0]
        self.shape = (*self.balance.inputs.valid.shape, 2)
        self.edges, self.heats = _by_parameter(self.network)
        self.surroundings: dict[int, list[int]] = defaultdict(list)
        for s, given in enumerate(self.network.surroundings):
            of_laws = {j for law in given.effects for j in law.parameters.values()}
            for j in of_laws | {k for k in (given.value, given.follow, given.offset) if k is not None}:
                self.surroundings[j].append(s)

    def parameter(self, j: int) -> Unknown:
        """By a parameter's value, in its own unit."""
        out = Unknown(parameter=j)
        self._capacities(out, j)
        for edge in self.edges[j]:
            self._edge(out, edge, j)
        self._heats(out, j)
        self._surroundings(out, j)
        if any(j in law.parameters.values() for law, _ in self.network.starts):
            excess = excess_K(self.network, stepped(self.values, j), self.balance.inputs)
            out.start_K = None if excess is None else np.imag(excess[0]) / STEP
        return out

    def start(self, cells: NDArray[np.int64]) -> Unknown:
        """By the start temperature of a body, each batch its own."""
        start_K = np.zeros((self.shape[0], self.network.n_cells))
        start_K[:, cells] = 1.0
        return Unknown(start_K=start_K)

    def offset(self, s: int) -> Unknown:
        """By an offset of a surrounding, each batch its own."""
        out = Unknown()
        self._warmer(out, s, np.ones(self.shape))
        return out

    def _capacities(self, out: Unknown, j: int) -> None:
        if not any(j == k for c in self.network.capacities for k, _ in c.powers):
            return
        slopes = np.array([c.slope(self.values, j)[0] for c in self.network.capacities])
        out.ratio = slopes / self.balance.capacity_J_per_K[0]
        conductance = self.balance.conductance_W_per_K[0]
        for i in np.flatnonzero(slopes):
            rise = self._series(np.eye(self.network.n_cells)[i]) - self.cells_degC[:, :1, i, None]
            out.pairs.append((conductance[:, i] * out.ratio[i], rise))

    def _edge(self, out: Unknown, edge: Edge, j: int) -> None:
        slope = edge_slope(self.balance, edge, j)
        own = self._series(edge.direction)
        lead = -own if edge.surrounding is None else self.balance.air.ends(edge.surrounding)[0] - own
        self._add(out, edge.direction, slope[..., None] * lead)

    def _heats(self, out: Unknown, j: int) -> None:
        sources = [s for s in (*self.solved.sources, *self.solved.disabled) if isinstance(s, HeatSource)]
        by_heat = {id(s.heat): s for s in sources}
        every = slice(0, self.shape[1])
        for heat in self.heats[j]:
            in_law = any(j in law.parameters.values() for law in (heat.law, *heat.factors))
            in_share = heat.direction_slope(j)
            for values in [stepped(self.values, j)] * in_law + [self.values] * bool(in_share.any()):
                if heat.temperature_dependent:
                    watts = np.moveaxis(by_heat[id(heat)].watts(self.borders, every, values), -2, -1)[0]
                else:
                    watts = self.balance.driven_W(heat, values)[0]
                if np.iscomplexobj(values):
                    self._add(out, heat.direction(self.values)[0], np.imag(watts) / STEP)
                else:
                    self._add(out, in_share, watts)

    @cached_property
    def borders(self) -> Borders:
        """Temperatures that temperature-dependent heat depends on."""
        if self.solved.coupled is not None:
            return self.solved.coupled.borders
        return Borders(np.moveaxis(self.cells_degC @ np.array(self.solved.places.rows).T, -1, 0)[:, None])

    def _surroundings(self, out: Unknown, j: int) -> None:
        inputs = self.balance.inputs
        for s in self.surroundings[j]:
            given = self.network.surroundings[s]
            warmer = np.zeros(self.shape)
            constant = s not in self.balance.air.moving
            if follows(given, inputs) and given.value is not None and given.follow is not None:
                if given.value == j:
                    warmer += 1.0 - self.values[0, given.follow]
                if given.follow == j:
                    warmer += self.balance.air.recorded_degC[s] - self.values[0, given.value]
            elif constant and given.value == j:
                warmer += 1.0
            if given.offset == j:
                warmer += 1.0
            for law in given.effects:
                if j in law.parameters.values():
                    moved = effect_K(law, stepped(self.values, j), inputs, self.balance.air)
                    warmer += np.imag(moved[0]) / STEP
            if warmer.any():
                self._warmer(out, s, warmer)

    def _warmer(self, out: Unknown, s: int, warmer: Array) -> None:
        """A surrounding that is warmer by a series (B, M, 2): what regimes' constant conductances let in."""
        out.air_K[s] = warmer
        out.pairs.append((self.balance.into_W_per_K[0, :, s], warmer))

    def _series(self, place: Array) -> Array:
        """Temperature of a place at both ends of every interval (B, M, 2), shifted so that its mean is right."""
        borders = self.cells_degC @ place
        return np.stack([borders[:, :-1], borders[:, 1:]], axis=-1) + (self.bulge_K @ place)[..., None]

    def _add(self, out: Unknown, direction: Array, series: Array) -> None:
        out.pairs.append((np.repeat(direction[None], self.balance.regimes.count, axis=0), series))


def _by_parameter(network: Network) -> tuple[dict[int, list[Edge]], dict[int, list[Heat]]]:
    """The edges and the heats that each parameter changes, by its number."""
    edges: dict[int, list[Edge]] = defaultdict(list)
    heats: dict[int, list[Heat]] = defaultdict(list)
    for edge in network.edges:
        laws = [network.factors[k] for k in edge.factors]
        for j in {k for k, _ in edge.conductance.powers}.union(*(law.parameters.values() for law in laws)):
            edges[j].append(edge)
    for heat in network.heats:
        if heat.disabled:  # its enabled copy has the other parameters
            for j in {k for law in (heat.law, *heat.factors) if law.disabled for k in law.parameters.values()}:
                heats[j].append(heat)
            continue
        shares = {o.share for o in heat.outlets if o.share is not None}
        for j in shares.union(*(law.parameters.values() for law in (heat.law, *heat.factors))):
            heats[j].append(heat)
    return edges, heats


def edge_slope(balance: Balance, edge: Edge, j: int) -> Array:
    """Derivative (B, M) of an edge's conductance in every interval by parameter j's value."""
    laws = [balance.network.factors[k] for k in edge.factors]
    values = stepped(balance.values, j)
    out = np.asarray(edge.conductance(values))[0] * np.ones(balance.inputs.valid.shape)
    for k, law in zip(edge.factors, laws, strict=True):
        if k in balance.regimes.varying or j in law.parameters.values():
            out = out * factor_series(law, values, balance.inputs)[0]
        else:
            out = out * balance.regimes.factor[0, balance.regimes.of, k]
    return np.asarray(np.imag(out) / STEP)


def few(pairs: Sequence[tuple[Array, Array]], n_cells: int) -> list[tuple[Array, Array]]:
    """The same heat in at most `n_cells` pairs of directions (R, N) and watts."""
    if len(pairs) <= n_cells:
        return list(pairs)
    n_regimes = len(pairs[0][0])
    if any((d != d[0]).any() for d, _ in pairs):
        return list(pairs)
    directions = np.array([d[0] for d, _ in pairs])
    total = np.einsum("jn,jbme->nbme", directions, np.array([s for _, s in pairs]))
    return [(np.repeat(unit[None], n_regimes, axis=0), total[i]) for i, unit in enumerate(np.eye(n_cells))]


RELATIVE = 1e-6  # to which derivatives of heat that needs the past converge
ROUNDS = 60


@dataclass(frozen=True)
class Selected:
    """Unknowns to differentiate by, in this order.

    Numbered `parameters` (None: the free ones) in fitting coordinates (`Parameter.to_x`); with `starts` the start
    temperature of every body, K; the offsets of the surroundings numbered `offsets`, K. Starts and offsets are each
    batch's own: their derivatives hold for that batch.
    """

    parameters: Sequence[int] | None = None
    starts: bool = False
    offsets: Sequence[int] = ()


ALL_FREE = Selected()


def sensitivities(
    network: Network,
    values: Array,
    inputs: Inputs,
    start_degC: Array | str | None = None,
    selected: Selected = ALL_FREE,
    tolerance_K: float = TOLERANCE_K,
    last: Trajectory | None = None,
) -> tuple[Simulation, Array, Array]:
    """A simulation at values (n,) and its derivatives by Q `selected` unknowns.

    Start temperatures that follow from first readings are taken as given. Other arguments as in `simulate`, for one
    parameter set.

    Returns:
        the simulation, d readings (Q, B, K, n_sensors) and d errors (Q, B, K, n_errors).

    Raises:
        InputError: as `simulate`; WorkError: the derivatives do not converge.
    """
    values = np.asarray(values, float).reshape(1, -1)
    start = checked_start(network, values, inputs, start_degC)
    if len(start) != 1 or (inputs.offsets_K is not None and len(inputs.offsets_K) != 1):
        raise InputError(f"machine {network.machine}: sensitivities need one set of start temperatures and offsets")
    solved = solved_balance(network, values, inputs, start, tolerance_K, last=last)
    numbers = network.free.tolist() if selected.parameters is None else list(selected.parameters)
    build = UnknownsOf(solved, solved.states.at(np.eye(network.n_cells)[None])[0])
    unknowns = [build.parameter(j) for j in numbers]
    unknowns += [build.start(cells) for cells in network.bodies.values()] if selected.starts else []
    unknowns += [build.offset(s) for s in selected.offsets]
    rows = rows_of(solved, 1)
    tangents = _Tangents(solved, unknowns, build.cells_degC).at_rows(rows)
    readings, errors, d_readings, d_errors = shown(rows, network, tangents)
    for q, j in enumerate(numbers):
        slope = float(network.parameters[j].slope(values[0, j]))
        d_readings[q] *= slope
        d_errors[q] *= slope
    return simulation_of(solved, readings, errors, tolerance_K), d_readings, d_errors


class _Tangents:
    """The thermal part: derivatives of all places' temperatures, at the borders while it is solved."""

    def __init__(self, solved: Solved, unknowns: Sequence[Unknown], cells_degC: Array) -> None:
        self.solved, self.balance, self.unknowns = solved, solved.balance, unknowns
        self.every = self.balance.inputs.every
        self.rise_K = cells_degC - cells_degC[:, :1]
        self.thermal = [q for q, u in enumerate(unknowns) if u.thermal]
        self.matrix = seen_matrix(self.balance.network, self.balance.values, solved.places)  # (1, n_out, N)
        self.n_places = len(solved.places.rows)

    def at_rows(self, rows: Rows) -> Tangents:
        """Tangents at the rows of the recordings."""
        inputs, network = self.balance.inputs, self.balance.network
        n_rows = rows.time_s.shape[1]
        seen = np.zeros((self.matrix.shape[1], len(self.unknowns), inputs.n_batches, n_rows))
        if self.thermal:
            seen[:, self.thermal] = self._coupled() if self.solved.sources else self._linear()
        chain = seen[self.n_places :] - seen[self.n_places :, ..., :1]
        numbers = {u.parameter: q for q, u in enumerate(self.unknowns) if u.parameter >= 0}
        for e, error in enumerate(network.errors):
            for row, gain in zip(error.rows, error.gains, strict=True):
                for j in {j for j, _ in gain.powers} & set(numbers):
                    rise = self.rise_K[:, :: self.every] @ row
                    chain[e, numbers[j]] += gain.slope(self.balance.values, j)[0] * rise
        air_K = np.zeros((len(self.unknowns), len(network.surroundings), inputs.n_batches, n_rows))
        for q, u in enumerate(self.unknowns):
            for s, ends in u.air_K.items():
                air_K[q, s] = at_borders(ends)[:, :: self.every]
        return Tangents(seen[: self.n_places], chain, air_K, numbers)

    def _alone(self, matrix: Array, every: int) -> Array:
        """Derivatives (n_out, Q, B, K) without what temperature-dependent heat answers; a capacity's without ratio."""
        response = self.solved.response
        out = np.empty((matrix.shape[1], len(self.thermal), *self.balance.inputs.time_s[:, ::every].shape))
        for at, forcing, start in self._groups(response):
            out[:, at] = np.moveaxis(response.outputs(forcing, start, matrix, every), -1, 0)
        return out

    def _with_ratio(self, out: Array, matrix: Array, every: int) -> Array:
        """Add the part of a capacity's derivative that follows the temperatures themselves."""
        for i, q in enumerate(self.thermal):
            ratio = self.unknowns[q].ratio
            if ratio is not None:
                out[:, i] -= np.moveaxis((self.rise_K[:, ::every] * ratio) @ matrix[0].T, -1, 0)
        return out

    def _groups(self, response: Response):  # type: ignore[no-untyped-def]
        """Unknowns with about as many pairs, together: positions, forcing, start (Q, B, N)."""
        balance = self.balance
        n_regimes, n_cells = balance.regimes.count, balance.network.n_cells
        groups: dict[int, list[tuple[int, list[tuple[Array, Array]]]]] = defaultdict(list)
        for i, q in enumerate(self.thermal):
            pairs = few(self.unknowns[q].pairs, n_cells)
            groups[1 << max(len(pairs) - 1, 0).bit_length()].append((i, pairs))
        for size, members in groups.items():
            at = [i for i, _ in members]
            directions = np.zeros((len(at), n_regimes, size, n_cells))
            series = np.zeros((len(at), size, *balance.inputs.dt_s.shape, 2))
            start = np.zeros((len(at), balance.inputs.n_batches, n_cells))
            for k, (i, pairs) in enumerate(members):
                for p, (direction, ends) in enumerate(pairs):
                    directions[k, :, p], series[k, p] = direction, ends
                given = self.unknowns[self.thermal[i]].start_K
                start[k] = 0.0 if given is None else given
            yield at, response.forcing(directions, series), start

    def _linear(self) -> Array:
        """Derivatives (n_out, Q, B, K) of a network whose heat does not answer."""
        return self._with_ratio(self._alone(self.matrix, self.every), self.matrix, self.every)

    def _coupled(self) -> Array:
        """Derivatives (n_out, Q, B, K) where heat answers to temperatures."""
        coupled, sources, balance = self.solved.coupled, self.solved.sources, self.balance
        assert coupled is not None
        n_batches, n_intervals = balance.inputs.valid.shape
        n_places, n_sources = len(coupled.borders.degC) - len(sources), len(sources)
        own = np.stack([s.direction for s in sources], axis=1)
        matrix = np.concatenate([own, self.matrix], axis=1)  # places of the sources come first
        n_seen = n_sources + n_places
        alone = self._alone(matrix if self.every == 1 else matrix[:, :n_seen], 1)
        self._with_ratio(alone[n_sources:], self.matrix[:, : len(alone) - n_sources], 1)
        slope = np.zeros((n_batches, n_intervals, 2, n_sources, n_seen))
        given = np.zeros((n_intervals, 2, n_batches, n_sources, len(self.thermal)))
        for k, source in enumerate(sources):
            self._slopes(source, slope[:, :, :, k, n_sources:], given[..., k, :])
        each = np.arange(n_sources)
        slope[..., each, each] += coupled.chord.slope_W_per_K[0, balance.regimes.of][:, :, None]
        answer = Answer(balance, self.solved.response.modes, balance.directions(sources), matrix[0], slope)
        y = self._answered(answer, np.ascontiguousarray(alone[:n_seen].transpose(3, 2, 0, 1)), given)
        shown = alone[n_sources:] if self.every == 1 else self._linear()
        return shown + y[:, :, n_sources:].transpose(2, 3, 1, 0)

    def _answered(self, answer: Answer, alone: Array, given: Array) -> Array:
        """The sources' contribution from derivatives at the places `alone` (M + 1, B, n, Q), at all outputs and rows.

        Sources along time need the whole past: they are repeated, window by window, until nothing moves.
        """
        coupled, (n_batches, n_intervals) = self.solved.coupled, self.balance.inputs.valid.shape
        assert coupled is not None
        now = np.zeros((n_batches, answer.matrix.shape[1], len(self.thermal)))
        if not any(source.along for source in self.solved.sources):
            return answer.run(slice(0, n_intervals), alone, given, now, self.every)[0]
        seen, out = alone.copy(), np.empty((n_intervals + 1, n_batches, len(answer.matrix), len(self.thermal)))
        for part in coupled.windows:
            now = self._window(part, answer, alone, seen, given[part], now, out)
        return out[:: self.every]

    def _slopes(self, source: Source, slope: Array, given: Array) -> None:
        """Fill in a point-by-point source's W/K at its places, and its heat by derivatives of surroundings."""
        coupled, part = self.solved.coupled, slice(0, self.balance.inputs.valid.shape[1])
        assert coupled is not None
        if source.along:
            return
        for place, watts in source.slopes(coupled.borders, part).items():
            slope[..., place] = np.moveaxis(watts[0], 1, 2)
        for s, watts in source.surrounding_slopes(coupled.borders, part).items():
            for i, q in enumerate(self.thermal):
                if s in self.unknowns[q].air_K:
                    by_air = np.moveaxis(watts[0], 1, 2) * self.unknowns[q].air_K[s]
                    given[..., i] += np.moveaxis(by_air, 0, -1)

    def _window(
        self, part: slice, answer: Answer, alone: Array, seen: Array, given: Array, now: Array, out: Array
    ) -> Array:
        """Repeat sources along time in some intervals: fills `seen` and `out` there; all cells' y at the end."""
        balance, coupled, sources = self.balance, self.solved.coupled, self.solved.sources
        assert coupled is not None
        borders, places = slice(part.start, part.stop + 1), slice(len(sources), alone.shape[2])
        degC = coupled.borders.degC[: alone.shape[2] - len(sources)]
        valid = (np.arange(borders.start, borders.stop)[:, None] <= balance.inputs.n_intervals)[..., None, None]
        for _ in range(ROUNDS):
            ahead = Borders(degC + 1j * STEP * seen[:, :, places].transpose(2, 3, 1, 0))
            for k, source in enumerate(sources):
                if source.along:
                    given[:, :, :, k] = np.imag(source.watts(ahead, part)).transpose(3, 2, 1, 0) / STEP
            out[borders], then = answer.run(part, alone[borders], given, now)
            new = alone[borders] + out[borders, :, : alone.shape[2]]
            gap = np.where(valid, np.abs(new - seen[borders]), 0.0).max(axis=(0, 1, 2))
            size = np.where(valid, np.abs(new), 0.0).max(axis=(0, 1, 2))
            seen[borders] = new
            if not np.isfinite(gap).all() or (gap <= RELATIVE * size).all():
                break
        if not (np.isfinite(gap).all() and (gap <= 100 * RELATIVE * size).all()):
            hours = balance.inputs.time_s[0, [part.start, part.stop]] / 3600
            raise WorkError(
                f"machine {balance.network.machine}: derivatives do not converge between {hours[0]:.2f} h and "
                f"{hours[1]:.2f} h of a batch; take smaller substeps"
            )
        return then
