"""The contracts of a connector: where samples come from, and where corrections go."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from compensation.contracts import Correction, Sample, Sink, Source
from data.errors import WorkError
from data.machine import Machine, parse_machine
from thermodrift.testing.contract import Suite, expect, expect_refused

MakeSource = Callable[[Machine, Sequence[Sample]], Source]
MakeSink = Callable[[Machine], tuple[Sink, Callable[[], Sequence[Mapping[str, Any]]]]]
MACHINE = """
machine: mill
channels:
  front: {role: temperature, unit: degC}
  spindle_rpm: {role: driver, unit: rpm}
  y: {role: position, unit: mm}
  z: {role: error, unit: um}
  ey: {role: error, unit: um, position: y}
"""
SAMPLES = (
    Sample(1.7e9, {"front": 21.5, "spindle_rpm": 4000.0}, {"z": -3.25}),
    Sample(1.7e9 + 10.0, {"front": 21.75}),
    Sample(1.7e9 + 20.0, {"front": 22.0, "spindle_rpm": 0.0}, {"z": 0.0}),
)
CORRECTION = Correction(
    1.7e9 + 20.0,
    {"z": -12.25, "ey": 1.0},
    {"ey": 3.5},
    {"z": "active", "ey": "hold"},
    {"ey": "sensor front is silent, since 3 min"},
)
WAIT_S = 30.0


@dataclass(frozen=True)
class SourceCase:
    """How to make a source that the samples arrive at."""

    make: MakeSource

    @property
    def machine(self) -> Machine:
        return parse_machine(MACHINE, "thermodrift.testing")

    def open(self, samples: Sequence[Sample] = SAMPLES) -> Source:
        return self.make(self.machine, samples)


@dataclass(frozen=True)
class SinkCase:
    """How to make a sink, and what gives the corrections that have arrived behind it."""

    make: MakeSink

    def open(self) -> tuple[Sink, Callable[[], Sequence[Mapping[str, Any]]]]:
        return self.make(parse_machine(MACHINE, "thermodrift.testing"))


SOURCE: Suite[SourceCase] = Suite()
SINK: Suite[SinkCase] = Suite()


def _finite(values: Mapping[str, float]) -> dict[str, float]:
    return {name: v for name, v in values.items() if math.isfinite(v)}


@SOURCE.check("the model sees what the sensors measured, in the units of the machine file, each moment once")
def samples_arrive_once_with_values_and_readings(c: SourceCase) -> None:
    source, got, until_s = c.open(), [], time.monotonic() + WAIT_S
    for sample in source.samples():
        got += [sample] if sample is not None else []
        if len(got) >= len(SAMPLES) or time.monotonic() > until_s:
            break
    source.close()
    expect(len(got) == len(SAMPLES), f"{len(SAMPLES)} samples", len(got))
    for sample, sent in zip(got, SAMPLES, strict=True):
        expect(abs(sample.time_s - sent.time_s) < 1e-3, f"a sample of {sent.time_s:.3f} s", sample.time_s)
        expect(_finite(sample.values) == sent.values, f"values {dict(sent.values)}", dict(sample.values))
        expect(
            _finite(sample.readings_um) == sent.readings_um, f"readings {dict(sent.readings_um)}", sample.readings_um
        )


@SOURCE.check("the runtime notices a silent machine and fades out; a source that blocks hides the silence")
def silence_is_given_or_the_source_ends(c: SourceCase) -> None:
    source, seen, until_s = c.open(), 0, time.monotonic() + WAIT_S
    for sample in source.samples():
        if sample is None and seen == len(SAMPLES):
            break
        seen += sample is not None
        expect(time.monotonic() < until_s, "None in silence", f"{seen} samples and no None")
    source.close()


@SOURCE.check("a command that is stopped closes in more than one place")
def closing_twice_is_harmless_and_ends_the_samples(c: SourceCase) -> None:
    source, until_s = c.open(), time.monotonic() + WAIT_S
    iterator = source.samples()
    next(iterator, None)
    source.close()
    source.close()
    for _ in iterator:
        expect(time.monotonic() < until_s, "the end of the samples after close", "more of them")


@SINK.check("the control adds what arrives: another number or axis moves the tool")
def a_correction_arrives_whole(c: SinkCase) -> None:
    sink, received = c.open()
    sink.write(CORRECTION)
    sink.close()
    records = received()
    expect(len(records) == 1, "one correction", len(records))
    record = records[0]
    for name in ("offset_um", "slope_um_per_m", "state", "reasons"):
        expect(
            dict(record[name]) == dict(getattr(CORRECTION, name)), f"{name} {getattr(CORRECTION, name)}", record[name]
        )
    expect(abs(record["time_s"] - CORRECTION.time_s) < 1e-3, f"time_s {CORRECTION.time_s:.3f}", record["time_s"])


@SINK.check("NaN in a control's register is any number")
def a_number_that_is_not_finite_is_never_sent(c: SinkCase) -> None:
    sink, received = c.open()
    for bad in (float("nan"), float("inf")):
        expect_refused(lambda bad=bad: sink.write(Correction(1.0, {"z": bad})), "z", kind=WorkError)  # type: ignore[misc]
    sink.close()
    expect(not received(), "nothing delivered", received())


@SINK.check("a command that is stopped closes in more than one place")
def closing_twice_is_harmless(c: SinkCase) -> None:
    sink, _ = c.open()
    sink.close()
    sink.close()
