"""One kind of process pool for all rooms: spawned workers, one thread of linear algebra each, shared state sent once.

Nothing outlives a command: a worker ends with the process that started it, Ctrl-C reaches the starting process alone,
and `data.endings.end_all` ends what is under way.

`joblib.Parallel` does not cover this use: it has no single tasks that run next to the caller and come from several of
its threads, no start-up step that loads modules before the first task, and it sends a task's state with every task.
"""

from __future__ import annotations

import os
import pickle
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from functools import lru_cache, partial
from multiprocessing import get_context, parent_process
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

from threadpoolctl import threadpool_limits

from data.endings import ending, without_interrupt

T = TypeVar("T")
R = TypeVar("R")


def in_threads(
    work: Callable[[T], R], items: Sequence[T], n: int, done: Callable[[T, int], object] | None = None
) -> list[R]:
    """`work` of every item in `n` threads, results in the items' order.

    On an error, or Ctrl-C, nothing that waits begins, and what is under way is not waited for.

    Args:
        done: called in this thread with each item as it is finished, and how many are.
    """
    pool = ThreadPoolExecutor(n)
    try:
        futures = [pool.submit(work, item) for item in items]
        which = dict(zip(futures, items, strict=True))
        for k, future in enumerate(as_completed(futures), 1):
            future.result()
            if done:
                done(which[future], k)
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown()
    return [future.result() for future in futures]


def one_thread() -> None:
    """Limit the threads of the libraries that are loaded by now."""
    threadpool_limits(limits=1)


class Processes:
    """A context of `n` worker processes; with n = 1 all work is done in this one. Results do not depend on n.

    Workers are spawned, never forked: a fork of a process that runs threads (an orchestrator's, OpenMP's) can hang.
    What the work raises is raised where its result is taken. Leaving the context begins nothing that still waits; by
    an exception, it also ends what is under way.

    Args:
        start: called in every worker first; the module it stands in is loaded there, before its threads are limited.
        spawn: whether there are worker processes; by default where n > 1.
    """

    def __init__(self, n: int = 1, start: Callable[[], object] = one_thread, spawn: bool | None = None) -> None:
        self.n, self._start, self._spawn = n, start, n > 1 if spawn is None else spawn
        self._pool: ProcessPoolExecutor | None = None
        self._folder: TemporaryDirectory[str] | None = None
        self._n_shared = 0
        self._submitting = threading.Lock()
        self._open = ExitStack()

    def __enter__(self) -> Self:
        if self._spawn:
            self._folder = TemporaryDirectory(prefix="thermodrift-")
            self._pool = ProcessPoolExecutor(self.n, get_context("spawn"), _begin, (self._start,))
            self._open.enter_context(ending(self.end))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()
        if kind is not None:
            self.end()
        if self._pool is not None and self._folder is not None:
            self._pool.shutdown(cancel_futures=True)
            self._folder.cleanup()
            self._pool = self._folder = None

    def end(self) -> None:
        """Kill the workers, from any thread; whoever waits for a result gets BrokenProcessPool."""
        with self._submitting:  # no worker is being started
            if self._pool is not None and self._folder is not None:
                for worker in list((self._pool._processes or {}).values()):  # kill_workers() from Python 3.14 on
                    worker.kill()
                self._pool.shutdown(cancel_futures=True)
                self._folder.cleanup()

    def warm_up(self) -> None:
        """Start all workers now, so that their imports go on while this process does other work."""
        for _ in range(self.n if self._pool is not None else 0):
            self.submit(self._start)

    def shared(self, value: T) -> Shared[T]:
        """A handle on state that every worker loads once, however many tasks use it."""
        if self._folder is None:
            return Shared(None, value)
        path = Path(self._folder.name) / str(self._n_shared)
        path.write_bytes(pickle.dumps(value, pickle.HIGHEST_PROTOCOL))
        self._n_shared += 1
        return Shared(path, None)

    def submit(self, work: Callable[..., R], *args: Any) -> Callable[[], R]:
        """Begin work in a worker; what is returned waits for its result (without workers it does the work itself)."""
        return partial(work, *args) if self._pool is None else self._submitted(work, *args).result

    def map(self, work: Callable[[T], R], items: Sequence[T]) -> Iterator[R]:
        """`work` of every item, in their order; `work` with its state travels once."""
        if self._pool is None or len(items) < 2:
            return map(work, items)
        held = self.shared(work)
        futures = [self._submitted(_applied, held, item) for item in items]
        return (future.result() for future in futures)

    def completed(self, work: Callable[..., R], items: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, R]]:
        """(Index, ``work(*item)``) of every item as it is done."""
        if self._pool is None:
            yield from ((k, work(*item)) for k, item in enumerate(items))
            return
        waiting: dict[Future[R], int] = {self._submitted(work, *item): k for k, item in enumerate(items)}
        yield from ((waiting[f], f.result()) for f in as_completed(waiting))

    def _submitted(self, work: Callable[..., R], *args: Any) -> Future[R]:
        """A submission may start a worker."""
        assert self._pool is not None
        with self._submitting, without_interrupt():
            return self._pool.submit(work, *args)


class Shared(Generic[T]):
    """State in a file of this session, or the value itself where there is one process."""

    def __init__(self, path: Path | None, value: T | None) -> None:
        self._path, self._value = path, value

    def get(self) -> T:
        value: Any = self._value if self._path is None else _loaded(self._path)
        return value


@lru_cache(maxsize=1)
def _loaded(path: Path) -> Any:
    value = pickle.loads(path.read_bytes())  # noqa: S301 - written by this session
    one_thread()  # of the libraries that the value brought along, too
    return value


def _begin(start: Callable[[], object]) -> None:
    """First call in a worker."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    start()


def _end_with_parent() -> None:
    """A killed parent leaves its workers waiting for tasks for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _applied(work: Shared[Callable[[T], R]], item: T) -> R:
    return work.get()(item)
