"""Speed of the grid on the simulated sample year, beside the plain way: a scikit-learn loop doing the same fits.

    python benchmarks/grid.py [--repeats 3] [--points 2,4,10]

Both ways fit the same cells (one channel, one selector, leave-batch-out, hyper-parameters by an inner leave-batch-out
where the family has one) in turn in one process; the table shows medians, the ratio and how far the errors differ.
Then the whole crossing of `make run` is timed once per repeat. Nothing is asserted about time.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from sklearn.base import BaseEstimator
from sklearn.cross_decomposition import PLSRegression
from sklearn.decomposition import PCA
from sklearn.linear_model import LinearRegression, Ridge
from sklearn.model_selection import GridSearchCV, LeaveOneGroupOut
from sklearn.pipeline import make_pipeline
from threadpoolctl import threadpool_limits

from data.batch import Batch
from data.machine import load_machine
from data.recording import read_batches
from data.sample_year import write_sample_year
from models.crossing import Crossing, Plan, cross_family, prepare
from models.grid import run_grid
from models.metrics import residual_std_um

PENALTIES = np.logspace(-6, 3, 25)


def plain(family: str, p: int) -> BaseEstimator:
    """The scikit-learn estimator that does the same."""
    inner = {"cv": LeaveOneGroupOut(), "scoring": "neg_root_mean_squared_error"}
    if family == "mlr":
        return LinearRegression()
    if family == "pcr":
        return make_pipeline(PCA(n_components=0.95 if p > 1 else 1, svd_solver="full"), LinearRegression())
    if family == "ridge":
        return GridSearchCV(Ridge(), {"alpha": PENALTIES * 1e3}, **inner)
    if family == "pcr_lbo":
        pipe = make_pipeline(PCA(), LinearRegression())
        return GridSearchCV(pipe, {"pca__n_components": list(range(1, p + 1))}, **inner)
    return GridSearchCV(PLSRegression(scale=False), {"n_components": list(range(1, p + 1))}, **inner)


def plain_loop(crossing: Crossing, family: str, points: list[int]) -> float:
    """Mean S over the cells, fold by fold and cell by cell."""
    scores = []
    for n in points:
        for fold in crossing.folds["leave-batch-out"]:
            design = crossing.design.subset(crossing.inputs("correlation", fold.train, n))
            x, y, groups = design.stacked(fold.train)
            model = plain(family, n)
            model.fit(x, y, groups=groups) if isinstance(model, GridSearchCV) else model.fit(x, y)
            rows = design.rows(fold.test[0])
            scores.append(residual_std_um(design.y_um[rows] - np.ravel(model.predict(design.x[rows]))))
    return float(np.mean(scores))


def grid_way(crossing: Crossing, family: str, points: list[int]) -> float:
    cells = cross_family(crossing, family).cells
    return float(cells[cells["n_tsp"].isin(points)]["S_mean_um"].mean())


def timed(work: Callable[[], float]) -> tuple[float, float]:
    start = time.perf_counter()
    value = work()
    return time.perf_counter() - start, value


def sample_batches(folder: Path) -> list[Batch]:
    machine = load_machine(Path(__file__).parent.parent / "machines" / "sample_vmc.yml")
    return [b for f in write_sample_year(folder) for b in read_batches(f, machine)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--points", default="2,4,10")
    args = parser.parse_args()
    points = [int(n) for n in args.points.split(",")]
    with tempfile.TemporaryDirectory() as folder:
        batches = sample_batches(Path(folder))
    rows = sum(b.n_rows for b in batches)
    print(f"simulated sample year: {len(batches)} batches, {rows} rows, points {points}, one thread each\n")
    print(f"{'family':8} {'plain s':>9} {'grid s':>9} {'ratio':>7} {'S plain µm':>11} {'S grid µm':>10}")
    with threadpool_limits(limits=1):
        for family in ("mlr", "pcr", "ridge", "pcr_lbo", "pls"):
            plan = Plan(("correlation",), (family,), ("leave-batch-out",), tuple(points))
            slow, fast = [], []
            for _ in range(args.repeats):
                crossing = prepare(batches, "z", plan)
                a, s_plain = timed(lambda c=crossing, f=family: plain_loop(c, f, points))
                crossing.subsets.clear()
                b, s_grid = timed(lambda c=crossing, f=family: grid_way(c, f, points))
                slow.append(a)
                fast.append(b)
            a, b = statistics.median(slow), statistics.median(fast)
            print(f"{family:8} {a:9.2f} {b:9.3f} {a / b:6.0f}× {s_plain:11.3f} {s_grid:10.3f}", flush=True)
    for workers in (1, os.cpu_count() or 1):
        print(f"\nthe crossing of `make run` (selectors × families × protocols, x, y and z), {workers} process(es)")
        for _ in range(args.repeats):
            start = time.perf_counter()
            results = run_grid(batches, "xyz", Plan(), workers=workers)
            cells = sum(len(r.cells) for _, r in results.values())
            print(f"  {time.perf_counter() - start:6.1f} s for {cells} cells", flush=True)


if __name__ == "__main__":
    main()
