"""Not in the library: what a missing heat or displacement follows, as a few terms over drivers, states and products.

The terms compete in the recordings themselves and not in the reconstructed series: each becomes heat at the place, its
forced response, rows of every channel, and is scored on batches left out. Heat that bodies exchange in proportion to
their difference is a coarse network's matter: where it shows it is free, and what else the heat follows is sought
beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch
from data.errors import InputError
from twin.calibration.fit_problem import Array
from twin.diagnosis.places.forced import whitened
from twin.diagnosis.places.left_out_terms import MOST, LeftOutTerms
from twin.diagnosis.places.states import neighbours_of, states_of_heat, states_of_shift
from twin.diagnosis.places.terms import ALIKE, SMALLEST, Term, heat_terms, shift_terms, told
from twin.diagnosis.places.where_when import Found, Located
from twin.diagnosis.telling.honest_digits import listed
from twin.quantity import Value
from twin.schema import MechanismPart

AS_GOOD = 0.9  # of the best terms' gain: then the form that a machine file can state is preferred


@dataclass(frozen=True)
class Coefficient:
    """A term's coefficient in `unit`; `sd` with the network's response as it is: a refit says how sure it is."""

    term: Term
    value: float
    sd: float
    unit: str
    words: str


@dataclass(frozen=True)
class Reconstruction:
    """What an unlisted effect follows. `gain` in nats of left-out log score over leaving it out.

    `explained` is the share of the left-out misfit beyond noise that the terms explain, `improved` of `batches` fall;
    both beside what is exchanged, where that shows.
    `part` states the effect as a mechanism of law free_flux or free_shift, where `part_gain` is nearly as good.
    """

    kind: str
    place: str
    terms: tuple[Coefficient, ...]
    gain: float
    explained: float
    improved: int
    batches: int
    part: MechanismPart | None
    part_gain: float

    @property
    def words(self) -> str:
        """One phrase: how much, where, following what."""
        return listed([c.words for c in self.terms]) if self.terms else f"nothing regular at {self.place}"


def reconstruct(
    located: Located, batches: Sequence[Batch], found: Found | None = None, most: int = MOST, stateable: bool = False
) -> Reconstruction:
    """At most so many terms for a place found, by default the first; `stateable`: those that one mechanism can state,
    whatever others would gain.

    Raises:
        InputError: nothing was found, it is a sensor's, or there are fewer than two batches.
    """
    found = found or next(iter(located.found), None)
    if found is None or found.kind == "sensor":
        what = "nothing was found" if found is None else f"the reading of {found.place} is a sensor's matter"
        raise InputError(f"reconstruct: {what}; give a place of missing heat or displacement")
    if len(batches) < 2:
        raise InputError(f"reconstruct: got {len(batches)} batch, needs 2 or more; give more recordings")
    heat = found.kind == "heat"
    terms, rows = (_heat if heat else _shift)(located, found, batches)
    scores = _scores(located, found, rows)
    best = scores.chosen(range(len(terms)), most)
    exchange = [k for k in best if terms[k].exchange]
    if exchange:
        best = scores.chosen([k for k, t in enumerate(terms) if not t.exchange], most, exchange)
    gain = scores.gain([*exchange, *best]) - scores.gain(exchange)
    stated, stated_gain = _stated(scores, terms, most, exchange)
    if best and set(best) != set(stated) and (stateable or stated_gain >= AS_GOOD * gain):
        best, gain = stated, stated_gain
    share, improved = scores.explained(best, exchange)
    told_by = _coefficients(scores, terms, best, exchange, found)
    part = _part(located, found, told_by) if best and set(best) == set(stated) else None
    return Reconstruction(found.kind, found.place, told_by, gain, share, improved, len(batches), part, stated_gain)


def _heat(located: Located, found: Found, batches: Sequence[Batch]) -> tuple[list[Term], list[Array]]:
    """Terms and, by batch, their whitened rows (Q, n_b) as heat into the body."""
    point = located.point
    every = heat_terms(found.place, neighbours_of(point.problem.network, found.place), states_of_heat(located, batches))
    terms = _distinct(every, point.problem.inputs.valid[..., None])
    into = point.forced.weights[list(point.problem.network.bodies).index(found.place)]
    channels, _ = point.forced.answers(np.repeat(into[None], len(terms), axis=0), np.stack([t.series for t in terms]))
    return terms, whitened(point.problem, channels)


def _shift(located: Located, found: Found, batches: Sequence[Batch]) -> tuple[list[Term], list[Array]]:
    """The same as displacement of the error channel."""
    problem = located.point.problem
    terms = _distinct(shift_terms(states_of_shift(located, batches)), problem.inputs.valid_rows)
    channels = np.zeros((len(terms), *terms[0].series.shape, len(problem.channels)))
    channels[..., problem.channels.index(found.place)] = np.stack([t.series for t in terms])
    return terms, whitened(problem, channels)


def _distinct(terms: Sequence[Term], valid: NDArray[np.bool_]) -> list[Term]:
    """Terms that move, without those that these recordings cannot tell from an earlier one."""
    kept: list[Term] = []
    size: list[Array] = []
    for term in terms:
        flat = np.where(valid, term.series, 0.0).ravel()
        norm = float(np.linalg.norm(flat))
        if norm < SMALLEST or any(abs(flat @ other) > ALIKE * norm for other in size):
            continue
        kept.append(term)
        size.append(flat / norm)
    return kept


def _scores(located: Located, found: Found, rows: Sequence[Array]) -> LeftOutTerms:
    """With what was found elsewhere held."""
    search = located.point.search
    held = [search.bases[h.basis].nuisance(h.place, h.sigma) for h in located.beside(found)]
    weight, fitted = search.noise.weight, search.fitted
    grams = [fitted.gram(b, [r], weight, [h[b] for h in held]) for b, r in enumerate(rows)]
    expected = [float(np.sum(1.0 / search.noise.inflation[k.channel])) for k in fitted.blocks]
    return LeftOutTerms(np.stack(grams), fitted.z, np.array(expected))


def _stated(scores: LeftOutTerms, terms: Sequence[Term], most: int, beside: Sequence[int]) -> tuple[list[int], float]:
    """The best terms that one mechanism can state, and their gain: of a driver, a second one with it, and one body."""
    best: list[int] = []
    gain, without = 0.0, scores.gain(beside)
    stated = {k: t for k, t in enumerate(terms) if t.role}
    drivers = dict.fromkeys((t.driver, t.other) for t in stated.values())
    bodies = dict.fromkeys(t.body for t in stated.values())
    for (driver, other), body in product(drivers, bodies):
        allowed = [
            k for k, t in stated.items()
            if t.driver in ("", driver) and t.other in ("", other) and t.body in ("", body)
        ]  # fmt: skip
        chosen = scores.chosen(allowed, most, beside)
        reached = scores.gain([*beside, *chosen]) - without
        if reached > gain:
            best, gain = chosen, reached
    return best, gain


def _coefficients(
    scores: LeftOutTerms, terms: Sequence[Term], chosen: Sequence[int], beside: Sequence[int], found: Found
) -> tuple[Coefficient, ...]:
    values, covariance = scores.coefficients([*chosen, *beside])
    out = []
    for k, value, sd in zip(chosen, values, np.sqrt(np.diagonal(covariance)), strict=False):
        unit = terms[k].unit(found.unit)
        words = told(terms[k], float(value), found.unit, found.place, found.kind == "heat")
        out.append(Coefficient(terms[k], float(value), float(sd), unit, words))
    return tuple(out)


def _part(located: Located, found: Found, coefficients: Sequence[Coefficient]) -> MechanismPart:
    """As a machine file states it, coefficients per unit of the driver, free within what they are known."""
    heat = found.kind == "heat"
    parameters = {}
    for c in coefficients:
        top = c.term.top ** (2 if c.term.role == "square" else 1) if c.term.driver else 1.0
        unit = c.unit.removesuffix("/K") + ("/K" if c.term.per == "K" else "")
        value, spread = c.value / top, max(c.sd, 0.3 * abs(c.value)) / top
        parameters[c.term.role] = Value(value=f"{value:.6g} {unit}", spread=f"{spread:.3g} {unit}")
    driver = next((c.term.driver for c in coefficients if c.term.driver), None)
    other = next((c.term.other for c in coefficients if c.term.other), None)
    some_body = found.place if heat else next(iter(located.point.problem.network.bodies))
    body = next((c.term.body for c in coefficients if c.term.body), some_body)
    return MechanismPart(
        law="free_flux" if heat else "free_shift",
        at={"body": body},
        into=found.place if heat else None,
        acts_on=None if heat else found.place,
        drivers={role: name for role, name in (("level", driver), ("other", other)) if name} or None,
        parameters=parameters,
        words=listed([c.words for c in coefficients]),
    )
