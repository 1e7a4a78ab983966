"""Stability of the selected temperature-sensitive points (TSP) over training sets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import combinations

from data.errors import InputError
from features.selectors.base import Diagnostic

_STABLE = 0.7  # as in the promotion rule


def stability_over_batches(sets: Sequence[tuple[str, ...]]) -> Diagnostic:
    """Whether one batch more or less changes the choice: `tsp_stability` of the leave-batch-out choices of a selector.

    Raises:
        InputError: no set at all.
    """
    value = tsp_stability(sets)
    rare = [f"{name} {100 * share:.0f} %" for name, share in tsp_frequency(sets).items() if share < 1.0]
    comment = "not in every fold: " + ", ".join(rare) if rare else "the same points whichever batch is left out"
    return Diagnostic("stability over batches", value, _STABLE, value >= _STABLE, comment)


def tsp_stability(sets: Sequence[tuple[str, ...]]) -> float:
    """Mean Jaccard similarity |A∩B| / |A∪B| over all pairs of chosen sets; 1 = always the same, 1 for one set.

    Raises:
        InputError: no set at all.
    """
    counted = _counted(sets)
    n = len(sets)
    total = sum(m * (m - 1) / 2 for m in counted.values())  # equal sets have similarity 1
    for (a, m), (b, k) in combinations(counted.items(), 2):
        total += m * k * len(a & b) / len(a | b)
    return total / (n * (n - 1) / 2) if n > 1 else 1.0


def tsp_frequency(sets: Sequence[tuple[str, ...]]) -> dict[str, float]:
    """Share of the sets that hold an input, 0..1, most frequent first (then by name); never chosen ones are absent.

    Raises:
        InputError: no set at all.
    """
    _counted(sets)
    count = Counter(name for chosen in sets for name in set(chosen))
    return {name: c / len(sets) for name, c in sorted(count.items(), key=lambda item: (-item[1], item[0]))}


def _counted(sets: Sequence[tuple[str, ...]]) -> Counter[frozenset[str]]:
    if not sets:
        raise InputError("stability of the chosen points: got no set; expected one per fold")
    return Counter(frozenset(s) for s in sets)
