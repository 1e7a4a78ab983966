"""Base class of the selectors of temperature-sensitive points (TSP).

To add one: a class below `Selector` in a file of its own and a line in `features/selectors/__init__.py`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from data.batch import Batch
from features.design import Design
from features.rises import temperature_inputs


@dataclass(frozen=True)
class Diagnostic:
    """A known weakness of a selector as a statistic with its usual threshold.

    `ok` False is a warning, not an error; `comment` explains the value.
    """

    statistic: str
    value: float
    threshold: float
    ok: bool
    comment: str


class Selector(ABC):
    """Chooses n_tsp inputs from training batches alone."""

    key: ClassVar[str]
    summary: ClassVar[str]
    source: ClassVar[str]
    takes_n_tsp: ClassVar[bool] = True  # False: the selector decides itself (or keeps all)
    packages: ClassVar[tuple[str, ...]] = ()  # what it imports to learn that an installation may lack

    @abstractmethod
    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        """Chosen inputs for every requested number of points, learned from the batches `train` of the design alone.

        The inputs come back in the design's order, so equal sets are equal tuples.
        """

    def diagnostics(self, design: Design, train: Sequence[int], n_tsp: int) -> tuple[Diagnostic, ...]:
        """Known weaknesses of this selector, measured on its choice of n_tsp inputs; by default none."""
        return ()

    def select(self, train_batches: Sequence[Batch], target: str, n_tsp: int) -> tuple[str, ...]:
        """Chosen channel names among all temperatures of the batches."""
        design = Design.build(train_batches, temperature_inputs(train_batches), target)
        return self.select_design(design, range(design.n_batches), [n_tsp])[n_tsp]
