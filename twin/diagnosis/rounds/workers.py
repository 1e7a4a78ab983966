"""Refits side by side in processes of their own, started once for a whole diagnosis; one process: in this one."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

T = TypeVar("T")
R = TypeVar("R")
Progress = Callable[[str, int, int], None]  # told of a step, how many of it are done, and of how many


class Workers:
    """A pool to be used as a context; results come in the order of the items, whatever the number of processes."""

    def __init__(self, processes: int = 1) -> None:
        self.processes = processes
        self._pool: ProcessPoolExecutor | None = None
        self._folder: TemporaryDirectory[str] | None = None
        self._sent = 0

    def __enter__(self) -> Workers:
        if self.processes > 1:
            self._folder = TemporaryDirectory(prefix="thermodrift-")
            self._pool = ProcessPoolExecutor(self.processes, get_context("spawn"), _begin)
            for _ in range(self.processes):
                self._pool.submit(_begin)  # imports go on while the baseline is fitted
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None and self._folder is not None:
            self._pool.shutdown(cancel_futures=True)
            self._folder.cleanup()
            self._pool = self._folder = None

    def map(self, work: Callable[[T], R], items: Sequence[T]) -> Iterator[R]:
        """`work` of every item; it travels to other processes once for all items, through a file of this session."""
        if self._pool is None or self._folder is None or len(items) < 2:
            return map(work, items)
        path = Path(self._folder.name) / str(self._sent)
        path.write_bytes(pickle.dumps(work, pickle.HIGHEST_PROTOCOL))
        self._sent += 1
        return self._pool.map(partial(_do, path), items)

    def beside(self, work: Callable[[], R]) -> Callable[[], R]:
        """Work begun in another process while this one goes on; what is returned waits for it."""
        return work if self._pool is None else self._pool.submit(work).result


def _do(path: Path, item: Any) -> Any:
    return _work(path)(item)


@lru_cache(maxsize=1)
def _work(path: Path) -> Callable[[Any], Any]:
    """The last work that came, kept for its other items."""
    work: Callable[[Any], Any] = pickle.loads(path.read_bytes())  # noqa: S301 - written by this session
    return work


def _begin() -> None:
    """All that work needs is loaded first, since threads are limited of what is loaded."""
    import twin.diagnosis.rounds.search  # noqa: F401

    threadpool_limits(limits=1)
