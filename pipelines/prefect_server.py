"""Prefect's temporary server, and the engine that works with one.

It takes as long to come up as the rest of the program to be imported: it is started first.
"""

from __future__ import annotations

import atexit
import threading
import time
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING

from prefect import settings as prefect_settings
from prefect.server.api.server import SubprocessASGIServer

from data.endings import at_end, without_interrupt
from pipelines.caller import Done, Say
from pipelines.engine import no_address
from pipelines.jobs.request import TrainRequest
from pipelines.settings import Settings

if TYPE_CHECKING:
    from pipelines.jobs.training import TrainOutcome

SERVER_START_S = 180  # its imports on a busy computer
POPEN_S = 1.0  # for the operating system to start a process


def start_server() -> threading.Thread | None:
    """Start Prefect's temporary server in the background, so that it comes up while other work goes on.

    None where PREFECT_API_URL names a running one. The flow finds the same server again. Prefect starts this server
    by itself as well, but only when the flow begins, and has no public way to start it earlier or to stop it.
    """
    if prefect_settings.PREFECT_API_URL.value():
        return None
    thread = threading.Thread(target=_serve, daemon=True)
    thread.start()
    at_end(partial(_kill_server, thread))
    return thread


def _serve() -> None:
    with without_interrupt(), suppress(RuntimeError):  # too late: the flow waits for it, or starts another
        SubprocessASGIServer().start(timeout=SERVER_START_S)


def _kill_server(starting: threading.Thread) -> None:
    """Its own way to stop may take 5 s, and lets a client that misses it start another one.

    Its store is SQLite, which a kill leaves in order.
    """
    server = SubprocessASGIServer()
    server.running = True  # so that none is started from now on
    atexit.unregister(server.stop)
    end_s = time.monotonic() + POPEN_S
    while server.server_process is None and starting.is_alive() and time.monotonic() < end_s:
        time.sleep(0.01)
    if server.server_process is not None:
        server.server_process.kill()
        server.server_process.wait()


class PrefectEngine:
    """Trainings as Prefect flows, on the server that PREFECT_API_URL names, else on a temporary one."""

    def __init__(self, address: str | None = None) -> None:
        if address is not None:
            raise no_address("prefect")
        self._server = start_server()

    def train(
        self, request: TrainRequest, settings: Settings, say: Say = lambda text: None, done: Done | None = None
    ) -> TrainOutcome:
        """See `flows.train_in_flow`."""
        from pipelines.flows import train_in_flow

        return train_in_flow(request, settings, say, done, self._server)
