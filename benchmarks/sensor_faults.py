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
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from compensation.faults import BEGINS, faults, watched, with_values
from compensation.substitutes import Guard, Substitutes
from data.batch import Batch
from pipelines.commands.predict import load_model
from pipelines.jobs.recordings import checked_files
from pipelines.settings import configure_environment, load
from pipelines.store.model_store import StoredModel

FOLDS = 6  # five sixths of the runs are as many as a training has
COUNTS_UM = 10.0  # a smaller error of the prediction is within what a model leaves anyway


def measured(models: Sequence[StoredModel], batches: Sequence[Batch]) -> tuple[pd.DataFrame, float, list[str]]:
    """One row a fault that counts; hours that were watched without one, and the runs with an alarm in them."""
    names = max((m.substitutes.names for m in models if m.substitutes is not None), key=len)
    rows, hours, alarms = [], 0.0, []
    for fold in range(min(FOLDS, len(batches))):
        left = batches[fold::FOLDS]
        guard = Guard(Substitutes.learn([b for b in batches if b not in left], names))
        for batch in left:
            hours += float(batch.time_s[-1]) / 3600.0
            alarms += [batch.batch_id] * (watched(guard, batch, names).first is not None)
        clean = [m.predict(left[0]) for m in models]
        for kind, at_fault, columns in faults(left[0], names):
            wrong = with_values(left[0], columns)
            seen = watched(guard, wrong, names)
            raw_um, left_um = (
                max(float(np.nanmax(np.abs(m.predict(b) - c)[:n])) for m, c in zip(models, clean, strict=True))
                for b, n in ((wrong, wrong.n_rows), (seen.passed, seen.until))
            )
            first = seen.first
            begun = 0 if kind == "exchanged" else wrong.n_rows // BEGINS
            rows.append({
                "fault": kind, "without_um": raw_um, "with_um": left_um, "found": first is not None,
                "right": first is not None and seen.untrusted[first] <= at_fault,
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
