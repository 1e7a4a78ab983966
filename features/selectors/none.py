"""Selector that keeps every input."""

from __future__ import annotations

from collections.abc import Sequence

from features.design import Design
from features.selectors.base import Selector


class NoSelection(Selector):
    """All inputs, whatever number is requested: the baseline of a selection."""

    key = "none"
    summary = "all inputs"
    source = "baseline"
    takes_n_tsp = False

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        return {n: design.inputs for n in n_tsps}
