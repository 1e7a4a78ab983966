"""The screen: the evidence for every candidate from one linearisation, under the structural discrepancy.

A candidate adds a signature s (n,) times an amplitude g to the rows. With everything else integrated out (parameters,
starts, structure) the log evidence ratio depends on two numbers alone, ``b = sᵀ M t`` and ``m = sᵀ M s`` with M the
inverse of the marginal covariance and t the target: ``log ∫ exp(b g - m g² / 2) p(g) dg`` (Kass and Raftery 1995,
J. Am. Stat. Assoc. 90, 773). Signs and physical ranges are in the prior p(g).

Structure that the covariance has not seen gains too, some candidates more than others: machines of another style give
each candidate its inflation, the mean of ``b² / m`` over them, by which b and m are divided.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from data.arrays import Array
from diagnosis.candidates.alternatives import alternatives
from diagnosis.candidates.free_forms import candidate_of, free_forms
from diagnosis.candidates.library import candidates, own_bodies
from diagnosis.candidates.priors import size_of, usual_amplitude
from diagnosis.contracts import Candidate, CandidateKind, Scored
from diagnosis.screening.linearisation import Asleep, asleep, columns_of, differences
from diagnosis.structure.covariance import Covariance, freedom, recalibrated
from diagnosis.structure.fit import StructuralFit
from diagnosis.structure.mild import mild_laws
from diagnosis.structure.policy import STRUCTURE
from diagnosis.structure.rows import Linear

NO_TRACE = 1e-9  # m below which a signature shows in no row


@dataclass(frozen=True)
class Prior:
    """Prior of an amplitude, counted from the value without an effect.

    `log_sd` > 0: positive, log-normal about `centre`; else normal about `centre` with `sd`.
    """

    centre: float
    sd: float
    log_sd: float = 0.0

    def evidence(self, b: Array, m: Array) -> Array:
        """``log ∫ exp(b g - m g² / 2) p(g) dg`` for b and m (…,)."""
        if self.log_sd:
            steps = np.linspace(-3.0, 3.0, STRUCTURE.amplitude_grid)
            g = self.centre * np.exp(self.log_sd * steps)
            weight = -0.5 * steps**2
            weight = weight - logsumexp(weight)
            return np.asarray(logsumexp(b[..., None] * g - 0.5 * m[..., None] * g**2 + weight, axis=-1))
        b, shift = b - m * self.centre, b * self.centre - 0.5 * m * self.centre**2
        free = 1.0 + m * self.sd**2
        return np.asarray(shift + 0.5 * b**2 * self.sd**2 / free - 0.5 * np.log(free))

    def best(self, b: float, m: float) -> float:
        """The most probable amplitude."""
        if self.log_sd:
            g = self.centre * np.exp(self.log_sd * np.linspace(-3.0, 3.0, 4 * STRUCTURE.amplitude_grid))
            score = b * g - 0.5 * m * g**2 - 0.5 * (np.log(g / self.centre) / self.log_sd) ** 2
            return float(g[int(np.argmax(score))])
        return float((b + self.centre / self.sd**2) / (m + 1.0 / self.sd**2))


@dataclass(frozen=True)
class Way:
    """One way in which a candidate may act: the column of its signature, its prior, the amplitudes per unit."""

    column: int
    prior: Prior
    amplitudes: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Screen:
    """The evidence for all candidates that have a signature, best first.

    Attributes:
        scored: the candidates; those of no listed mechanism are in `free`.
        names, gains: (C,) and (T, C): log evidence of every listed candidate in each machine of the null, nats.
        inflation: of every candidate by name.
        left_out: why a candidate has no signature.
        projected: (n, c) whitened columns with everything else projected out; `column` of `Scored` numbers them.
        shadow: (p, c) by how much the shared unknowns move for a unit of each column.
        square: (c,) m of each column, before inflation.
    """

    scored: tuple[Scored, ...]
    free: tuple[Scored, ...]
    names: tuple[str, ...]
    gains: Array
    free_gains: Array
    inflation: Mapping[str, float]
    left_out: Mapping[str, str]
    whitened: Array
    projected: Array
    shadow: Array
    square: Array
    _kept: dict[str, Array] = field(default_factory=dict, repr=False)

    def likeness(self, columns: Sequence[int]) -> Array:
        """|cos| (k, k) between signatures once everything else is projected out."""
        chosen = list(columns)
        gram = self.whitened[:, chosen].T @ self.projected[:, chosen]
        size = np.sqrt(np.maximum(np.diag(gram), NO_TRACE))
        return np.asarray(np.abs(gram) / np.outer(size, size))

    @cached_property
    def best(self) -> Scored | None:
        return self.scored[0] if self.scored else None


def proposed(fitted: StructuralFit) -> list[Candidate]:
    """All mechanisms at all places, and the alternatives that doubt the machine file's values."""
    return candidates(fitted.machine, fitted.part) + alternatives(fitted.problem.network)


