"""The last few things made from a set of batches: error channels and protocols ask for the same ones again."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from threading import RLock
from typing import Generic, TypeVar

from data.batch import Batch

T = TypeVar("T")


class Recent(Generic[T]):
    """Remembers what was made of the same batch objects under the same key, the last `most` of them."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._held: list[tuple[Hashable, tuple[Batch, ...], T]] = []
        self._lock = RLock()

    def of(self, key: Hashable, batches: tuple[Batch, ...], make: Callable[[], T]) -> T:
        """What is remembered, or what `make` makes now."""
        with self._lock:
            for i, (k, held, thing) in enumerate(self._held):
                if k == key and len(held) == len(batches) and all(a is b for a, b in zip(held, batches, strict=True)):
                    self._held.append(self._held.pop(i))
                    return thing
            made = make()
            self._held = [*self._held, (key, batches, made)][-self._most :]
            return made
