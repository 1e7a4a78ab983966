"""Samples through a source and corrections into a sink, for the connectors that need no server.

Those of a server have tests against a real one: tests/compensation/test_mqtt.py and test_opcua.py.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from compensation.connectors import SINKS, SOURCES
from compensation.connectors.streams import CsvSink, CsvSource, StandardInput, StandardOutput
from compensation.contracts import Correction, Sample, Sink, Source
from data.errors import WorkError
from data.machine import parse_machine

MACHINE = parse_machine(
    """
machine: mill
channels:
  front: {role: temperature, unit: degC}
  spindle_rpm: {role: driver, unit: rpm}
  y: {role: position, unit: mm}
  z: {role: error, unit: um}
  ey: {role: error, unit: um, position: y}
""",
    "mill",
)
SAMPLES = (
    Sample(1.7e9, {"front": 21.5, "spindle_rpm": 4000.0}, {"z": -3.25}),
    Sample(1.7e9 + 10.0, {"front": 21.75}),
    Sample(1.7e9 + 20.0, {"front": 22.0, "spindle_rpm": 0.0}, {"z": 0.0}),
)
REASON = {"ey": "sensor front is silent, since 3 min"}
CORRECTION = Correction(1.7e9 + 20.0, {"z": -12.25, "ey": 1.0}, {"ey": 3.5}, {"z": "active", "ey": "hold"}, REASON)
WITH_SERVER = {"mqtt", "mqtts", "opc.tcp"}
Received = Callable[[], list[dict[str, Any]]]  # the corrections that have arrived, with the fields of `Correction`


def standard_input(folder: Path) -> Source:
    lines = [json.dumps({"time_s": s.time_s, **s.values, **s.readings_um}) for s in SAMPLES]
    return StandardInput("-", MACHINE, io.BytesIO("\n".join(lines).encode()))


def csv_source(folder: Path) -> Source:
    names = ("front", "spindle_rpm", "z")
    rows = [(s.time_s, *({**s.values, **s.readings_um}.get(n, "") for n in names)) for s in SAMPLES]
    text = "".join(",".join(map(str, row)) + "\n" for row in [("time_s", *names), *rows])
    (folder / "in.csv").write_text(text)
    return CsvSource(str(folder / "in.csv"), MACHINE)


def standard_output(folder: Path) -> tuple[Sink, Received]:
    stream = io.StringIO()
    return StandardOutput("-", MACHINE, stream), lambda: [json.loads(line) for line in stream.getvalue().splitlines()]


def csv_sink(folder: Path) -> tuple[Sink, Received]:
    path = folder / "out.csv"
    fields = {"offset_um": "offset_um", "slope_um_per_m": "slope_um_per_m", "state": "state", "reason": "reasons"}

    def received() -> list[dict[str, Any]]:
        out = []
        for row in csv.DictReader(path.read_text().splitlines()):
            record: dict[str, Any] = {"time_s": float(row["time_s"]), **{name: {} for name in fields.values()}}
            for axis, (column, name) in itertools.product(("z", "ey"), fields.items()):
                if cell := row.get(f"{axis}_{column}"):
                    record[name][axis] = float(cell) if "_um" in name else cell
            out.append(record)
        return out

    return CsvSink(str(path), MACHINE), received


MAKE_SOURCE = {"-": standard_input, ".csv": csv_source}
MAKE_SINK = {"-": standard_output, ".csv": csv_sink}


@pytest.fixture(params=[key for key in SOURCES if key not in WITH_SERVER])
def source(request: pytest.FixtureRequest, tmp_path: Path) -> Source:
    return MAKE_SOURCE[request.param](tmp_path)


@pytest.fixture(params=[key for key in SINKS if key not in WITH_SERVER])
def sink(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Sink, Received]:
    return MAKE_SINK[request.param](tmp_path)


def finite(values: Mapping[str, float]) -> dict[str, float]:
    return {name: v for name, v in values.items() if math.isfinite(v)}


def test_samples_arrive_once_and_then_silence_or_the_end(source: Source) -> None:
    """The runtime notices a silent machine by None; a source that blocks hides the silence."""
    got: list[Sample] = []
    until_s = time.monotonic() + 30.0
    for sample in source.samples():
        if sample is None and len(got) >= len(SAMPLES):
            break
        got += [sample] if sample is not None else []
        assert time.monotonic() < until_s
    source.close()
    for s in got:
        assert s.time_s == pytest.approx(1.7e9 + 10.0 * got.index(s), abs=1e-3)
    assert [(finite(s.values), finite(s.readings_um)) for s in got] == [(s.values, s.readings_um) for s in SAMPLES]


def test_closing_twice_is_harmless_and_ends_the_samples(source: Source) -> None:
    samples, until_s = source.samples(), time.monotonic() + 30.0
    next(samples, None)
    source.close(), source.close()
    for _ in samples:
        assert time.monotonic() < until_s


def test_a_correction_arrives_whole_and_closing_twice_is_harmless(sink: tuple[Sink, Received]) -> None:
    to, received = sink
    to.write(CORRECTION)
    to.close(), to.close()
    (record,) = received()
    wanted = asdict(replace(CORRECTION, time_s=record["time_s"]))
    assert record["time_s"] == pytest.approx(CORRECTION.time_s, abs=1e-3)
    for name in ("offset_um", "slope_um_per_m", "state", "reasons"):
        assert record[name] == wanted[name]


def test_a_number_that_is_not_finite_is_never_sent(sink: tuple[Sink, Received]) -> None:
    """NaN in a control's register is any number."""
    to, received = sink
    for bad in (float("nan"), float("inf")):
        with pytest.raises(WorkError, match=r"\A.*z.*\Z"):
            to.write(Correction(1.0, {"z": bad}))
    to.close()
    assert not received()
