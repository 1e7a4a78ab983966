"""The loop that answers samples next to the control: whatever fails, it goes on, and nothing that is sent jumps."""

from __future__ import annotations

import hashlib
import json
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import inf
from pathlib import Path
from typing import Any

from compensation.contracts import Correction, Sample, Sink, Source
from compensation.runtime import Compensator
from data.errors import InputError, WorkError
from data.files import from_json, write_atomic

_SAVED_EVERY_S = 30.0  # what a power cut may lose of what was learned while what is sent does not change
_FADE_STEP_S = 1.0  # between two corrections while a stop fades


class StateFile:
    """All that a restart needs, in one record that is replaced atomically, with a checksum."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def load(self, log: Callable[[str], None] = print) -> Mapping[str, Any] | None:
        """What was saved; None where nothing was. A file that cannot be read is set aside with one line."""
        try:
            kept = from_json(self.path.read_text(encoding="utf-8"))
            if kept["sha256"] != _digest(kept["state"]):
                raise ValueError("its checksum is another one")
            return dict(kept["state"])
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError) as error:
            self.set_aside(f"cannot be read ({error})", log)
            return None

    def set_aside(self, why: str, log: Callable[[str], None]) -> None:
        """Keeps a file that cannot be used under another name."""
        aside = self.path.with_name(f"{self.path.name}.unusable")
        try:
            self.path.replace(aside)
        except OSError as error:
            log(f"state file {self.path}: {why}, and cannot be set aside ({error}); it is not used")
        else:
            log(f"state file {self.path}: {why}; set aside as {aside.name}")

    def save(self, plain: Mapping[str, Any]) -> None:
        """Replaces the record. Raises: WorkError, it cannot be written."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(self.path, json.dumps({"sha256": _digest(plain), "state": plain}))
        except OSError as error:
            raise WorkError(f"state file {self.path}: cannot be written ({error}); give another --state") from None


