"""Refits side by side in processes of their own, started once for a whole diagnosis; one process: in this one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from types import TracebackType
from typing import TypeVar

from threadpoolctl import threadpool_limits

T = TypeVar("T")
R = TypeVar("R")


class Workers:
    """A pool to be used as a context; results come in the order of the items, whatever the number of processes."""

    def __init__(self, processes: int = 1) -> None:
        self.processes = processes
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Workers:
        if self.processes > 1:
            self._pool = ProcessPoolExecutor(self.processes, get_context("spawn"), _one_thread)
            for _ in range(self.processes):
                self._pool.submit(_warm)  # imports go on while the baseline is fitted
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    def map(self, work: Callable[[T], R], items: Sequence[T]) -> Iterator[R]:
        """`work` of every item; it and the items travel to other processes."""
        if self._pool is None or len(items) < 2:
            return map(work, items)
        return self._pool.map(work, items)


def _one_thread() -> None:
    threadpool_limits(limits=1)


def _warm() -> None:
    import twin.diagnosis.search  # noqa: F401
