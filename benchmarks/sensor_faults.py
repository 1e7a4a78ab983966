"""What does a sensor cost that fails unnoticed?

    python -m benchmarks.sensor_faults models:/NAME@champion... --recordings PATH...

The guard learns from five of six recorded runs and watches the sixth, in turn. Each run is played as it is, for false
alarms. In the first run of each sixth every sensor in turn freezes, steps by 5 K, drifts by 1 or 10 K/h, from a quarter
of the run on, and is exchanged with its neighbour in the list. Of the faults that change the prediction by more than
10 µm without a guard it prints how many are found, how often the first sensor that is named is the right one, the time
until then, and the largest error of the prediction without and with the guard, until the guard gives up.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from compensation.substitutes import Guard, Substitutes
from data.arrays import Array
from data.batch import Batch
from pipelines.commands.predict import load_model
from pipelines.model_store import StoredModel
from pipelines.recordings import checked_files
from pipelines.settings import configure_environment, load

FOLDS = 6  # five sixths of the runs are as many as a training has
COUNTS_UM = 10.0  # a smaller error of the prediction is within what a model leaves anyway


def faults(batch: Batch, names: Sequence[str]) -> Iterator[tuple[str, set[str], dict[str, Array]]]:
    """Kind, the sensors at fault, and the values of these."""
    first = batch.n_rows // 4
    later = np.arange(batch.n_rows) >= first
    hours = np.maximum(batch.time_s - batch.time_s[first], 0.0) / 3600.0
    for name, other in zip(names, [*names[1:], names[0]], strict=True):
        v = batch.masked(name)
        yield "frozen", {name}, {name: np.where(later, v[first], v)}
        yield "step of 5 K", {name}, {name: v + 5.0 * later}
        yield "drift of 1 K/h", {name}, {name: v + hours}
        yield "drift of 10 K/h", {name}, {name: v + 10.0 * hours}
        yield "exchanged", {name, other}, {name: batch.masked(other), other: v}


def watched(guard: Guard, batch: Batch, names: Sequence[str]) -> tuple[list[dict[str, str]], Batch, int]:
    """By row the sensors that are not ok, the batch with what the guard lets pass, and how many rows that holds for."""
    watch, found, passed = guard.begin(), [], []
    columns = {n: batch.masked(n) for n in names}
    until = batch.n_rows
    for k, time_s in enumerate(batch.time_s):
        watch, checked = guard.step(watch, float(time_s), {n: float(columns[n][k]) for n in names})
        found.append({n: str(s) for n, s in checked.status.items() if s not in ("ok", "lost")})
        passed.append([checked.values[n] for n in names])  # noqa: PD011 - no pandas
        if checked.fault is not None:
            until = min(until, k)
    return found, _with(batch, dict(zip(names, np.array(passed).T, strict=True))), until


def _with(batch: Batch, columns: Mapping[str, Array]) -> Batch:
    return replace(batch, table=batch.table.assign(**columns), findings=())


def measured(models: Sequence[StoredModel], batches: Sequence[Batch]) -> tuple[pd.DataFrame, float, list[str]]:
    """One row a fault that counts; hours that were watched without one, and the runs with an alarm in them."""
    names = max((m.substitutes.names for m in models if m.substitutes is not None), key=len)
    rows, hours, alarms = [], 0.0, []
    for fold in range(min(FOLDS, len(batches))):
        left = batches[fold::FOLDS]
        guard = Guard(Substitutes.learn([b for b in batches if b not in left], names))
        for batch in left:
            found, _, _ = watched(guard, batch, names)
            hours += float(batch.time_s[-1]) / 3600.0
            alarms += [batch.batch_id] * any(found)
        clean = [m.predict(left[0]) for m in models]
        for kind, at_fault, columns in faults(left[0], names):
            wrong = _with(left[0], columns)
            found, passed, until = watched(guard, wrong, names)
            raw_um, left_um = (
                max(float(np.nanmax(np.abs(m.predict(b) - c)[:n])) for m, c in zip(models, clean, strict=True))
                for b, n in ((wrong, batch.n_rows), (passed, until))
            )
            first = next((k for k, bad in enumerate(found) if bad), None)
            begun = 0 if kind == "exchanged" else wrong.n_rows // 4
            rows.append({
                "fault": kind, "without_um": raw_um, "with_um": left_um, "found": first is not None,
                "right": first is not None and set(found[first]) <= at_fault,
                "after_s": np.nan if first is None else float(wrong.time_s[first] - wrong.time_s[begun]),
            })  # fmt: skip
    table = pd.DataFrame(rows)
    return table[table["without_um"] > COUNTS_UM], hours, alarms


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+")
    parser.add_argument("--recordings", nargs="+", type=Path, required=True)
    given = parser.parse_args()
    configure_environment()
    models = [load_model(m, load()) for m in given.models]
    table, hours, alarms = measured(models, checked_files(models[0].machine, given.recordings))
    each = table.groupby("fault", sort=False).agg(
        n=("found", "size"), found=("found", "sum"), right=("right", "sum"), after_s=("after_s", "median"),
        without_um=("without_um", "max"), with_um=("with_um", "max"), median_um=("with_um", "median"),
    )  # fmt: skip
    print(each.round(1).to_string())
    print(f"{len(alarms)} of the runs without a fault raise an alarm in {hours:.0f} h: {', '.join(alarms) or 'none'}")


if __name__ == "__main__":
    main()
