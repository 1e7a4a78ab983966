"""The twin with the true terms in it, refitted: what a perfect answer would reach, and which terms can be seen at all.

A term is visible when, with the others in, it cuts the left-out error of some channel by a tenth and gains more on the
left-out batches than structure alone does (99 % quantile of the structural null, without a diagnosis' own margin).
What no candidate states is compared with the same case redrawn without it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from twin.calibration.identifiability import Interval, intervals90
from twin.calibration.least_squares import result
from twin.compile import compile_network
from twin.diagnosis.drafting.draft import drafted_part
from twin.diagnosis.proposals.slack import no_news
from twin.diagnosis.rounds.baseline import TOLERANCE, baseline
from twin.diagnosis.rounds.fitted import Fitted, refitted, settle
from twin.diagnosis.rounds.null import MARGIN, Null, structural_null
from twin.diagnosis.rounds.null_beside import null_beside
from twin.diagnosis.rounds.parts_of_batches import enough_batches, usable_batches
from twin.diagnosis.rounds.prediction import left_out_rows
from twin.diagnosis.rounds.refits import SMALLER, Tried, improved
from twin.diagnosis.rounds.trust import least_gain
from twin.diagnosis.scoring.memory import Memory, whiter
from twin.diagnosis.scoring.screen import Scored, alone, proposed, screen
from twin.diagnosis.telling.conclude import parameters_told
from twin.proof.scoring.amplitude import Sized, sized
from twin.proof.scoring.answer_key import AnswerKey, TrueTerm
from twin.proof.scoring.true_candidate import each_its_own, of_no_list, open_shape, true_candidates, with_terms
from twin.schema import TwinPart, twin_part

CUT = 0.1  # of a channel's left-out error: less is not worth a name
Redraw = Callable[[str], tuple[Machine, Sequence[Batch]]]


@dataclass(frozen=True)
class TrueModel:
    """Errors in units of the noise (`error_level`) of the baseline, the true model and noise alone; one entry a term
    of `gain_nats`, `threshold_nats` and `bar_nats`, what a diagnosis asks of such a gain before it claims it; nan where
    nothing could be fitted. `sizes`: a term's amplitude as the true model fits it, low and high of its 90 % interval
    as a diagnosis would tell them (`amplitude.sized`).

    `visible` None: not known, as no candidate states the term and the case could not be redrawn.
    """

    error_before: float
    error_true: float
    error_floor: float
    gain_nats: tuple[float, ...]
    threshold_nats: tuple[float, ...]
    bar_nats: tuple[float, ...]
    visible: tuple[bool | None, ...]
    sizes: tuple[Sized, ...]


@threadpool_limits.wrap(limits=1)
def true_model(
    machine: Machine,
    batches: Sequence[Batch],
    answer: Mapping[str, Any],
    redraw: Redraw | None = None,
    seed: int = 0,
) -> TrueModel:
    """The true model of a case whose key is open.

    Args:
        answer: the key as the vault's JSON gives it.
        redraw: from an effect's key to machine and batches of the same case without that effect.

    Raises:
        InputError: recordings or a machine file that cannot be used; WorkError: the machine file's model fails.
    """
    key = AnswerKey.from_json(answer)
    fit = _fit(machine, batches)
    level = _level(fit)
    if not key.terms:
        return TrueModel(level, level, 1.0, (), (), (), (), ())
    every = [*proposed(fit), *(c for t in key.terms if (c := of_no_list(t, fit)) is not None)]
    seen = screen(fit, every)
    found, full = _chosen(fit, key.terms, [true_candidates(t, seen, every) for t in key.terms])
    stated = [k for k, s in enumerate(found) if s is not None]
    if full is None:
        full, stated = fit, []
    judged = [
        _judged(fit, full, key.terms, found, k, stated, seed)
        if k in stated
        else _redrawn(fit, t, redraw, _null(fit, seed))
        for k, t in enumerate(key.terms)
    ]
    others = [j.fitted for k, j in enumerate(judged) if k not in stated and j.fitted is not None]
    best = full if stated and not others else others[0] if others else fit  # an unlisted effect stands alone
    numbers = zip(*((j.gain, j.threshold, j.bar, j.visible, j.size) for j in judged), strict=True)
    return TrueModel(level, _level(best), 1.0, *numbers)


@dataclass(frozen=True)
class _Judged:
    gain: float = float("nan")
    threshold: float = float("nan")
    bar: float = float("nan")
    visible: bool | None = None
    size: Sized = (None, None, None)
    fitted: Fitted | None = None  # of the case redrawn


def _fit(machine: Machine, batches: Sequence[Batch]) -> Fitted:
    part = twin_part(machine) if machine.twin is not None else drafted_part(machine, batches).part
    usable, _ = usable_batches(compile_network(machine, part=part), sorted(batches, key=lambda b: b.batch_id))
    parts, _ = enough_batches(usable)
    return baseline(machine, part, parts, None, len(usable))


def _null(fit: Fitted, seed: int) -> Null:
    every = proposed(fit)
    seen = screen(fit, every)
    return structural_null(fit, seen.evidence, seen.columns(no_news(every, fit)), seed)


def _chosen(
    fit: Fitted, terms: Sequence[TrueTerm], choices: Sequence[Sequence[Scored]]
) -> tuple[list[Scored | None], Fitted | None]:
    """By term the candidate that states it best, by the screen, or by refits where that saw one shape of many; and the
    fit with all of them.

    A test bar's growth gained 152 nats from the shaft, which the screen had preferred, and 539 from the front bearing.
    """
    found = each_its_own(terms, choices)
    several = [k for k, own in enumerate(choices) if len(own) > 1 and open_shape(terms[k], own[0])]
    if not several:
        return found, _with(fit, terms, found)
    for k in several:
        every = [[*found[:k], s, *found[k + 1 :]] for s in choices[k]]
        fits = [_with(fit, terms, one) for one in every]
        gains = [-np.inf if full is None else _gain(fit, full, whiter(fit.memory, full.memory)) for full in fits]
        best = int(np.argmax(gains))
        found, full = every[best], fits[best]
    return found, full


def _with(fit: Fitted, terms: Sequence[TrueTerm], found: Sequence[Scored | None]) -> Fitted | None:
    """The fit with the terms that are stated in it at its optimum; None where it cannot be simulated.

    As a diagnosis does, it begins with less where all of it cannot: heat that feeds itself runs away in a network whose
    values are off.
    """
    own = [(t, s) for t, s in zip(terms, found, strict=True) if s is not None]
    for share in (1.0, *SMALLER):
        try:
            part, at = with_terms(fit.part, [t for t, _ in own], [s for _, s in own], fit, share)
            return settle(refitted(fit, part, at))
        except (InputError, WorkError):
            continue
        except ValueError:  # one candidate twice
            return None
    return None


def _judged(
    fit: Fitted,
    full: Fitted,
    terms: Sequence[TrueTerm],
    found: Sequence[Scored | None],
    which: int,
    stated: Sequence[int],
    seed: int,
) -> _Judged:
    """One term with the others in: the better of two fits without it is what it must beat."""
    others = [k for k in stated if k != which]
    own = [(terms[k], s) for k in others if (s := found[k]) is not None]
    part: TwinPart = with_terms(fit.part, [t for t, _ in own], [s for _, s in own], fit)[0]
    try:
        back = refitted(full, part)
        # where the first fit stands at its optimum, a second one only shows whether it had stopped short
        without = [settle(back)] if others else [settle(back, steps=4, tolerance=0.05, rounds=2), fit]
    except (InputError, WorkError):
        return _Judged()
    memory = whiter(full.memory, without[0].memory)
    scores = [_score(w, memory) for w in without]
    best = int(np.argmax(scores))
    s = found[which]
    assert s is not None
    beside = null_beside(without[best], full, s.candidate, seed)
    if beside is None:  # a value that is doubted, labels that are swapped
        beside = _null(without[best], seed), _score(full, memory)
    structure = beside[0].threshold(beside[1], name=s.candidate.name, margin=1.0)
    out = _beyond(without[best], full, memory, structure)
    better = improved(alone(without[best], memory), alone(full, memory))
    least = least_gain(Tried(s, out.gain, better, 0, 0.0, full), len(full.batches))
    size = _size(full, s, terms[which], beside[0].scatter(s.candidate.name, beside[1]))
    return replace(out, bar=max(least, MARGIN * structure), size=size)


@lru_cache(maxsize=1)
def _known(full: Fitted) -> dict[str, Interval]:
    """The intervals of a fit's parameters, by name; the last fit's are kept: each of its terms asks."""
    state = replace(full.state, noise=full.noise)
    return {i.name: i for i in intervals90(result(full.problem, state, TOLERANCE, ""), full.problem.unknowns)}


def _size(full: Fitted, s: Scored, term: TrueTerm, scatter: float) -> Sized:
    """The term's amplitude in the true model, told as a diagnosis tells it."""
    told, _ = parameters_told(full, s.candidate, _known(full), scatter)
    parameters = {name: (e.value, (e.low, e.high) if e.known else None) for name, e in told.items()}
    return sized(s.candidate.mechanism, parameters, term)


