"""Temperatures of a linear network under given heat, exactly, for many batches and parameter sets in one array pass.

Within an interval conductances are constant and drivers linear; the solution there is a sum of modes, each a
scalar recursion. Pieces of all batches advance together: modal heat by matrix product, one recursion that only
finds each piece's end, a short loop along the pieces of a batch, one recursion from the true starts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from data.arrays import Array
from data.errors import InputError
from twin.simulation.modes import Modes, Weights, advance, heat, weights_of
from twin.simulation.schedule import Drive, Ints, Pieces, Schedule

__all__ = ["Drive", "Forcing", "Response", "Schedule", "States"]

_CHUNK_ELEMENTS = 30_000  # of one recursion step (pieces x sets x modes): stays in the second-level cache
_OWN_SERIES = 12  # interval values per product for sets with own series: below it zeros are cheaper than more products
_CHUNK_BYTES = 128 << 20  # of one chunk's states


@dataclass(frozen=True)
class Term:
    """Heat of one group of sources: `directions_W` (Q or 1, R, J, N) times a drive of J series."""

    directions_W: Array
    drive: Drive


@dataclass(frozen=True)
class Forcing:
    """Heat into the network, as a sum of terms; `a + b` is the heat of both. Cheap: nothing is evaluated yet."""

    terms: tuple[Term, ...] = ()

    def __add__(self, other: Forcing) -> Forcing:
        return Forcing(self.terms + other.terms)


@dataclass(frozen=True)
class States:
    """Modal amplitudes at the ends of all rows, for Q sets; `at` reads temperatures or linear outputs from them."""

    modes: Modes
    pieces: Pieces
    start_degC: Array
    chunks: tuple[tuple[slice, Array], ...]
    n_sets: int

    def at(self, matrix: Array, every: int = 1) -> Array:
        """Linear outputs (Q, B, M // every + 1, n_out) at interval borders, index 0 at the start.

        `matrix` (Q or P or 1, n_out, N) acts on node temperatures. `every` counts the borders that `run` kept.
        Behind a batch's last valid interval the last valid value is held.

        Raises:
            InputError: a matrix of another shape.
        """
        matrix = _matrix(matrix, self.n_sets, self.modes.n_nodes)
        border = self.pieces.border[:, ::every]
        out = np.empty((matrix.shape[1], self.n_sets, *border.shape))
        for sets, amplitude in self.chunks:
            _read(self.modes, self.pieces, amplitude, self.start_degC, matrix, border, sets, out)
        return np.moveaxis(out, 0, -1)


@dataclass(frozen=True)
class Response:
    """What networks with these modes do on this schedule: P parameter sets (or one, for all right-hand sides).

    Raises:
        InputError: the schedule has a regime that the modes lack.
    """

    modes: Modes
    schedule: Schedule
    _cache: dict[int, list[Weights]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.schedule.n_regimes > self.modes.n_regimes:
            raise InputError(
                f"response: the schedule uses regime {self.schedule.n_regimes - 1}, the modes have "
                f"{self.modes.n_regimes} regimes; give one conductance matrix per regime"
            )

    def forcing(self, directions_W: Array, series: Array | Drive) -> Forcing:
        """Heat `sum_j directions_W[q, r, j] * series[q, j]`, W: directions (Q or 1, R, J, N) in W per unit of a series.

        `series` (Q or 1, J, B, M, 2) has the values at the start and the end of every interval, linear in between;
        a `Drive` made by `schedule.drive(series)` is sorted into pieces once and serves many parameter sets.

        Raises:
            InputError: shapes that disagree, or a value that is not finite within a batch's valid intervals.
        """
        drive = series if isinstance(series, Drive) else self.schedule.drive(series)
        directions = np.asarray(directions_W, float)
        expected = (self.modes.n_regimes, drive.n_series, self.modes.n_nodes)
        if directions.ndim != 4 or directions.shape[1:] != expected:
            raise InputError(
                f"forcing: directions have shape {directions.shape}, expected (sets, regimes, series, nodes) = "
                f"(…, {', '.join(map(str, expected))})"
            )
        return Forcing((Term(directions, drive),))

    def run(self, forcing: Forcing, start_degC: Array, every: int = 1) -> States:
        """States from node temperatures `start_degC` (Q or 1, B, N), at every `every`-th interval border.

        A larger `every` merges the intervals between kept borders and costs that much less; results are the same.
        Memory: 8 bytes x Q x B x M / every x N, all kept for `States.at`; `outputs` keeps only a chunk of it.

        Raises:
            InputError: shapes that disagree.
        """
        n_sets, start = self._sets(forcing, start_degC)
        pieces = self.schedule.pieces(every)
        chunks = tuple((sets, self._advance(forcing, start, pieces, sets)) for sets in self._chunks(pieces, n_sets))
        return States(self.modes, pieces, start, chunks, n_sets)

    def outputs(self, forcing: Forcing, start_degC: Array, matrix: Array, every: int = 1) -> Array:
        """`run(...).at(matrix)` with bounded memory: 128 MiB of states (one set at least) in addition to the result."""
        n_sets, start = self._sets(forcing, start_degC)
        matrix = _matrix(matrix, n_sets, self.modes.n_nodes)
        pieces = self.schedule.pieces(every)
        out = np.empty((matrix.shape[1], n_sets, *pieces.border.shape))
        store: Array | None = None  # the first chunk's states, which no later one exceeds: fresh pages cost time
        for sets in self._chunks(pieces, n_sets):
            amplitude = self._advance(forcing, start, pieces, sets, store)
            store = amplitude if store is None else store
            _read(self.modes, pieces, amplitude, start, matrix, pieces.border, sets, out)
        return np.moveaxis(out, 0, -1)

    def _sets(self, forcing: Forcing, start_degC: Array) -> tuple[int, Array]:
        start = np.asarray(start_degC, float)
        expected = (self.schedule.n_batches, self.modes.n_nodes)
        if start.ndim != 3 or start.shape[1:] != expected:
            raise InputError(
                f"run: start temperatures have shape {start.shape}, expected (sets, batches, nodes) = "
                f"(…, {expected[0]}, {expected[1]})"
            )
        bad = np.argwhere(~np.isfinite(start))
        if len(bad):
            q, b, n = bad[0].tolist()
            raise InputError(
                f"run: set {q}, batch {b}, node {n}: start temperature is {start[q, b, n]}, expected a finite number"
            )
        if any(t.drive.schedule is not self.schedule for t in forcing.terms):
            raise InputError("run: the heat was prepared for another schedule; use this response's forcing()")
        counts = {"modes": self.modes.n_sets, "start temperatures": len(start)}
        for k, t in enumerate(forcing.terms):
            counts |= {f"directions of term {k}": len(t.directions_W), f"series of term {k}": t.drive.n_sets}
        n_sets = max(counts.values())
        odd = {name: n for name, n in counts.items() if n not in (1, n_sets)}
        if odd:
            name, n = next(iter(odd.items()))
            raise InputError(f"run: {name} come in {n} sets, expected 1 or {n_sets} as the other inputs")
        return n_sets, start

    def _chunks(self, pieces: Pieces, n_sets: int) -> Iterator[slice]:
        n = self.modes.n_nodes
        size = min(_CHUNK_ELEMENTS // (pieces.n_pieces * n + 1), _CHUNK_BYTES // (8 * pieces.n_rows * n + 1))
        size = max(size, 1)
        return (slice(lo, min(lo + size, n_sets)) for lo in range(0, n_sets, size))

    def _weights(self, pieces: Pieces) -> list[Weights]:
        if pieces.every not in self._cache:
            self._cache[pieces.every] = [weights_of(self.modes, b, self.schedule.step_s) for b in pieces.blocks]
        return self._cache[pieces.every]

    def _advance(
        self, forcing: Forcing, start_degC: Array, pieces: Pieces, sets: slice, store: Array | None = None
    ) -> Array:
        """Modal amplitudes (rows, sets, N) of some sets at the end of every row, in the memory of `store` if given."""
        modes = self.modes.of_sets(sets)
        weights = [w.of_sets(sets) for w in self._weights(pieces)]
        n_sets, n_modes = sets.stop - sets.start, modes.n_nodes
        shape = (pieces.n_rows, n_sets, n_modes)
        amplitude = np.empty(shape) if store is None else store.reshape(-1)[: np.prod(shape)].reshape(shape)
        if not forcing.terms:
            amplitude[:] = 0.0
        for k, term in enumerate(forcing.terms):
            _add_heat(amplitude, term, modes, pieces, weights, sets, first=k == 0)
        ends = advance(amplitude, modes, pieces, weights, _of_sets(start_degC, sets))
        if not np.isfinite(ends).all():
            places = [place for t in forcing.terms if (place := t.drive.first_bad()) is not None]
            raise InputError(
                f"run: heat is not finite; {places[0]}, expected a finite number; bridge the gap or shorten the batch"
                if places
                else "run: heat is not finite although every series is; look for a direction that is not finite"
            )
        return amplitude


def _add_heat(
    amplitude: Array, term: Term, modes: Modes, pieces: Pieces, weights: list[Weights], sets: slice, first: bool
) -> None:
    """Add (or, the first, write) one term's modal heat per row to amplitude (rows, sets, N)."""
    n_sets = amplitude.shape[1]
    directions = _of_sets(term.directions_W, sets)
    modal = [directions[:, b.regime] @ modes.shape[:, b.regime] for b in pieces.blocks]
    # series shared by all sets: one matrix product for all; own series: a few sets at once, block by block diagonal
    own = term.drive.n_sets > 1
    size = max(1, _OWN_SERIES // (term.drive.n_series * pieces.every)) if own else n_sets
    for group in (slice(lo, min(lo + size, n_sets)) for lo in range(0, n_sets, size)):
        series = term.drive.rows(pieces.every, slice(sets.start + group.start, sets.start + group.stop))
        for block, weight, modal_W, rows in zip(pieces.blocks, weights, modal, series, strict=True):
            weight, modal_W = weight.of_sets(group), _of_sets(modal_W, group)
            target = amplitude[block.rows, group]
            if own:
                modal_W = _each_its_own(modal_W, target.shape[1])
            n_own = max(len(modal_W), len(weight.decay))
            out = target.reshape(len(rows), -1) if first and n_own == target.shape[1] else None
            part = heat(block, weight, modal_W, rows, out).reshape(len(rows), n_own, -1)
            if out is None and first:
                target[...] = part
            elif out is None:
                target += part


def _each_its_own(modal_W: Array, n_sets: int) -> Array:
    """Directions (Q, Q * J, N) on the series of Q sets side by side, from those (Q or 1, J, N) on own series."""
    n_series, n_modes = modal_W.shape[1:]
    wide = np.zeros((n_sets, n_sets, n_series, n_modes))
    wide[np.arange(n_sets), np.arange(n_sets)] = modal_W
    return wide.reshape(n_sets, -1, n_modes)


def _read(
    modes: Modes, pieces: Pieces, amplitude: Array, start_degC: Array, matrix: Array, border: Ints, sets: slice,
    out: Array,
) -> None:  # fmt: skip
    """Write the outputs of some sets at the rows `border` into out (n_out, Q, B, borders): time last, as laws read."""
    chosen, few = _of_sets(matrix, sets), modes.of_sets(sets)
    of_modes = chosen[:, None] @ few.shape  # (Q or 1, R, n_out, N)
    start = chosen @ _of_sets(start_degC, sets).swapaxes(-1, -2)  # (Q or 1, n_out, B)
    lines = np.empty((len(out), pieces.n_rows + len(border)))
    for i in range(amplitude.shape[1]):
        reading = of_modes[min(i, len(of_modes) - 1)]
        for block in pieces.blocks:
            np.matmul(reading[block.regime], amplitude[block.rows, i].T, out=lines[:, block.rows])
        lines[:, pieces.n_rows :] = start[min(i, len(start) - 1)]
        for line, into in zip(lines, out[:, sets.start + i], strict=True):
            line.take(border, out=into, mode="clip")


def _of_sets(array: Array, sets: slice) -> Array:
    """Some sets of an array, or the only one."""
    return array if len(array) == 1 else array[sets]


def _matrix(matrix: Array, n_sets: int, n_nodes: int) -> Array:
    values = np.asarray(matrix, float)
    if values.ndim != 3 or values.shape[2] != n_nodes or values.shape[0] not in (1, n_sets):
        raise InputError(
            f"outputs: the matrix has shape {values.shape}, expected (sets, outputs, nodes) = "
            f"(1 or {n_sets}, …, {n_nodes})"
        )
    return values
