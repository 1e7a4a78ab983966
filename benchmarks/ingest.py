"""Ingest of a large CSV recording against pyarrow alone (CSV to Parquet), in one run.

    python benchmarks/ingest.py [--gb 1.0] [--rounds 3] [--threads 2]

"ingest" keeps every row of the 10 Hz recording, "ingest to 1 s" averages it onto a 1 s grid. "pyarrow alone" streams
as ingest does, in bounded memory; "pyarrow in memory" reads the whole file at once, which is its fastest way. All may
use pyarrow's pool of --threads (all cores by default); ingest adds one thread that reads ahead. The ways run in
processes of their own, taking turns; time and peak memory are theirs, without the interpreter's start. Prints a table.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq

if __name__ == "__main__":  # also without -m: the rows of the table need the package
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from benchmarks.table import Row

TARGET, TARGET_MB = 1.0, 180  # of pyarrow alone's speed, and memory
STEP_S = 0.1
RUN_S, STOP_S = 1800.0, 600.0
TEMPERATURES = 16
ROWS_A_BLOCK = int((RUN_S + STOP_S) / STEP_S)
MACHINE = """
machine: bench
recording:
  files: ["*.csv"]
  time: {column: time_s, unit: s}
  step_s: STEP
  max_gap_s: 5
  split: {driver: spindle_rpm, min_run_s: 600}
channels:
  spindle_rpm: {role: driver, unit: rpm, resolution: 1, range: [0, 20000]}
  x_um: {role: error, unit: um, resolution: 0.01, range: [-500, 500]}
  y_um: {role: error, unit: um, resolution: 0.01, range: [-500, 500]}
  z_um: {role: error, unit: um, resolution: 0.01, range: [-500, 500]}
""" + "".join(
    f"  T{i:02d}: {{role: temperature, unit: degC, resolution: 0.01, range: [-10, 90]}}\n" for i in range(TEMPERATURES)
)


def write_recording(path: Path, size_bytes: float) -> int:
    """Blocks of running and standing, 20 channels at 10 Hz; gives the rows written."""
    rng = np.random.default_rng(0)
    rows = 0
    level = np.zeros(TEMPERATURES + 3)
    with path.open("wb") as file:
        while file.tell() < size_bytes:
            t = np.arange(ROWS_A_BLOCK) * STEP_S
            running = t < RUN_S
            tau_s = np.linspace(600.0, 3000.0, len(level))
            aim = np.where(running[0], rng.uniform(3.0, 12.0, len(level)), 0.0)
            rise = aim + (level - aim) * np.exp(-np.minimum(t, RUN_S)[:, None] / tau_s)
            rise *= np.exp(-np.maximum(t - RUN_S, 0.0)[:, None] / tau_s)
            level = rise[-1]
            noise = rng.normal(0.0, 0.02, rise.shape)
            columns: dict[str, object] = {"time_s": np.round(t + rows * STEP_S, 1)}
            columns["spindle_rpm"] = np.where(running, rng.integers(20, 120) * 100, 0)
            for k, name in enumerate([*(f"T{i:02d}" for i in range(TEMPERATURES)), "x_um", "y_um", "z_um"]):
                columns[name] = np.round((20.0 if k < TEMPERATURES else 0.0) + rise[:, k] + noise[:, k], 2)
            pc.write_csv(pa.table(columns), file, pc.WriteOptions(include_header=rows == 0, quoting_style="none"))
            rows += ROWS_A_BLOCK
    return rows


def clocks() -> tuple[float, float]:
    """Wall and CPU seconds."""
    return time.perf_counter(), time.process_time()


def since(began: tuple[float, float]) -> dict[str, float]:
    wall_s, cpu_s = clocks()
    return {"s": wall_s - began[0], "cpu_s": cpu_s - began[1]}


def peak_MB() -> float:
    """Largest resident memory of this program; getrusage would count that of the program which started it too."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def with_ingest(csv: Path, out: Path, step_s: float = STEP_S) -> dict[str, float]:
    from data.ingest import ingest
    from data.lake import Lake
    from data.machine import parse_machine

    machine = parse_machine(MACHINE.replace("STEP", str(step_s)), "benchmark")
    began = clocks()
    report = ingest([csv], machine, Lake(out))
    return {**since(began), "rows": report.rows_stored, "batches": len(report.batches)}


def with_ingest_1s(csv: Path, out: Path) -> dict[str, float]:
    return with_ingest(csv, out, 1.0)


