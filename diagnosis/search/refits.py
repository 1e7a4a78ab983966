"""Full refits of candidates and their gains on batches left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial, reduce
from typing import TypeVar

import numpy as np

from data.arrays import Array
from data.errors import InputError, WorkError
from data.processes import Processes
from diagnosis.candidates.priors import log_prior, start_values, starts
from diagnosis.contracts import Candidate, CandidateKind, Fitted, Scored, Tried
from diagnosis.fitting.fitted import baseline, refitted, settle
from diagnosis.fitting.regression import Memory, whiter
from diagnosis.policy import POLICY, Policy
from diagnosis.screening.evidence import Evidence
from diagnosis.screening.screen import alone
from twin.calibration.fit_problem import Noise
from twin.calibration.least_squares import State, descend
from twin.compiling.cells import several
from twin.mechanisms import MECHANISMS
from twin.schema import TwinPart

T = TypeVar("T")
R = TypeVar("R")
Progress = Callable[[str, int, int], None]  # receives the step, how many of it are done, and of how many


Work = tuple[Scored, str]  # a candidate and its cluster


class Refits:
    """Full refits from one fit; `requested` names all candidates, whether they can be simulated or not."""

    def __init__(self, now: Fitted, workers: Processes, tell: Progress) -> None:
        self.requested: set[str] = set()
        self._now, self._workers, self._tell = now, workers, tell

    def __call__(self, work: Sequence[Work]) -> list[Tried]:
        """Those that can be simulated."""
        out = []
        self.requested |= {s.candidate.name for s, _ in work}
        for n, t in enumerate(self._workers.map(partial(refit, self._now), [s for s, _ in work])):
            self._tell("refit", n + 1, len(work))
            if t is not None:
                out.append(replace(t, cluster=work[n][1]))
        return out


def multiplies_heat(c: Candidate) -> bool:
    """Whether the candidate multiplies a heat, so that its gain is not linear in its amplitude."""
    return c.mechanism in MECHANISMS and "heat" in MECHANISMS[c.mechanism].acts_at


def continued(now: Fitted, tried: Sequence[Tried], workers: Processes) -> list[Tried]:
    """The refits, of which the most promising that fell far short of the screen are fitted to their optimum."""
    short = [
        t
        for t in tried
        if t.scored.gain > POLICY.continued_min_screen_gain_nats
        and t.gain < POLICY.short_refit_gain_share * t.scored.gain
        and t.fitted is not None
    ]
    first = sorted(short, key=lambda t: -t.scored.gain)[: POLICY.continued_refits]
    on = dict(zip(map(id, first), workers.map(partial(optimised, now), first), strict=True))
    return [on.get(id(t), t) for t in tried]


def refit(now: Fitted, s: Scored, policy: Policy = POLICY) -> Tried | None:
    """One candidate in full; None where it cannot be simulated."""
    if s.candidate.kind is CandidateKind.SENSOR_SWAP:  # the fit was bent towards the wrong labels
        try:
            part = s.candidate.applied(now.part, start_values(s, now)[0])
            fitted = baseline(now.machine, part, now.batches, None, now.runs)
            return judged(now, Tried(s, 0.0, 0, s.candidate.name, 0.0, fitted), policy=policy)
        except (InputError, WorkError):
            return None
    for values, begin in starts(s, now):
        try:
            part = s.candidate.applied(now.part, values)
            first = Tried(s, 0.0, 0, s.candidate.name, 0.0, refitted(now, part, begin))
            done = judged(now, first, roughly=True, policy=policy)
            if multiplies_heat(s.candidate) and done.gain < s.gain:
                return optimised(now, done, policy)
            if max(done.gain, s.gain) < POLICY.continued_min_screen_gain_nats or not _discounted(now, s.candidate):
                return done
            again = judged(
                now, replace(done, fitted=_with_equal_weights(now, part, begin)), roughly=True, policy=policy
            )
            return max(done, again, key=lambda one: one.gain)
        except (InputError, WorkError):
            continue
    return None


def _discounted(now: Fitted, c: Candidate) -> bool:
    """Whether the candidate acts on an error whose noise the fit has inflated, so that it hardly counts."""
    if c.where.kind != "error" or c.part is None:
        return False
    factor = dict(zip(now.problem.channels, now.noise.factor, strict=True))
    return (
        max(float(factor.get(name, 1.0)) for name in (c.where.name, *several(c.part.acts_on)))
        > POLICY.discounted_channel_noise_factor
    )


def _with_equal_weights(now: Fitted, part: TwinPart, begin: Mapping[str, float]) -> Fitted:
    """The refit with all channels and rows weighted alike at first, as a baseline begins.

    The fit before may have inflated the noise of an error that lacks a large shift; with that weight the shift would
    not be found.
    """
    start = refitted(now, part, begin, steps=0)
    channels = len(start.problem.channels)
    alike = Noise(np.full(channels, POLICY.initial_noise_factor), np.full(channels, POLICY.initial_rows_per_value))
    state = State.at(start.problem, start.state.z, start.state.nuisance, alike)
    state = descend(start.problem, state, POLICY.equal_weight_steps, POLICY.refit_tolerance)
    return settle(
        replace(start, state=state),
        POLICY.equal_weight_settle_steps,
        POLICY.refit_tolerance,
        POLICY.equal_weight_settle_rounds,
    )


def optimised(now: Fitted, t: Tried, policy: Policy = POLICY) -> Tried:
    """The refit continued to its optimum, unless batches left out are predicted worse there."""
    assert t.fitted is not None
    try:
        done = judged(now, replace(t, fitted=settle(t.fitted, rounds=POLICY.finalist_settle_rounds)), policy=policy)
        return done if done.gain >= t.gain else max(done, judged(now, t, policy=policy), key=lambda one: one.gain)
    except (InputError, WorkError):
        return t


def judged(now: Fitted, t: Tried, roughly: bool = False, policy: Policy = POLICY) -> Tried:
    """A refit with its gain over the fit before; `roughly` with the slack of that fit.

    Both fits count rows by the memory of the whiter residuals: a missing effect lengthens that of the other (as in
    `twin.calibration.least_squares.likelier`).
    """
    assert t.fitted is not None
    memory = common_memory([now, t.fitted], policy)
    before, after = alone(now, memory), alone(t.fitted, memory, now if roughly else None)
    gain = _score(after, policy) - _score(before, policy)
    better, worse = better_and_worse(before, after, policy)
    return replace(t, gain=gain, improved=better, worse=worse, log_prior=log_prior(t.scored, t.fitted))


def compared(now: Fitted, finalists: Sequence[Tried], policy: Policy = POLICY) -> list[Tried]:
    """The finalists with gains by one memory, that of the whitest, which alone makes them comparable."""
    if not finalists:
        return []
    memory = common_memory([now, *(t.fitted for t in finalists if t.fitted)], policy)
    before = _score(alone(now, memory), policy)
    return [replace(t, alike=_score(alone(t.fitted, memory), policy) - before) for t in finalists if t.fitted]


def common_memory(fits: Sequence[Fitted], policy: Policy = POLICY) -> Memory:
    """The memory of the shortest reach in each channel, by which the rows of all these fits count."""
    memory = reduce(whiter, (f.memory for f in fits))
    return memory if policy.counts_row_memory else Memory.none(len(memory.share))


def _score(evidence: Evidence, policy: Policy) -> float:
    return float(evidence.base_score(left_out=policy.leaves_batches_out)[0])


def better_and_worse(before: Evidence, after: Evidence, policy: Policy = POLICY) -> tuple[int, int]:
    """Left-out batches whose squares fall, and those whose squares rise by more than chance makes.

    A batch in which a driver is off is predicted alike with and without its effect: it speaks neither for nor against.
    """
    old, new = _squares(before, after, policy.leaves_batches_out)
    return int((new < old).sum()), int((new - old > 2.0 * POLICY.telling_nats).sum())


def explained(before: Evidence, after: Evidence) -> float:
    """The share of left-out squares that is explained."""
    old, new = _squares(before, after)
    return float(1.0 - new.sum() / old.sum())


def _squares(before: Evidence, after: Evidence, left_out: bool = True) -> tuple[Array, Array]:
    """Every left-out batch's squares (B,) of both, each channel in units of what is left of it afterwards."""
    left, right = before.residuals(left_out=left_out), after.residuals(left_out=left_out)
    unit = np.maximum(np.nan_to_num(after.mean_squares(right)[0], nan=1.0), POLICY.min_noise_variance_share)
    old = [(e[:, 0] ** 2 / (before.weight * unit)[b.channel]).sum() for b, e in zip(before.batches, left, strict=True)]
    new = [(f[:, 0] ** 2 / (after.weight * unit)[a.channel]).sum() for a, f in zip(after.batches, right, strict=True)]
    return np.array(old), np.array(new)