def never_reported(every: Collection[Candidate], fitted: StructuralFit) -> set[str]:
    """Names of the candidates that say how a network is drawn, not what a machine does, and of mild physics."""
    mild = mild_laws(fitted.part, fitted.problem, fitted.values, every)
    return {c.name for c in every if c.mechanism == "sensor_place" or c.name in mild}


def screen(fitted: StructuralFit, seed: int = 0) -> Screen:
    """The evidence for all candidates that have a signature."""
    every = [c for c in proposed(fitted) if c.kind is not CandidateKind.SENSOR_SWAP]
    loose = never_reported(every, fitted)
    every = [c for c in every if c.name not in loose]
    bodies = own_bodies(fitted.part)
    terms = [candidate_of([f], bodies[0]) for f in free_forms(fitted.machine, fitted.part, fitted.batches)]
    terms = [c for c in terms if c.name not in {*fitted.part.mechanisms, *(one.name for one in every)}]
    found = asleep(fitted.machine, fitted.part, [*every, *terms])
    columns, ways, refused = _signatures(fitted, found, [*every, *terms])
    return _scored(fitted, every, terms, columns, ways, {**found.left_out, **refused}, seed)


def _signatures(
    fitted: StructuralFit, found: Asleep, every: Sequence[Candidate]
) -> tuple[Array, dict[str, list[Way]], dict[str, str]]:
    """All columns (n, c), by candidate how it may act, and why others have no signature."""
    own = {u.name for u in fitted.problem.unknowns}
    numbers = sorted({j for js in found.amplitudes.values() for j in js if found.network.parameters[j].name not in own})
    place = {j: k for k, j in enumerate(numbers)}
    state = fitted.state
    columns = [columns_of(fitted.problem, fitted.batches, found.network, state.z, state.nuisance, numbers)]
    finite, refused = differences(fitted, every)
    more: list[Array] = [np.concatenate(change) for change in finite.values()]
    ways: dict[str, list[Way]] = {}
    first = len(numbers)
    for k, name in enumerate(finite):
        ways[name] = [Way(first + k, Prior(1.0, STRUCTURE.finite_change_sd), {})]
    size = size_of(fitted)
    for c in every:
        at = [place[j] for j in found.amplitudes.get(c.name, ()) if j in place]
        if not at or (c.change is not None and c.change.per_batch is not None):
            continue
        if c.change is not None:
            ways[c.name] = [Way(at[0], Prior(0.0, c.change.spread or 1.0), {"factor": 1.0})]
            continue
        priors = [usual_amplitude(c, amplitude, size) for amplitude in c.amplitudes]
        ways[c.name] = [
            Way(k, Prior(*prior), {amplitude: 1.0})
            for k, prior, amplitude in zip(at, priors, c.amplitudes, strict=False)
        ]
        if len(at) > 1 and all(log_sd for *_, log_sd in priors):  # all of it in its usual proportions
            usual = {a: centre for a, (centre, *_) in zip(c.amplitudes, priors, strict=True)}
            joint = Way(first + len(more), Prior(1.0, 0.0, priors[0][2]), usual)
            more.append(columns[0][:, at] @ np.array(list(usual.values()))[: len(at)])
            ways[c.name].append(joint)
    return np.column_stack([*columns, *more]) if more else columns[0], ways, refused


def _scored(
    fitted: StructuralFit, every: Sequence[Candidate], terms: Sequence[Candidate], columns: Array,
    ways: Mapping[str, list[Way]], left_out: Mapping[str, str], seed: int,
) -> Screen:  # fmt: skip
    covariance = fitted.covariance
    assert covariance is not None, "a screen needs the structural discrepancy"
    linear = Linear.at(fitted.problem, fitted.state.z, fitted.state.nuisance)
    prior = covariance.prior_of([u.name for u in fitted.problem.unknowns])
    rows, p = covariance.rows, len(prior)
    known = covariance.whitened(np.hstack([linear.jacobian * prior, linear.nuisance]))
    whole = np.hstack([covariance.columns, known])
    root = cho_factor(whole.T @ whole + np.eye(whole.shape[1]))
    targets, count = _targets(fitted, linear, covariance, seed)
    white, aims = covariance.whitened(columns), covariance.whitened(targets)
    shared = cho_solve(root, whole.T @ white)
    projected = white - whole @ shared
    along = projected.T @ aims
    square = np.maximum(np.einsum("nc,nc->c", white, projected), 0.0)
    rest = aims - whole @ cho_solve(root, whole.T @ aims)
    misfit = np.einsum("nt,nt->t", aims, rest)
    null = _null(along, misfit, count, rows.n)
    listed = _evidence(every, ways, along[:, 0], null, square)
    free = _evidence(terms, ways, along[:, 0], null, square)
    base = covariance.columns.shape[1]
    raw = np.einsum("nc,nc->c", white, white)
    absorbed = 1.0 - square / np.maximum(raw, NO_TRACE)
    return Screen(
        tuple(_sorted(listed, absorbed, square)),
        tuple(_sorted(free, absorbed, square)),
        tuple(e.candidate.name for e in listed),
        np.array([e.null for e in listed]).T if listed else np.zeros((count, 0)),
        np.array([e.null for e in free]).T if free else np.zeros((count, 0)),
        {e.candidate.name: e.inflation for e in (*listed, *free)},
        left_out,
        white,
        projected,
        shared[base : base + p] * prior[:, None],
        square,
    )


