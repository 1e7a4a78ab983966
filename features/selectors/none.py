"""No selection: every input is kept."""

from __future__ import annotations

from collections.abc import Sequence

from features.design import Design
from features.selectors.base import Selector


class NoSelection(Selector):
    """All inputs, whatever number is asked for: what a selection has to beat."""

    key = "none"
    words = "all inputs"
    source = "baseline"
    effort = "quick"
    takes_n_tsp = False

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        return {n: design.inputs for n in n_tsps}
