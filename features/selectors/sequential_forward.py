"""Selector: forward selection by the error on left-out batches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from features.design import Design
from features.selectors.base import Selector
from features.selectors.left_out import LeftOut, beam
from features.selectors.statistics import check_n_tsps, chosen_of_varying, training_statistics


class SequentialForward(Selector):
    """Start with nothing; add the input with which least squares predicts left-out training batches best.

    Score: mean S over the training batches, each left out once (`features.selectors.left_out`). What was added
    stays, so two inputs that only help together are not found. Equal scores: the first in the order of the inputs.

    Source: A. Whitney (1971), A direct method of nonparametric measurement selection, IEEE Trans. Comput. 20.
    """

    key = "sequential_forward"
    summary = "one by one the input that lowers the error on left-out training batches most"
    source = "A. Whitney (1971), IEEE Trans. Comput. 20, 1100–1103"

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        check_n_tsps(design, n_tsps, self.key)
        varying = np.flatnonzero(training_statistics(design, train, self.key).varying)
        path = beam(LeftOut.of(design, train, varying), width=1) if len(varying) else []
        return chosen_of_varying(design, varying, n_tsps, lambda n: np.flatnonzero(path[n - 1][0][0]))
