"""Waveform relaxation for temperature-dependent heat (Lelarasmee et al. 1982).

Each iteration evaluates the laws on the previous trajectory, at both ends of every interval, and solves the linear
network with that heat. Strong feedback is linearised: its mean slope is added to the conductance matrix (a chord). If
the iteration still does not contract, the converged part is kept and the rest is solved in shorter windows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError, WorkError
from twin.simulation.balance import Balance, Borders, Source
from twin.simulation.modes import Modes, modes_of
from twin.simulation.response import Forcing, Response
from twin.simulation.schedule import Schedule


class Mixing:
    """Anderson's acceleration of depth 2, batch by batch (Walker and Ni 2011, SIAM J. Numer. Anal. 49, 1715)."""

    def __init__(self, valid: NDArray[np.bool_], off: bool) -> None:
        self.valid, self.off = valid, off
        self.was: list[tuple[Array, Array]] = []  # changes of (what a round gives, what it changes), newest last
        self.last: tuple[Array, Array] | None = None

    def __call__(self, old: Array, new: Array) -> Array:
        """The next trajectory (n, P, B, m + 1) from the previous one and its image under an iteration."""
        if self.off:
            return new
        gap = np.where(self.valid, new - old, 0.0)
        if self.last is not None:
            self.was = [*self.was[-1:], (new - self.last[0], gap - self.last[1])]
        self.last = (new, gap)
        if not self.was:
            return new
        normal = np.stack([[np.einsum("npbm,npbm->pb", f, g) for _, g in self.was] for _, f in self.was])
        right = np.stack([np.einsum("npbm,npbm->pb", f, gap) for _, f in self.was])
        normal, right = np.moveaxis(normal, (0, 1), (-2, -1)), np.moveaxis(right, 0, -1)
        size = np.trace(normal, axis1=-2, axis2=-1)[..., None, None]
        ridge = 1e-12 * size + (size == 0)
        share = np.linalg.solve(normal + ridge * np.eye(len(self.was)), right[..., None])[..., 0]
        return np.asarray(new - sum(share[..., k, None] * self.was[k][0] for k in range(len(self.was))))


WEAK = 0.5  # a loop gain below which the plain iteration contracts fast enough
ROUNDS, LAST_ROUNDS = 25, 60  # of a window, and of one that is a single interval
SAMPLED = 48  # intervals per batch that a mean slope is taken over


@dataclass(frozen=True)
class Chord:
    """The part of each source's slope that is in the conductance matrix, W/K (P, R, k), along its direction."""

    slope_W_per_K: Array
    modes: Modes

    @property
    def used(self) -> bool:
        return bool(self.slope_W_per_K.any())


@dataclass
class Coupled:
    """The converged heat of the sources as series (P, k, B, M, 2), and how it was found.

    `windows` are the stretches of intervals that were iterated one after the other, `rounds` all iterations.
    """

    series_W: Array
    borders: Borders
    chord: Chord
    windows: list[slice] = field(default_factory=list)
    rounds: int = 0


def plain_modes(balance: Balance) -> Modes:
    """The network's own modes; regimes of the same conductances share them."""
    first = np.unique(balance.mode_group, return_index=True)[1]
    return modes_of(balance.capacity_J_per_K, balance.conductance_W_per_K[:, first]).of_regimes(balance.mode_group)


def solve(balance: Balance, sources: Sequence[Source], rows: Array, start_degC: Array, tolerance_K: float) -> Coupled:
    """The heat of temperature-dependent sources from start temperatures (P or 1, B, N); `rows` (n, N) are its places.

    Stops when no place's temperature moves by more than tolerance_K / 10 from one round to the next.

    Raises:
        InputError: no convergence within a single interval; names the heat, the batch, the time and the remedy.
    """
    return _Solver(balance, sources, rows, start_degC, tolerance_K / 10.0).solve()


