"""Ctrl-C and SIGTERM end a training and all its processes within 5 s; the next one goes on where it stopped."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from data.processes import Processes
from pipelines import stopping
from tests.toys.small_year import write_machine, write_year

ROOT = Path(__file__).parents[2]
LIMIT_S = 5.0
pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes below /proc")


def of_session(leader: int) -> list[str]:
    """Command lines of the living processes of a session."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state, *numbers = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(numbers[2]) == leader and state != "Z":
                found.append((folder / "cmdline").read_text().replace("\0", " "))
        except (FileNotFoundError, ProcessLookupError):
            pass
    return found


def wait_for(condition: Callable[[], object], limit_s: float) -> bool:
    end_s = time.monotonic() + limit_s
    while not (reached := bool(condition())) and time.monotonic() < end_s:
        time.sleep(0.05)
    return reached


class Training:
    """A training in a session of its own."""

    def __init__(self, folder: Path, *more: str, **environment: str) -> None:
        machine = write_machine(folder / "m.yml", "stopped")
        write_year(folder / "in", 4)
        command = ["-m", "tests.toys.endless_training", "train", "--machine", machine, "--recordings", folder / "in",
                   "--channels", "z", "--selectors", "none", *more]  # fmt: skip
        self.home = folder / "home"
        self.process = subprocess.Popen(
            [sys.executable, *map(str, command)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "THERMODRIFT_HOME": str(self.home), "TMPDIR": str(folder), **environment},
            start_new_session=True,
        )  # fmt: skip

    def kept(self) -> set[str]:
        return {p.name for p in self.home.glob("unfinished/*/z__*")}

    def stop(self, number: int, group: bool) -> tuple[int, float, str]:
        """Exit code, seconds from the signal on, and standard error."""
        begun_s = time.monotonic()
        (os.killpg if group else os.kill)(self.process.pid, number)
        error = self.process.communicate(timeout=60)[1]  # at its end every process that shares the pipe is gone
        return self.process.returncode, time.monotonic() - begun_s, error


@pytest.mark.integration
@pytest.mark.parametrize(
    ("options", "endless", "number", "group"),
    [
        pytest.param(["--direct"], "worker", signal.SIGINT, True, marks=pytest.mark.slow),
        pytest.param(["--direct"], "here", signal.SIGTERM, False, marks=pytest.mark.slow),
        pytest.param([], "worker", signal.SIGTERM, True, marks=pytest.mark.slow),
        pytest.param([], "here", signal.SIGINT, False, marks=pytest.mark.slow),
    ],
)
def test_a_signal_ends_all_processes_and_the_next_run_resumes(
    tmp_path: Path, options: list[str], endless: str, number: int, group: bool
) -> None:
    families = ("--families", "endless,zero,mlr")
    training = Training(tmp_path, *families, *options, ENDLESS=endless)
    assert wait_for(lambda: training.kept() == {"z__zero", "z__mlr"} or training.process.poll() is not None, 120)
    code, seconds, error = training.stop(number, group)
    assert wait_for(lambda: not of_session(training.process.pid), 1), of_session(training.process.pid)
    assert (code, seconds < LIMIT_S) == (128 + number, True), (code, seconds, error)
    last = error.splitlines()[-1]
    assert last.startswith("thermodrift: stopped; 2 finished parts of the crossing kept in ")
    assert "Traceback" not in error
    assert last.endswith("; run the same command to go on")
    assert not list(tmp_path.glob("thermodrift-*"))
    if options and endless == "worker":
        again = Training(tmp_path, *families, *options)
        assert wait_for(lambda: len(of_session(again.process.pid)) > 2 or again.process.poll() is not None, 120)
        assert "resumes: 2 finished parts of the crossing were crossed on 20" in again.stop(signal.SIGTERM, False)[2]


def test_a_worker_ends_with_the_process_that_started_it() -> None:
    code = (
        "import os, time; from data.processes import Processes\n"
        "if __name__ == '__main__':\n"
        "    with Processes(2) as pool:\n"
        "        print(pool.submit(os.getpid)(), flush=True); pool.submit(time.sleep, 600)()"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert parent.stdout is not None and parent.stdout.readline()
    parent.kill()
    parent.communicate()
    assert wait_for(lambda: not of_session(parent.pid), 10)


def test_an_exception_does_not_wait_for_what_is_under_way() -> None:
    begun_s = time.monotonic()
    with pytest.raises(KeyboardInterrupt), Processes(2) as pool:
        pool.submit(os.getpid)()
        pool.submit(time.sleep, 600)
        raise KeyboardInterrupt
    assert time.monotonic() - begun_s < 60


def test_without_a_signal_everything_is_as_before() -> None:
    before = [signal.getsignal(n) for n in stopping.SIGNALS]
    with pytest.raises(ValueError, match="mine"), stopping.prompt():
        assert signal.getsignal(signal.SIGTERM) != before[1]
        raise ValueError("mine")
    assert [signal.getsignal(n) for n in stopping.SIGNALS] == before
