"""Forward sensitivities: how every channel changes with every parameter, start temperature and offset.

The derivative of the heat balance is a heat balance with other heat: all unknowns are right-hand sides of one linear
run with the simulation's own modes (Tomovic and Vukobratovic 1972, General Sensitivity Theory), and heat answers to
them interval by interval (`tangent_answer`). What multiplies a temperature is linear within an interval, so
derivatives are of second order in it, like the simulation itself.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from data.arrays import Array
from data.errors import InputError, WorkError
from twin.network import Network
from twin.simulation.balance import Borders, Source
from twin.simulation.channels import Rows, Tangents, shown
from twin.simulation.inputs import STEP, Inputs
from twin.simulation.response import Response
from twin.simulation.run import TOLERANCE_K, Simulation, Solved, rows_of, seen_matrix, simulation_of, solved_balance
from twin.simulation.start import checked_start
from twin.simulation.tangent import Answer, Unknown, UnknownsOf, few

RELATIVE = 1e-6  # to which derivatives of heat that needs the past converge
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
                air_K[q, s] = np.concatenate([ends[:, :1, 0], ends[..., 1]], axis=-1)[:, :: self.every]
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
        matrix = np.concatenate([own, self.matrix], axis=1)  # what sources look at comes first
        n_seen = n_sources + n_places
        alone = self._alone(matrix if self.every == 1 else matrix[:, :n_seen], 1)
        self._with_ratio(alone[n_sources:], self.matrix[:, : len(alone) - n_sources], 1)
        slope = np.zeros((n_batches, n_intervals, 2, n_sources, n_seen))
        given = np.zeros((n_intervals, 2, n_batches, n_sources, len(self.thermal)))
        for k, source in enumerate(sources):
            self._slopes(source, slope[:, :, :, k, n_sources:], given[..., k, :])
        each = np.arange(n_sources)
        slope[..., each, each] += coupled.chord.slope_W_per_K[0, balance.regimes.of][:, :, None]
        answer = Answer(self.solved, matrix[0], slope)
        y = self._answered(answer, np.ascontiguousarray(alone[:n_seen].transpose(3, 2, 0, 1)), given)
        shown = alone[n_sources:] if self.every == 1 else self._linear()
        return shown + y[:, :, n_sources:].transpose(2, 3, 1, 0)

    def _answered(self, answer: Answer, alone: Array, given: Array) -> Array:
        """What the sources make of derivatives at the places `alone` (M + 1, B, n, Q), at all outputs and rows.

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