def _redrawn(fit: Fitted, term: TrueTerm, redraw: Redraw | None, null: Null) -> _Judged:
    """The case with the term against the case without it, each with the machine file alone."""
    if redraw is None:
        return _Judged()
    other = _fit(*redraw(term.effect))
    memory = whiter(fit.memory, other.memory)
    return replace(_beyond(fit, other, memory, null.threshold(_score(other, memory), margin=1.0)), fitted=other)


def _beyond(before: Fitted, after: Fitted, memory: Memory, threshold: float) -> _Judged:
    gain = _gain(before, after, memory)
    old, new = _rms(before), _rms(after)
    cut = max((1.0 - new[c] / old[c] for c in old if c in new and old[c] > 0), default=0.0)
    return _Judged(gain, threshold, visible=bool(gain > threshold and cut >= CUT))


def _gain(before: Fitted, after: Fitted, memory: Memory) -> float:
    return _score(after, memory) - _score(before, memory)


def _score(fitted: Fitted, memory: Memory) -> float:
    return float(alone(fitted, memory).base_score()[0])


def _rms(fitted: Fitted) -> dict[str, float]:
    """Left-out rms by channel over all rows."""
    table = left_out_rows(fitted).rms
    square = (table["rms"] ** 2 * table["rows"]).groupby(table["channel"]).sum()
    rows = table["rows"].groupby(table["channel"]).sum()
    return {str(c): float(np.sqrt(square[c] / rows[c])) for c in square.index}


def _level(fitted: Fitted) -> float:
    noise = dict(zip(fitted.problem.channels, fitted.problem.noise, strict=True))
    return float(np.sqrt(np.mean([(value / noise[c]) ** 2 for c, value in _rms(fitted).items()])))
