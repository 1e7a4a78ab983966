"""Models of several forms to be exported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from compensation.exports.base import Export, ExportedAxis
from compensation.safety import Limits
from data.batch import Channel
from models.program import Builder

DIGEST = "0123456789abcdef" * 4
LIMITS = Limits(max_offset_um=40.0, rate_um_per_s=0.02, step_um=6.0, hold_s=900.0, stale_s=900.0, warm_up_s=0.0)


def straight(region: Mapping[str, tuple[float, float]] | None = None) -> ExportedAxis:
    """3 (t0 − t0 first) − 2 t1 + 1.5, and with a slope of 0.01 (t0 − t0 first) along y."""
    known = {n: Channel(n, "temperature", "degC") for n in ("t0", "t1")}
    b = Builder(known, 300.0)
    x = b.channels(["t0", "t1"])
    rise = b.since_first(b.pick(x, [0]))
    error = b.affine(b.join(rise, b.pick(x, [1])), np.array([[3.0, -2.0]]), 1.5)
    program = b.program([error, b.affine(rise, np.array([[0.01]]))], False, "y", 100.0)
    trained = {"t0": (10.0, 30.0), "t1": (15.0, 25.0), "y": (0.0, 500.0)} if region is None else region
    return ExportedAxis("y", program, trained, LIMITS)


def offset_only() -> ExportedAxis:
    """The same without a slope."""
    a = straight()
    program = replace(a.program, outputs=a.program.outputs[:1], along="", reference_mm=0.0)
    return replace(a, program=program)


def lagged() -> ExportedAxis:
    """2 × the rise of t0 behind a first-order lag of 20 min."""
    b = Builder({"t0": Channel("t0", "temperature", "degC")}, 300.0)
    late = b.lags(b.since_first(b.channels(["t0"])), [1200.0], 0.0)
    return ExportedAxis("x", b.program([b.affine(late, np.array([[2.0]]))], False), {"t0": (10.0, 30.0)}, LIMITS)


def export_of(*axes: ExportedAxis, machine: str = "mill 1", simulated: bool = True) -> Export:
    return Export(machine, "champion@production", "v7", DIGEST, "2026-01-02T03:04:05Z", simulated, axes)
