"""How well the time that is told fits the time at which an effect was at work."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

Windows = Sequence[tuple[str, float, float]]


def overlap(told: Windows, true: Windows, length_s: Mapping[str, float]) -> float:
    """Intersection over union of both in time, over all batches; 0 where neither has any time (Jaccard 1912)."""
    one, other = _by_batch(told, length_s), _by_batch(true, length_s)
    both = sum(_length(_common(one[b], other[b])) for b in length_s)
    either = sum(_length(one[b]) + _length(other[b]) for b in length_s) - both
    return both / either if either > 0 else 0.0


def always(length_s: Mapping[str, float]) -> list[tuple[str, float, float]]:
    """Every batch from its start to its end."""
    return [(batch, 0.0, seconds) for batch, seconds in length_s.items()]


def _by_batch(windows: Windows, length_s: Mapping[str, float]) -> dict[str, list[tuple[float, float]]]:
    """Merged, in order, within the batch."""
    out: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for batch, start, end in sorted(windows):
        if batch not in length_s:
            continue
        start, end = max(start, 0.0), min(end, length_s[batch])
        if out[batch] and start <= out[batch][-1][1]:
            out[batch][-1] = (out[batch][-1][0], max(end, out[batch][-1][1]))
        elif end > start:
            out[batch].append((start, end))
    return out


def _common(one: Sequence[tuple[float, float]], other: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    return [(max(a, c), min(b, d)) for a, b in one for c, d in other if min(b, d) > max(a, c)]


def _length(windows: Sequence[tuple[float, float]]) -> float:
    return sum(end - start for start, end in windows)
