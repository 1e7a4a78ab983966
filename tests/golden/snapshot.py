"""Golden snapshot of the numbers that a change of structure must not move.

    python -m tests.golden.snapshot record  [SECTION ...]
    python -m tests.golden.snapshot compare [SECTION ...]

Sections: leaderboard, predictions, simulation, calibration, findings, studies. All inputs are simulated and fixed, so
a difference comes from the code or from the numerical libraries. Record and compare on the same machine.
"""

from __future__ import annotations

import gzip
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from data.batch import Batch
from data.ingest import ingest
from data.lake import Lake
from data.machine import Machine, load_machine
from diagnosis.diagnose import diagnose
from diagnosis.findings.schema import as_json
from models.families import FAMILIES
from models.selection.crossing import Plan
from models.selection.grid import run_grid
from plants.sample.sample_year import write_sample_year
from twin.calibration import CalibrationOptions, calibrate
from twin.compile import compile_network
from twin.run_plan import load_run_plan
from twin.simulation import simulate
from twin.simulation.inputs import inputs_of_plan, start_of_plan

ROOT = Path(__file__).parents[2]
HELD = Path(__file__).with_name("snapshot.json.gz")
SAMPLE = ROOT / "machines" / "sample_vmc.yml"
RTOL = 1e-6  # after reordered sums; `compare` reports the largest difference, 0 where nothing was reordered
UNTIMED = ("seconds",)  # wall-clock fields of findings.json
EVERY = 37  # of a long series, the rows that are kept


def leaderboard() -> Any:
    """The cells of the sample year at effort quick: three error channels, four protocols."""
    found = run_grid(_year(), ("x", "y", "z"), Plan(effort="quick"), load_machine(SAMPLE), workers=2)
    return {target: _table(result.cells) for target, (_, result) in found.items()}


def predictions() -> Any:
    """Left-out predictions of z by one cell of every family that a machining centre takes, on eight batches."""
    machine = load_machine(SAMPLE)
    families = tuple(f for f in FAMILIES if not FAMILIES[f].needs_position)
    plan = Plan(("mrmr",), families, ("leave-batch-out",), n_tsps=(4,), iterative_n_tsps=(4,))
    found = run_grid(_year()[::4], ("z",), plan, machine, workers=2)
    return _table(found["z"][1].predictions.iloc[::EVERY])


def simulation() -> Any:
    """The rotating-spindle test of docs/plans on the sample machine."""
    machine = load_machine(SAMPLE)
    network = compile_network(machine)
    plan = load_run_plan(ROOT / "docs" / "plans" / "iso_spindle_test.yml", machine)
    inputs = inputs_of_plan(network, plan)
    found = simulate(network, network.values, inputs, start_of_plan(network, plan))
    return {"readings": _array(found.readings[0, 0, ::EVERY]), "errors": _array(found.errors[0, 0, ::EVERY])}


def calibration() -> Any:
    """The sample machine calibrated on six batches of the sample year, with each left out in turn."""
    found = calibrate(load_machine(SAMPLE), _year()[::5], CalibrationOptions(leave_out=True, processes=2))
    assert found.left_out is not None
    intervals = [[i.name, i.value, i.low, i.high] for i in found.intervals90]
    return {"intervals90": intervals, "rms": _table(found.rms), "left_out": _table(found.left_out.by_channel())}


def findings() -> Any:
    """findings.json of eight cases: two with nothing missing, four with one effect, one with two, one unlisted."""
    from thermodrift_exam.proof.sealing.examinee import read_case
    from thermodrift_exam.proof.suite import build, small_suite, write_built

    out = {}
    for spec in _cases(small_suite()):
        with tempfile.TemporaryDirectory() as folder:
            write_built(build(spec), Path(folder) / "case")
            machine, batches = read_case(Path(folder) / "case", Path(folder) / "lake")
        out[spec.name] = json.loads(as_json(diagnose(machine, batches, processes=2).findings))
        for key in UNTIMED:
            out[spec.name].pop(key)
    return out


def studies() -> Any:
    """The figures of the five published studies at two seeds."""
    from thermodrift_exam.studies import STUDIES
    from thermodrift_exam.studies.base import run_studies

    return {key: _table(result.table) for key, result in run_studies(list(STUDIES), seeds=2, workers=2).items()}


