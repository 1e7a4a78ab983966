"""Every registered selector keeps the contract, and the correlations that they share against numpy."""

from __future__ import annotations

import numpy as np
import pytest
from stacked_rows import LENGTHS, P, stack, year

from features.selectors import SELECTORS
from features.selectors.statistics import training_statistics
from thermodrift.testing import ContractCheck, check_selector

TRAIN = [0, 1, 3]


@pytest.mark.parametrize("check", [c for key in SELECTORS for c in check_selector(key, generate_only=True)], ids=str)
def test_contract(check: ContractCheck) -> None:
    check()


def test_keys_are_those_of_the_registry() -> None:
    assert {key: selector.key for key, selector in SELECTORS.items()} == {key: key for key in SELECTORS}


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