def _targets(fitted: StructuralFit, linear: Linear, covariance: Covariance, seed: int) -> tuple[Array, int]:
    """The recordings (n, 1), misfits of T machines of another style and white noise (n, T), side by side.

    A machine's misfit is the sum of one of every group at the group's scale, as the covariance has it.
    """
    assert fitted.structure is not None
    rng, other = np.random.default_rng(seed), fitted.structure.other
    count = sum(d.shape[1] for d in other)
    misfit = np.zeros((linear.rows.n, count))
    for scale, group in zip(covariance.scales, other, strict=True):
        if group.shape[1] and count:
            order = np.concatenate([rng.permutation(group.shape[1]) for _ in range(-(-count // group.shape[1]))])
            misfit += scale * group[:, order[:count]]
    misfit = recalibrated(linear, misfit, covariance.sd, freedom(fitted.problem.unknowns))[0] if count else misfit
    noise = rng.standard_normal(misfit.shape) * covariance.sd[linear.rows.channel][:, None]
    return np.column_stack([linear.target, misfit, noise]), count


def _null(along: Array, misfit: Array, count: int, rows: int) -> Array:
    """b (c, T) of machines in which nothing is missing.

    A machine's misfit is no larger than what leaves as much as the recordings leave.
    """
    structural, noise = misfit[1 : 1 + count], float(np.median(misfit[1 + count :])) if count else 1.0
    room = max(misfit[0] - min(noise, misfit[0]), STRUCTURE.null_min_misfit_share * rows)
    scales = np.minimum(1.0, np.sqrt(room / np.maximum(structural, NO_TRACE)))
    quiet = min(1.0, float(np.sqrt(misfit[0] / max(noise, NO_TRACE))))
    return np.asarray(along[:, 1 : 1 + count] * scales + quiet * along[:, 1 + count :])


@dataclass(frozen=True)
class _Evidence:
    """A candidate's log evidence in the recordings and in each machine of the null (T,)."""

    candidate: Candidate
    way: Way
    gain: float
    amplitude: float
    inflation: float
    null: Array


def _evidence(
    every: Sequence[Candidate], ways: Mapping[str, list[Way]], b: Array, null: Array, m: Array
) -> list[_Evidence]:
    """Every candidate by the best of its ways; a machine of the null counts by the inflation of the others."""
    out = []
    for c in every:
        best: _Evidence | None = None
        for way in ways.get(c.name, ()):
            k, square = way.column, float(m[way.column])
            if square < NO_TRACE:
                continue
            lift = null[k] ** 2 / square
            inflation = max(1.0, float(lift.mean())) if len(lift) else 1.0
            others = np.maximum(1.0, (lift.sum() - lift) / max(len(lift) - 1, 1))
            gain = float(way.prior.evidence(np.array(b[k] / inflation), np.array(square / inflation)))
            if best is None or gain > best.gain:
                chance = way.prior.evidence(null[k] / others, square / others)
                amplitude = way.prior.best(float(b[k]) / inflation, square / inflation)
                best = _Evidence(c, way, gain, amplitude, inflation, chance)
        if best is not None:
            out.append(best)
    return out


def _sorted(found: Sequence[_Evidence], absorbed: Array, square: Array) -> list[Scored]:
    out = [
        Scored(
            e.candidate,
            e.gain,
            0,
            float(absorbed[e.way.column]),
            {name: share * e.amplitude for name, share in e.way.amplitudes.items()},
            float(np.sqrt(e.inflation / max(square[e.way.column], NO_TRACE))),
            e.way.column,
        )
        for e in found
    ]
    return sorted(out, key=lambda s: (-s.gain, s.candidate.name))


def moved(s: Scored, seen: Screen) -> Scored:
    """With the linear step of the fit's unknowns when the candidate enters."""
    amplitude = max(s.amplitudes.values(), key=abs, default=1.0)
    return replace(s, moves=tuple((-amplitude * seen.shadow[:, s.column]).tolist()))


def best_variants(scored: Sequence[Scored]) -> list[Scored]:
    """Of what was evaluated at several values of its shape, the one that gains most, in the same order."""
    first: dict[str, Scored] = {}
    for s in scored:
        first.setdefault(s.candidate.plain, s)
    kept: NDArray[np.bool_] = np.array([first[s.candidate.plain] is s for s in scored], bool)
    return [s for s, keep in zip(scored, kept, strict=True) if keep]