SECTIONS: dict[str, Callable[[], Any]] = {
    f.__name__: f for f in (simulation, calibration, predictions, leaderboard, findings, studies)
}


def differences(golden: Any, got: Any, rtol: float = RTOL, where: str = "") -> Iterator[tuple[str, float]]:
    """Every leaf that differs: its path and the relative difference, inf where the leaves cannot be compared."""
    if isinstance(golden, dict) and isinstance(got, dict):
        for key in sorted({*golden, *got}):
            if key in golden and key in got:
                yield from differences(golden[key], got[key], rtol, f"{where}/{key}")
            else:
                yield f"{where}/{key}", math.inf
    elif isinstance(golden, list) and isinstance(got, list) and len(golden) == len(got):
        for k, (a, b) in enumerate(zip(golden, got, strict=True)):
            yield from differences(a, b, rtol, f"{where}/{k}")
    elif isinstance(golden, float | int) and isinstance(got, float | int) and not isinstance(golden, bool):
        scale = max(abs(golden), abs(got))
        if scale and abs(golden - got) > rtol * scale:
            yield where, abs(golden - got) / scale
    elif golden != got:
        yield where, math.inf


def against_held(section: str, rtol: float = RTOL) -> list[tuple[str, float]]:
    """Every leaf of a section, computed now, that differs from the one in the file by more than `rtol`."""
    return list(differences(_held()[section], _plain(SECTIONS[section]()), rtol))


def compare(sections: Sequence[str]) -> int:
    """Print a line per section: how many leaves differ by more than 1e-9 and 1e-6; 1 where any is beyond `RTOL`."""
    failed = 0
    for name in sections:
        begun = time.perf_counter()
        found = against_held(name, 1e-9)
        beyond = [(where, d) for where, d in found if d > RTOL]
        worst = max((d for _, d in found), default=0.0)
        took = f"{time.perf_counter() - begun:.0f} s"
        print(
            f"{name}: {len(found)} beyond 1e-9, {len(beyond)} beyond {RTOL:g}, worst {worst:.2g} ({took})", flush=True
        )
        for where, d in beyond[:20]:
            print(f"  {name}{where}: {d:.3g}")
        failed |= bool(beyond)
    return failed


def record(sections: Sequence[str]) -> None:
    """Write the sections, keeping the others that the file holds."""
    held = _held() if HELD.exists() else {}
    for name in sections:
        begun = time.perf_counter()
        held[name] = _plain(SECTIONS[name]())
        HELD.write_bytes(gzip.compress(json.dumps(held, ensure_ascii=False).encode("utf-8"), mtime=0))
        print(f"{name}: recorded in {time.perf_counter() - begun:.0f} s", flush=True)


def _held() -> dict[str, Any]:
    held: dict[str, Any] = json.loads(gzip.decompress(HELD.read_bytes()))
    return held


def _cases(small: Sequence[Any]) -> list[Any]:
    nothing, drift, cabinet, pump, two, unlisted = small
    other = replace(nothing, plant="elements", seed=nothing.seed + 1)
    shift = replace(cabinet, effects={"speed_shift": 2.0}, seed=cabinet.seed + 1)
    every = (nothing, other, drift, cabinet, pump, shift, two, unlisted)
    return [replace(spec, name=f"case_{k}") for k, spec in enumerate(every, 1)]


def _year() -> list[Batch]:
    """The sample year as `thermodrift ingest` stores it."""
    machine: Machine = load_machine(SAMPLE)
    with tempfile.TemporaryDirectory() as folder:
        write_sample_year(Path(folder) / "year", seed=0)
        lake = Lake(Path(folder) / "lake")
        ingest([Path(folder) / "year"], machine, lake)
        return lake.load_all(machine.machine)


def _table(table: pd.DataFrame) -> dict[str, list[Any]]:
    return {str(name): column.tolist() for name, column in table.items()}


def _array(values: Any) -> list[Any]:
    plain: list[Any] = np.asarray(values, float).tolist()
    return plain


def _plain(value: Any) -> Any:
    """As JSON reads it back; NaN is null."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def main(arguments: Sequence[str]) -> int:
    """Entry point."""
    if not arguments or arguments[0] not in ("record", "compare") or set(arguments[1:]) - set(SECTIONS):
        print(__doc__)
        return 2
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sections = list(arguments[1:]) or list(SECTIONS)
    if arguments[0] == "record":
        record(sections)
        return 0
    return compare(sections)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
