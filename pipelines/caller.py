"""How the steps of a job run: as plain calls, in threads, each try of an item within a context of the caller's."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import TypeVar

from data.errors import InputError

T = TypeVar("T")
R = TypeVar("R")
Say = Callable[[str], None]  # one line of progress
Done = Callable[[str, int, int], None]  # step, finished, of how many
Working = Callable[[str, str], AbstractContextManager[object]]  # step and label of an item
LANES = max(2, os.cpu_count() or 1)  # concurrent steps: no fewer than the processes of `workers_for`
RETRIES = 2  # for steps that touch a share or a store, where a second try can succeed
RETRY_DELAY_S = 2.0  # for a share or a store to come back


class DirectCaller:
    """Steps as plain calls, in as many threads as there are `lanes`.

    Args:
        working: a context around each try of an item of a step, such as `pipelines.flows.FlowRun.working`.
    """

    def __init__(self, done: Done | None = None, working: Working | None = None, lanes: int = LANES) -> None:
        self.done, self._working, self._lanes = done, working, lanes

    def map(self, step: str, work: Callable[[T], R], items: Sequence[T], retries: int = 0) -> list[R]:
        """`work` on every item, results in the items' order; an exception of any of them is raised."""
        from threadpoolctl import threadpool_limits

        from data.processes import in_threads

        if self._working is not None:
            work = within(self._working, step, work)
        work = counted(step, retried(work, retries), len(items), self.done)
        with threadpool_limits(limits=1):
            if len(items) == 1:  # in this thread, so that Ctrl-C ends it at once
                return [work(items[0])]
            return in_threads(work, items, self._lanes)


def within(working: Working, step: str, work: Callable[[T], R]) -> Callable[[T], R]:
    """`work` in the context of the step and the item's label."""

    def inside(item: T) -> R:
        with working(step, label(item)):
            return work(item)

    return inside


def retried(work: Callable[[T], R], retries: int) -> Callable[[T], R]:
    """`work` with so many more tries after an error, except that of input, which does not improve by waiting."""

    def trying(item: T) -> R:
        for _ in range(retries):
            try:
                return work(item)
            except InputError:
                raise
            except Exception:
                time.sleep(RETRY_DELAY_S)
        return work(item)

    return trying


def counted(step: str, work: Callable[[T], R], of: int, done: Done | None) -> Callable[[T], R]:
    """`work` that reports each item as it is finished, in whatever order and thread."""
    if done is None:
        return work
    lock, finished = threading.Lock(), 0

    def counting(item: T) -> R:
        nonlocal finished
        result = work(item)
        with lock:
            finished += 1
            done(f"{step} {label(item)}".rstrip(), finished, of)
        return result

    return counting


def label(item: object) -> str:
    """An item as progress and task names show it: its label, a name, or names and numbers; else empty."""
    if isinstance(own := getattr(item, "label", None), str):
        return own
    parts = item if isinstance(item, tuple) else (item,)
    return " ".join(map(str, parts)) if all(isinstance(part, str | int) for part in parts) else ""
