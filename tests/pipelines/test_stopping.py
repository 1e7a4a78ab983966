"""Ctrl-C and SIGTERM end a training and all its processes within 5 s; the next one goes on where it stopped."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from data.processes import Processes
from pipelines import stopping
from tests.toys.signalled import ROOT, Command
from tests.toys.small_year import write_machine, write_year

LIMIT_S, STARTED_S = 5.0, 600.0  # until a moment is reached on a slow computer


def kept(c: Command) -> set[str]:
    return {p.name for p in c.home.glob("unfinished/*/z__*")}


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="looks for processes below /proc")
@pytest.mark.parametrize(
    ("options", "endless", "number", "group"),
    [
        (["--direct"], "worker", signal.SIGINT, True),
        (["--direct"], "here", signal.SIGTERM, False),
        ([], "worker", signal.SIGTERM, True),
        ([], "here", signal.SIGINT, False),
    ],
)
def test_a_signal_ends_all_processes_and_the_next_run_resumes(
    tmp_path: Path, options: list[str], endless: str, number: int, group: bool
) -> None:
    write_year(tmp_path / "in", 4)
    call = ["train", "--machine", write_machine(tmp_path / "m.yml", "stopped"), "--recordings", tmp_path / "in",
            "--channels", "z", "--selectors", "none", "--families", "endless,zero,mlr", *options]  # fmt: skip

    def begun(endless: str) -> Command:
        return Command(tmp_path / "home", *call, module="tests.toys.endless_training", ENDLESS=endless)

    training = begun(endless)
    assert training.reached(lambda c: kept(c) == {"z__zero", "z__mlr"}, STARTED_S), training.output()
    ended = training.stop(number, group)
    assert (ended.code, ended.seconds < LIMIT_S, ended.left) == (128 + number, True, ()), ended
    last = ended.error.splitlines()[-1]
    assert last.startswith("thermodrift: stopped; 2 finished parts of the crossing kept in ")
    assert "Traceback" not in ended.error
    assert last.endswith("; run the same command to go on")
    assert not list(tmp_path.glob("thermodrift-*"))
    if options and endless == "worker":
        again = begun(endless)
        assert again.reached(lambda c: len(c.processes()) > 2, STARTED_S), again.output()
        said = again.stop(signal.SIGTERM, False).error
        assert "resumes: 2 finished parts of the crossing were crossed on 20" in said


def test_a_worker_ends_with_the_process_that_started_it() -> None:
    code = (
        "import os, time; from data.processes import Processes\n"
        "if __name__ == '__main__':\n"
        "    with Processes(2) as pool:\n"
        "        print(pool.submit(os.getpid)(), flush=True); pool.submit(time.sleep, 600)()"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None and parent.stdout.readline()
    workers = psutil.Process(parent.pid).children(recursive=True)
    parent.kill()
    parent.communicate()
    assert len(workers) >= 2 and not psutil.wait_procs(workers, 10)[1]


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
