"""All performance figures in one table, side by side in one run: own time, reference, ratio, target, growth.

    python -m benchmarks [--quick] [--families mlr,ridge,…] [--whole] [--out table.md]

CPU seconds of all processes with one thread each, so that other work on the machine counts little; medians. `--quick`
takes small sizes and the linear families, under two minutes on an idle core. `--whole` adds the complete crossing of
the sample year on all cores, in wall seconds: run it on an idle machine. Everything measured is simulated.
docs/performance.md explains the rows.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from threadpoolctl import threadpool_limits

from benchmarks import elastic_net, grid, grid_growth, ingest, twin_speed
from benchmarks.plain_models import PLAIN
from benchmarks.table import Row, markdown, median_s
from data.batch import Batch
from features.design import Design
from features.rises import temperature_inputs
from models.families.lag_dictionary import DRIVEN, Columns
from models.numerics.batch_process import ByColumns, ByRows, Windows
from models.selection.crossing import Plan


@dataclass(frozen=True)
class Sizes:
    """How much is measured: batches of the sample year, every so many folds of a plain loop, repeats, CSV in GB."""

    families: tuple[str, ...]
    batches: int = 30
    every: int = grid.EVERY
    repeats: int = 3
    processes: int = grid.PROCESSES  # of joblib
    csv_gb: float = 0.291
    twin_batches: int = twin_speed.BATCHES
    twin_h: float = twin_speed.HOURS
    growth: int = 10  # up to so many times the first size
    whole: bool = False


QUICK = Sizes(("mlr", "ridge", "huber"), batches=10, repeats=1, csv_gb=0.05, twin_batches=10, twin_h=2.0, growth=3)


def table_rows(sizes: Sizes, done: Callable[[str], None] = lambda part: None) -> list[Row]:
    """Every row of the table; `done` gets the name of each part when it is measured."""
    out: list[Row] = []
    with threadpool_limits(limits=1), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.simplefilter("ignore", UserWarning)
        for part, rows in parts(sizes):
            out += rows
            done(part)
    return out


def parts(sizes: Sizes) -> Iterator[tuple[str, list[Row]]]:
    """The parts of the table in turn, each with its name."""
    with tempfile.TemporaryDirectory() as folder:
        batches = grid.sample_batches(Path(folder), sizes.batches)
    for family in sizes.families:
        growth = grid_growth.exponents(family, sizes.growth)
        rows = grid.rows(batches, [family], sizes.repeats, sizes.every, sizes.processes)
        yield family, [replace(row, growth=growth) if k == 0 else row for k, row in enumerate(rows) if row.note == ""]
    if set(grid.TOGETHER) <= set(sizes.families):
        yield (
            "together",
            [row for row in grid.rows(batches, grid.TOGETHER, 1, sizes.every, sizes.processes) if row.note],
        )
    yield "lag dictionary", [lag_dictionary(batches, sizes.repeats)]
    yield "elastic net", elastic_net.rows(sizes.repeats)
    yield "twin", twin_speed.rows(twin_speed.ways(), sizes.repeats, sizes.twin_batches, sizes.twin_h)
    yield "ingest", ingest.rows(sizes.csv_gb, sizes.repeats)
    yield "complete crossing", [complete(batches, sizes.whole)]
    yield "nets on a GPU", list(on_gpu(batches, sizes.repeats))


def lag_dictionary(batches: Sequence[Batch], repeats: int) -> Row:
    """All pairs of batches left out for one setting: solved in the columns, and by an inverse of all windows."""
    design = Design.build(batches, temperature_inputs(batches)[: grid.POINTS], "z")
    columns = Columns.of(design)
    windows = Windows.of(design, columns.x, range(len(batches)))
    variance = 10.0 * columns.prior(range(len(batches))) ** 2 * (columns.reach <= DRIVEN)
    took = []
    for way in (ByColumns, ByRows):

        def pairs(way: type[ByColumns | ByRows] = way) -> None:
            process = way(windows, variance, 1.0, np.ones(len(windows.ids)))
            for k in range(len(windows.ids)):
                process.left_um(k)

        took.append(median_s(pairs, repeats))
    n = len(windows.ids)
    return Row(f"lag dictionary, {n} batches left out in pairs", took[0], "inverse of all windows", took[1])


def complete(batches: Sequence[Batch], run: bool) -> Row:
    """The complete crossing of the sample year, or what to add for it."""
    what = f"complete crossing, {len(batches)} batches, three channels, {os.cpu_count()} cores, wall"
    if not run:
        return Row(what, target_s=grid.TARGET_WHOLE_S, note="not run (add --whole)")
    wall_s = grid.whole([*batches], Plan(protocols=("leave-batch-out",), effort="complete"), "complete crossing")
    return Row(what, wall_s, target_s=grid.TARGET_WHOLE_S)


def on_gpu(batches: Sequence[Batch], repeats: int) -> Iterator[Row]:
    """Training of each sequence net on a GPU, next to the processor: all batches but one, error z."""
    import torch

    from models.families import FAMILIES

    if not torch.cuda.is_available():
        yield Row("nets on a GPU", reference="the same on the processor", note="not run (no GPU)")
        return
    design = Design.build(batches, temperature_inputs(batches)[: grid.POINTS], "z")
    for key in ("tcn", "gru", "lstm"):
        train = range(len(batches) - 1)
        took = [
            median_s(partial(FAMILIES[key](device=device).fit_design, design, train), repeats)
            for device in ("cuda", "cpu")
        ]
        yield Row(f"nets on a GPU, {key}, {len(train)} batches", took[0], "the same on the processor", took[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small sizes, linear families")
    parser.add_argument("--families", help="families of the crossing, comma-separated")
    parser.add_argument("--whole", action="store_true", help="add the complete crossing of the sample year")
    parser.add_argument("--out", type=Path, help="write the table there too")
    args = parser.parse_args()
    sizes = QUICK if args.quick else Sizes(tuple(PLAIN))
    families = tuple(args.families.split(",")) if args.families else sizes.families
    if unknown := [f for f in families if f not in PLAIN]:
        parser.error(f"--families: no reference for {unknown[0]!r}; expected some of {', '.join(PLAIN)}")
    rows = table_rows(
        replace(sizes, families=families, whole=args.whole), lambda part: print(f"measured: {part}", file=sys.stderr)
    )
    text = markdown(rows)
    if args.out:
        args.out.write_text(text + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