class _Solver:
    """`seen` (n + k, P, B, M + 1) are the temperatures of the places and along each source's own direction."""

    def __init__(
        self, balance: Balance, sources: Sequence[Source], rows: Array, start_degC: Array, tolerance_K: float
    ) -> None:
        self.balance, self.sources, self.rows, self.tolerance_K = balance, sources, rows, tolerance_K
        self.directions = np.stack([s.direction for s in sources], axis=1)  # (P, k, N)
        self.outlets = balance.directions(sources)
        n_sets = max(len(balance.values), len(start_degC))
        n_batches, self.n_intervals = balance.inputs.valid.shape
        self.now_degC = np.broadcast_to(start_degC, (n_sets, *start_degC.shape[1:]))
        self.matrix = np.concatenate([np.repeat(rows[None], len(self.directions), axis=0), self.directions], axis=1)
        first = np.einsum("pkn,pbn->kpb", self.matrix, self.now_degC)
        self.seen = np.repeat(first[..., None], self.n_intervals + 1, axis=-1)
        self.borders = Borders(self.seen)
        self.series = np.zeros((n_sets, len(sources), n_batches, self.n_intervals, 2))
        self.along = any(s.along for s in sources)
        self.rounds = 0

    def solve(self) -> Coupled:
        windows, at, size = [], 0, self.n_intervals
        chord = self._chord(slice(0, self.n_intervals))
        while at < self.n_intervals:
            part = slice(at, min(at + size, self.n_intervals))
            reached, chord = self._window(part, chord)
            if reached == at:
                if part.stop - at == 1:
                    raise InputError(self._stiff(at, chord))
                size = max((part.stop - at) // 8, 1)
                continue
            windows.append(slice(at, reached))
            size = 2 * (part.stop - at if reached == part.stop else reached - at)
            at = reached
        return Coupled(self.series, self.borders, chord, windows, self.rounds)

    def _window(self, part: slice, chord: Chord) -> tuple[int, Chord]:
        """Iterate in the intervals `part`; the border up to which it converged (the start itself if nowhere)."""
        valid = np.arange(part.start, part.stop + 1) <= self.balance.inputs.n_intervals[:, None]
        seen = self.seen[..., part.start : part.stop + 1]
        seen[...] = np.where(np.isfinite(seen), seen, seen[..., :1])
        alone = part.stop - part.start == 1
        response, base = self._response(part, chord)
        mixing = Mixing(valid, off=self.along)
        worst: list[float] = []
        for k in range(LAST_ROUNDS if alone else ROUNDS):
            self.rounds += 1
            heat_W = self._heat_W(part, chord)
            if not np.isfinite(np.where(valid[:, 1:, None], heat_W, 0.0)).all():
                return part.start, chord
            new = base + self._answer(response, heat_W)
            change = np.where(valid, np.abs(new - seen), 0.0).max(axis=(0, 1, 2))
            worst.append(float(change.max()))
            converged = worst[-1] <= self.tolerance_K
            seen[...] = new if converged else mixing(seen, new)
            if converged or (not alone and k >= 6 and worst[-1] > 0.5 * worst[-4]):
                break
            if k in (1, 4) and part.start == 0:  # one chord for all windows
                fresh = self._chord(part)
                if not np.allclose(fresh.slope_W_per_K, chord.slope_W_per_K, rtol=0.2):
                    chord, mixing = fresh, Mixing(valid, off=self.along)
                    response, base = self._response(part, chord)
        late = np.flatnonzero(change > self.tolerance_K)
        reached = part.stop if not len(late) else part.start + max(int(late[0]) - 1, 0)
        if reached > part.start:
            self.series[:, :, :, part.start : reached] = self._heat_W(slice(part.start, reached), chord)
        if part.start < reached < self.n_intervals:
            self._advance(slice(part.start, reached), chord)
        return reached, chord

    def _advance(self, part: slice, chord: Chord) -> None:
        """Carry all cells to the end of a window that has converged."""
        response, known = self._known(part, chord)
        heat = known + response.forcing(self.outlets, self.series[:, :, :, part])
        every = np.eye(self.balance.network.n_cells)[None]
        self.now_degC = response.outputs(heat, self.now_degC, every, every=part.stop - part.start)[:, :, -1]

    def _response(self, part: slice, chord: Chord) -> tuple[Response, Array]:
        """The response in a window, and what `seen` is there without the sources, (n + k, P, B, m + 1)."""
        response, known = self._known(part, chord)
        return response, np.moveaxis(response.outputs(known, self.now_degC, self.matrix), -1, 0)

    def _answer(self, response: Response, heat_W: Array) -> Array:
        rest = np.zeros((1, *self.now_degC.shape[1:]))
        return np.moveaxis(response.outputs(response.forcing(self.outlets, heat_W), rest, self.matrix), -1, 0)

    def _known(self, part: slice, chord: Chord) -> tuple[Response, Forcing]:
        balance = self.balance
        if part == slice(0, self.n_intervals):
            response = Response(chord.modes, balance.schedule)
            return response, balance.forcing(response)
        left = np.clip(balance.inputs.n_intervals - part.start, 0, part.stop - part.start)
        response = Response(chord.modes, Schedule(balance.inputs.dt_s[:, part], balance.regimes.of[:, part], left))
        known = Forcing()
        for directions, series in balance.known:
            known = known + response.forcing(directions, series[:, :, :, part])
        return response, known

    def _heat_W(self, part: slice, chord: Chord) -> Array:
        """The sources' heat on the present trajectory, plus what the chord takes out, (P, k, B, m, 2)."""
        out = self.series[:, :, :, part]
        for k, source in enumerate(self.sources):
            out[:, k] = np.moveaxis(source.watts(self.borders, part), -2, -1)
        if chord.used:
            own = np.moveaxis(self.seen[len(self.rows) :, ..., part.start : part.stop + 1], 0, 1)
            slope = np.moveaxis(chord.slope_W_per_K[:, self.balance.regimes.of[:, part]], -1, 1)[..., None]
            out += slope * np.stack([own[..., :-1], own[..., 1:]], axis=-1)
        return out

    def _chord(self, part: slice) -> Chord:
        """Mean slopes along the sources' own directions on the present trajectory, where the feedback is strong."""
        balance = self.balance
        n_sets, n_regimes = balance.conductance_W_per_K.shape[:2]
        slope = np.zeros((n_sets, n_regimes, len(self.sources)))
        for k, source in enumerate(self.sources):
            if not source.along:  # what holds during an interval needs no help
                slope[:, :, k] = self._mean_slope(source, part)
        weak = self._gain(slope, part) < WEAK
        slope = np.where(weak[:, None, None], 0.0, slope)
        if not slope.any():
            return Chord(slope, plain_modes(balance))
        own = np.einsum("prk,pki,pkj->prij", slope, self.directions, self.directions)
        return Chord(slope, modes_of(balance.capacity_J_per_K, balance.conductance_W_per_K + own))

    def _mean_slope(self, source: Source, part: slice) -> Array:
        """Decrease of a source's heat per kelvin along its own direction, mean per regime, (P, R)."""
        balance = self.balance
        direction = source.direction
        size = (direction**2).sum(axis=-1)
        sample = slice(part.start, part.stop, max((part.stop - part.start) // SAMPLED, 1))
        slopes = source.slopes(self.borders, sample)
        of, valid = balance.regimes.of[:, sample], balance.inputs.valid[:, sample]
        decrease = np.zeros((len(direction), *valid.shape))
        for place, slope in slopes.items():
            along = (direction @ self.rows[place]) / np.where(size > 0, size, 1.0)
            decrease = decrease - along[:, None, None] * slope.mean(axis=-2)
        decrease = np.where(np.isfinite(decrease), np.maximum(decrease, 0.0), 0.0)
        out = np.zeros((len(direction), balance.regimes.count))
        overall = (decrease * valid).sum(axis=(1, 2)) / max(int(valid.sum()), 1)
        for r in range(balance.regimes.count):
            here = (of == r) & valid
            out[:, r] = (decrease * here).sum(axis=(1, 2)) / here.sum() if here.any() else overall
        return out

    def _gain(self, slope: Array, part: slice) -> Array:
        """Loop gain over the window, and per interval, of the sources' slopes, (P,): the larger of the two."""
        balance = self.balance
        dt_s = balance.inputs.dt_s[:, part]
        capacity = balance.capacity_J_per_K[:, None, :, None] * np.eye(balance.network.n_cells)
        out = np.zeros(len(slope))
        for span_s in (dt_s.sum(axis=1).max(), dt_s.max()):
            try:
                answer = np.linalg.solve(
                    balance.conductance_W_per_K + capacity / span_s, np.swapaxes(self.directions, -1, -2)[:, None]
                )
            except np.linalg.LinAlgError:
                raise WorkError(
                    f"machine {balance.network.machine}: a body that stores next to nothing conducts next to nothing; "
                    "check capacities and conductances"
                ) from None
            gain = np.einsum("prk,pkn,prnk->pr", slope, self.directions, answer)
            out = np.maximum(out, gain.max(axis=1))
        return out

    def _stiff(self, at: int, chord: Chord) -> str:
        """One line about the heat that moved most in the interval that does not converge."""
        inputs = self.balance.inputs
        old = self.series[:, :, :, at].copy()
        jump = np.abs(self._heat_W(slice(at, at + 1), chord)[..., 0, :] - old).max(axis=-1)
        jump = np.where(np.isfinite(jump), jump, np.inf) * inputs.valid[None, None, :, at]
        _, k, b = (int(i) for i in np.unravel_index(int(np.argmax(jump)), jump.shape))
        name = self.sources[k].name
        own = [p.name for p in self.balance.network.parameters if p.name.startswith(f"mechanisms.{name}.")]
        check = f"check parameter {own[0]}" if own else f"check {name}"
        return (
            f"stiff beyond the step control: heat {name!r}, batch {inputs.batch_ids[b]}, at "
            f"{inputs.time_s[b, at] / 3600.0:.2f} h, does not converge within one interval of "
            f"{inputs.dt_s[b, at]:g} s; take smaller substeps, or {check}"
        )