def _digest(plain: Any) -> str:
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def _now_s() -> float:
    """A monotonic clock that counts on while the computer sleeps, where the system has one, s."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


class _Stop:
    """Signals that ask for an end: after the first one what is sent fades, the second one ends at once."""

    def __init__(self) -> None:
        self.asked, self.number = False, 0

    def __call__(self, number: int, frame: object) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked, self.number = True, number


@contextmanager
def _signals(stop: _Stop, caught: bool) -> Iterator[None]:
    """`stop` receives SIGINT and SIGTERM, in the main thread alone."""
    if not caught or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {n: signal.signal(n, stop) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class _Line:
    """One compensation with its sinks and its state file."""

    def __init__(
        self, machine: Compensator, sinks: Sequence[Sink], state: StateFile | None, log: Callable[[str], None],
        seen: Callable[[Correction], None],
    ) -> None:  # fmt: skip
        self.machine, self.sinks, self.state, self.log, self.seen = machine, sinks, state, log, seen
        self._failing: dict[str, str] = {}  # what has failed since it last worked, and how
        self._saved_s = -inf
        self._saved: Mapping[str, Any] | None = None  # what was sent, as the record says

    def restore(self) -> None:
        """Goes on from the state file, as far as it can be used."""
        known = self.state.load(self.log) if self.state is not None else None
        if self.state is None or known is None:
            return
        try:
            self.machine.restore(known)
            self.log(f"goes on from {self.state.path}")
        except (InputError, KeyError, TypeError, ValueError, AttributeError) as error:
            self.state.set_aside(f"cannot be used ({error})", self.log)
        if self.machine.stopped:
            self.log("stopped by the operator: nothing is sent until `thermodrift compensate --start`")

    def answer(
        self, sample: Sample | None, clock_s: float, at_s: float | None = None, ends: bool = False
    ) -> Correction:
        """The correction after a sample, or in silence; where the models fail, what was sent is held and then fades.

        `at_s`: Unix time of a silence, s; None: that of the computer. `ends`: see `Compensator.silence`. The record has
        what is sent before the sinks do, so that a restart knows it.
        """
        time_s = sample.time_s if sample is not None else time.time() if at_s is None else at_s
        try:
            correction = self.machine.take(sample, clock_s) if sample else self.machine.silence(clock_s, time_s, ends)
            if sample is not None:
                self._failing.pop("model", None)
        except Exception as error:  # no sample ends the process
            self._fails("model", f"sample not used, {type(error).__name__} ({error}): {sample}"[:500])
            correction = self.machine.fault(clock_s, time_s, f"the model fails ({type(error).__name__})")
        self.save(clock_s, _SAVED_EVERY_S if self.machine.sent() == self._saved else 0.0)
        for k, sink in enumerate(self.sinks):
            try:
                sink.write(correction)
                self._failing.pop(str(k), None)
            except Exception as error:  # the other sinks go on
                self._fails(str(k), str(error))
        self.seen(correction)
        return correction

    def catch_up(self, from_s: float, to_s: float) -> None:
        """In a replay, where nobody looks between two samples: what is sent moves on as at a machine."""
        tick_s, at_s = self.machine.tick_s, from_s + self.machine.tick_s
        while at_s < to_s and self.machine.behind_um > 0.0:
            self.answer(None, at_s, at_s)
            at_s += tick_s

    def save(self, clock_s: float, least_s: float = 0.0) -> None:
        """Saves the state, if so much time has passed since it was."""
        if self.state is None or abs(clock_s - self._saved_s) < least_s:
            return
        self._saved_s = clock_s
        try:
            self.state.save(self.machine.as_plain())
        except Exception as error:  # a full disk does not end the compensation
            self._saved = None
            self._fails("state", str(error))
        else:
            self._saved = self.machine.sent()
            self._failing.pop("state", None)

    def _fails(self, what: str, why: str) -> None:
        """One line for an unbroken row of failures."""
        if what not in self._failing:
            self.log(why)
        self._failing[what] = why


def serve(
    machine: Compensator,
    source: Source,
    sinks: Sequence[Sink],
    state: StateFile | None = None,
    log: Callable[[str], None] = print,
    replay: bool = False,
    seen: Callable[[Correction], None] = lambda c: None,
    fade_s: float | None = None,
    confirm: bool = False,
    start: bool = False,
) -> int:
    """Answers samples until the source ends or a signal asks for the end; the state file keeps what was sent last.

    A sink that fails is reported once and tried again with the next correction: the machine holds what it has. Where
    the source ends or fails once it has given samples, and at the first SIGINT or SIGTERM, what is sent fades to 0
    within the limits before the sinks are closed; the failure is raised then.

    Args:
        replay: time is that of the samples instead of the computer's, as for recordings and accelerated tests; the end
            of a recording is no end of a machine, and nothing fades.
        seen: called with every correction.
        fade_s: longest time that a stop may fade, s; None: as long as the limits need.
        confirm: the operator confirms the sensors as they are, see `Compensator.confirm`.
        start: the operator ends a stop, see `Compensator.start`.

    Returns:
        The signal that asked for the end; 0 where the input ended.
    """
    line, stop, clock_s = _Line(machine, sinks, state, log, seen), _Stop(), 0.0
    why, failed, begun = "signal to end", None, False
    try:
        with _signals(stop, not replay):
            line.restore()
            if confirm:
                machine.confirm()
            if start:
                machine.start()
            line.save(clock_s)
            try:
                for sample in source.samples():
                    if stop.asked:
                        break
                    if not replay:
                        clock_s = _now_s()
                    elif sample is not None:
                        if begun:
                            line.catch_up(clock_s, sample.time_s)
                        clock_s = sample.time_s
                    line.answer(sample, clock_s)
                    begun = begun or sample is not None
                else:
                    why = "the input ends"
            except Exception as error:
                failed, why = error, f"the input fails ({error})"
            if (begun or stop.asked) and not replay:
                _fade(line, fade_s, f"{why}: what is sent fades to 0 first; a signal ends at once", stop, log)
            if failed is not None:
                raise failed
    finally:
        line.save(clock_s)
        source.close()
        for sink in sinks:
            sink.close()
    return stop.number


def _fade(line: _Line, fade_s: float | None, why: str, stop: _Stop, log: Callable[[str], None]) -> None:
    """Lets what is sent fade to 0."""
    stop.asked = True  # the next signal ends at once
    log(why)
    until_s = inf if fade_s is None else _now_s() + fade_s
    try:
        while (now_s := _now_s()) < until_s:
            correction = line.answer(None, now_s, ends=True)
            if not any((*correction.offset_um.values(), *correction.slope_um_per_m.values())):
                return
            time.sleep(_FADE_STEP_S)
    except KeyboardInterrupt:
        log("signal: ends with what was sent last")
