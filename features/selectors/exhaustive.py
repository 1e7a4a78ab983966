"""The best of all subsets by the error on left-out batches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from features.design import Design
from features.selectors.base import Diagnostic, Selector
from features.selectors.left_out import LeftOut, beam, errors_of_all
from features.selectors.statistics import DIGITS, check_n_tsps, chosen_of_varying, training_statistics

_STATE_NUMBERS = 4_000_000  # of the beam's matrices at once
_TIE = 0.02  # errors closer than this are one choice, as in the promotion rule


class Exhaustive(Selector):
    """Of all subsets of n inputs the one that least squares predicts left-out training batches with best.

    Score: mean S over the training batches, each left out once (`features.selectors.left_out`). All subsets
    of at most `most_inputs` inputs are tried. Of more inputs a beam search tries those that grow, one input at a time,
    from the `width` best of every size (fewer where memory binds): then the result need not be the best of all, and
    the diagnostics report it. Of equal scores the first in the order of the inputs is taken.

    Source: G. Furnival and R. Wilson (1974), Technometrics 16, 499–511, for trying all subsets.
    """

    key = "exhaustive"
    summary = "of all subsets the least error on left-out training batches"
    source = "G. Furnival and R. Wilson (1974), Technometrics 16, 499–511"

    def __init__(self, most_inputs: int = 14, width: int = 16) -> None:
        self.most_inputs, self.width = int(most_inputs), int(width)

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        check_n_tsps(design, n_tsps, self.key)
        varying = np.flatnonzero(training_statistics(design, train, self.key).varying)
        best = self._best_two(design, train, varying)
        return chosen_of_varying(design, varying, n_tsps, lambda n: np.flatnonzero(best[n - 1][0][0]))

    def diagnostics(self, design: Design, train: Sequence[int], n_tsp: int) -> tuple[Diagnostic, ...]:
        varying = np.flatnonzero(training_statistics(design, train, self.key).varying)
        p = len(varying)
        out = []
        if p > self.most_inputs:
            out.append(
                Diagnostic("inputs", float(p), float(self.most_inputs), False,
                           "too many for all subsets: a beam search was made, and a better set may exist")
            )  # fmt: skip
        if n_tsp < p:
            sets, error = self._best_two(design, train, varying)[n_tsp - 1]
            gap = float(error[1] / error[0] - 1.0) if len(error) > 1 and error[0] > 0 else 0.0
            other = ", ".join(design.inputs[c] for c in varying[sets[-1]])
            comment = "second best" if gap >= _TIE else "as good within the tie"
            out.append(
                Diagnostic("gap to the runner-up", gap, _TIE, gap >= _TIE, f"{comment}: {other}")
            )  # fmt: skip
        return tuple(out)

    def _best_two(
        self, design: Design, train: Sequence[int], columns: NDArray[np.int64]
    ) -> list[tuple[NDArray[np.bool_], Array]]:
        """For 1 to p of the columns the best set and the runner-up: (sets (≤ 2, p), errors)."""
        if not len(columns):
            return []
        nothing, p = LeftOut.of(design, train, columns), len(columns)
        if p > self.most_inputs:
            width = _STATE_NUMBERS // (nothing.learned.size * p)
            return [(sets[:2], error[:2]) for sets, error in beam(nothing, max(1, min(self.width, width)))]
        error = errors_of_all(nothing)
        subset = np.arange(len(error))
        order = np.lexsort((-subset, np.round(error, DIGITS), np.bitwise_count(subset)))
        border = np.searchsorted(np.bitwise_count(subset)[order], np.arange(1, p + 1))
        firsts = [order[b : b + 2] for b in border[:-1]] + [order[-1:]]
        bits = 1 << np.arange(p)[::-1]
        return [((subset[f][:, None] & bits) > 0, error[f]) for f in firsts]
