"""Waveform relaxation for temperature-dependent heat (Lelarasmee et al. 1982).

Each iteration evaluates the laws on the previous trajectory, at both ends of every interval, and solves the linear
network with that heat. Strong feedback is linearised: its mean slope is added to the conductance matrix (a chord). If
the iteration still does not contract, Newton's method follows; where that diverges, or a law needs the past, the
converged part is kept and the rest is solved in shorter windows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError, WorkError
from twin.simulation.balance import Balance, Borders, Source
from twin.simulation.modes import Modes, first_order_hold, modes_of
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


class Answer:
    """y of a linear network to heat ``w = slope (seen + y) + given`` of k sources, at outputs `matrix` (n_out, N).

    The sources depend on the first n outputs, with `slope` (B, M, 2, k, n), W/K, at both ends of every interval.
    """

    def __init__(
        self, balance: Balance, modes: Modes, directions: Array, matrix: Array, slope: Array, which: int = 0
    ) -> None:
        """`directions` (P, R, k, N) of the sources; `which` parameter set is answered."""
        schedule, valid = balance.schedule, balance.inputs.valid
        self.matrix, self.slope = matrix, slope
        kind = np.where(valid, schedule.regime * len(schedule.step_s) + schedule.step, -1)
        kinds, number = np.unique(kind, return_inverse=True)
        self.number = number.reshape(kind.shape)  # of each interval's regime and step
        regime, dt_s = kinds // len(schedule.step_s), schedule.step_s[kinds % len(schedule.step_s), None]
        decay, start_s, end_s = first_order_hold(modes.rate_per_s[which, regime], dt_s * (kinds >= 0)[:, None])
        shape = modes.shape[which, regime]
        modal = (directions[which, regime] @ shape).swapaxes(-1, -2)
        self.keeps = (shape * decay[:, None]) @ modes.inverse[which, regime]  # (kinds, N, N); behind the end all of it
        self.of_start = shape @ (start_s[..., None] * modal)  # (kinds, N, k)
        self.of_end = shape @ (end_s[..., None] * modal)
        loop = slope[:, :, 1] @ (matrix[: slope.shape[-1]] @ self.of_end)[self.number]
        self.solution = np.linalg.inv(np.eye(loop.shape[-1]) - loop)  # (B, M, k, k)

    def run(self, part: slice, seen: Array, given: Array, now: Array, every: int = 1) -> tuple[Array, Array]:
        """Outputs and, at the end, all cells of y from its cells `now` (B, N, Q) at the start of some intervals.

        Time goes first: seen (m + 1, B, n, Q), given (m, 2, B, k, Q), outputs (m // every + 1, B, n_out, Q).
        """
        n_seen, shown = seen.shape[2], self.matrix @ now
        out = np.empty(((part.stop - part.start) // every + 1, *shown.shape))
        out[0] = shown
        for i, m in enumerate(range(part.start, part.stop)):
            number = self.number[:, m]
            start_W = self.slope[:, m, 0] @ (seen[i] + shown[:, :n_seen]) + given[i, 0]
            ahead = self.keeps[number] @ now + self.of_start[number] @ start_W
            known_W = self.slope[:, m, 1] @ (seen[i + 1] + self.matrix[:n_seen] @ ahead) + given[i, 1]
            now = ahead + self.of_end[number] @ (self.solution[:, m] @ known_W)
            shown = self.matrix @ now
            if (i + 1) % every == 0:
                out[(i + 1) // every] = shown
        return out, now


WEAK = 0.5  # a loop gain below which the plain iteration contracts fast enough
ROUNDS, LAST_ROUNDS = 25, 60  # of a window, and of one that is a single interval
DIVERGES = 4.0  # times the step before: Newton's method from rest is given up
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


@dataclass
class Trajectory:
    """The temperatures (n + k, P, B, M + 1) that a solution ended with, from which one of near parameters begins."""

    degC: Array | None = None


def solve(
    balance: Balance, sources: Sequence[Source], rows: Array, start_degC: Array, tolerance_K: float,
    last: Trajectory | None = None,
) -> Coupled:  # fmt: skip
    """The heat of temperature-dependent sources from start temperatures (P or 1, B, N); `rows` (n, N) are its places.

    Stops when no place's temperature moves by more than tolerance_K / 10 from one round to the next, a hundredth of it
    from the `last` trajectory, which is replaced: the result may not depend on where the iteration begins.

    Raises:
        InputError: no convergence within a single interval; names the heat, the batch, the time and the remedy.
    """
    solver = _Solver(balance, sources, rows, start_degC, tolerance_K / 10.0)
    if last is not None:
        solver.begin(last)
    coupled = solver.solve()
    if last is not None:
        last.degC = solver.seen
    return coupled


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
        self.chord = self._chord(slice(0, self.n_intervals))
        self.rounds = 0

    def begin(self, last: Trajectory) -> None:
        """Begin at a trajectory, where it is one of this network's."""
        if last.degC is not None and last.degC.shape == self.seen.shape:
            self.seen[..., 1:] = np.where(np.isfinite(last.degC), last.degC, self.seen)[..., 1:]
            self.tolerance_K /= 100.0

    def solve(self) -> Coupled:
        whole, start_degC = slice(0, self.n_intervals), self.now_degC
        reached = self._window(whole) if self.n_intervals else 0
        if reached < self.n_intervals and not self.along:
            self.now_degC = start_degC
            reached = self.n_intervals if self._newton() else 0
        windows = [slice(0, reached)] if reached else []
        if reached < self.n_intervals:
            windows += self._windows(reached)
        return Coupled(self.series, self.borders, self.chord, windows, self.rounds)

    def _windows(self, at: int) -> Iterator[slice]:
        """The rest from a border on, as far at once as the iteration contracts."""
        size = 2 * at or max(self.n_intervals // 8, 1)
        while at < self.n_intervals:
            part = slice(at, min(at + size, self.n_intervals))
            reached = self._window(part)
            if reached == at:
                if part.stop - at == 1:
                    raise InputError(self._stiff(at))
                size = max((part.stop - at) // 8, 1)
                continue
            yield slice(at, reached)
            size = 2 * (part.stop - at if reached == part.stop else reached - at)
            at = reached

    def _window(self, part: slice) -> int:
        """Iterate in the intervals `part`; the border up to which it converged (the start itself if nowhere)."""
        valid = np.arange(part.start, part.stop + 1) <= self.balance.inputs.n_intervals[:, None]
        seen = self.seen[..., part.start : part.stop + 1]
        seen[...] = np.where(np.isfinite(seen), seen, seen[..., :1])
        alone = part.stop - part.start == 1
        response, base = self._response(part)
        mixing = Mixing(valid, off=self.along)
        worst: list[float] = []
        for k in range(LAST_ROUNDS if alone else ROUNDS):
            self.rounds += 1
            heat_W = self._heat_W(part)
            if not np.isfinite(np.where(valid[:, 1:, None], heat_W, 0.0)).all():
                return part.start
            new = base + self._answer(response, heat_W)
            change = np.where(valid, np.abs(new - seen), 0.0).max(axis=(0, 1, 2))
            worst.append(float(change.max()))
            converged = worst[-1] <= self.tolerance_K
            seen[...] = new if converged else mixing(seen, new)
            if converged or (not alone and k >= 6 and worst[-1] > 0.5 * worst[-4]):
                break
            if k in (1, 4) and part.start == 0:  # one chord for all windows
                fresh = self._chord(part)
                if not np.allclose(fresh.slope_W_per_K, self.chord.slope_W_per_K, rtol=0.2):
                    self.chord, mixing = fresh, Mixing(valid, off=self.along)
                    response, base = self._response(part)
        late = np.flatnonzero(change > self.tolerance_K)
        reached = part.stop if not len(late) else part.start + max(int(late[0]) - 1, 0)
        if reached > part.start:
            self.series[:, :, :, part.start : reached] = self._heat_W(slice(part.start, reached))
        if part.start < reached < self.n_intervals:
            self._advance(slice(part.start, reached))
        return reached

    def _newton(self) -> bool:
        """Newton's method on the whole trajectory; whether it converged. What changed heat does to a linear network is
        solved exactly, interval by interval, so that feedback of any strength takes a few rounds.
        """
        part, n_valid = slice(0, self.n_intervals), self.balance.inputs.n_intervals[:, None]
        valid = np.arange(self.n_intervals + 1) <= n_valid
        response, base = self._response(part)
        self._rest()
        before = np.inf
        for _ in range(ROUNDS):
            self.rounds += 1
            heat_W = self._heat_W(part)
            if not np.isfinite(np.where(valid[:, 1:, None], heat_W, 0.0)).all():
                break
            step = np.where(valid, base + self._answer(response, heat_W) - self.seen, 0.0)
            slope = self._slopes()
            try:
                for p in range(len(slope)):
                    step[:, p] += self._answered(slope[p], step[:, p], p)
            except np.linalg.LinAlgError:  # a loop gain of exactly one within an interval
                break
            worst = float(np.abs(step).max())
            if not worst < DIVERGES * before:
                break
            self.seen += step
            if worst <= self.tolerance_K:
                self.series[...] = self._heat_W(part)
                return True
            before = worst
        self._rest()
        return False

    def _rest(self) -> None:
        """Every place at its start temperature throughout."""
        self.seen[..., 1:] = self.seen[..., :1]

    def _slopes(self) -> Array:
        """Of every source's heat by `seen`, W/K (P, B, M, 2, k, n + k), with what the chord takes out."""
        n, every = len(self.rows), slice(0, self.n_intervals)
        n_sets, n_batches = self.seen.shape[1:3]
        slope = np.zeros((n_sets, n_batches, self.n_intervals, 2, len(self.sources), n + len(self.sources)))
        for k, source in enumerate(self.sources):
            for place, watts in source.slopes(self.borders, every).items():
                slope[..., k, place] = np.moveaxis(watts, -2, -1)
        each = np.arange(len(self.sources))
        slope[..., each, n + each] += self.chord.slope_W_per_K[:, self.balance.regimes.of][:, :, :, None]
        return slope

    def _answered(self, slope: Array, gap_K: Array, which: int) -> Array:
        """What the sources' answer to a gap (n + k, B, M + 1) adds to it."""
        answer = Answer(self.balance, self.chord.modes, self.outlets, self.matrix[which], slope, which)
        given = np.zeros((self.n_intervals, 2, gap_K.shape[1], len(self.sources), 1))
        now = np.zeros((gap_K.shape[1], self.matrix.shape[-1], 1))
        out, _ = answer.run(slice(0, self.n_intervals), np.moveaxis(gap_K, (2, 1, 0), (0, 1, 2))[..., None], given, now)
        return np.moveaxis(out[..., 0], (0, 1, 2), (2, 1, 0))

    def _advance(self, part: slice) -> None:
        """Carry all cells to the end of a window that has converged."""
        response, known = self._known(part)
        heat = known + response.forcing(self.outlets, self.series[:, :, :, part])
        every = np.eye(self.balance.network.n_cells)[None]
        self.now_degC = response.outputs(heat, self.now_degC, every, every=part.stop - part.start)[:, :, -1]

    def _response(self, part: slice) -> tuple[Response, Array]:
        """The response in a window, and what `seen` is there without the sources, (n + k, P, B, m + 1)."""
        response, known = self._known(part)
        return response, np.moveaxis(response.outputs(known, self.now_degC, self.matrix), -1, 0)

    def _answer(self, response: Response, heat_W: Array) -> Array:
        rest = np.zeros((1, *self.now_degC.shape[1:]))
        return np.moveaxis(response.outputs(response.forcing(self.outlets, heat_W), rest, self.matrix), -1, 0)

    def _known(self, part: slice) -> tuple[Response, Forcing]:
        balance = self.balance
        if part == slice(0, self.n_intervals):
            response = Response(self.chord.modes, balance.schedule)
            return response, balance.forcing(response)
        left = np.clip(balance.inputs.n_intervals - part.start, 0, part.stop - part.start)
        response = Response(self.chord.modes, Schedule(balance.inputs.dt_s[:, part], balance.regimes.of[:, part], left))
        known = Forcing()
        for directions, series in balance.known:
            known = known + response.forcing(directions, series[:, :, :, part])
        return response, known

    def _heat_W(self, part: slice) -> Array:
        """The sources' heat on the present trajectory, plus what the chord takes out, (P, k, B, m, 2)."""
        out = self.series[:, :, :, part]
        for k, source in enumerate(self.sources):
            out[:, k] = np.moveaxis(source.watts(self.borders, part), -2, -1)
        if self.chord.used:
            own = np.moveaxis(self.seen[len(self.rows) :, ..., part.start : part.stop + 1], 0, 1)
            slope = np.moveaxis(self.chord.slope_W_per_K[:, self.balance.regimes.of[:, part]], -1, 1)[..., None]
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

    def _stiff(self, at: int) -> str:
        """One line about the heat that moved most in the interval that does not converge."""
        inputs = self.balance.inputs
        old = self.series[:, :, :, at].copy()
        jump = np.abs(self._heat_W(slice(at, at + 1))[..., 0, :] - old).max(axis=-1)
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
