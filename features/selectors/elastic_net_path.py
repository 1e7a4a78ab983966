"""Stability selection over batches along the path of the elastic net."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from features.design import Design
from features.selectors.base import Diagnostic, Selector
from features.selectors.left_out import Blocks
from features.selectors.statistics import DIGITS, Statistics, check_n_tsps, chosen_of_varying, training_statistics

_ROUNDING = 1e-12
_STEPS_PER_INPUT = 20  # a path has about one step per input; this many mean that rounding goes in circles


def active_inputs(products: Array, with_target: Array, levels: Array) -> NDArray[np.bool_]:
    """Where β ≠ 0 minimises ½ βᵀGβ − rᵀβ + λ Σ|β_j|, for S problems at L falling levels of λ: (S, L, p).

    G (S, p, p) are the inputs' products with the ridge part on the diagonal (positive definite), r (S, p) those with
    the target.

    All problems at once take 1/19 of the time of scikit-learn's `lars_path_gram` one by one (50 halves, 10 inputs:
    ``benchmarks/elastic_net.py``).

    Source: B. Efron et al. (2004), Least angle regression, Ann. Statist. 32, 407–499, with the lasso's leaving step;
    H. Zou and T. Hastie (2005), J. R. Statist. Soc. B 67, 301–320, for the ridge part.
    """
    n_problems, p = with_target.shape
    out = np.zeros((n_problems, len(levels), p), bool)
    problem = np.arange(n_problems)
    g, r = products, with_target
    beta, rest = np.zeros_like(r), r.copy()
    penalty = np.abs(r).max(axis=1, initial=0.0)
    active = np.zeros(r.shape, bool)
    if p:
        active[problem, np.argmax(np.abs(r), axis=1)] = True
    barred = np.zeros_like(active)
    for _ in range(_STEPS_PER_INPUT * p):
        some = penalty > levels[-1]
        if not some.all():
            problem, g, r, beta, rest, penalty, active, barred = (
                a[some] for a in (problem, g, r, beta, rest, penalty, active, barred)
            )
        if not len(problem):
            break
        both = active[:, :, None] & active[:, None, :]
        system = np.where(both, g, np.eye(p))
        direction = np.linalg.solve(system, (np.sign(rest) * active)[..., None])[..., 0] * active
        slope = (g @ direction[..., None])[..., 0]
        joining, leaving = _joining(penalty, rest, slope, active | barred), _leaving(beta, direction)
        n, first_in, first_out = np.arange(len(problem)), joining.argmin(axis=1), leaving.argmin(axis=1)
        leaves = leaving[n, first_out] < joining[n, first_in]
        step = np.minimum(np.minimum(joining[n, first_in], leaving[n, first_out]), penalty)
        passed = (levels <= penalty[:, None]) & (levels > (penalty - step)[:, None])
        out[problem] |= passed[:, :, None] & active[:, None, :]
        beta, penalty = beta + step[:, None] * direction, penalty - step
        column = np.where(leaves, first_out, first_in)
        beta[n[leaves], column[leaves]] = 0.0
        active[n, column] = ~leaves
        barred[:] = False
        barred[n[leaves], column[leaves]] = True  # it is at the border now and must not rejoin at once
        rest = r - (g @ beta[..., None])[..., 0]
    out[problem] |= (levels <= penalty[:, None])[:, :, None] & active[:, None, :]
    return out


def _joining(penalty: Array, rest: Array, slope: Array, kept_out: NDArray[np.bool_]) -> Array:
    """Falls of the penalty after which an input that is not active reaches it, (S, p)."""
    fall = np.full(rest.shape, np.inf)
    for sign in (1.0, -1.0):
        gap, speed = np.maximum(penalty[:, None] - sign * rest, 0.0), 1.0 - sign * slope
        reaches = (speed > _ROUNDING) & ~kept_out
        fall = np.minimum(fall, np.where(reaches, gap / np.where(reaches, speed, 1.0), np.inf))
    return fall


def _leaving(beta: Array, direction: Array) -> Array:
    """Falls of the penalty after which an active coefficient is back at 0, (S, p)."""
    returns = beta * direction < 0.0
    fall: Array = np.where(returns, -beta / np.where(returns, direction, 1.0), np.inf)
    return fall


_LEVELS = np.geomspace(1.0, 1e-4, 41)  # of the penalty, for inputs and target of unit spread: at 1 nothing is active
_STABLE = 0.6  # the least threshold that the method's bound on false choices is stated for


class ElasticNetPath(Selector):
    """Inputs that the elastic net picks again and again on halves of the training batches.

    Whole batches are drawn, half of them at a time: every half where there are at most `subsamples`, else as many in
    complementary pairs. On each the exact path from strong to weak penalty is followed, inputs and target of unit
    spread there; `ridge` is the quadratic part (0: nearly the lasso). For n points the penalty falls as long
    as n inputs at most are active on average; the n of largest selection frequency so far are taken. Equal ones go
    by the frequency over the whole path, by |corr| with the error, and by the order of the inputs.

    Source: N. Meinshausen and P. Bühlmann (2010), Stability selection, J. R. Statist. Soc. B 72, 417–473; R. Shah and
    R. Samworth (2013), ibid. 75, 55–80, for the complementary pairs.
    """

    key = "elastic_net_path"
    summary = "picked most often by the elastic net on halves of the training batches"
    source = "N. Meinshausen and P. Bühlmann (2010), J. R. Statist. Soc. B 72, 417–473"

    def __init__(self, ridge: float = 0.01, subsamples: int = 50, seed: int = 0) -> None:
        self.ridge, self.subsamples, self.seed = float(ridge), int(subsamples), int(seed)

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        check_n_tsps(design, n_tsps, self.key)
        statistics = training_statistics(design, train, self.key)
        varying = np.flatnonzero(statistics.varying)
        frequency = self.frequencies(design, train, varying)
        return chosen_of_varying(
            design, varying, n_tsps, lambda n: _ranked(frequency, n, statistics.with_target[varying])[0][:n]
        )

    def diagnostics(self, design: Design, train: Sequence[int], n_tsp: int) -> tuple[Diagnostic, ...]:
        statistics: Statistics = training_statistics(design, train, self.key)
        varying = np.flatnonzero(statistics.varying)
        if n_tsp >= len(varying):
            return ()
        order, score = _ranked(self.frequencies(design, train, varying), n_tsp, statistics.with_target[varying])
        least, next_one = float(score[order[n_tsp - 1]]), float(score[order[n_tsp]])
        words = (
            f"share of the halves that pick {design.inputs[varying[order[n_tsp - 1]]]}, the last chosen; "
            f"the first left out, {design.inputs[varying[order[n_tsp]]]}, has {next_one:.2f}"
        )
        return (Diagnostic("selection frequency at the cut", least, _STABLE, least >= _STABLE, words),)

    def frequencies(self, design: Design, train: Sequence[int], columns: NDArray[np.int64]) -> Array:
        """Share of the halves on which each of the columns is active at each level of the penalty, (L, p)."""
        blocks = Blocks.of(design, train, columns)
        _, _, products = blocks.pooled(self._halves(len(blocks.count)))
        size = np.sqrt(np.maximum(np.einsum("sjj->sj", products), 0.0))
        flat = size <= 1e-7 * np.sqrt(np.einsum("bjj->j", blocks.zz))
        size[flat] = np.inf
        products = products / size[:, :, None] / size[:, None, :]
        g = products[:, 1:, 1:]
        np.einsum("sjj->sj", g)[...] = 1.0 + max(self.ridge, 1e-8)
        return active_inputs(g, products[:, 1:, 0], _LEVELS).mean(axis=0)

    def _halves(self, n_blocks: int) -> NDArray[np.bool_]:
        """Sets of half the blocks, (S, B)."""
        half = max(1, n_blocks // 2)
        if comb(n_blocks, half) <= self.subsamples:
            chosen = [list(c) for c in combinations(range(n_blocks), half)]
        else:
            rng = np.random.default_rng(self.seed)
            drawn = [rng.permutation(n_blocks) for _ in range(self.subsamples // 2)]
            chosen = [part.tolist() for d in drawn for part in (d[:half], d[-half:])]
        sets = np.zeros((len(chosen), n_blocks), bool)
        for s, members in enumerate(chosen):
            sets[s, members] = True
        return sets


def _ranked(frequency: Array, n: int, with_target: Array) -> tuple[NDArray[np.int64], Array]:
    """Columns from the best down, and the largest frequency of each as long as n are active on average, both (p,)."""
    active = np.maximum.accumulate(frequency.sum(axis=1))
    most = frequency[active <= n].max(axis=0, initial=0.0)
    keys = (-np.abs(with_target), -frequency.mean(axis=0), -most)
    return np.lexsort([np.round(k, DIGITS) for k in keys]), most
