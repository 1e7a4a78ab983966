"""The correlations that selectors share, against numpy."""

from __future__ import annotations

import numpy as np
from stacked_rows import LENGTHS, P, stack, year

from features.selectors import SELECTORS
from features.selectors.statistics import training_statistics

TRAIN = [0, 1, 3]


def test_correlations_from_sums_equal_numpy_on_stacked_rows() -> None:
    x, y = year()
    x[5:9, 3] = np.nan
    y[40:44] = np.nan
    design = stack(x, y, LENGTHS)
    statistics = training_statistics(design, TRAIN, "any")
    rows, target, _ = design.stacked(TRAIN)
    truth = np.corrcoef(np.column_stack([rows, target]), rowvar=False)
    assert np.allclose(statistics.between, truth[:P, :P], atol=1e-12)
    assert np.allclose(statistics.with_target, truth[:P, P], atol=1e-12)
    order = np.argsort(-np.abs(truth[:P, P]))
    for n, inputs in SELECTORS["correlation"]().select_design(design, TRAIN, range(1, P + 1)).items():
        assert set(inputs) == {f"t{i}" for i in order[:n]}
