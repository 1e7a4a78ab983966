"""The true model, the twin with the concealed terms, refitted: errors of a perfect answer, and visibility of each term.

A term is visible when, with the others in, it gains `VISIBLE_NATS` of log evidence, each fit under its own likeliest
hyperparameters. Of a term that no candidate describes it is unknown.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from diagnosis.candidates.free_forms import BODY_PARAMETERS, Form, Level, candidate_of
from diagnosis.candidates.priors import free_values
from diagnosis.contracts import Candidate, Scored, Where
from diagnosis.drafting.draft import drafted_part
from diagnosis.findings.conclude import reported_parameters
from diagnosis.fitting.batches import enough_batches, usable_batches
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import baseline, left_out_rows, refitted
from diagnosis.policy import POLICY
from diagnosis.screening.screen import Screen, proposed, screen
from thermodrift_exam.proof.scoring.answer_key import AnswerKey, Spot, TrueTerm
from thermodrift_exam.proof.scoring.matching import Sized, counted_as, exact, sized
from twin.calibration.identifiability import Interval, intervals90
from twin.calibration.least_squares import result
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS
from twin.quantity import Value
from twin.schema import TwinPart, twin_part


def true_candidates(term: TrueTerm, seen: Screen, every: Sequence[Candidate]) -> list[Scored]:
    """The candidates at the term's place with its mechanism, best first in the screen.

    The key does not state the driver channel of the twin, or the other bodies involved.
    """
    own = [s for s in seen.scored if _is(term, s.candidate)]
    own = [s for s in own if s.candidate.where.name == term.where.name] or own
    if own:
        return sorted(own, key=lambda s: -s.gain)
    unseen = next((c for c in every if _is(term, c)), None)  # a term that cannot be switched off has no signature
    return [] if unseen is None else [Scored(unseen)]


def open_shape(term: TrueTerm, s: Scored) -> bool:
    """Whether it has a shape parameter that the key does not state and that the screen evaluates at one value only."""
    return not set(s.candidate.shape) <= set(term.parameters or {})


def of_no_list(term: TrueTerm, fit: Fitted) -> Candidate | None:
    """The law of an unlisted heat as the key states it; None if it states none or a driver is not recorded.

    `true_candidates` finds it among the candidates.
    """
    role, *drivers = term.form or ("",)
    if not role or not all(name in b.table.columns for name in drivers for b in fit.batches):
        return None
    level, other, *_ = (*(Level(name, "", 1.0, False) for name in drivers), None, None)
    body = term.where.name if role in BODY_PARAMETERS else ""
    return candidate_of([Form(Where("node", term.where.name), role, level, other, body)])


def each_its_own(terms: Sequence[TrueTerm], choices: Sequence[Sequence[Scored]]) -> list[Scored | None]:
    """By term its first choice, none twice; candidates driven as the key states have priority. The heats of a cabinet
    and of a pump at one body are two candidates of one mechanism.
    """
    wanted = Counter(own[0].candidate.name for own in choices if own)
    out: list[Scored | None] = []
    for term, own in zip(terms, choices, strict=True):
        twice = bool(own) and wanted[own[0].candidate.name] > 1
        first = sorted(own, key=lambda s: not _driven_as(term, s.candidate)) if twice else own
        taken = {s.candidate.name for s in out if s is not None}
        out.append(next((s for s in first if s.candidate.name not in taken), None))
    return out


def at_truth(term: TrueTerm, s: Scored, now: Fitted) -> Mapping[str, Value]:
    """The values of a candidate where the key states them, under the priors of a diagnosis."""
    if s.candidate.mechanism not in MECHANISMS:
        return {}
    mechanism = MECHANISMS[s.candidate.mechanism]
    known = {n: v for n, (v, _) in (term.parameters or {}).items() if n in {p.name for p in mechanism.parameters}}
    stated = {a: known[a] - off for a, off in (mechanism.off or {}).items() if a in known}
    values = free_values(replace(s, amplitudes={**s.amplitudes, **stated}), now)

    def moved(name: str, given: Value) -> Value:
        usual = given.value if given.prior is None else given.prior
        return given.model_copy(update={"value": _said(known[name], mechanism.spec(name).unit), "prior": usual})

    return {name: moved(name, given) if name in known else given for name, given in values.items()}


def with_terms(part: TwinPart, terms: Sequence[TrueTerm], found: Sequence[Scored], now: Fitted) -> TwinPart:
    """The twin part with these candidates.

    Raises:
        ValueError: two of them take the same name.
    """
    for term, s in zip(terms, found, strict=True):
        part = s.candidate.applied(part, at_truth(term, s, now))
    return part


def _driven_as(term: TrueTerm, c: Candidate) -> bool:
    """Whether it is driven by the channel that the key names; by none, where the key names none."""
    drivers = c.part.drivers if c.part is not None else None
    channels = set(drivers.values()) if isinstance(drivers, Mapping) else {drivers} - {None}
    return term.driver in channels if term.driver else not channels


def _is(term: TrueTerm, c: Candidate) -> bool:
    return counted_as(c.mechanism) == counted_as(term.mechanism) and exact(Spot(c.where.kind, c.where.name), term)


def _said(number: float, unit: str) -> str | float:
    return float(f"{number:.6g}") if unit == "1" else f"{number:.6g} {unit}"


VISIBLE_NATS = 30.0  # odds of 1e13


@dataclass(frozen=True)
class TrueModel:
    """Errors in units of the noise (`error_level`) of the baseline, the true model and noise alone; one entry a term of
    `gain_nats` and `bar_nats`, what visible takes; nan where nothing could be fitted. `sizes`: a term's amplitude as
    the true model fits it, low and high of its 90 % interval as a diagnosis states them (`amplitude.sized`).

    `visible` None: unknown, since no candidate describes the term.
    """

    error_before: float
    error_true: float
    error_floor: float
    gain_nats: tuple[float, ...]
    bar_nats: tuple[float, ...]
    visible: tuple[bool | None, ...]
    sizes: tuple[Sized, ...]


@threadpool_limits.wrap(limits=1)
def true_model(
    machine: Machine, batches: Sequence[Batch], answer: Mapping[str, Any], fit: Fitted | None = None
) -> TrueModel:
    """The true model of an opened case; `answer` is the key as the vault's JSON gives it, `fit` the baseline of a
    diagnosis of the same batches, where there is one.

    Raises:
        InputError: recordings or a machine file that cannot be used; WorkError: the machine file's model fails.
    """
    key = AnswerKey.from_json(answer)
    fit = fit or _fit(machine, batches)
    level = _level(fit)
    if not key.terms:
        return TrueModel(level, level, 1.0, (), (), (), ())
    every = [*proposed(fit), *(c for t in key.terms if (c := of_no_list(t, fit)) is not None)]
    seen = screen(fit, every)
    found, full = best_candidates(fit, key.terms, [true_candidates(t, seen, every) for t in key.terms])
    judged = [_judged(fit, full, key.terms, found, k) for k in range(len(key.terms))]
    numbers = zip(*((j.gain, VISIBLE_NATS, j.visible, j.size) for j in judged), strict=True)
    return TrueModel(level, _level(full or fit), 1.0, *numbers)


@dataclass(frozen=True)
class _Judged:
    gain: float = float("nan")
    visible: bool | None = None
    size: Sized = (None, None, None)


def _fit(machine: Machine, batches: Sequence[Batch]) -> Fitted:
    part = twin_part(machine) if machine.twin is not None else drafted_part(machine, batches).part
    usable, _ = usable_batches(compile_network(machine, part=part), sorted(batches, key=lambda b: b.batch_id))
    parts, _ = enough_batches(usable)
    return baseline(machine, part, parts, None, len(usable))


def best_candidates(
    fit: Fitted, terms: Sequence[TrueTerm], choices: Sequence[Sequence[Scored]]
) -> tuple[list[Scored | None], Fitted | None]:
    """By term the candidate that describes it best, by the screen, or by refits where its shape is unknown; and the fit
    with all of them.
    """
    found = each_its_own(terms, choices)
    several = [k for k, own in enumerate(choices) if len(own) > 1 and open_shape(terms[k], own[0])]
    if not several:
        return found, _with(fit, terms, found)
    for k in several:
        every = [[*found[:k], s, *found[k + 1 :]] for s in choices[k]]
        fits = [_with(fit, terms, one) for one in every]
        gains = [-np.inf if full is None else full.log_evidence for full in fits]
        best = int(np.argmax(gains))
        found, full = every[best], fits[best]
    return found, full


def _with(fit: Fitted, terms: Sequence[TrueTerm], found: Sequence[Scored | None]) -> Fitted | None:
    """The fit with the stated terms, fitted as a diagnosis fits an explanation. None where it cannot be simulated."""
    own = [(t, s) for t, s in zip(terms, found, strict=True) if s is not None]
    try:
        return refitted(fit, with_terms(fit.part, [t for t, _ in own], [s for _, s in own], fit), fresh=True)
    except (InputError, WorkError, ValueError):  # ValueError: one candidate twice
        return None


def _judged(
    fit: Fitted, full: Fitted | None, terms: Sequence[TrueTerm], found: Sequence[Scored | None], which: int
) -> _Judged:  # fmt: skip
    """One term with the others in the model, compared with the better of two fits without it."""
    s = found[which]
    if full is None or s is None:
        return _Judged()
    own = [(t, o) for k, (t, o) in enumerate(zip(terms, found, strict=True)) if k != which and o is not None]
    part = with_terms(fit.part, [t for t, _ in own], [o for _, o in own], fit)
    try:
        without = [refitted(full, part).log_evidence, (refitted(fit, part, fresh=True) if own else fit).log_evidence]
    except (InputError, WorkError):
        return _Judged()
    gain = float(full.log_evidence - max(without))
    return _Judged(gain, gain > VISIBLE_NATS, _size(full, s, terms[which]))


@lru_cache(maxsize=1)
def _known(full: Fitted) -> dict[str, Interval]:
    """Intervals of the parameters of a fit, by name; those of the last fit are cached, as each term needs them."""
    fit = result(full.problem, full.state, POLICY.fit_tolerance_nats, "")
    return {i.name: i for i in intervals90(fit, full.problem.unknowns)}


def _size(full: Fitted, s: Scored, term: TrueTerm) -> Sized:
    """The amplitude of the term in the true model, stated as in a diagnosis."""
    stated, _ = reported_parameters(full, s.candidate, _known(full))
    parameters = {name: (e.value, (e.low, e.high) if e.known else None) for name, e in stated.items()}
    return sized(s.candidate.mechanism, parameters, term)


def _rms(fitted: Fitted) -> dict[str, float]:
    """Left-out rms by channel over all rows."""
    table = left_out_rows(fitted).rms
    square = (table["rms"] ** 2 * table["rows"]).groupby(table["channel"]).sum()
    rows = table["rows"].groupby(table["channel"]).sum()
    return {str(c): float(np.sqrt(square[c] / rows[c])) for c in square.index}


def _level(fitted: Fitted) -> float:
    noise = dict(zip(fitted.problem.channels, fitted.problem.noise, strict=True))
    return float(np.sqrt(np.mean([(value / noise[c]) ** 2 for c, value in _rms(fitted).items()])))
