"""How the steps of a job run: as plain calls here, as tasks of a flow in `pipelines.flows`."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

T = TypeVar("T")
R = TypeVar("R")
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
        from threadpoolctl import threadpool_limits

        from data.processes import in_threads

        work = counted(step, work, len(items), self.done)
        with threadpool_limits(limits=1):
            if len(items) == 1:  # in this thread, so that Ctrl-C ends it at once
                return [work(items[0])]
            return in_threads(work, items, LANES)


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
