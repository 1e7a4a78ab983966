"""Coverage of the bounds on a run's S, sequentially on forward blocks: a bound uses only what was known before it.

    python -m benchmarks.coverage [--machines lathe,spindle,year,elements,volumes] [--cells none|ridge,…] [--out FILE]

Every block of later runs is bounded as `predict` does it: from all earlier runs a crossing of the cells, the bound of
the left-out runs of each, and their disagreement. Columns, over all error channels and cells of a machine:
- runs: bounded runs (a run counts once per channel and cell; they are not independent);
- below: share of S below the run's bound, with a Wilson 95 % interval; bound/S: mean bound over mean S;
- next: the same for the bound of `expected_next`; naive: for the 90 % quantile of leave-batch-out;
- doubled: share of runs with more than twice the S that `expected_next` promised;
- caught: how many of these were flagged beforehand; false: flagged among the others; above: flagged runs above bound;
- weighed: what the authority that falls outside the trained region changes of S, % (geometric mean ± standard error).
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
from models.metrics import residual_std_um
from models.protocols import forward
from models.selection.conformal import RunBound, expected_next
from models.selection.crossing import FamilyResult, Plan, cross_family, prepare, refit, with_target
from models.selection.result import CELL_KEYS
from models.selection.stack import best_cells
from models.selection.trust import Region, left_out_runs
from pipelines.store.model_store import StoredModel
from plants.sample.sample_year import write_sample_year
from thermodrift_exam.plants.plant import draw

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


def bounded(
    machine: Machine, batches: Sequence[Batch], target: str, cells: Sequence[str]
) -> Iterator[dict[str, object]]:
    """A row per later run and cell."""
    kept, named = with_target(batches, target), [cell.split("|") for cell in cells]
    selectors, families = (tuple(dict.fromkeys(c[k] for c in named)) for k in (0, 1))
    for block in forward(kept):
        try:
            crossing = prepare([kept[k] for k in block.train], target, Plan(selectors, families, PROTOCOLS), machine)
        except InputError:  # too few runs
            continue
        every = len(crossing.design.inputs)
        wanted = [(s, f, int(points[0]) if points else every) for s, f, *points in named]
        result = FamilyResult.joined([cross_family(crossing, f, [(s, n)], crossing.folds) for s, f, n in wanted])
        peers = best_cells(crossing, result, "forward" if crossing.folds.get("forward") else "leave-batch-out")
        models = {
            c: refit(crossing, *c) for c in wanted if f"leave-batch-out|{'|'.join(map(str, c))}" in result.predictions
        }
        for cell, fitted in models.items():
            runs = left_out_runs(crossing, cell, result.predictions, peers).runs
            near = runs.loc[runs["protocol"] == "leave-batch-out", "S_um"].dropna()
            bound, promised = RunBound.of(runs), expected_next(runs)
            siblings = [models[c] for c in peers[CELL_KEYS[1:]].itertuples(index=False, name=None) if c[1] != cell[1]]
            model = StoredModel(fitted, machine, Region.of(crossing.batches, fitted.inputs), {}, bound, tuple(siblings))
            for k in block.test:
                predicted_um = fitted.predict(kept[k])
                error_um, weight = zeroed_error_um(kept[k], target), model.weight(model.distance(kept[k]))
                S_um = float(residual_std_um(error_um - predicted_um))
                if not np.isfinite(S_um):  # an input is masked throughout
                    continue
                yield {
                    "target": target, "cell": "|".join(map(str, cell)), "block": block.name,
                    "batch_id": kept[k].batch_id, "S_um": S_um,
                    "weighed_S_um": float(residual_std_um(error_um - weight * predicted_um)),
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
    weighed = np.log(rows["weighed_S_um"] / S_um).groupby(rows["batch_id"]).mean()
    return {
        "weighed %": f"{100 * weighed.mean():+.1f} ± {100 * weighed.sem():.1f}",
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
                    rows += [{"machine": name, **r} for r in bounded(machine, known, target, args.cells.split(","))]
            print(pd.DataFrame({name: summary(pd.DataFrame(rows).query("machine == @name"))}).T.to_string(), flush=True)
    table = pd.DataFrame(rows)
    parts = {**dict(list(table.groupby("machine", sort=False))), "all": table}
    print(pd.DataFrame({name: summary(own) for name, own in parts.items()}).T.to_string())
    if args.out:
        table.to_csv(args.out, index=False)


if __name__ == "__main__":
    main()
