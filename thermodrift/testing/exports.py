"""The contract of an export: what its files state, and what it refuses."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from compensation.exports.base import AxisModel, Export, Exporter
from compensation.safety import Limits
from data.batch import Channel
from data.errors import InputError
from models.program import Builder
from thermodrift.testing.contract import Suite, expect, expect_described

DIGEST = "0123456789abcdef" * 4


LIMITS = Limits(max_offset_um=40.0, rate_um_per_s=0.02, step_um=6.0, hold_s=900.0, stale_s=900.0, warm_up_s=0.0)


def straight(region: Mapping[str, tuple[float, float]] | None = None) -> AxisModel:
    """3 (t0 − t0 first) − 2 t1 + 1.5, and with a slope of 0.01 (t0 − t0 first) along y."""
    known = {n: Channel(n, "temperature", "degC") for n in ("t0", "t1")}
    b = Builder(known, 300.0)
    x = b.channels(["t0", "t1"])
    rise = b.since_first(b.pick(x, [0]))
    error = b.affine(b.join(rise, b.pick(x, [1])), np.array([[3.0, -2.0]]), 1.5)
    program = b.program([error, b.affine(rise, np.array([[0.01]]))], False, "y", 100.0)
    trained = {"t0": (10.0, 30.0), "t1": (15.0, 25.0), "y": (0.0, 500.0)} if region is None else region
    return AxisModel("y", program, trained, LIMITS)


def offset_only() -> AxisModel:
    """The same without a slope."""
    a = straight()
    program = replace(a.program, outputs=a.program.outputs[:1], along="", reference_mm=0.0)
    return replace(a, program=program)


def lagged() -> AxisModel:
    """2 × the rise of t0 behind a first-order lag of 20 min."""
    b = Builder({"t0": Channel("t0", "temperature", "degC")}, 300.0)
    late = b.lags(b.since_first(b.channels(["t0"])), [1200.0], 0.0)
    return AxisModel("x", b.program([b.affine(late, np.array([[2.0]]))], False), {"t0": (10.0, 30.0)}, LIMITS)


def export_of(*axes: AxisModel, machine: str = "mill 1", simulated: bool = True) -> Export:
    return Export(machine, "champion@production", "v7", DIGEST, "2026-01-02T03:04:05Z", simulated, axes)


@dataclass(frozen=True)
class ExportCase:
    """An exporter and models of several forms."""

    exporter: type[Exporter]

    @property
    def forms(self) -> dict[str, Export]:
        return {
            "an offset": export_of(offset_only()),
            "an offset and a slope": export_of(straight()),
            "a lag": export_of(lagged()),
            "two axes": export_of(offset_only(), lagged()),
            "odd names": export_of(replace(offset_only(), axis="µ 1/a"), machine="Fräse */ 1"),
        }

    def written(self, export: Export) -> dict[str, bytes]:
        """Content of the files by name.

        Raises:
            InputError: refused.
        """
        with TemporaryDirectory() as folder:
            paths = self.exporter().write(export, Path(folder))
            return {p.relative_to(folder).as_posix(): p.read_bytes() for p in paths}


SUITE: Suite[ExportCase] = Suite()


@SUITE.check("the command line and the documentation show these")
def says_what_it_is(c: ExportCase) -> None:
    expect_described(c.exporter, Exporter, "key", "summary", "suffix")


@SUITE.check("a file at a control for years must say which model it is and what it assumes")
def every_file_states_what_it_is(c: ExportCase) -> None:
    files = c.written(export_of(offset_only()))
    expect(files and all(name.startswith("mill_1") for name in files), "files that begin with mill_1", list(files))
    for name, content in files.items():
        text = content.decode(errors="replace")
        companions = "".join(b.decode(errors="replace") for n, b in files.items() if Path(n).stem == Path(name).stem)
        for stated in ("mill 1", "champion@production", "v7", DIGEST, "2026-01-02T03:04:05Z", "degC", "um", "-error_um",
                       "hold"):  # fmt: skip
            expect(stated in text or stated in companions, f"{stated!r} in {name}, or in a file of its name", "none")


@SUITE.check("a model of simulated runs must not reach a real machine unseen")
def simulated_models_are_marked(c: ExportCase) -> None:
    for simulated in (True, False):
        for name, content in c.written(export_of(offset_only(), simulated=simulated)).items():
            marked = bool(re.search(rb"(?<!_)SIMULATED", content))
            if marked != simulated and not (simulated and self_contained(name)):
                expect(False, f"{'a' if simulated else 'no'} mark SIMULATED in {name}", marked)


def self_contained(name: str) -> bool:
    """A source file whose header states it."""
    return name.endswith(".c")


@SUITE.check("a second export of one model must compare as equal")
def the_same_bytes_every_time(c: ExportCase) -> None:
    one, other = (c.written(export_of(offset_only())) for _ in range(2))
    expect(one == other, "the same files twice", sorted(n for n in one if one[n] != other.get(n)))


@SUITE.check("what the target cannot express must be refused before anything is written")
def every_form_is_written_or_refused_in_one_line(c: ExportCase) -> None:
    for form, export in c.forms.items():
        with TemporaryDirectory() as folder:
            try:
                paths = c.exporter().write(export, Path(folder))
            except InputError as error:
                text = str(error)
                expect(
                    "\n" not in text and "these exports can: " in text, f"one line for {form} with those that can", text
                )
                expect(not list(Path(folder).iterdir()), f"nothing written for {form} that is refused", "files")
                continue
            expect(
                paths and all(p.parent == Path(folder) and p.stat().st_size for p in paths), f"files for {form}", paths
            )
            names = [p.name for p in paths]
            expect(all(n.isascii() for n in names), f"names in ASCII for {form}", names)


@SUITE.check("a model is exported again each season")
def earlier_files_are_replaced(c: ExportCase) -> None:
    with TemporaryDirectory() as folder:
        for simulated in (True, False):
            c.exporter().write(export_of(offset_only(), simulated=simulated), Path(folder))
        kept = {p.name for p in Path(folder).iterdir()}
    expect(kept == set(c.written(export_of(offset_only()))), "the same files after a second export", kept)
