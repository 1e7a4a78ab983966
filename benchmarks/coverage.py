"""Coverage of the bounds on a run's S, sequentially on forward blocks: a bound uses only what was known before it.

    python -m benchmarks.coverage [--machines lathe,spindle,year,elements,volumes] [--cells none|ridge,…] [--out FILE]

Every block of later runs is bounded as `predict` does it: from all earlier runs a crossing, the bound of its left-out
runs, the model with its siblings. Columns, over all error channels and cells of a machine:
- runs: bounded runs (a run counts once per channel and cell; they are not independent);
- below: share of S below the run's bound, with a Wilson 95 % interval; bound/S: mean bound over mean S;
- next: the same for the bound of `expected_next`; naive: for the 90 % quantile of leave-batch-out;
- doubled: share of runs with more than twice the S that `expected_next` promised;
- caught: how many of these were flagged beforehand; false: flagged among the others; above: flagged runs above bound.
The recordings of lathe and spindle are read from --data; machines without data are left out.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import binomtest
from threadpoolctl import threadpool_limits

from data.batch import Batch
from data.checks import check_machine, checked
from data.errors import InputError
from data.machine import Machine, load_machine
from data.recording import read_batches
from features.rises import zeroed_error_um
from models.conformal import RunBound, expected_next
from models.crossing import Plan, prepare, refit, with_target
from models.metrics import residual_std_um
from models.protocols import forward
from models.trust import Region, fit_siblings, left_out_runs
from pipelines.model_store import StoredModel
from plants.plant import draw
from plants.sample.sample_year import write_sample_year

ROOT = Path(__file__).parent.parent
CELLS = ("none|ridge", "correlation|ridge|4", "none|pls", "none|distributed_lag", "correlation|lag_dictionary|4")
PROTOCOLS = ("forward", "leave-batch-out", "leave-season-out", "leave-speed-out")
Recorded = tuple[Machine, list[Batch]]


def recorded(name: str, files: Sequence[Path]) -> Recorded:
    machine = load_machine(ROOT / "machines" / f"{name}.yml")
    return machine, [checked(b, machine) for f in files for b in read_batches(f, machine)]


def sample_year(seed: int) -> Recorded:
    with tempfile.TemporaryDirectory() as folder:
        return recorded("sample_vmc", write_sample_year(Path(folder), seed=seed))


def plant(kind: str, seed: int) -> Recorded:
    case = draw(seed, plant=kind, batches=30)
    return case.machine, [checked(b, case.machine) for b in case.batches]


def machines(data: Path) -> dict[str, Callable[[], list[Recorded]]]:
    """By name what a row of the table is about."""
    lathe, spindle = sorted(data.glob("lathe_gv1203/2*.csv")), sorted(data.glob("spindle_fl/*.csv"))
    return {
        "lathe": lambda: [recorded("lathe_gv1203", lathe)] if lathe else [],
        "spindle": lambda: [recorded("spindle_fl", spindle)] if spindle else [],
        "year": lambda: [sample_year(seed) for seed in (2, 3)],
        "elements": lambda: [plant("elements", seed) for seed in (21, 23)],
        "volumes": lambda: [plant("volumes", seed) for seed in (22, 24)],
    }


def bounded(machine: Machine, batches: Sequence[Batch], target: str, cell: str) -> Iterator[dict[str, object]]:
    """A row per later run of a cell."""
    selector, family, *points = cell.split("|")
    plan = Plan((selector,), (family,), PROTOCOLS, tuple(map(int, points)) or None)
    kept = with_target(batches, target)
    for block in forward(kept):
        try:
            crossing = prepare([kept[k] for k in block.train], target, plan, machine)
            n_tsp = int(points[0]) if points else len(crossing.design.inputs)
            runs = left_out_runs(crossing, selector, family, n_tsp).runs
            fitted = refit(crossing, selector, family, n_tsp)
        except InputError:  # too few runs to fit the cell
            continue
        bound, promised = RunBound.of(runs), expected_next(runs)
        near = runs.loc[runs["protocol"] == "leave-batch-out", "S_um"].dropna()
        if near.empty:
            continue
        region, siblings = Region.of(crossing.batches, fitted.inputs), fit_siblings(fitted, crossing.batches)
        model = StoredModel(fitted, machine, region, {}, bound, siblings)
        for k in block.test:
            predicted_um = fitted.predict(kept[k])
            S_um = float(residual_std_um(zeroed_error_um(kept[k], target) - predicted_um))
            if not np.isfinite(S_um):  # an input is masked throughout
                continue
            yield {
                "target": target, "cell": cell, "block": block.name, "batch_id": kept[k].batch_id, "S_um": S_um,
                **model.run_error(kept[k], predicted_um)._asdict(), "next_S_um": promised.S_um,
                "next_bound_um": promised.bound_um, "naive_um": float(np.quantile(near, 0.9)),
            }  # fmt: skip


def summary(rows: pd.DataFrame) -> dict[str, str]:
    S_um = rows["S_um"].to_numpy(float)

    def against(column: str) -> str:
        below = int((S_um <= rows[column]).sum())
        low, high = binomtest(below, len(rows)).proportion_ci(method="wilson")
        share = f"{100 * below / len(rows):.0f} ({100 * low:.0f}–{100 * high:.0f})"
        return f"{share} {rows[column].mean() / S_um.mean():.2f}"

    doubled = S_um > 2 * rows["next_S_um"].to_numpy(float)
    flagged = (rows["flagged"] != "").to_numpy()
    above = S_um > rows["bound90_S_um"].to_numpy(float)
    return {
        "runs": str(len(rows)), "below % bound/S": against("bound90_S_um"), "next": against("next_bound_um"),
        "naive": against("naive_um"), "doubled": f"{doubled.sum()}", "caught": f"{(doubled & flagged).sum()}",
        "false %": f"{100 * flagged[~doubled].mean():.0f}", "above": f"{(above & flagged).sum()}/{above.sum()}",
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--machines", default="lathe,spindle,year,elements,volumes")
    parser.add_argument("--cells", default=",".join(CELLS))
    parser.add_argument("--out", type=Path, help="the rows as CSV")
    args = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)
    rows, every = [], machines(args.data)
    with threadpool_limits(limits=1):
        for name in args.machines.split(","):
            for machine, batches in every[name]():
                known = check_machine(batches, machine)
                for target in known[0].names("error"):
                    for cell in args.cells.split(","):
                        rows += [{"machine": name, **row} for row in bounded(machine, known, target, cell)]
            print(pd.DataFrame({name: summary(pd.DataFrame(rows).query("machine == @name"))}).T.to_string(), flush=True)
    table = pd.DataFrame(rows)
    parts = {**dict(list(table.groupby("machine", sort=False))), "all": table}
    print(pd.DataFrame({name: summary(own) for name, own in parts.items()}).T.to_string())
    if args.out:
        table.to_csv(args.out, index=False)


if __name__ == "__main__":
    main()
