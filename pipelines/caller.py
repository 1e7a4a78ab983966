"""How the steps of a job run: as plain calls here, as tasks of a flow in `pipelines.flows`."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, TypeVar

from threadpoolctl import threadpool_limits

T = TypeVar("T")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)
Say = Callable[[str], None]  # one line of progress
Done = Callable[[str, int, int], None]  # step, finished, of how many
LANES = max(2, os.cpu_count() or 1)  # concurrent steps: no fewer than the processes of `workers_for`
RETRIES = 2  # for steps that touch a share or a store, where a second try can succeed


class Caller(Protocol):
    """How steps run."""

    def map(self, step: str, work: Callable[[T], R], items: Sequence[T], retries: int = 0) -> list[R]:
        """`work` on every item, results in the items' order; an exception of any of them is raised."""


class DirectCaller:
    """Steps as plain calls, up to `LANES` at a time."""

    def __init__(self, done: Done | None = None) -> None:
        self.done = done

    def map(self, step: str, work: Callable[[T], R], items: Sequence[T], retries: int = 0) -> list[R]:
        if len(items) == 1:  # in this thread, so that Ctrl-C ends it at once
            with threadpool_limits(limits=1):
                only = work(items[0])
            if self.done:
                self.done(step, 1, 1)
            return [only]
        with threadpool_limits(limits=1), ThreadPoolExecutor(LANES) as pool:
            return gather(step, [pool.submit(work, item) for item in items], self.done)


class Future(Protocol[R_co]):
    """A submitted step, in a thread pool or in Prefect."""

    def result(self) -> R_co:
        """Wait for the step; raises what it raised."""


def gather(step: str, futures: Sequence[Future[R]], done: Done | None) -> list[R]:
    """Results in the order of submission; `done` hears of each."""
    results: list[R] = []
    for future in futures:
        results.append(future.result())
        if done:
            done(step, len(results), len(futures))
    return results
