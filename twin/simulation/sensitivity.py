"""Forward sensitivities: how every channel changes with every parameter, start temperature and offset.

The derivative of the heat balance is a heat balance with other heat: all unknowns are right-hand sides of one linear
run with the simulation's own modes (Tomovic and Vukobratovic 1972, General Sensitivity Theory). What multiplies a
temperature is linear within an interval, so derivatives are of second order in it, like the simulation itself.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError, WorkError
from twin.network import Network
from twin.simulation.channels import Rows, Tangents, shown
from twin.simulation.coupling import outlets
from twin.simulation.inputs import Inputs
from twin.simulation.law_calls import STEP
from twin.simulation.mixing import Mixing
from twin.simulation.response import Response
from twin.simulation.run import TOLERANCE_K, Simulation, simulation_of
from twin.simulation.schedule import Schedule
from twin.simulation.solved import Solved, rows_of, seen_matrix, solved_balance
from twin.simulation.sources import Borders
from twin.simulation.start import checked_start
from twin.simulation.tangent_forcing import Unknown, UnknownsOf, few

Array = NDArray[np.float64]

RELATIVE = 1e-6  # to which the derivatives' own iteration converges
ROUNDS = 60


def sensitivities(
    network: Network,
    values: Array,
    inputs: Inputs,
    start_degC: Array | str | None = None,
    parameters: Sequence[int] | None = None,
    starts: bool = False,
    offsets: Sequence[int] = (),
    offsets_K: Array | None = None,
    tolerance_K: float = TOLERANCE_K,
    every: int | None = None,
) -> tuple[Simulation, Array, Array]:
    """A simulation at values (n,), d readings (Q, B, K, n_sensors) and d errors (Q, B, K, n_errors).

    The Q unknowns are the `parameters` (numbers; default the free ones) in fitting coordinates (`Parameter.to_x`),
    with `starts` the start temperature of every body in K, then offsets in K of the surroundings numbered `offsets`.
    Starts and offsets are each batch's own: their derivatives hold for that batch. Start temperatures that follow from
    first readings are taken as given. Other arguments as in `simulate`, for one parameter set.

    Raises:
        InputError: as `simulate`; WorkError: the derivatives do not converge.
    """
    values = np.asarray(values, float).reshape(1, -1)
    every = inputs.every if every is None else every
    start = checked_start(network, values, inputs, start_degC)
    if len(start) != 1 or (offsets_K is not None and len(offsets_K) != 1):
        raise InputError(f"machine {network.machine}: sensitivities need one set of start temperatures and offsets")
    solved = solved_balance(network, values, inputs, start, tolerance_K, 1, offsets_K)
    numbers = network.free.tolist() if parameters is None else list(parameters)
    build = UnknownsOf(solved, solved.states.at(np.eye(network.n_cells)[None])[0])
    unknowns = [build.parameter(j) for j in numbers]
    unknowns += [build.start(cells) for cells in network.bodies.values()] if starts else []
    unknowns += [build.offset(s) for s in offsets]
    rows = rows_of(solved, every, 1)
    tangents = _Tangents(solved, unknowns, build.cells_degC, every).at_rows(rows)
    readings, errors, d_readings, d_errors = shown(rows, network, tangents)
    for q, j in enumerate(numbers):
        slope = float(network.parameters[j].slope(values[0, j]))
        d_readings[q] *= slope
        d_errors[q] *= slope
    return simulation_of(solved, readings, errors, tolerance_K, every), d_readings, d_errors


class _Tangents:
    """The thermal part: derivatives of all places' temperatures, at the borders while it is solved."""

    def __init__(self, solved: Solved, unknowns: Sequence[Unknown], cells_degC: Array, every: int) -> None:
        self.solved, self.balance, self.unknowns = solved, solved.balance, unknowns
        self.every = every
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
            seen[:, self.thermal] = self._coupled() if self.solved.sources else self._alone(self.every)
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
                air_K[q, s] = np.concatenate([ends[:, :1, 0], ends[..., 1]], axis=-1)[:, :: self.every]
        return Tangents(seen[: self.n_places], chain, air_K, numbers)

    def _alone(self, every: int) -> Array:
        """Derivatives (n_out, Q, B, K) without what temperature-dependent heat answers."""
        response = self.solved.response
        out = np.empty((self.matrix.shape[1], len(self.thermal), *self.balance.inputs.time_s[:, ::every].shape))
        for at, forcing, start in self._groups(response, slice(0, self.balance.inputs.valid.shape[1])):
            out[:, at] = np.moveaxis(response.outputs(forcing, start, self.matrix, every), -1, 0)
        return self._with_ratio(out, self.matrix, every)

    def _with_ratio(self, out: Array, matrix: Array, every: int, part: slice | None = None) -> Array:
        """Add the part of a capacity's derivative that follows the temperatures themselves."""
        rise_K = self.rise_K if part is None else self.rise_K[:, part.start : part.stop + 1]
        for i, q in enumerate(self.thermal):
            ratio = self.unknowns[q].ratio
            if ratio is not None:
                out[:, i] -= np.moveaxis((rise_K[:, ::every] * ratio) @ matrix[0].T, -1, 0)
        return out

    def _groups(self, response: Response, part: slice):  # type: ignore[no-untyped-def]
        """Unknowns with about as many pairs, together: positions, forcing in the intervals `part`, start (Q, B, N)."""
        balance = self.balance
        n_regimes, n_cells = balance.regimes.count, balance.network.n_cells
        groups: dict[int, list[tuple[int, list[tuple[Array, Array]]]]] = defaultdict(list)
        for i, q in enumerate(self.thermal):
            pairs = few(self.unknowns[q].pairs, n_cells)
            groups[1 << max(len(pairs) - 1, 0).bit_length()].append((i, pairs))
        for size, members in groups.items():
            at = [i for i, _ in members]
            directions = np.zeros((len(at), n_regimes, size, n_cells))
            series = np.zeros((len(at), size, *balance.inputs.dt_s[:, part].shape, 2))
            start = np.zeros((len(at), balance.inputs.n_batches, n_cells))
            for k, (i, pairs) in enumerate(members):
                for p, (direction, ends) in enumerate(pairs):
                    directions[k, :, p], series[k, p] = direction, ends[:, part]
                given = self.unknowns[self.thermal[i]].start_K
                start[k] = 0.0 if given is None else given
            yield at, response.forcing(directions, series), start

    def _coupled(self) -> Array:
        """Derivatives (n_out, Q, B, K) where heat answers to temperatures: the simulation's iteration once more."""
        coupled, response, sources = self.solved.coupled, self.solved.response, self.solved.sources
        assert coupled is not None
        shape = self.balance.inputs.valid.shape
        heat = np.zeros((len(self.thermal), len(sources), *shape, 2))
        n_places = len(coupled.borders.degC) - len(sources)
        own = [s.direction for s in sources] if coupled.chord.used else []
        matrix = np.concatenate([self.matrix[:, :n_places], *(d[:, None] for d in own)], axis=1)
        seen = np.zeros((matrix.shape[1], len(self.thermal), shape[0], shape[1] + 1))
        now = None  # derivative of all cells at the start of a window, without the ratio's part
        for part in coupled.windows:
            now = self._window(part, matrix, n_places, seen, heat, now)
        into, rest = outlets(self.balance, sources), np.zeros((1, shape[0], matrix.shape[2]))
        answer = response.outputs(response.forcing(into, heat), rest, self.matrix, self.every)
        return self._alone(self.every) + np.moveaxis(answer, -1, 0)

    def _window(
        self, part: slice, matrix: Array, n_places: int, seen: Array, heat: Array, now: Array | None
    ) -> Array | None:
        """Iterate in some intervals: fills `heat` (Q, k, B, m, 2) and `seen` there; all cells (Q, B, N) at the end."""
        balance, coupled = self.balance, self.solved.coupled
        assert coupled is not None
        n_steps, response = part.stop - part.start, self.solved.response
        if n_steps < balance.inputs.valid.shape[1]:
            left = np.clip(balance.inputs.n_intervals - part.start, 0, n_steps)
            schedule = Schedule(balance.inputs.dt_s[:, part], balance.regimes.of[:, part], left)
            response = Response(coupled.chord.modes, schedule)
        groups = [(at, f, start if now is None else now[at]) for at, f, start in self._groups(response, part)]
        own = seen[..., part.start : part.stop + 1]
        for at, forcing, start in groups:
            own[:, at] = np.moveaxis(response.outputs(forcing, start, matrix), -1, 0)
        self._with_ratio(own[:n_places], matrix[:, :n_places], 1, part)
        base = own.copy()
        valid = np.arange(part.start, part.stop + 1) <= balance.inputs.n_intervals[:, None]
        mixing = Mixing(valid, off=any(s.along for s in self.solved.sources))
        into, rest = outlets(balance, self.solved.sources), np.zeros((1, balance.inputs.n_batches, matrix.shape[2]))
        slopes = self._slopes(part)
        for _ in range(ROUNDS):
            heat[:, :, :, part] = self._answer_W(part, seen, slopes, n_places)
            new = base + np.moveaxis(response.outputs(response.forcing(into, heat[:, :, :, part]), rest, matrix), -1, 0)
            gap = np.where(valid, np.abs(new - own), 0.0).max(axis=(0, 2, 3))
            size = np.where(valid, np.abs(new), 0.0).max(axis=(0, 2, 3))
            if not np.isfinite(gap).all() or (gap <= RELATIVE * size).all():
                own[...] = new
                break
            own[...] = mixing(own, new)
        if not (np.isfinite(gap).all() and (gap <= 100 * RELATIVE * size).all()):
            hours = balance.inputs.time_s[0, [part.start, part.stop]] / 3600
            raise WorkError(
                f"machine {balance.network.machine}: derivatives do not converge between {hours[0]:.2f} h and "
                f"{hours[1]:.2f} h of a batch; take smaller substeps"
            )
        if part.stop == balance.inputs.valid.shape[1]:
            return None
        cells = np.eye(matrix.shape[2])[None]
        out = response.outputs(response.forcing(into, heat[:, :, :, part]), rest, cells, n_steps)[:, :, -1]
        for at, forcing, start in groups:
            out[at] += response.outputs(forcing, start, cells, n_steps)[:, :, -1]
        return np.asarray(out)

    def _slopes(self, part: slice) -> list[tuple[dict[int, Array], dict[int, Array]]]:
        """Of every source that works point by point: W/K by place and by surrounding, (1, B, 2, m)."""
        coupled = self.solved.coupled
        assert coupled is not None
        sources = self.solved.sources
        return [
            ({}, {}) if s.along else (s.slopes(coupled.borders, part), s.surrounding_slopes(coupled.borders, part))
            for s in sources
        ]

    def _answer_W(
        self, part: slice, seen: Array, slopes: list[tuple[dict[int, Array], dict[int, Array]]], n_places: int
    ) -> Array:
        """What the sources make of the derivatives `seen`, (Q, k, B, m, 2), the chord's part included."""
        coupled, balance = self.solved.coupled, self.balance
        assert coupled is not None
        borders = Borders(seen)
        n_batches, n_steps = balance.inputs.n_batches, part.stop - part.start
        out = np.zeros((len(self.thermal), len(self.solved.sources), n_batches, n_steps, 2))
        for k, (source, (by_place, by_air)) in enumerate(zip(self.solved.sources, slopes, strict=True)):
            watts = np.zeros((len(self.thermal), n_batches, 2, n_steps))
            if source.along:
                ahead = Borders(coupled.borders.degC[:n_places] + 1j * STEP * seen[:n_places])
                watts += np.imag(source.watts(ahead, part)) / STEP
            for place, slope in by_place.items():
                watts += slope * borders.ends(place, part)
            for s, slope in by_air.items():
                for i, q in enumerate(self.thermal):
                    if s in self.unknowns[q].air_K:
                        watts[i] += slope[0] * np.moveaxis(self.unknowns[q].air_K[s][:, part], -1, -2)
            out[:, k] = np.moveaxis(watts, -2, -1)
            if coupled.chord.used:
                chord = coupled.chord.slope_W_per_K[0, balance.regimes.of[:, part], k]
                out[:, k] += chord[..., None] * np.moveaxis(borders.ends(n_places + k, part), -2, -1)
        return out
