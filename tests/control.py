"""Compensation and receiver in closed loop: `python -m tests.control [--streams 10000] [--kills 100] [--table CSV]`.

A stream is a life of a toy machine in simulated time: the loop of the compensation answers samples that are late,
repeated, stamped ahead or behind, not numbers, frozen, stepped or of exchanged sensors, while clocks are set, the
process ends or is killed and starts again, and the receiver of an export moves what arrives. A kill ends the command
`compensate` in real time, by SIGKILL, SIGTERM or the end of its input, and starts it again at the same receiver.
The receiver is the C that the export writes, where gcc is installed, else its core in Python. Each kill prints a line,
and each stream that breaks something.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import shutil
import signal
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from compensation.safety import Limits
from tests.chaos import LOADED, become
from tests.hostile import LIMITS, ROUNDING_UM, Control, Loop, Receiver, Stream, receiver
from tests.toys.signalled import ROOT
from tests.toys.small_year import write_machine, write_year

# ----- kills of the command, in real time

ENDS = ("SIGKILL", "SIGTERM", "SIGTERM, then SIGKILL", "end of the input")
AT_ONCE = 25  # commands that run next to each other, since each waits for its warm-up most of the time
RATE_UM_PER_S, SAMPLE_S, STEP_S = 1.0, 1.0, 10.0
AT_CONTROL = Limits(max_offset_um=60.0, rate_um_per_s=RATE_UM_PER_S, warm_up_s=2.0)
SENDER = Limits()  # of the command, but for size and rate
PATIENCE_S = 5.0  # of a busy computer, beyond the warm-up and two of its largest intervals
LONGEST_S = 300.0  # for a command to start, to act or to end


class Machine:
    """A computer next to a control, on which the command is ended and started again."""

    def __init__(
        self, folder: Path, model: Path, values: dict[str, float], numbers: Iterable[int], seed: int, own: Receiver
    ) -> None:
        self.folder, self.model, self.values, self.seed = folder, model, values, seed
        self.numbers, self.done = list(numbers), list[Loop]()
        self.control = Control(own, AT_CONTROL)
        self.cycled_s, self.sent_um, self.sent_s, self.lives = time.monotonic(), math.nan, 0.0, 0
        self.start()

    def start(self) -> None:
        """The command, as a fork that shares what this process has imported."""
        self.lives += 1
        self.log, self.read = self.folder / f"{self.lives}.log", 0
        self.log.touch()
        reading, self.stdin = os.pipe()
        argv = [
            "pipelines.cli", "compensate", str(self.model), "--state", str(self.folder / "state.json"), "--from", "-",
            "--period-s", str(STEP_S), "--sample-s", str(SAMPLE_S), "--rate-um-per-s", str(RATE_UM_PER_S),
        ]  # fmt: skip
        sys.stdout.flush()
        if not (pid := os.fork()):
            become(self.folder, self.log, argv, reading)
        os.close(reading)
        self.pid, self.began_s, self.samples, self.active = pid, time.monotonic(), 0, 0
        self.given, self.first_s, self.last_s, self.gap_s = set[float](), math.nan, math.nan, SAMPLE_S
        self.active_s, self.moving = math.nan, False
        self.ends_s, self.ended, self.killed_s = math.inf, "", math.inf
        self.dice = random.Random(f"{self.seed} {self.numbers[0] if self.numbers else 'last'}")

    def cycle(self, valid: bool = True, um: float | None = None) -> None:
        now_s = time.monotonic()
        self.control.cycle(now_s - self.cycled_s, um, valid)
        self.cycled_s = now_s

    def turn(self) -> bool:
        """A second of this machine; False once all its commands have ended."""
        self.answers()
        ended, status = os.waitpid(self.pid, os.WNOHANG)
        if ended:
            self.answers()
            return self.over(os.waitstatus_to_exitcode(status))
        now_s = time.monotonic()
        if now_s >= self.killed_s:
            os.kill(self.pid, signal.SIGKILL)
        elif not self.ended and now_s >= self.ends_s:
            self.end()
        elif not self.ended:
            noisy = {name: value + self.dice.gauss(0.0, 0.02) for name, value in self.values.items()}
            sample = {"time_s": time.time(), **noisy}
            self.given.add(sample["time_s"])
            with contextlib.suppress(BrokenPipeError):
                os.write(self.stdin, (json.dumps(sample) + "\n").encode())
        if now_s - self.began_s > LONGEST_S:
            self.control.must(False, "hangs", self.log.read_text(encoding="utf-8", errors="replace")[-300:])
            os.kill(self.pid, signal.SIGKILL)
        return True

    def answers(self) -> None:
        """What the command has sent since the last turn, through the receiver."""
        with self.log.open("rb") as file:
            file.seek(self.read)
            whole = file.read().rpartition(b"\n")[0]
        self.read += len(whole) + bool(whole)
        records = [json.loads(line) for line in whole.splitlines() if line.startswith(b"{")]
        for record in records:
            self.answered(record)
        if not records:
            self.cycle()

    def answered(self, record: dict[str, Any]) -> None:
        um, state, time_s = record["offset_um"]["z"], record["state"]["z"], record["time_s"]
        must = self.control.must
        must(not abs(um - self.sent_um) > SENDER.step_um + ROUNDING_UM, "step sent", f"{self.sent_um} to {um} µm")
        self.moving, self.sent_um, self.sent_s = um != self.sent_um, um, time_s
        self.cycle(um=um)
        if time_s not in self.given:
            return
        self.samples += 1
        self.active += state == "active"
        if not time_s - self.last_s <= SENDER.stale_s:  # the first one, or this computer was so busy: warm-up begins
            self.first_s, self.gap_s, self.last_s = time_s, SAMPLE_S, time_s
        self.gap_s, self.last_s = max(self.gap_s, time_s - self.last_s), time_s
        late_s = time_s - self.first_s - SENDER.warm_up_s - 2.0 * self.gap_s
        if state == "active" and math.isnan(self.active_s):
            self.active_s = time_s - self.first_s
            must(late_s <= PATIENCE_S, "not active again", f"{self.active_s} s after a restart")
            self.ends_s = time.monotonic() + self.dice.uniform(0.0, 15.0)
        elif math.isnan(self.active_s) and late_s > LONGEST_S / 2.0:
            must(False, "not active again", record["reasons"]["z"])
            self.ends_s = 0.0

    def end(self) -> None:
        """The end of this life, of the kind that is due."""
        self.ended = ENDS[self.numbers[0] % len(ENDS)] if self.numbers else "SIGKILL"
        if self.ended == "end of the input":
            os.close(self.stdin)
        else:
            os.kill(self.pid, signal.SIGKILL if self.ended == "SIGKILL" else signal.SIGTERM)
        if self.ended == "SIGTERM, then SIGKILL":
            self.killed_s = time.monotonic() + self.dice.uniform(0.0, 10.0)

    def over(self, code: int) -> bool:
        """What was seen of a life, and the next one."""
        expected = {"SIGKILL": (-9,), "SIGTERM": (128 + 15,), "end of the input": (0,)}.get(self.ended, (-9, 128 + 15))
        said = self.log.read_text(encoding="utf-8", errors="replace")
        self.control.must(code in expected and "Traceback" not in said, "exit", f"{self.ended}: {code}; {said[-300:]}")
        if code in (0, 128 + 15):
            self.control.must(self.sent_um == 0.0, "not at 0", f"{self.ended}: {self.sent_um} µm")
        state = json.loads((self.folder / "state.json").read_text(encoding="utf-8"))["state"]
        still_s = self.sent_s - state["grid_s"] - state["shift_s"]
        if self.ended == "SIGKILL":
            limit_s = SENDER.stale_s + STEP_S + 30.0  # the record of a machine that does not move is half a minute old
            self.control.must(still_s <= limit_s, "stands still", f"active, still for {still_s} s")
        if self.ended != "end of the input":
            os.close(self.stdin)
        if not self.numbers:
            return False
        active_s = None if math.isnan(self.active_s) else self.active_s
        self.done.append(Loop(self.ended, self.numbers.pop(0), self.samples, self.active, 1, self.control.share,
                              self.moving, active_s, tuple(dict.fromkeys(self.control.broken))))  # fmt: skip
        self.control.broken, self.control.share = [], 0.0
        if not self.numbers:
            self.control.is_left()
            self.done[-1] = replace(self.done[-1], broken=(*self.done[-1].broken, *self.control.broken))
            return False
        self.start()
        return True


def warm(folder: Path) -> tuple[Path, dict[str, float], Callable[[Path], None]]:
    """A stored model, the sensors of a warm machine, and what writes the state of one that was saved just now."""
    from typer.testing import CliRunner

    from data.recording import read_batches
    from pipelines.cli import app
    from tests.pipelines.test_compensating import INPUTS, last_recording, store_model

    write_year(folder / "in", 7)
    write_machine(folder / "m.yml", "mill")
    stored = store_model(folder, folder / "model")
    (batch,) = read_batches(last_recording(folder), stored.machine)

    def prime(state: Path) -> None:
        table = batch.table.rename(columns={"time_s": "time"}).drop(columns=["z", "x"])
        table["time"] += time.time() - table["time"].iloc[-1]
        table.to_csv(folder / "rows.csv", index=False)
        done = CliRunner().invoke(app, [
            "compensate", str(folder / "model"), "--replay", "--from", str(folder / "rows.csv"), "--state", str(state),
            "--period-s", str(STEP_S), "--rate-um-per-s", "50",
        ])  # fmt: skip
        assert done.exit_code == 0, done.output

    return folder / "model", {c: float(batch.table[c].iloc[-1]) for c in INPUTS}, prime


def kills(numbers: Sequence[int], folder: Path, seed: int, keep: Callable[[Loop], None]) -> None:
    """The kills of these numbers, on `AT_ONCE` machines at most."""
    import importlib

    for name in LOADED:
        importlib.import_module(name)
    model, values, prime = warm(folder)
    machines = list[Machine]()
    prime(folder / "state.json")
    at_control = receiver(AT_CONTROL, folder)
    for k in range(min(AT_ONCE, len(numbers))):
        own = folder / f"machine-{k}"
        shutil.rmtree(own, ignore_errors=True)
        own.mkdir()
        shutil.copy(folder / "state.json", own)
        machines.append(Machine(own, model, values, numbers[k::AT_ONCE], seed, at_control.another(own)))
    running = list(machines)
    while running:
        next_s = time.monotonic() + SAMPLE_S
        running = [m for m in running if m.turn()]
        fresh = [loop for m in machines for loop in m.done]
        for m in machines:
            m.done = []
        for loop in fresh:
            keep(loop)
        time.sleep(max(next_s - time.monotonic(), 0.0))


# ----- the command


def run(out: Path, streams: int, count: int, seed: int, say: Callable[[str], None] = print) -> list[Loop]:
    """So many streams and kills."""
    out.mkdir(parents=True, exist_ok=True)
    found: list[Loop] = []

    def keep(loop: Loop) -> None:
        found.append(loop)
        if loop.broken or loop.what != "stream":
            say(f"{loop.what} {loop.number}: {'; '.join(loop.broken)[:500] or 'nothing broken'}")

    if count:
        kills(range(count), out / "kills", seed, keep)
    at_control = receiver(LIMITS, out / "streams")
    for number in range(streams):
        keep(Stream(number, seed, at_control).run())
    return found


def summary(loops: Sequence[Loop]) -> list[dict[str, Any]]:
    """A row for the streams and for each end of the command."""
    rows = []
    for what in ("stream", *ENDS):
        if not (own := [loop for loop in loops if loop.what == what]):
            continue
        broken = [b.partition(":")[0] for loop in own for b in loop.broken]
        waited = [loop.active_s for loop in own if loop.active_s is not None]
        rows.append({
            "what": what, "n": len(own), "with_a_broken_invariant": sum(bool(loop.broken) for loop in own),
            "broken": "; ".join(sorted(set(broken))), "samples": sum(loop.samples for loop in own),
            "active_samples": sum(loop.active for loop in own), "restarts": sum(loop.restarts for loop in own),
            "largest_step_of_limit": round(max(loop.share for loop in own), 6),
            "ended_while_moving": sum(loop.moving for loop in own),
            "median_active_after_s": round(statistics.median(waited), 1) if waited else "",
            "largest_active_after_s": round(max(waited), 1) if waited else "",
        })  # fmt: skip
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.control", description=__doc__)
    parser.add_argument("--streams", type=int, default=10_000)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=ROOT / "var" / "control", help="work folder")
    parser.add_argument("--table", type=Path, help="where the rows go, such as results/control.csv")
    given = parser.parse_args()
    rows = summary(run(given.out.resolve(), given.streams, given.kills, given.seed))
    for row in rows:
        print(", ".join(f"{name} {value}" for name, value in row.items() if value != ""))
    if given.table:
        import pandas as pd

        from benchmarks.results import write

        command = f"python -m tests.control --streams {given.streams} --kills {given.kills} --table {given.table}"
        write(given.table, pd.DataFrame(rows), command)


if __name__ == "__main__":
    main()
