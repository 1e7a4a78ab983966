"""How the cost of a crossing grows with rows, sensors, batches and seeds, on made-up recordings (simulated).

    python -m benchmarks.grid_growth [--largest]

One set of inputs (all sensors), leave-batch-out, one thread. Per line: seconds for what is read once (the sums of the
batches), then milliseconds per fold for fitting and judging. `--largest` adds 1,000 batches × 300 sensors × 10,000
rows, 24 GB as a table: made and summed batch by batch, then 1,000 folds of least squares from the sums alone. Nothing
is asserted about time.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import fields

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.table import exponent
from features.design import Design
from models.families import FAMILIES
from models.families.linear import Blocks
from models.protocols import Fold
from models.selection.judging import FamilyScores

BASE = {"batches": 30, "sensors": 10, "rows": 300}
GROWTH = {
    "rows": (100, 1_000, 10_000),
    "sensors": (10, 30, 100, 300),
    "batches": (10, 30, 100, 300, 1_000),
}
CLOSED, ITERATIVE = ("mlr", "pcr", "ridge"), ("lssvm", "bp")
MOST_INNER = 30_000_000  # folds² × sensors³ / 1000 that ridge's inner leave-batch-out is still timed at


def recordings(batches: int, sensors: int, rows: int, first: int = 0) -> Design:
    """Batches of rises that share a few slow modes, with noise, and an error made from them."""
    x, y = np.empty((batches * rows, sensors)), np.empty(batches * rows)
    mixing = np.random.default_rng(1).uniform(0, 6, (4, sensors))
    gains = np.random.default_rng(2).normal(0, 8, 4)
    t = np.linspace(0, 6, rows)[:, None]
    for k in range(batches):
        rng = np.random.default_rng([3, first + k])
        modes = (1 - np.exp(-t / np.array([0.4, 1.5, 4.0, 9.0]))) * rng.uniform(0.3, 2.0, 4)
        own = slice(k * rows, (k + 1) * rows)
        x[own] = modes @ mixing
        x[own] += rng.normal(0, 0.1, (rows, sensors))
        y[own] = modes @ gains + rng.normal(0, 0.7, rows)
    offsets = (rows * np.arange(batches + 1)).astype(np.int64)
    names = tuple(f"t{i}" for i in range(sensors))
    time_s = np.tile(np.linspace(0, 6 * 3600, rows), batches)
    return Design(names, "z", tuple(f"b{k}" for k in range(batches)), x, y, time_s, offsets, 60.0)


def folds_of(batches: int) -> list[Fold]:
    k = range(batches)
    return [Fold(f"b{i}", tuple(j for j in k if j != i), (i,)) for i in k]


def seconds_per_fold(design: Design, family: str, **options: int) -> float:
    folds = folds_of(design.n_batches)
    start = time.process_time()
    FamilyScores.run(
        design,
        FAMILIES[family](**options),
        folds,
        [(design, list(range(len(folds))))],
        ["leave-batch-out"] * len(folds),
    )
    return (time.process_time() - start) / len(folds)


def exponents(family: str, largest: int, repeats: int = 1) -> str:
    """Growth of the cost of a fold with rows, sensors and batches, up to a multiple of the first size of each."""
    if family not in CLOSED or largest < 2:
        return ""
    seconds_per_fold(recordings(5, 3, 50), family)  # imports are not what is measured
    found = []
    for what, values in GROWTH.items():
        sizes = [v for v in values if v <= max(largest * values[0], values[1])]
        took = [min(seconds_per_fold(recordings(**{**BASE, what: v}), family) for _ in range(repeats)) for v in sizes]
        found.append(f"{what} {exponent(sizes, took):.1f}")
    return ", ".join(found)


def grown(what: str, value: int) -> None:
    size = {**BASE, what: value}
    design = recordings(**size)
    start = time.perf_counter()
    _ = design.moments
    once = time.perf_counter() - start
    cells = []
    for family in (*CLOSED, *ITERATIVE):
        inner = size["batches"] ** 2 * size["sensors"] ** 3 / 1000
        slow = (family == "ridge" and inner > MOST_INNER) or (
            family in ITERATIVE and max(size["batches"], size["sensors"]) > 100
        )
        cells.append("" if slow else f"{1e3 * seconds_per_fold(design, family):.2f}")
    print(
        f"{size['batches']:8}{size['sensors']:9}{size['rows']:8}{once:10.3f}" + "".join(f"{c:>9}" for c in cells),
        flush=True,
    )


def largest(batches: int = 1_000, sensors: int = 300, rows: int = 10_000) -> None:
    parts = []
    start = time.perf_counter()
    reading = 0.0
    for k in range(batches):
        design = recordings(1, sensors, rows, first=k)
        begun = time.perf_counter()
        m = design.moments
        own = Blocks.of(m)
        mean_x, mean_y = own.mean_x + m.shift_x, own.mean_y + m.shift_y
        raw = own.raw + own.count[:, None] * m.shift_x**2
        parts.append(Blocks(own.count, mean_x, mean_y, own.xx, own.xy, own.yy, raw, np.zeros(sensors)))
        reading += time.perf_counter() - begun
    joined = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Blocks) if f.name != "origin"}
    blocks = Blocks(**joined, origin=np.zeros(sensors))
    making = time.perf_counter() - start - reading
    start = time.perf_counter()
    S_um = []
    for first in range(0, batches, 20):
        left = np.arange(first, min(first + 20, batches))
        masks = np.ones((len(left), batches), bool)
        masks[np.arange(len(left)), left] = False
        pool = blocks.pool(masks, scaled=False)
        coef = np.asarray(np.linalg.solve(pool.xx, pool.xy[:, :, None]), np.float64)
        S_um.append(blocks.left_out_S_um(left, pool, np.arange(len(left)), coef)[:, 0])
    took = time.perf_counter() - start
    words = f"\n{batches} batches × {sensors} sensors × {rows} rows: sums {reading:.0f} s"
    words += f" (making the rows {making:.0f} s), {batches} folds of least squares {took:.1f} s"
    print(f"{words}, {1e3 * took / batches:.1f} ms a fold; S_mean {np.mean(np.concatenate(S_um)):.3f} µm (noise 0.7)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--largest", action="store_true", help="add the largest, some minutes")
    args = parser.parse_args()
    with threadpool_limits(limits=1):
        for family in (*CLOSED, *ITERATIVE):
            seconds_per_fold(recordings(5, 3, 50), family)  # imports are not what is measured
        print("one thread, milliseconds per fold (fit and judge); sums: seconds, once")
        print(
            f"{'batches':>8}{'sensors':>9}{'rows':>8}{'sums s':>10}" + "".join(f"{f:>9}" for f in (*CLOSED, *ITERATIVE))
        )
        for what, values in GROWTH.items():
            for value in values:
                grown(what, value)
        print("\nseeds (starts of bp's nets), milliseconds per fold")
        for starts in (1, 3, 10, 30):
            print(f"{starts:8}{1e3 * seconds_per_fold(recordings(**BASE), 'bp', starts=starts):9.1f}", flush=True)
        if args.largest:
            largest()


if __name__ == "__main__":
    main()
