"""Full refits of the candidates that a screen thinks worth it, and their gains on batches left out."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import lru_cache, partial, reduce
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
from threadpoolctl import threadpool_limits

from data.arrays import Array
from data.errors import InputError, WorkError
from diagnosis.candidates.priors import log_prior, start_values
from diagnosis.contracts import Candidate, Fitted, Scored, Tried
from diagnosis.fitting.fitted import MISFIT, REFIT_TOLERANCE, SMOOTH, baseline, refitted, settle
from diagnosis.fitting.regression import QUIET, whiter
from diagnosis.screening.evidence import Evidence
from diagnosis.screening.screen import alone
from twin.calibration.fit_problem import Noise
from twin.calibration.least_squares import State, descend, x_of, z_bounds
from twin.compiling.cells import several
from twin.mechanisms import MECHANISMS
from twin.quantity import Value
from twin.schema import TwinPart

T = TypeVar("T")
R = TypeVar("R")
Progress = Callable[[str, int, int], None]  # told of a step, how many of it are done, and of how many


def _one_thread() -> None:
    threadpool_limits(limits=1)


class Workers:
    """A pool to be used as a context; results come in the order of the items, whatever the number of processes."""

    def __init__(self, processes: int = 1, start: Callable[[], object] = _one_thread) -> None:
        self.processes, self._start = processes, start
        self._pool: ProcessPoolExecutor | None = None
        self._folder: TemporaryDirectory[str] | None = None
        self._sent = 0

    def __enter__(self) -> Workers:
        if self.processes > 1:
            self._folder = TemporaryDirectory(prefix="thermodrift-")
            self._pool = ProcessPoolExecutor(self.processes, get_context("spawn"), self._start)
            for _ in range(self.processes):
                self._pool.submit(self._start)  # imports go on while the baseline is fitted
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None and self._folder is not None:
            self._pool.shutdown(cancel_futures=True)
            self._folder.cleanup()
            self._pool = self._folder = None

    def map(self, work: Callable[[T], R], items: Sequence[T]) -> Iterator[R]:
        """`work` of every item; it travels to other processes once for all items, through a file of this session."""
        if self._pool is None or self._folder is None or len(items) < 2:
            return map(work, items)
        path = Path(self._folder.name) / str(self._sent)
        path.write_bytes(pickle.dumps(work, pickle.HIGHEST_PROTOCOL))
        self._sent += 1
        return self._pool.map(partial(_do, path), items)

    def beside(self, work: Callable[[], R]) -> Callable[[], R]:
        """Work begun in another process while this one goes on; what is returned waits for it."""
        return work if self._pool is None else self._pool.submit(work).result


def _do(path: Path, item: Any) -> Any:
    return _work(path)(item)


@lru_cache(maxsize=1)
def _work(path: Path) -> Callable[[Any], Any]:
    """The last work that came, kept for its other items."""
    work: Callable[[Any], Any] = pickle.loads(path.read_bytes())  # noqa: S301 - written by this session
    return work


FELL, MATES = 0.5, 2  # of its gain in the screen: a refit that gains less speaks for none of its cluster
AFRESH = 3  # steps of a refit at an error with all rows counted alike
GIVEN_UP, PROMISED = 2.0, 20.0  # times the noise that a channel is fitted to, and nats, where that is worth its time
RANKED = 4  # rounds after which a gain stands: with ten, 11 gains of 11 to 900 nats came to 4 more at most
SMALLER = (0.3, 0.1, 0.03)  # of a screen's amplitude, where a machine with all of it cannot be simulated

Work = tuple[Scored, int]  # a candidate and the number of its cluster


class Refits:
    """Full refits beside one fit; `asked` are the names of all that it was asked for, simulated or not."""

    def __init__(self, now: Fitted, workers: Workers, tell: Progress) -> None:
        self.asked: set[str] = set()
        self._now, self._workers, self._tell = now, workers, tell

    def __call__(self, work: Sequence[Work]) -> list[Tried]:
        """Those that can be simulated."""
        out = []
        self.asked |= {s.candidate.name for s, _ in work}
        for n, t in enumerate(self._workers.map(partial(refit, self._now), [s for s, _ in work])):
            self._tell("refit", n + 1, len(work))
            if t is not None:
                out.append(replace(t, cluster=work[n][1]))
        return out


def grows(c: Candidate) -> bool:
    """Whether it multiplies a heat by what that heat brings about."""
    return c.mechanism in MECHANISMS and "heat" in MECHANISMS[c.mechanism].acts_at


def short_ones_on(now: Fitted, tried: Sequence[Tried], workers: Workers) -> list[Tried]:
    """The same, those of the highest promises fitted on where the refit fell far short of the screen.

    A few steps may end on the way: air dragged along by the shaft gained 30 nats of a promised 169, and 277 further on.
    """
    short = [t for t in tried if t.scored.gain > PROMISED and t.gain < FELL * t.scored.gain and t.fitted is not None]
    first = sorted(short, key=lambda t: -t.scored.gain)[:MATES]
    on = dict(zip(map(id, first), workers.map(partial(taken_on, now), first), strict=True))
    return [on.get(id(t), t) for t in tried]


def refit(now: Fitted, s: Scored) -> Tried | None:
    """One candidate in full; None where it cannot be simulated."""
    if s.candidate.mechanism == "sensor_swap":  # the fit was bent towards the wrong labels
        try:
            part = s.candidate.applied(now.part, start_values(s, now)[0])
            return judged(now, Tried(s, 0.0, 0, 0, 0.0, baseline(now.machine, part, now.batches, None, now.runs)))
        except (InputError, WorkError):
            return None
    for values, begin in _begins(s, now):
        try:
            part = s.candidate.applied(now.part, values)
            done = judged(now, Tried(s, 0.0, 0, 0, 0.0, refitted(now, part, begin)), roughly=True)
            if grows(s.candidate) and done.gain < s.gain:
                return taken_on(now, done)
            if max(done.gain, s.gain) < PROMISED or not _given_up(now, s.candidate):
                return done
            again = judged(now, replace(done, fitted=_afresh(now, part, begin)), roughly=True)
            return max(done, again, key=lambda one: one.gain)
        except (InputError, WorkError):
            continue
    return None


def _begins(s: Scored, now: Fitted) -> Iterator[tuple[Mapping[str, Value], Mapping[str, float]]]:
    """Free values and where the refit begins, one after the other until it can: a linear step may lead where no machine
    is, as heat that feeds itself runs away."""
    values, at = start_values(s, now)
    yield values, {**_beside(s, now), **at}
    yield values, at
    for share in SMALLER if s.amplitudes else ():
        yield start_values(replace(s, amplitudes={a: share * v for a, v in s.amplitudes.items()}), now)


def _given_up(now: Fitted, c: Candidate) -> bool:
    """Whether the candidate is at an error that the fit hardly counts."""
    if c.where.kind != "error" or c.part is None:
        return False
    factor = dict(zip(now.problem.channels, now.noise.factor, strict=True))
    return max(float(factor.get(name, 1.0)) for name in (c.where.name, *several(c.part.acts_on))) > GIVEN_UP


def _afresh(now: Fitted, part: TwinPart, begin: Mapping[str, float]) -> Fitted:
    """The refit with all channels and rows counted alike at first, as a baseline begins.

    An error that lacks a shift of tens of micrometres was given up by the fit before: its rows count little, and in
    them the shift is never found.
    """
    start = refitted(now, part, begin, steps=0)
    channels = len(start.problem.channels)
    alike = Noise(np.full(channels, MISFIT), np.full(channels, SMOOTH))
    state = State.at(start.problem, start.state.z, start.state.nuisance, alike)
    state = descend(start.problem, state, AFRESH, REFIT_TOLERANCE)
    return settle(replace(start, state=state), steps=2, tolerance=REFIT_TOLERANCE, rounds=2)


def _beside(s: Scored, now: Fitted) -> dict[str, float]:
    """Values of the fit's own parameters where the refit begins: the linear joint optimum.

    From where they were the start would look bad in some channels, which the noise then gives up.
    """
    z = now.state.z + np.array(s.moves[: len(now.state.z)]) if s.moves else now.state.z
    values = now.problem.values_at(x_of(now.problem.unknowns, np.clip(z, *z_bounds(now.problem.unknowns))))
    network = now.problem.network
    return {u.name: float(values[network.index(u.name)]) for u in now.problem.unknowns}


def taken_on(now: Fitted, t: Tried) -> Tried:
    """The same, fitted on to its optimum, unless batches left out are predicted worse there."""
    assert t.fitted is not None
    try:
        done = judged(now, replace(t, fitted=settle(t.fitted, rounds=RANKED)))
        return done if done.gain >= t.gain else max(done, judged(now, t), key=lambda one: one.gain)
    except (InputError, WorkError):
        return t


def judged(now: Fitted, t: Tried, roughly: bool = False) -> Tried:
    """A refit with its gain over the fit before; `roughly` with the slack of that fit.

    Rows remember each other, for both as in the fit that leaves the whiter residuals: a missing effect makes those of
    the other repeat themselves (as `twin.calibration.least_squares.likelier`).
    """
    assert t.fitted is not None
    memory = whiter(now.memory, t.fitted.memory)
    before, after = alone(now, memory), alone(t.fitted, memory, now if roughly else None)
    gain = float(after.base_score()[0] - before.base_score()[0])
    return replace(t, gain=gain, improved=improved(before, after), log_prior=log_prior(t.scored, t.fitted))


def compared(now: Fitted, finalists: Sequence[Tried]) -> list[Tried]:
    """All with their gains where rows count as in the whitest of them: else the whiter would win by the count."""
    if not finalists:
        return []
    whitest = reduce(whiter, (t.fitted.memory for t in finalists if t.fitted), now.memory)
    before = float(alone(now, whitest).base_score()[0])
    return [replace(t, alike=float(alone(t.fitted, whitest).base_score()[0]) - before) for t in finalists if t.fitted]


def improved(before: Evidence, after: Evidence) -> int:
    """Left-out batches whose squares fall."""
    old, new = _squares(before, after)
    return int((new < old).sum())


def explained(before: Evidence, after: Evidence) -> float:
    """The share of left-out squares that goes."""
    old, new = _squares(before, after)
    return float(1.0 - new.sum() / old.sum())


def _squares(before: Evidence, after: Evidence) -> tuple[Array, Array]:
    """Every left-out batch's squares (B,) of both, each channel in units of what is left of it afterwards."""
    left, right = before.left_out(), after.left_out()
    unit = np.maximum(np.nan_to_num(after.mean_squares(right)[0], nan=1.0), QUIET)
    old = [(e[:, 0] ** 2 / (before.weight * unit)[b.channel]).sum() for b, e in zip(before.batches, left, strict=True)]
    new = [(f[:, 0] ** 2 / (after.weight * unit)[a.channel]).sum() for a, f in zip(after.batches, right, strict=True)]
    return np.array(old), np.array(new)
