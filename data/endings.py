"""What is to be ended when a command ends: worker processes, servers, a progress bar.

Every command imports this at its start, so it imports little.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_endings: dict[object, Callable[[], object]] = {}


def at_end(end: Callable[[], object]) -> None:
    """`end_all` calls `end`, from any thread."""
    _endings[object()] = end


@contextmanager
def ending(end: Callable[[], object]) -> Iterator[None]:
    """`at_end` while the context is open."""
    key = object()
    _endings[key] = end
    try:
        yield
    finally:
        _endings.pop(key, None)


def end_all() -> None:
    """End at once what runs outside of this process, the last begun first."""
    while _endings:
        _endings.popitem()[1]()


@contextmanager
def without_interrupt() -> Iterator[None]:
    """Processes that this thread starts in the context do not receive Ctrl-C: this process decides when they end."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
