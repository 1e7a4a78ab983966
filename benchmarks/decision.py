"""What does the default decision reach on later runs?

    python -m benchmarks.decision [--recordings FOLDER] [--machines lathe,year] [--effort quick] [--out results/…csv]

The last twelve runs of a machine, in three blocks: before each block all that `train` does is repeated on the runs so
far (race, choice, refit), and the chosen model predicts the block as it does at the machine: a guard replaces sensors
that fail for a while, and where it gives up, or a sensor never arrives, nothing is sent. A provisional choice sends its
share of the correction, a refused one nothing. Next to it are ridge on all temperatures, refitted at the same times
behind the same guard, and no model. One row per error channel and run: S of each, µm, the 90 % bound that was stated,
the family and its standing, and sensors that never arrived. The lathe is real, FOLDER holds it; the year is simulated.
Nothing is asserted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from benchmarks.beyond import ROOT
from benchmarks.forward import in_time, machines
from benchmarks.results import write
from compensation.faults import with_values
from compensation.substitutes import Guard
from data.arrays import Array
from data.batch import Batch
from data.machine import Machine
from features.rises import zeroed_error_um
from models.base import Family
from models.families import FAMILIES
from models.metrics import residual_std_um
from models.protocols import PromotionRule
from models.selection.crossing import Plan, unfitted
from models.selection.grid import run_grid
from models.selection.outlook import outlook
from models.selection.promotion import decide
from pipelines.store.fitted_model import substitutes_of

LAST, BLOCK = 12, 4  # runs that are predicted, and runs between two decisions


def corrected_um(model: Family, guard: Guard, batch: Batch) -> tuple[Array, list[str]]:
    """The correction of a run row by row (n,), µm, and the inputs that are nowhere recorded in it."""
    names = [n for n in guard.substitutes.names if n in batch.channels]
    recorded = {n: batch.masked(n) for n in names}
    watch, rows, until = guard.begin(), list[list[float]](), batch.n_rows
    for k in range(batch.n_rows):
        watch, checked = guard.step(watch, float(batch.time_s[k]), {n: float(v[k]) for n, v in recorded.items()})
        rows.append([checked.values[n] for n in names])  # noqa: PD011 - a mapping
        if checked.fault is not None:
            until = k
            break
    table = {n: np.full(batch.n_rows, np.nan) for n in names}
    for n, values in zip(names, np.array(rows).T, strict=True):
        table[n][: len(values)] = values
    predicted = model.predict(with_values(batch, table))
    predicted[until:] = 0.0
    return predicted, [n for n, v in recorded.items() if not np.isfinite(v).any()]


def rows(name: str, machine: Machine, batches: Sequence[Batch], effort: str) -> Iterator[dict[str, object]]:
    """A row per error channel and predicted run."""
    for target in batches[0].names("error"):
        for first in range(len(batches) - LAST, len(batches), BLOCK):
            so_far, later = batches[:first], batches[first : first + BLOCK]
            _, result = run_grid(so_far, [target], Plan(effort=effort), machine)[target]  # type: ignore[arg-type]
            choice = decide(result, PromotionRule())
            model = unfitted(choice.family, result.stack).fit(so_far, choice.inputs, target, machine)
            thermal = so_far[0].names("temperature", "ambient")
            recorded = [n for n in thermal if all(np.isfinite(b.masked(n)).any() for b in so_far)]
            ridge = FAMILIES["ridge"]().fit(so_far, recorded, target, machine)
            guards = [Guard(substitutes_of(m, so_far)) for m in (model, ridge)]
            bound_um = outlook(result, choice).bound_um
            share = {"champion": 1.0, "provisional": choice.authority}.get(choice.standing, 0.0)
            for b in later:
                error_um = zeroed_error_um(b, target)
                sent_um, lacking = corrected_um(model, guards[0], b)
                yield {
                    "machine": name, "channel": target, "run": b.batch_id, "n_trained": first,
                    "S_um": residual_std_um(error_um - share * sent_um),
                    "bound90_S_um": bound_um,
                    "ridge_S_um": residual_std_um(error_um - corrected_um(ridge, guards[1], b)[0]),
                    "no_model_S_um": residual_std_um(error_um), "family": choice.family, "selector": choice.selector,
                    "n_tsp": choice.n_tsp, "standing": choice.standing, "not_recorded": " ".join(lacking),
                    "simulated": b.simulated,
                }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--machines", default="lathe,year")
    parser.add_argument("--effort", default="quick")
    parser.add_argument("--out", type=Path, help="where the rows go, such as results/decision.csv")
    args = parser.parse_args()
    found: list[dict[str, object]] = []
    with threadpool_limits(limits=1):
        for name in args.machines.split(","):
            machine, batches = machines(args.recordings)[name]()
            for row in rows(name, machine, in_time(batches), args.effort):
                found.append(row)
                print(", ".join(f"{k} {v:.2f}" if isinstance(v, float) else str(v) for k, v in row.items()), flush=True)
    table = pd.DataFrame(found)
    print(table.groupby(["machine", "channel"])[["S_um", "ridge_S_um", "no_model_S_um"]].agg(["mean", "std"]).round(2))
    if args.out:
        write(
            args.out, table.round(4), f"python -m benchmarks.decision --machines {args.machines} --effort {args.effort}"
        )


if __name__ == "__main__":
    main()
