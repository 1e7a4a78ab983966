"""What a study is: a published system repeated on simulated machines, its figures and orderings as data.

To add one: a class below `Study` in a file of its own and a line in `models/studies/__init__.py`. A seed is another
machine and another year of it. An ordering says which figures the source found to be less than which; how often that
holds over the seeds is counted, never asserted.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class Figure:
    """One number of a study, per seed: what it is, its unit, and what the source printed (None: nothing)."""

    key: str
    words: str
    unit: str = "µm"
    published: float | None = None
    digits: int = 2


@dataclass(frozen=True)
class Ordering:
    """A claim about figures: of every pair in `less` the first is less than the second, in one and the same seed.

    `published_gain` is the printed part by which the first pair's smaller lies below its greater, 1 − a/b. Evidence is
    an ordering that no source printed: `evidence_for` names the ordering that it is to explain. `why` says, with the
    means of figures in braces, what lies behind a claim that does not hold here.
    """

    key: str
    words: str
    less: tuple[tuple[str, str], ...]
    published_gain: float | None = None
    evidence_for: str = ""
    why: str = ""

    def holds(self, values: Mapping[str, float]) -> bool:
        """Whether one seed's figures are in this order; a figure that is not a number is in none."""
        return all(values[a] < values[b] for a, b in self.less)


class Study(ABC):
    """A published system. `assumed` are the things its description leaves open and what stands for them here.

    `remarks` say, with the means of figures in braces, what is to be known of the figures themselves.
    """

    key: ClassVar[str]
    title: ClassVar[str]
    words: ClassVar[str]
    source: ClassVar[str]
    machine: ClassVar[str]
    assumed: ClassVar[tuple[str, ...]]
    remarks: ClassVar[tuple[str, ...]] = ()
    figures: ClassVar[tuple[Figure, ...]]
    orderings: ClassVar[tuple[Ordering, ...]]

    @abstractmethod
    def run(self, seed: int) -> dict[str, float]:
        """Every figure of `figures` on one simulated machine-year; the same seed gives the same numbers."""
