"""Speed of the grid on the simulated sample year, next to the plain ways to do the same fits.

    python -m benchmarks.grid [--repeats 3] [--families mlr,ridge,…]

Three ways in turn in one process, in CPU seconds of all processes per cell (30 folds of leave-batch-out,
hyper-parameters by an inner leave-batch-out where the family has one; error channel z):
- plain: a loop over folds around scikit-learn's estimator (networks: a net trained alone in torch);
- joblib: scikit-learn's `cross_validate` over `LeaveOneGroupOut`, the selector in the pipeline, a process a core;
- grid: the crossing of all quick selectors × numbers of points, one thread, by its number of cells.
For the families of `plain_models.SAME` a fourth way is a loop around scikit-learn's own fits with the same settings and
rows: as far as it is the limit, sharing cannot help. The plain ways are timed on every fifth fold of the cell
`correlation`, 4 points, and counted five times; families on few rows (`ROWS`) give them as few. S is of those folds,
the same where the fits are the same. Then what each protocol costs, the quick and the complete crossing. Nothing is
asserted about time.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import tempfile
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import sklearn
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import GridSearchCV, LeaveOneGroupOut, cross_validate
from sklearn.pipeline import make_pipeline
from threadpoolctl import threadpool_limits

from benchmarks.plain_models import CHEAP, PLAIN, ROWS, SAME, TopCorrelated
from benchmarks.table import Row, timed
from data.batch import Batch
from data.machine import Machine, load_machine
from data.recording import read_batches
from models.metrics import residual_std_um
from models.protocols import PROTOCOLS
from models.selection.crossing import Crossing, Plan, cross_family, prepare
from models.selection.grid import run_grid
from plants.sample.sample_year import write_sample_year

POINTS, EVERY = 4, 5
PROCESSES = os.cpu_count() or 1
TOGETHER = ("mlr", "ridge", "pcr", "lssvm", "bp", "random_forest")  # that the target for all together is of
TARGET, TARGET_TOGETHER = 20.0, 500.0
TARGET_WHOLE_S = 300.0


def plain_loop(crossing: Crossing, family: str, every: int = EVERY) -> float:
    """Mean S of the cell, fold by fold."""
    scores = []
    for fold in crossing.folds["leave-batch-out"][::every]:
        design = crossing.design.subset(crossing.inputs("correlation", fold.train, POINTS))
        x, y, groups = thinned(family, *design.stacked(fold.train))
        model = PLAIN[family](POINTS)
        model.fit(x, y, groups=groups) if isinstance(model, GridSearchCV) else model.fit(x, y)
        rows = design.rows(fold.test[0])
        scores.append(float(residual_std_um(design.y_um[rows] - np.ravel(model.predict(design.x[rows])))))
    return float(np.mean(scores))


def same_fits(crossing: Crossing, family: str, every: int = EVERY) -> float:
    """The same by the library's own fits with the family's settings and rows."""
    scores = []
    for fold in crossing.folds["leave-batch-out"][::every]:
        design = crossing.design.subset(crossing.inputs("correlation", fold.train, POINTS))
        predicted = SAME[family](design, fold.train, fold.test[0])
        scores.append(float(residual_std_um(design.y_um[design.rows(fold.test[0])] - predicted)))
    return float(np.mean(scores))


def joblib_way(crossing: Crossing, family: str, every: int = EVERY, processes: int = PROCESSES) -> float:
    """The same by `cross_validate` in so many processes."""
    design = crossing.design
    x, y, groups = thinned(family, *design.stacked(range(design.n_batches)))
    inner = PLAIN[family](POINTS)
    folds = [*LeaveOneGroupOut().split(x, y, groups)][::every]
    with sklearn.config_context(enable_metadata_routing=True):
        if isinstance(inner, GridSearchCV):
            inner.cv = LeaveOneGroupOut().set_split_request(groups=True)
        found = cross_validate(make_pipeline(TopCorrelated(POINTS), inner), x, y, cv=folds,
                               params={"groups": groups} if isinstance(inner, GridSearchCV) else None,
                               n_jobs=processes, scoring="neg_root_mean_squared_error")  # fmt: skip
    counts = np.array([len(test) for _, test in folds])
    return float(np.mean(-found["test_score"] * np.sqrt(counts / (counts - 1))))


def thinned(family: str, *arrays: np.ndarray) -> list[np.ndarray]:
    """Evenly as few rows as the family itself learns from."""
    n = len(arrays[0])
    some = np.round(np.linspace(0, n - 1, min(n, ROWS.get(family, n)))).astype(int)
    return [a[some] for a in arrays]


def grid_way(crossing: Crossing, family: str, every: int = EVERY) -> tuple[float, int]:
    """S of the same cell, and how many cells were crossed."""
    crossing.subsets.clear()
    result = cross_family(crossing, family)
    own = result.scores[(result.scores["selector"] == "correlation") & (result.scores["n_tsp"] == POINTS)]
    return float(own["S_um"].iloc[::every].mean()), len(result.cells)


def sample_machine() -> Machine:
    return load_machine(Path(__file__).parent.parent / "machines" / "sample_vmc.yml")


def sample_batches(folder: Path, batches: int = 30) -> list[Batch]:
    machine = sample_machine()
    return [b for f in write_sample_year(folder, batches=batches) for b in read_batches(f, machine)]


@dataclass(frozen=True)
class Cell:
    """CPU seconds per cell by each way, and S in µm of the cell; `same` is NaN where there is no such loop."""

    family: str
    plain_s: float
    joblib_s: float
    grid_s: float
    same_s: float
    S_um: tuple[float, float, float, float]


def measured(crossing: Crossing, family: str, repeats: int, every: int = EVERY, processes: int = PROCESSES) -> Cell:
    """The ways in turn, medians; folds that are left out are counted as those that are timed."""
    took: list[list[float]] = [[], [], [], []]
    share = len(crossing.folds["leave-batch-out"]) / len(crossing.folds["leave-batch-out"][::every])
    S_same = math.nan
    with threadpool_limits(limits=1):
        for _ in range(repeats):
            a, S_plain = timed(plain_loop, crossing, family, every)
            b, S_joblib = timed(joblib_way, crossing, family, every, processes)
            c, (S_grid, cells) = timed(grid_way, crossing, family, every)
            d, S_same = timed(same_fits, crossing, family, every) if family in SAME else (math.nan, math.nan)
            for own, value in zip(took, (a * share, b * share, c / cells, d * share), strict=True):
                own.append(value)
    plain_s, joblib_s, grid_s, same_s = (statistics.median(own) for own in took)
    return Cell(family, plain_s, joblib_s, grid_s, same_s, (S_plain, S_joblib, S_grid, S_same))


def crossing_of(batches: Sequence[Batch], processes: int = PROCESSES) -> Crossing:
    """Channel z of the batches; the worker processes are there already, as in a long session."""
    crossing = prepare(batches, "z", Plan(protocols=("leave-batch-out",)))
    joblib_way(crossing, "mlr", processes=processes)
    return crossing


def rows(
    batches: Sequence[Batch],
    families: Sequence[str],
    repeats: int,
    every: int = EVERY,
    processes: int = PROCESSES,
) -> list[Row]:
    """Rows of the table: each family by each way, and those of the target together."""
    crossing, cells = crossing_of(batches, processes), []
    out = []
    for family in families:
        c = measured(crossing, family, repeats if family in CHEAP else 1, every, processes)
        cells.append(c)
        what = f"crossing, {family}, a cell"
        out.append(Row(what, c.grid_s, "scikit-learn, a loop", c.plain_s, TARGET))
        out.append(Row(what, c.grid_s, f"joblib, processes: {processes}", c.joblib_s))
        if family in SAME:
            out.append(Row(what, c.grid_s, "the library's own fits, same settings", c.same_s))
    those = [c for c in cells if c.family in TOGETHER]
    if those:
        ours_s, note = sum(c.grid_s for c in those), ", ".join(c.family for c in those)
        for name, seconds, target in (
            ("scikit-learn, a loop", sum(c.plain_s for c in those), TARGET_TOGETHER),
            (f"joblib, processes: {processes}", sum(c.joblib_s for c in those), math.nan),
        ):
            out.append(Row("crossing, together, a cell of each", ours_s, name, seconds, target, note=note))
    return out


def compare(batches: list[Batch], families: list[str], repeats: int) -> None:
    print(f"{'CPU seconds per cell':24}{'plain':>9}{'joblib':>9}{'same':>9}{'grid':>9}{'plain/':>8}{'joblib/':>8}"
          f"{'same/':>8}{'S plain':>10}{'joblib':>8}{'grid':>8}{'same µm':>9}")  # fmt: skip
    groups: dict[str, np.ndarray] = {}
    crossing = crossing_of(batches)
    for family in families:
        m = measured(crossing, family, repeats if family in CHEAP else 1)
        a, b, c, d = m.plain_s, m.joblib_s, m.grid_s, m.same_s
        kind = "linear" if family in CHEAP else "kernels, trees, nets"
        groups[kind] = groups.get(kind, np.zeros(3)) + np.array([a, b, c])
        print(f"{family:24}{a:9.3f}{b:9.3f}{d:9.3f}{c:9.4f}{a / c:7.0f}×{b / c:7.0f}×{d / c:7.1f}×"
              f"{m.S_um[0]:10.3f}{m.S_um[1]:8.3f}{m.S_um[2]:8.3f}{m.S_um[3]:9.3f}", flush=True)  # fmt: skip
    for words, (a, b, c) in {**groups, "all": sum(groups.values(), np.zeros(3))}.items():
        print(f"{words:24}{a:9.3f}{b:9.3f}{'':9}{c:9.4f}{a / c:7.0f}×{b / c:7.0f}×")
    print()


def whole(batches: list[Batch], plan: Plan, words: str) -> float:
    """Wall seconds of one crossing with all cores; prints what each family took of it."""
    start = last = time.perf_counter()
    took: dict[str, float] = {}

    def progress(what: str, done: int, of: int) -> None:
        nonlocal last
        now = time.perf_counter()
        took[what.split()[1]] = took.get(what.split()[1], 0.0) + now - last
        last = now

    machine = sample_machine()
    results = run_grid(batches, "xyz", plan, machine, workers=os.cpu_count() or 1, progress=progress)
    cells = sum(len(r.cells) for _, r in results.values())
    slowest = sorted(took, key=lambda f: -took[f])[:6]
    wall_s = time.perf_counter() - start
    print(f"{words}: {wall_s:.1f} s for {cells} cells on {os.cpu_count()} cores; "
          f"waited longest for {', '.join(f'{f} {took[f]:.0f} s' for f in slowest)}", flush=True)  # fmt: skip
    return wall_s


def protocols(batches: list[Batch], repeats: int) -> None:
    """What each protocol costs: the quick crossing of z in one process, protocols in turn."""
    took: dict[str, list[float]] = {p: [] for p in PROTOCOLS}
    for _ in range(repeats):
        for p, seconds in took.items():
            plan = Plan(effort="quick", protocols=(p,))
            seconds.append(timed(run_grid, batches, ["z"], plan, sample_machine())[0])
    for p, seconds in took.items():
        folds = len(PROTOCOLS[p](batches))
        print(f"{p:24}{statistics.median(seconds):9.2f} s, {folds} folds", flush=True)
    print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--families", default=",".join(PLAIN))
    parser.add_argument("--no-whole", action="store_true", help="leave out the whole crossings")
    args = parser.parse_args()
    warnings.simplefilter("ignore", ConvergenceWarning)
    warnings.simplefilter("ignore", UserWarning)
    with tempfile.TemporaryDirectory() as folder:
        batches = sample_batches(Path(folder))
    print(f"simulated sample year: {len(batches)} batches, {sum(b.n_rows for b in batches)} rows\n")
    compare(batches, args.families.split(","), args.repeats)
    if not args.no_whole:
        protocols(batches, args.repeats)
        whole(batches, Plan(effort="quick"), f"quick crossing, {len(PROTOCOLS)} protocols, x, y and z")
        whole(
            batches,
            Plan(protocols=("leave-batch-out",), effort="complete"),
            "complete crossing, leave-batch-out, x, y and z",
        )


if __name__ == "__main__":
    main()
