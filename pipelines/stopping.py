"""Ctrl-C and SIGTERM end a command within seconds, whatever its threads and processes do at that moment.

An exception in the main thread does not suffice: the main thread may be in compiled code, may wait for a thread that
is, or may run a library that handles the signal itself. Everything that is written is either atomic or unfinished by
its own mark, so that the process may end at any moment.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from data.endings import end_all
from pipelines import console

LIMIT_S = 4.0  # for ending processes and removing scratch files; an operator waits 5 s and then kills
SIGNALS = (signal.SIGINT, signal.SIGTERM)
_note: Callable[[], str] | None = None


def note(summary: Callable[[], str] | None) -> None:
    """What a command that is stopped from now on states, such as what it keeps."""
    global _note
    _note = summary


@contextmanager
def prompt() -> Iterator[None]:
    """In the context, SIGINT and SIGTERM end this process: one line, exit code 128 + signal (130, 143).

    Call it from the main thread. A signal that the caller ignores stays ignored.
    """
    receiver, sender = socket.socketpair()
    sender.setblocking(False)

    def pass_on(number: int, _: Any) -> None:
        sender.send(bytes([number]))

    before = {number: signal.getsignal(number) for number in SIGNALS}
    for number in (n for n in SIGNALS if before[n] is not signal.SIG_IGN):
        signal.signal(number, pass_on)
    # Written by the interpreter's own handler: at once, and also where a library has put its handler in place of ours.
    wakeup = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    watcher = threading.Thread(target=_watch, args=(receiver,), name="stopping", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(wakeup)
        for number, handler in before.items():
            signal.signal(number, handler)
        sender.close()
        watcher.join()  # forever, where a signal came: the watcher ends the process
        receiver.close()


def release() -> None:
    """Leave both signals to a part that ends by itself, within `prompt`."""
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _watch(receiver: socket.socket) -> None:
    while received := receiver.recv(1):
        if received[0] in SIGNALS:
            _stop(received[0])


def _stop(number: int) -> None:
    logging.disable()
    threading.excepthook = lambda args: None  # of threads whose workers are gone
    console.out.quiet = True
    cleaner = threading.Thread(target=_clean, daemon=True)
    cleaner.start()
    cleaner.join(LIMIT_S)
    try:
        console.error(f"stopped; {_note()}" if _note else "stopped")
    finally:
        os._exit(128 + number)


def _clean() -> None:
    end_all()
    sys.stdout.flush()
    # Temporary folders. What is registered with atexit is not called: Prefect's clients wait there for their server.
    weakref.finalize._exitfunc()  # type: ignore[attr-defined]
