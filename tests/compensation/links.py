"""A machine at a link, and waiting for what arrives over one."""

from __future__ import annotations

import time
from collections.abc import Callable

from compensation.contracts import Sample, Source

TIMEOUT_S = 60.0
MACHINE = """
machine: mill
channels:
  front: {role: temperature, unit: degC}
  room: {role: ambient, unit: degC}
  z: {role: error, unit: um}
"""


def eventually(condition: Callable[[], object], what: str) -> None:
    until_s = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < until_s, what
        time.sleep(0.05)


def taken(source: Source, wanted: Callable[[Sample], object] = lambda sample: True) -> Sample:
    """The next sample that is wanted."""
    until_s = time.monotonic() + TIMEOUT_S
    for sample in source.samples():
        if sample is not None and wanted(sample):
            return sample
        assert time.monotonic() < until_s, "no such sample"
    raise AssertionError("the source has ended")
