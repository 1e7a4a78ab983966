"""SIGTERM and Ctrl-C end every long command within 5 s, whatever it does at that moment, and nothing survives."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from plants.sample.sample_year import write_sample_year
from tests.toys.one_round import write_fleet
from tests.toys.signalled import Command
from tests.toys.small_year import write_machine, write_year

ROOT = Path(__file__).parents[2]
SAMPLE = ROOT / "machines" / "sample_vmc.yml"
LIMIT_S = 5.0
STARTED_S = 600.0  # until a moment is reached on a slow computer
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="looks for processes below /proc"),
]
Moment = float | Callable[[Command], object]


def printed(text: str) -> Moment:
    return lambda c: text in c.output()


def unfinished(c: Command) -> object:
    """The grid has kept a family, so that it is under way."""
    return list(c.home.glob("unfinished/*/z__*"))


def server(c: Command) -> object:
    return [line for line in c.processes().values() if "prefect_process" in line]


def workers(c: Command) -> object:
    return [line for line in c.processes().values() if "spawn_main" in line]


def then(moment: Moment, wait_s: float) -> Moment:
    """Some time after a moment."""

    def both(c: Command) -> bool:
        if callable(moment) and not moment(c):
            return False
        time.sleep(wait_s)
        return True

    return both


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small machine with a promoted model in `promoted`, and recordings of the sample machine in `year`."""
    folder = tmp_path_factory.mktemp("signals")
    write_machine(folder / "m.yml", "small")
    write_year(folder / "in", 9)
    for file in write_sample_year(folder / "whole")[::6]:
        (folder / "year").mkdir(exist_ok=True)
        shutil.copy(file, folder / "year")
    return folder


@pytest.fixture(scope="module")
def promoted(given: Path) -> Path:
    home = given / "promoted"
    command = Command(home, "train", *train(given), "--families", "zero,ridge,mlr", "--direct")
    assert command.process.wait(300) == 0, command.output()
    return home


def train(given: Path) -> list[object]:
    return ["--machine", given / "m.yml", "--recordings", given / "in", "--channels", "z", "--selectors", "none"]


