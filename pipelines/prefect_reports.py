"""The way of a job's reports to Prefect: a process that begins to come up while the rest of the program is imported,
takes what it is given without an answer, and ends with this process."""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
import threading
from contextlib import suppress
from typing import Any

from data.endings import at_end, without_interrupt
from pipelines import console
from pipelines.prefect_process import END_S

PROCESS = (sys.executable, "-m", "pipelines.prefect_process")
STOP_S = 1.0  # to report that the job was stopped; an operator waits 5 s for all of it


class Reports:
    """An open way to `pipelines.prefect_process`.

    No method raises because of Prefect, and only `close` waits for it, at most `END_S`. Where a report may be lost, one
    line on the console says so.
    """

    def __init__(self) -> None:
        self._sending, self._saying = threading.Lock(), threading.Lock()
        self._begun = self._said = self._over = False
        self._why = ""  # what the process last said of a server that does not answer
        self._process: subprocess.Popen[bytes] | None = None
        try:
            self._process = _started()
        except OSError as error:
            self._lose(f"its process cannot be started ({error.strerror or error})")
            return
        self._listener = threading.Thread(target=self._listen, args=(self._process,), daemon=True)
        self._listener.start()
        at_end(self.stop)
        atexit.register(self.stop)

    def send(self, what: str, **report: Any) -> None:
        """Hand over a report, from any thread; `prefect_process.Record` has their kinds."""
        if self._process is None or self._process.stdin is None:
            return
        line = json.dumps({"what": what, **report}, default=str).encode() + b"\n"
        with self._sending:
            self._begun = True
            try:
                whole = os.write(self._process.stdin.fileno(), line) == len(line)
            except BlockingIOError:
                whole = False
            except (OSError, ValueError):  # it ended, and `_listen` says why; or `stop` was called
                return
        if not whole:  # the pipe is full
            self._lose("its process hangs")

    def close(self) -> None:
        """Wait until all is delivered, at most `END_S`."""
        if self._process is None:
            return
        self._end_input(self._process)
        try:
            self._process.wait(END_S)
            self._listener.join(STOP_S)
        except subprocess.TimeoutExpired:
            self._lose(self._why or f"its server did not take all reports within {END_S:g} s after the job")
        self._kill(self._process)

    def stop(self) -> None:
        """End the process, which may still report within `STOP_S` that the job was ended."""
        if self._process is None:
            return
        self._over = True
        self._end_input(self._process)
        if self._begun:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(STOP_S)
        self._kill(self._process)

    def _end_input(self, process: subprocess.Popen[bytes]) -> None:
        with self._sending:
            if process.stdin is not None:
                process.stdin.close()

    def _kill(self, process: subprocess.Popen[bytes]) -> None:
        """Its database is SQLite, which a kill leaves in order."""
        self._over = True
        process.kill()
        process.wait()
        atexit.unregister(self.stop)

    def _listen(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        with process.stdout as answers:
            for line in answers:
                kind, _, self._why = line.decode().strip().partition(" ")
                if kind == "lost":
                    self._lose(self._why)
        if (code := process.wait()) != 0:
            self._lose(f"its process ended with exit code {code}")

    def _lose(self, why: str) -> None:
        with self._saying:
            if self._said or self._over:
                return
            self._said = True
        console.note(f"Prefect: {why}; its record of this run is incomplete, the job does not depend on it")


def _started() -> subprocess.Popen[bytes]:
    with without_interrupt():
        process = subprocess.Popen(
            PROCESS, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0,
            start_new_session=True,
        )  # fmt: skip
    if hasattr(os, "set_blocking") and process.stdin is not None:  # so that a process that hangs holds nobody up
        os.set_blocking(process.stdin.fileno(), False)
    return process
