"""What the two lag families gain and lose from, on later runs: the way a setting is chosen, and the columns.

    python -m benchmarks.lags [--recordings FOLDER] [--machines lathe,spindle,year,volumes,elements]

Runs are predicted one by one, each from all runs before it: the last twelve of a machine with at least 24, else the
later half. Per error channel: mean S ± std in µm, the mean difference to the line "base" above it with its standard
error over the runs, and the CPU time; for `distributed_lag` the settings that were chosen. Lines "columns" are some
columns of `lag_dictionary`, as the plain mean of six settings (three levels of the prior, two steadinesses of the
drift), no batch mistrusted. The last line compares the two ways to choose a setting over all error channels but the
lathe's. Nothing is asserted.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from benchmarks.beyond import ROOT
from benchmarks.forward import STEP, folds, in_time, machines
from data.arrays import Array
from data.errors import InputError
from features.design import Design
from models.base import Family
from models.families import lag_dictionary
from models.families.distributed_lag import DistributedLag
from models.families.lag_dictionary import PROMPT, UNDRIVEN, Columns, LagDictionary
from models.families.mlr import MLR
from models.families.ridge import Ridge
from models.metrics import residual_std_um
from models.numerics.batch_process import BatchProcess, Windows
from models.protocols import Fold

FAMILIES: dict[str, Family] = {
    "mlr": MLR(),
    "ridge": Ridge(),
    "distributed_lag, leave_batch_out": DistributedLag(),
    "distributed_lag, forward (base)": DistributedLag(order_by="forward"),
    "lag_dictionary": LagDictionary(),
}
SETTINGS = [(level, steady) for level in (0.1, 10.0, 1000.0) for steady in (1.0, 100.0)]


def column_sets(columns: Columns) -> dict[str, NDArray[np.bool_]]:
    """Columns that take part: with and without absolute temperature, each sensor's start and the drivers."""
    now, measured = columns.reach == PROMPT, columns.reach <= UNDRIVEN
    level = np.array([n.startswith(("clock", "start level")) for n in columns.names])
    each = np.array([" at start, " in n for n in columns.names])
    lagged = measured & ~level & ~each
    return {
        "now": now,
        "now, start level": now | level,
        "lags": lagged,
        "lags, start level": lagged | level,
        "lags, start level, each start": measured,
        "lags, drivers": lagged | ~measured,
        "lags, drivers, both starts": lagged | ~measured | level | each,
    }


def all_trusted_S_um(design: Design, parts: Sequence[Fold]) -> Array:
    with patch.object(lag_dictionary, "_ODD", np.inf):
        return family_S_um(LagDictionary(), design, parts)


def family_S_um(family: Family, design: Design, parts: Sequence[Fold]) -> Array:
    fitted = family.fit_folds(design, [f.train for f in parts])
    if isinstance(family, DistributedLag):
        chosen = {(m.fitted["k"], m.fitted["taus_s"][-1] / 60.0) for m in fitted}
        print("    penalty and decay:", ", ".join(f"{k:g} {tau_min:g} min" for k, tau_min in sorted(chosen)))
    predicted = fitted[0].predict_folds(design, fitted, [f.test for f in parts])
    left = [design.y_um[design.rows(f.test[0])] - own[0] for f, own in zip(parts, predicted, strict=True)]
    return np.array([residual_std_um(e) for e in left])


def columns_S_um(columns: Columns, takes: NDArray[np.bool_], design: Design, parts: Sequence[Fold]) -> Array:
    """S (F,) of the mean prediction of six settings with some of the columns; no batch is mistrusted."""
    out = []
    for fold in parts:
        windows, prior = Windows.of(design, columns.x, fold.train), columns.prior(fold.train)
        each = [BatchProcess.of(windows, np.where(takes, level * steady * prior**2, 0.0), steady).gains()
                for level, steady in SETTINGS]  # fmt: skip
        rows = design.rows(fold.test[0])
        out.append(residual_std_um(design.y_um[rows] - columns.x[rows] @ np.mean(each, axis=0)))
    return np.array(out)


def show(name: str, S_um: Array, base: Array | None, took_s: float) -> None:
    line = f"  {name:38} {S_um.mean():6.2f} ± {S_um.std(ddof=1):5.2f}"
    if base is None:
        print(f"{line} {'':15} {took_s:6.1f} s", flush=True)
        return
    less = S_um - base
    print(f"{line}  {less.mean():+6.2f} ± {less.std(ddof=1) / np.sqrt(len(less)):4.2f} {took_s:6.1f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--machines", default="lathe,spindle,year,volumes,elements")
    args = parser.parse_args()
    known = machines(args.recordings)
    gain: list[float] = []
    for name in args.machines.split(","):
        try:
            machine, batches = known[name]()
        except InputError as error:
            print(f"\n{name}: skipped ({error})")
            continue
        batches = in_time(batches)
        n = len(batches)
        parts = folds(STEP, batches) or [Fold("", tuple(range(k)), (k,)) for k in range(max(3, n // 2), n)]
        thermal = batches[0].names("temperature", "ambient")
        inputs = [c for c in thermal if all(np.isfinite(b.masked(c)).any() for b in batches)]
        for target in batches[0].names("error"):
            design = Design.build(batches, inputs, target, machine)
            columns = Columns.of(design)
            runs: dict[str, Callable[[], Array]] = {
                key: partial(family_S_um, family, design, parts) for key, family in FAMILIES.items()
            }
            runs["lag_dictionary, none mistrusted"] = partial(all_trusted_S_um, design, parts)
            runs |= {
                f"columns: {key}": partial(columns_S_um, columns, takes, design, parts)
                for key, takes in column_sets(columns).items()
            }
            print(f"\n{name}, {target}: {len(parts)} runs")
            base: Array | None = None
            in_turn = np.nan
            for k, run in runs.items():
                start = time.process_time()
                S_um = run()
                show(k, S_um, base, time.process_time() - start)
                if k.endswith("(base)"):
                    gain += [] if name == "lathe" else [float(np.log(S_um.mean() / in_turn))]
                    base = S_um
                in_turn = S_um.mean()
    if len(gain) > 1:
        percent = 100.0 * np.array(gain)
        spread = percent.std(ddof=1) / np.sqrt(len(percent))
        print(f"\nforward over leave_batch_out: S {percent.mean():+.1f} ± {spread:.1f} %, {len(gain)} error channels")


if __name__ == "__main__":
    with threadpool_limits(limits=1):
        main()
