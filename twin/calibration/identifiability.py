"""Identifiability of a calibration: intervals, correlation, and combinations determined by the prior alone.

In z = (x − prior) / spread the prior's information is 1 in every direction. Directions in which the data's is below
that are the prior's (Vajda, Rabitz, Walter & Lecourtier 1989, Chem. Eng. Commun. 83, use the same eigenvectors).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import linprog

from data.arrays import Array
from twin.calibration.fit_problem import Unknown
from twin.calibration.least_squares import Fit

Z90 = 1.6448536269514722
SMALL = 0.2  # a weight below this share of the largest is not worded
LISTED = 6  # a combination of more parameters names this many
EQUAL = 0.2  # weights closer than this count as equal: a plain ratio, product, sum or difference


@dataclass(frozen=True)
class Interval:
    """A parameter with its 90 % interval in its own unit; `prior_shrinkage` is posterior sd / prior sd in x."""

    name: str
    unit: str
    value: float
    low: float
    high: float
    prior_shrinkage: float


@dataclass(frozen=True)
class Undetermined:
    """A parameter or combination that the recordings do not determine.

    Moving x along `direction` (p,), of length 1 in prior spreads, changes the recordings by less than their noise:
    `information` is the data's there, the prior's being 1. `names` are the parameters that take part.
    """

    names: tuple[str, ...]
    direction: Array
    information: float
    summary: str


def intervals90(fit: Fit, unknowns: Sequence[Unknown]) -> list[Interval]:
    """90 % intervals of every parameter: normal in x, within its bounds, transformed to its unit."""
    out = []
    for u, x, sd, ratio in zip(unknowns, fit.x, np.sqrt(np.diag(fit.covariance)), prior_shrinkage(fit, unknowns),
                               strict=True):  # fmt: skip
        low, high = np.clip([x - Z90 * sd, x + Z90 * sd], u.low, u.high)
        out.append(Interval(u.name, u.unit, u.value(x), u.value(low), u.value(high), float(ratio)))
    return out


def correlation(fit: Fit) -> Array:
    """The posterior correlation matrix (p, p) of x."""
    sd = np.sqrt(np.diag(fit.covariance))
    return np.asarray(fit.covariance / np.outer(sd, sd))


def prior_shrinkage(fit: Fit, unknowns: Sequence[Unknown]) -> Array:
    """Posterior sd / prior sd of every parameter (p,): 1 without information in the recordings, near 0 with much."""
    return np.sqrt(np.diag(fit.covariance)) / np.array([u.spread for u in unknowns])


def undetermined(fit: Fit, unknowns: Sequence[Unknown]) -> list[Undetermined]:
    """Combinations that the recordings do not determine, least determined first.

    Along each the data's information is below the prior's: the posterior sd is above 0.71 of the prior's. Eigenvectors
    of near-equal information mix at will, so their span is described by sparse vectors.
    """
    spread = np.array([u.spread for u in unknowns])
    # From the covariance, 1 / (information + 1): exact where information is small, whatever it is elsewhere.
    values, vectors = np.linalg.eigh(fit.covariance / np.outer(spread, spread))
    weak = values > 1 / 2
    null = vectors[:, weak]
    information = (null * np.maximum(0.0, 1 / values[weak] - 1)) @ null.T
    found = []
    for support, directions in _families(sparse_basis(null)):
        weakest = directions[:, 0] if directions.shape[1] == 1 else _weakest(directions, information)
        seen = float(max(0.0, weakest @ information @ weakest))
        summary = _in_words(directions * spread[:, None], weakest, support, unknowns)
        found.append(Undetermined(tuple(unknowns[i].name for i in support), weakest, seen, summary))
    return sorted(found, key=lambda u: (round(u.information, 3), len(u.names), u.names))


def sparse_basis(null: Array) -> Array:
    """Sparse vectors of length 1 (p, k) that span the columns of an orthonormal `null` (p, k).

    Through each coordinate goes the vector of least absolute sum that is 1 there (a linear programme, after Spielman,
    Wang & Wright 2012, "Exact recovery of sparsely-used dictionaries"); the sparsest independent ones are kept.
    """
    p, k = null.shape
    if k == 0:
        return null
    candidates = []
    for i in np.flatnonzero(np.sum(null**2, axis=1) > 0.02):
        # v = null c with v = plus − minus: the variables are c (free), plus, minus >= 0.
        equal = np.block([[null, -np.eye(p), np.eye(p)], [null[i], np.zeros(2 * p)]])
        solved = linprog(
            np.concatenate([np.zeros(k), np.ones(2 * p)]),
            A_eq=equal,
            b_eq=np.append(np.zeros(p), 1.0),
            bounds=[(None, None)] * k + [(0, None)] * (2 * p),
            method="highs",
        )
        if solved.success and solved.x is not None:
            v = null @ solved.x[:k]
            candidates.append(v / np.linalg.norm(v))
    chosen: list[Array] = []
    taken = np.zeros((p, 0))
    for v in sorted(candidates, key=lambda v: round(float(np.abs(v).sum()), 6)):
        new = v - taken @ (taken.T @ v)
        if len(chosen) < k and np.linalg.norm(new) > 0.3:
            chosen.append(v * np.sign(v[np.argmax(np.abs(v))]))
            taken = np.column_stack([taken, new / np.linalg.norm(new)])
    if len(chosen) < k:
        rest = null - taken @ (taken.T @ null)
        chosen.extend(np.linalg.svd(rest)[0][:, : k - len(chosen)].T)
    return np.column_stack(chosen)


def _families(basis: Array) -> list[tuple[list[int], Array]]:
    """Supports and their vectors (p, m): vectors that overlap join where together they leave one combination fixed."""
    strong = np.abs(basis) >= SMALL * np.abs(basis).max(axis=0, initial=0.0)
    groups = [({int(i) for i in np.flatnonzero(s)}, [j]) for j, s in enumerate(strong.T)]
    merged = True
    while merged:
        merged = False
        for a, b in combinations(range(len(groups)), 2):
            support = groups[a][0] | groups[b][0]
            columns = groups[a][1] + groups[b][1]
            if groups[a][0] & groups[b][0] and len(columns) == len(support) - 1:
                groups[a] = (support, columns)
                del groups[b]
                merged = True
                break
    return [(sorted(s), basis[:, c]) for s, c in groups]


def _weakest(directions: Array, information: Array) -> Array:
    """The direction of least information in a span."""
    basis = np.linalg.qr(directions)[0]
    weakest = basis @ np.linalg.eigh(basis.T @ information @ basis)[1][:, 0]
    return np.asarray(weakest * np.sign(weakest[np.argmax(np.abs(weakest))]))


def _in_words(moves: Array, weakest: Array, support: list[int], unknowns: Sequence[Unknown]) -> str:
    """What is undetermined; `moves` (p, m) in x, `weakest` (p,) in prior spreads."""
    names = readable_names([u.name for u in unknowns])
    if len(support) == 1:
        return f"{names[support[0]]}: the recordings do not determine it; the prior does"
    listed = ", ".join(names[i] for i in support[:-1]) + f" and {names[support[-1]]}"
    scales = {unknowns[i].scale for i in support}
    units = {unknowns[i].unit for i in support}
    fixed = np.linalg.svd(moves[support].T)[2][moves.shape[1] :]
    if len(fixed) == 1 and (scales == {"log"} or (scales == {"linear"} and len(units) == 1)):
        return f"{listed}: only {_combination(fixed[0], [names[i] for i in support], scales == {'log'})}"
    order = sorted(support, key=lambda i: (-round(abs(float(weakest[i])), 6), names[i]))
    sign = np.sign(weakest[order[0]])
    parts = [f"{names[i]} {'up' if weakest[i] * sign > 0 else 'down'} {abs(weakest[i]):.2f}" for i in order]
    if len(parts) > LISTED:
        parts = [*parts[:LISTED], f"and {len(parts) - LISTED} more with smaller parts"]
        listed = f"{len(support)} parameters together"
    count = "only one combination" if len(support) == 2 else "one combination is not determined"
    return f"{listed}: {count}; the recordings do not see the move (in prior spreads) {', '.join(parts)}"


def _combination(weights: Array, names: list[str], log: bool) -> str:
    """What stays determined: ``Σ w x`` of a log or linear group, as 'their ratio' where the weights allow."""
    largest = int(np.argmax(np.abs(weights).round(9)))
    w = weights / weights[largest]
    w = np.where(np.abs(np.abs(w) - 1) < EQUAL, np.sign(w), w)
    equal = bool(np.all(np.abs(w) == 1))
    if equal and np.all(w > 0):
        return "their product" if log else "their sum"
    if equal and len(w) == 2:
        return "their ratio" if log else "their difference"
    if not log:
        terms = [f"{'+' if v > 0 else '−'} {'' if abs(v) == 1 else f'{abs(v):.2g} × '}{n}" for n, v in zip(names, w,
                 strict=True)]  # fmt: skip
        return " ".join(terms).removeprefix("+ ")
    powers = [n if abs(v) == 1 else f"({n})^{abs(v):.2g}" for n, v in zip(names, w, strict=True)]
    over = " × ".join(t for t, v in zip(powers, w, strict=True) if v > 0)
    under = " × ".join(t for t, v in zip(powers, w, strict=True) if v < 0)
    return f"{over} / {f'({under})' if ' × ' in under else under}" if under else over


def readable_names(names: Sequence[str]) -> list[str]:
    """``links.shaft-front.conductance`` as "shaft–front conductance"; the full name where that is not unique."""
    short = []
    for name in names:
        parts = name.split(".")
        kept = parts[1:] if len(parts) > 2 else parts
        joined = [part.replace("-", "–") if parts[0] == "links" else part for part in kept]
        short.append(" ".join(joined).replace("_", " "))
    return [s if short.count(s) == 1 else n for s, n in zip(short, names, strict=True)]