ARGUMENTS: dict[str, Callable[[Path], list[object]]] = {
    "train": lambda g: ["train", *train(g), "--families", "zero,mlr"],
    "train direct": lambda g: ["train", *train(g), "--families", "zero,mlr", "--direct"],
    "train workers": lambda g: ["train", *train(g), "--families", "zero,bp", "--direct"],
    "train torch": lambda g: ["train", *train(g), "--families", "zero,lstm", "--direct"],
    "train torch in flow": lambda g: ["train", *train(g), "--families", "zero,lstm"],
    "ingest": lambda g: ["ingest", g / "whole", "--machine", SAMPLE],
    "schedule": lambda g: ["schedule", "--machine", g / "m.yml", "--recordings", g / "in", "--cron", "0 5 * * 1"],
    "schedule run": lambda g: ["schedule", write_fleet(g / "fleet.yml", g / "m.yml", g / "in")],
    "diagnose": lambda g: ["diagnose", "--machine", SAMPLE, "--recordings", g / "year", "--out",
                           g / f"diagnosis{time.monotonic_ns()}"],
    "calibrate": lambda g: ["calibrate", "--machine", SAMPLE, "--recordings", g / "year", "--out",
                            g / f"calibrated{time.monotonic_ns()}.yml"],
    "demonstrate": lambda g: ["demonstrate", "--seed", 1, "--out", g / f"demonstration{time.monotonic_ns()}"],
    "reproduce": lambda g: ["reproduce", "all", "--seeds", 3, "--out", g / f"reproduced{time.monotonic_ns()}"],
    "simulate": lambda g: ["simulate", "--sample-year", "--out", g / f"simulated{time.monotonic_ns()}"],
    "status": lambda g: ["status"],
    "compensate": lambda g: ["compensate", "models:/small-z@champion"],
    "rehearse": lambda g: ["rehearse", "models:/small-z@champion", "--recordings", g / "in", "--sample-s", "1"],
    "describe": lambda g: ["describe", *sorted((g / "whole").glob("*.csv")), "--out",
                            g / f"drafted{time.monotonic_ns()}.yml"],
}  # fmt: skip
OF_PROMOTED = {"compensate", "rehearse"}
OF_EXAM = {"demonstrate", "reproduce"}  # commands of another distribution
TERM, INT = signal.SIGTERM, signal.SIGINT
MAKING_STORE = printed("first use")
CASES: list[tuple[str, str, Moment, int]] = [
    ("train", "start", 0.1, INT),
    ("train", "imports", 1.2, TERM),
    ("train", "server comes up", server, INT),
    ("train", "first store", then(MAKING_STORE, 1.0), TERM),
    ("train", "track", then(printed("track"), 0.3), INT),
    ("train", "promote", then(printed("promote"), 0.3), TERM),
    ("train", "report", printed("report"), INT),
    ("train workers", "workers start", workers, TERM),
    ("train workers", "in the grid", then(workers, 4.0), INT),
    ("train direct", "first store", then(MAKING_STORE, 3.0), INT),
    ("train direct", "track", then(printed("track"), 0.5), TERM),
    ("train torch", "in the fit", then(unfinished, 3.0), INT),
    ("train torch", "in the fit, terminated", then(unfinished, 6.0), TERM),
    ("train torch in flow", "in the fit", then(unfinished, 3.0), TERM),
    ("ingest", "reads", printed("3/30"), INT),
    ("ingest", "reads, terminated", printed("9/30"), TERM),
    ("schedule", "waits", then(printed("next at"), 0.5), TERM),
    ("schedule", "waits, interrupted", then(printed("next at"), 0.5), INT),
    ("schedule run", "server comes up", server, TERM),
    ("schedule run", "in a round", then(unfinished, 0.5), INT),
    ("schedule run", "in a round, terminated", then(unfinished, 2.0), TERM),
    ("diagnose", "begins", 4.0, TERM),
    ("diagnose", "workers", then(workers, 4.0), INT),
    ("diagnose", "workers, terminated", then(workers, 15.0), TERM),
    ("calibrate", "fits", 6.0, INT),
    ("calibrate", "fits, terminated", 9.0, TERM),
    ("demonstrate", "begins", 6.0, INT),
    ("demonstrate", "diagnoses", 25.0, TERM),
    ("reproduce", "simulates", 6.0, INT),
    ("reproduce", "workers", then(workers, 6.0), TERM),
    ("simulate", "writes", 1.5, INT),
    ("status", "first store", then(printed("first use"), 1.0), INT),
    ("status", "imports", 2.0, TERM),
    ("compensate", "waits for samples", 7.0, INT),
    ("compensate", "waits for samples, terminated", 7.0, TERM),
    ("rehearse", "plays", 6.0, INT),
    ("describe", "reads", 2.0, TERM),
]
SMALL = ("train workers", "workers start")


def parameters() -> Iterator[object]:
    for name, moment, when, number in CASES:
        marks = [] if (name, moment) == SMALL else [pytest.mark.slow]
        if name in OF_EXAM and not entry_points(group="thermodrift.commands", name=name):
            continue
        yield pytest.param(name, when, number, id=f"{name}-{moment}-{signal.Signals(number).name}", marks=marks)


@pytest.mark.parametrize(("name", "when", "number"), list(parameters()))
def test_a_signal_ends_the_command(
    name: str, when: Moment, number: int, given: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    home = request.getfixturevalue("promoted") if name in OF_PROMOTED else tmp_path / "home"
    reading, writing = os.pipe()  # standard input that stays open and is silent
    command = Command(home, *ARGUMENTS[name](given), stdin=reading)
    os.close(reading)
    try:
        if callable(when):
            assert command.reached(when, STARTED_S), f"the moment did not come: {command.output()}"
        else:
            with suppress(subprocess.TimeoutExpired):
                command.process.wait(when)
        assert command.process.poll() is None, f"it ended too soon: {command.output()}"
        ended = command.stop(number, group=number == INT)
    finally:
        command.kill()
        os.close(writing)
    assert not ended.left, ended
    assert ended.seconds < LIMIT_S, ended
    if not callable(when) and ended.code == -number:
        return  # Python was still loading the command; a shell reports 128 + signal all the same
    assert ended.code == 128 + number, ended
    assert "Traceback" not in ended.error, ended