def with_pyarrow(csv: Path, out: Path) -> dict[str, float]:
    out.mkdir()
    rows = 0
    began = clocks()
    with pc.open_csv(csv) as reader, pq.ParquetWriter(out / "all.parquet", reader.schema) as writer:
        for block in reader:
            writer.write_batch(block)
            rows += block.num_rows
    return {**since(began), "rows": rows, "batches": 1}


def with_pyarrow_in_memory(csv: Path, out: Path) -> dict[str, float]:
    out.mkdir()
    began = clocks()
    table = pc.read_csv(csv)
    pq.write_table(table, out / "all.parquet")
    return {**since(began), "rows": table.num_rows, "batches": 1}


PLAIN = {"pyarrow alone": with_pyarrow, "pyarrow in memory": with_pyarrow_in_memory}
OURS = {"ingest": with_ingest, "ingest to 1 s": with_ingest_1s}
WAYS = PLAIN | OURS


def one(way: str, csv: str, out: str, threads: str) -> None:
    """In a child process: run one way and report its time and peak memory."""
    pa.set_cpu_count(int(threads))
    result = WAYS[way](Path(csv), Path(out))
    result["peak_MB"] = peak_MB()
    result["disk_MB"] = sum({p.stat().st_ino: p.stat().st_size for p in Path(out).rglob("*.parquet")}.values()) / 1e6
    sys.stdout.write(json.dumps(result))


def measured(gb: float, rounds: int, threads: int) -> tuple[dict[str, list[dict[str, float]]], float, int]:
    """Results of every way, round by round; MB and rows of the CSV."""
    results: dict[str, list[dict[str, float]]] = {way: [] for way in WAYS}
    with tempfile.TemporaryDirectory() as folder:
        csv = Path(folder) / "recording.csv"
        n_rows = write_recording(csv, gb * 1e9)
        size_MB = csv.stat().st_size / 1e6
        for k in range(rounds):
            for way in WAYS:
                out = f"{folder}/{k} {way}"
                child = [sys.executable, __file__, "--one", way, str(csv), out, str(threads)]
                done = subprocess.run(child, check=True, capture_output=True, text=True)
                results[way].append(json.loads(done.stdout))
                shutil.rmtree(out)
    return results, size_MB, n_rows


def rows(gb: float, rounds: int, threads: int = 1) -> list[Row]:
    """Rows of the table, CPU seconds of the children; the target is of speed and of memory."""
    results, size_MB, _ = measured(gb, rounds, threads)
    cpu = {way: statistics.median(r["cpu_s"] for r in runs) for way, runs in results.items()}
    peak = {way: statistics.median(r["peak_MB"] for r in runs) for way, runs in results.items()}
    out = []
    for way in OURS:
        enough = f"≤ {TARGET_MB} MB", peak[way] <= TARGET_MB
        for plain in PLAIN:
            what, reference = f"{way}, {size_MB:.0f} MB of CSV", f"{plain}, {peak[plain]:.0f} MB of memory"
            target = TARGET if plain == "pyarrow alone" else math.nan
            note = f"{peak[way]:.0f} MB of memory"
            out.append(Row(what, cpu[way], reference, cpu[plain], target, limit=enough, note=note))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gb", type=float, default=1.0, help="size of the CSV in GB (1e9 bytes)")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="threads of pyarrow's pool, for all ways")
    args = parser.parse_args()
    results, size_MB, n_rows = measured(args.gb, args.rounds, args.threads)
    batch_MB = ROWS_A_BLOCK * (TEMPERATURES + 5) * 8 / 1e6
    print(
        f"{size_MB:.0f} MB of CSV, {n_rows} rows, {TEMPERATURES + 4} channels; one batch {batch_MB:.0f} MB in memory;"
        f" pyarrow uses {args.threads} threads, on {os.cpu_count()} cores"
    )
    print(f"{'':18}{'median s':>10}{'MB/s':>8}{'CPU s':>8}{'peak MB':>9}{'rows':>10}{'batches':>9}{'Parquet MB':>12}")
    for way, runs in results.items():
        s, cpu, peak = (statistics.median(r[name] for r in runs) for name in ("s", "cpu_s", "peak_MB"))
        last = runs[-1]
        print(
            f"{way:18}{s:10.2f}{size_MB / s:8.0f}{cpu:8.2f}{peak:9.0f}{last['rows']:10}{last['batches']:9}"
            f"{last['disk_MB']:12.1f}"
        )
    for way in OURS:
        for plain in PLAIN:
            ratios = [p["s"] / i["s"] for p, i in zip(results[plain], results[way], strict=True)]
            middle = statistics.median(ratios)
            print(f"{way} at {middle:.2f} of the speed of {plain} (rounds {min(ratios):.2f} to {max(ratios):.2f})")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        one(*sys.argv[2:])
    else:
        main()
