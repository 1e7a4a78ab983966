"""The screen: the gain of every candidate by its signature, all nuisances integrated out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.linalg import cho_factor, cho_solve
from scipy.special import log_ndtr

from data.arrays import Array
from diagnosis.candidates.alternatives import alternatives
from diagnosis.candidates.discretisation import never_reported
from diagnosis.candidates.library import candidates
from diagnosis.contracts import COLUMNS, Candidate, Scored
from diagnosis.fitting.covariance import slices_of
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.marginal import TINY, Hyper
from diagnosis.fitting.signatures import Signatures, signatures
from diagnosis.policy import POLICY
from twin.mechanisms import MECHANISMS
from twin.quantity import Spec, Value, convert

SCANNED = ("draught", "floor_sink", "sun")  # laws that are screened at several values of their shape
NO_TRACE = 1e-9  # given noises: a signature below it is rounding


@dataclass(frozen=True)
class Screen:
    """All candidates that have a signature, best first, and why others have none.

    `shadow` (p, C) is by how much the fit's parameters z move for a unit of each column of the signatures.
    """

    scored: tuple[Scored, ...]
    signatures: Signatures
    shadow: Array


def proposed(fitted: Fitted) -> list[Candidate]:
    """All mechanisms at all places, and values of the machine file that may be wrong.

    Only laws without a trace at their usual value are screened at others, and radiation goes to surroundings alone.
    """
    laws = candidates(fitted.machine, fitted.part)
    hours = float(np.median([b.step_s * b.n_rows for b in fitted.batches])) / 3600.0
    every = [
        *laws,
        *(w for c in laws if not c.variant_of for w in _windows(c, hours)),
        *alternatives(fitted.problem.network),
    ]
    never = never_reported(every, fitted)
    return [
        c for c in every
        if c.name not in never and not (c.variant_of and c.mechanism not in SCANNED) and not _between_bodies(c, fitted)
    ]  # fmt: skip


def _windows(c: Candidate, run_h: float) -> Iterator[Candidate]:
    """What happens once in a run, in every part of it: at another time it has no trace."""
    window = MECHANISMS[c.mechanism].window
    if window is None or c.part is None:
        return
    begin, lasting = (MECHANISMS[c.mechanism].spec(name) for name in window)
    each_h = run_h / POLICY.run_windows
    duration = Value(value=f"{convert(f'{2.0 * each_h:g} h', lasting.unit):g} {lasting.unit}")
    for k in range(POLICY.run_windows):
        given = {begin.name: Value(value=f"{k * each_h:.4g} h"), lasting.name: duration}
        part = c.part.model_copy(update={"parameters": {**c.part.parameters, **given}})
        yield replace(
            c, name=f"{c.name}_at_{k}", label=f"{c.label}, begun at {k * each_h:.2g} h", part=part, variant_of=c.name
        )


def _between_bodies(c: Candidate, fitted: Fitted) -> bool:
    at = c.part.at if c.mechanism == "radiation" and c.part is not None else None
    return isinstance(at, Mapping) and at.get("surrounding") in fitted.part.bodies


def screen(fitted: Fitted, every: Sequence[Candidate], before: Screen | None = None) -> Screen:
    """Log evidence that each candidate adds, its amplitude integrated out (a score test, Cox and Hinkley 1974, §9.3).

    The prior of an amplitude is so wide that its signature is `screen_amplitude_noises` in the channel that it changes
    most: the same for heat and for a lever. A finite change is whole or not at all. Each candidate is judged under the
    likeliest for it of the hyperparameters that leave an effect more room. Signatures of a screen `before`, at a fit
    with fewer effects, are used again.
    """
    seen, marginal = signatures(fitted, every, before.signatures if before else None), fitted.marginal
    many = marginal.many(fitted.columns, marginal.white(seen.columns))
    prior = POLICY.screen_amplitude_noises / np.maximum(_largest_rms(fitted, seen), NO_TRACE)
    positive = _positive(every, seen)
    gain, promised = np.full(len(prior), -np.inf), fitted.level.log_evidence(fitted.grams)
    amplitude, sd = np.zeros_like(prior), np.zeros_like(prior)
    for hyper in roomier(fitted.hyper):
        level = marginal.level(hyper)
        scores = level.screened(fitted.grams, many)
        more, mean = _gains(scores.left, scores.residual, prior, positive)
        more[seen.whole] = (scores.residual - 0.5 * scores.left)[seen.whole]
        more += level.log_evidence(fitted.grams) - promised
        if hyper == fitted.hyper:
            own = scores
        better = more > gain
        gain[better], amplitude[better] = more[better], mean[better]
        sd[better] = 1.0 / np.sqrt(scores.left[better])
    absorbed = 1.0 - own.left / np.maximum(many.squares, TINY)
    scored = []
    for one in every:
        columns = seen.of.get(one.name)
        if columns is None:
            continue
        k = max(columns, key=lambda k: gain[k])
        name = (*one.amplitudes, "factor")[columns.index(k)]
        scored.append(
            Scored(
                one, float(gain[k]), float(absorbed[k]), {name: float(amplitude[k])}, float(sd[k]), float(prior[k]), k
            )
        )
    return Screen(tuple(sorted(scored, key=lambda s: (-s.gain, s.candidate.name))), seen, own.shadow)


def roomier(hyper: Hyper) -> list[Hyper]:
    """These hyperparameters, and those with less structure and starts nearer to the first readings."""
    scales = [s for s in POLICY.structure_scales if s <= hyper.structure][-POLICY.screened_scales :]
    starts = [s for s in POLICY.start_scales if s <= hyper.starts]
    return [replace(hyper, structure=s, starts=t) for s in scales for t in starts]


def _gains(left: Array, with_residual: Array, prior: Array, positive: Array) -> tuple[Array, Array]:
    """Log Bayes factors and means (C,) of amplitudes of prior N(0, prior²), half of it where they are `positive`."""
    precision = left + 1.0 / prior**2
    mean = with_residual / precision
    gain = 0.5 * with_residual * mean - 0.5 * np.log(prior**2 * precision)
    return np.where(positive, gain + np.log(2.0) + log_ndtr(mean * np.sqrt(precision)), gain), mean


def _positive(every: Sequence[Candidate], seen: Signatures) -> Array:
    out = np.zeros(seen.columns[0].shape[1], bool)
    for c in every:
        for (name, off), k in zip(c.amplitudes.items(), seen.of.get(c.name, ()), strict=False):
            out[k] = MECHANISMS[c.mechanism].spec(name).low >= off
    return out


def _largest_rms(fitted: Fitted, seen: Signatures) -> Array:
    """Root mean square (C,) of every column in the channel that it changes most, in units of the given noise."""
    squares = np.zeros((len(fitted.rows), seen.columns[0].shape[1]))
    for m, x in zip(fitted.problem.measured, seen.columns, strict=True):
        for channel, at in slices_of(m.channel):
            squares[channel] += np.einsum("nc,nc->c", x[at], x[at])
    return np.asarray(np.sqrt(squares / np.maximum(fitted.rows, 1.0)[:, None]).max(axis=0))


def similarity(fitted: Fitted, seen: Screen, scored: Sequence[Scored]) -> Array:
    """|cos| (k, k) between signatures once recalibration and structure are projected out."""
    marginal, p = fitted.marginal, len(fitted.z)
    which = [s.column for s in scored]
    white = marginal.white([x[:, which] for x in seen.signatures.columns])
    every = [np.hstack([x[:, :-1], w]) for x, w in zip(fitted.columns, white, strict=True)]
    c = fitted.level.reduced(marginal.grams(every))
    gram = c[p:, p:] - c[p:, :p] @ cho_solve(cho_factor(c[:p, :p] + np.eye(p)), c[:p, p:])
    size = np.sqrt(np.maximum(np.diag(gram), TINY))
    return np.asarray(np.abs(gram) / np.outer(size, size))


def one_of_each(scored: Sequence[Scored]) -> list[Scored]:
    """Of what was looked for at several values of its shape, the first; in the same order."""
    first: dict[str, Scored] = {}
    for s in scored:
        first.setdefault(s.candidate.base_name, s)
    return list(first.values())


def limits(fitted: Fitted, seen: Screen, threshold: float) -> pd.DataFrame:
    """Columns of the table `limits`, most sensitive first within each mechanism.

    The amplitude whose expected gain, half its square over its variance given all that is recalibrated, reaches the
    threshold (the local power of a score test, Cox and Hinkley 1974, §9.3).
    """
    own = np.sqrt(np.einsum("bpp->p", fitted.grams.inner)[:-1])
    names = [u.name for u in fitted.problem.unknowns]
    rows = []
    for s in one_of_each(sorted(seen.scored, key=lambda s: (bool(s.candidate.variant_of), s.sd))):
        c = s.candidate
        if c.mechanism not in MECHANISMS or not c.amplitudes:
            continue
        spec = MECHANISMS[c.mechanism].spec(next(iter(s.amplitudes)))
        limit = s.sd * (np.sqrt(2.0 * threshold) + POLICY.limit_power_sd)
        by = int(np.argmax(np.abs(seen.shadow[:, s.column]) * own))
        unseen = limit > max(abs(spec.low), abs(spec.high)) or not np.isfinite(limit)
        value, unit = np.nan if unseen else float(limit), _unit(fitted, c, spec)
        rows.append(
            (c.mechanism, c.where.kind, c.where.name, c.label, value, unit, s.absorbed,
             names[by] if s.absorbed > POLICY.limit_absorbed_share else "")
        )  # fmt: skip
    table = pd.DataFrame(rows, columns=list(COLUMNS["limits"]))
    digits = table.assign(size=np.log(table["limit"]).round(9))  # what differs by rounding alone is of equal size
    return digits.sort_values(["mechanism", "size", "name", "words"], ignore_index=True).drop(columns="size")


def _unit(fitted: Fitted, c: Candidate, spec: Spec) -> str:
    """The unit of an amplitude: "W/%" where it counts per unit of a driver in per cent."""
    drivers = c.part.drivers if c.part is not None else None
    if not spec.per or not drivers:
        return spec.unit
    channel = drivers if isinstance(drivers, str) else drivers.get(spec.per)
    unit = fitted.machine.channels[channel].unit if channel else "1"
    return spec.unit if unit == "1" else f"{spec.unit}/{unit}"
