"""A command in a process group of its own: start it, wait for a moment, send a signal, and see what is left of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
LINGER_S = 1.0  # for the system to take away what was killed
_MARK = "THERMODRIFT_TEST_MARK"


@dataclass(frozen=True)
class Ended:
    """Exit code, seconds from the signal to the end, standard error, and command lines of what survived."""

    code: int
    seconds: float
    error: str
    left: tuple[str, ...]


class Command:
    """`thermodrift ARGS` with a home and temporary files of its own.

    All of its processes are found by a mark in their environment, also those that leave the group.
    """

    def __init__(
        self, home: Path, *arguments: object, module: str = "pipelines.cli", stdin: int = subprocess.DEVNULL,
        **environment: str,
    ) -> None:  # fmt: skip
        home.mkdir(parents=True, exist_ok=True)
        self.home, self.mark = home, uuid.uuid4().hex
        self.log = home.with_name(f"{home.name}-{self.mark[:8]}.log")
        own = {
            "THERMODRIFT_HOME": str(home), "TMPDIR": str(home.parent), "OMP_NUM_THREADS": "1", _MARK: self.mark,
            **environment,
        }  # fmt: skip
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", module, *map(str, arguments)], cwd=ROOT, stdin=stdin, stdout=log, stderr=log,
                env={**os.environ, **own}, start_new_session=True,
            )  # fmt: skip

    def processes(self) -> dict[int, str]:
        """Living processes by id, with their command lines."""
        needle, found = f"{_MARK}={self.mark}".encode(), {}
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                if (folder / "stat").read_text().rpartition(")")[2].split()[0] == "Z":
                    continue
                if needle in (folder / "environ").read_bytes().split(b"\0"):
                    found[int(folder.name)] = (folder / "cmdline").read_text().replace("\0", " ")
            except (FileNotFoundError, ProcessLookupError, PermissionError):
                pass
        return found

    def output(self) -> str:
        return self.log.read_text(encoding="utf-8", errors="replace")

    def reached(self, condition: Callable[[Command], object], limit_s: float) -> bool:
        """Wait for a condition; False where the command ends first or the time is up."""
        end_s = time.monotonic() + limit_s
        while self.process.poll() is None and time.monotonic() < end_s:
            if condition(self):
                return True
            time.sleep(0.02)
        return bool(condition(self)) and self.process.poll() is None

    def stop(self, number: int, group: bool, limit_s: float = 60.0) -> Ended:
        """Send the signal to the process, or to its group as a terminal does, and wait for the end of all."""
        begun_s = time.monotonic()
        (os.killpg if group else os.kill)(self.process.pid, number)
        try:
            code = self.process.wait(limit_s)
        except subprocess.TimeoutExpired:
            code = -1000
        seconds = time.monotonic() - begun_s
        end_s = time.monotonic() + LINGER_S
        while (left := self.processes()) and time.monotonic() < end_s:
            time.sleep(0.05)
        self.kill()
        return Ended(code, seconds, self.output(), tuple(left.values()))

    def kill(self) -> None:
        """End whatever is left, so that no test leaves anything behind."""
        for pid in self.processes():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()
