"""Speed of the grid on the simulated sample year, beside the plain ways to do the same fits.

    python -m benchmarks.grid [--repeats 3] [--families mlr,ridge,…]

Three ways in turn in one process, in seconds per cell (30 folds of leave-batch-out, hyper-parameters by an inner
leave-batch-out where the family has one; error channel z):
- plain: a loop over folds around scikit-learn's estimator (networks: a net trained alone in torch);
- joblib: scikit-learn's `cross_validate` over `LeaveOneGroupOut`, the selector in the pipeline, a process a core;
- grid: the crossing of all quick selectors × numbers of points, one thread, by its number of cells.
The plain ways are timed on every fifth fold of the cell `correlation`, 4 points, and counted five times; families on
few rows (`ROWS`) give them as few. S is of those folds, the same where the fits are the same. Then what each protocol
costs, the quick and the complete crossing. Nothing is asserted about time.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypeVar

import numpy as np
import sklearn
from sklearn.exceptions import ConvergenceWarning
from sklearn.model_selection import GridSearchCV, LeaveOneGroupOut, cross_validate
from sklearn.pipeline import make_pipeline
from threadpoolctl import threadpool_limits

from benchmarks.plain_models import CHEAP, PLAIN, ROWS, TopCorrelated
from data.batch import Batch
from data.machine import Machine, load_machine
from data.recording import read_batches
from models.crossing import Crossing, Plan, cross_family, prepare
from models.grid import run_grid
from models.metrics import residual_std_um
from models.protocols import PROTOCOLS
from plants.sample.sample_year import write_sample_year

P = ParamSpec("P")
T = TypeVar("T")
POINTS, EVERY = 4, 5


def plain_loop(crossing: Crossing, family: str) -> float:
    """Mean S of the cell, fold by fold."""
    scores = []
    for fold in crossing.folds["leave-batch-out"][::EVERY]:
        design = crossing.design.subset(crossing.inputs("correlation", fold.train, POINTS))
        x, y, groups = thinned(family, *design.stacked(fold.train))
        model = PLAIN[family](POINTS)
        model.fit(x, y, groups=groups) if isinstance(model, GridSearchCV) else model.fit(x, y)
        rows = design.rows(fold.test[0])
        scores.append(float(residual_std_um(design.y_um[rows] - np.ravel(model.predict(design.x[rows])))))
    return float(np.mean(scores))


def joblib_way(crossing: Crossing, family: str) -> float:
    """The same by `cross_validate`, a process a core."""
    design = crossing.design
    x, y, groups = thinned(family, *design.stacked(range(design.n_batches)))
    inner = PLAIN[family](POINTS)
    folds = [*LeaveOneGroupOut().split(x, y, groups)][::EVERY]
    with sklearn.config_context(enable_metadata_routing=True):
        if isinstance(inner, GridSearchCV):
            inner.cv = LeaveOneGroupOut().set_split_request(groups=True)
        found = cross_validate(make_pipeline(TopCorrelated(POINTS), inner), x, y, cv=folds,
                               params={"groups": groups} if isinstance(inner, GridSearchCV) else None,
                               n_jobs=os.cpu_count(), scoring="neg_root_mean_squared_error")  # fmt: skip
    counts = np.array([len(test) for _, test in folds])
    return float(np.mean(-found["test_score"] * np.sqrt(counts / (counts - 1))))


def thinned(family: str, *arrays: np.ndarray) -> list[np.ndarray]:
    """Evenly as few rows as the family itself learns from."""
    n = len(arrays[0])
    some = np.round(np.linspace(0, n - 1, min(n, ROWS.get(family, n)))).astype(int)
    return [a[some] for a in arrays]


def grid_way(crossing: Crossing, family: str) -> tuple[float, int]:
    """S of the same cell, and how many cells were crossed."""
    crossing.subsets.clear()
    result = cross_family(crossing, family)
    own = result.scores[(result.scores["selector"] == "correlation") & (result.scores["n_tsp"] == POINTS)]
    return float(own["S_um"].iloc[::EVERY].mean()), len(result.cells)


def timed(work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> tuple[float, T]:
    start = time.perf_counter()
    value = work(*args, **kwargs)
    return time.perf_counter() - start, value


def sample_machine() -> Machine:
    return load_machine(Path(__file__).parent.parent / "machines" / "sample_vmc.yml")


def sample_batches(folder: Path) -> list[Batch]:
    machine = sample_machine()
    return [b for f in write_sample_year(folder) for b in read_batches(f, machine)]


def compare(batches: list[Batch], families: list[str], repeats: int) -> None:
    print(f"{'seconds per cell':24}{'plain':>9}{'joblib':>9}{'grid':>9}{'plain/':>8}{'joblib/':>8}"
          f"{'S plain':>10}{'joblib':>8}{'grid µm':>9}")  # fmt: skip
    groups: dict[str, np.ndarray] = {}
    crossing = prepare(batches, "z", Plan(protocols=("leave-batch-out",)))
    joblib_way(crossing, "mlr")  # the processes are there already, as in a long session
    for family in families:
        took: list[list[float]] = [[], [], []]
        for _ in range(repeats if family in CHEAP else 1):
            with threadpool_limits(limits=1):
                a, S_plain = timed(plain_loop, crossing, family)
                b, S_joblib = timed(joblib_way, crossing, family)
                c, (S_grid, cells) = timed(grid_way, crossing, family)
            for seconds, value in zip(took, (a * EVERY, b * EVERY, c / cells), strict=True):
                seconds.append(value)
        a, b, c = (statistics.median(s) for s in took)
        kind = "linear" if family in CHEAP else "kernels, trees, nets"
        groups[kind] = groups.get(kind, np.zeros(3)) + np.array([a, b, c])
        print(f"{family:24}{a:9.3f}{b:9.3f}{c:9.4f}{a / c:7.0f}×{b / c:7.0f}×"
              f"{S_plain:10.3f}{S_joblib:8.3f}{S_grid:9.3f}", flush=True)  # fmt: skip
    for words, (a, b, c) in {**groups, "all": sum(groups.values(), np.zeros(3))}.items():
        print(f"{words:24}{a:9.3f}{b:9.3f}{c:9.4f}{a / c:7.0f}×{b / c:7.0f}×")
    print()


def whole(batches: list[Batch], plan: Plan, words: str) -> None:
    """One crossing with all cores, with what each family took of it."""
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
    print(f"{words}: {time.perf_counter() - start:.1f} s for {cells} cells on {os.cpu_count()} cores; "
          f"waited longest for {', '.join(f'{f} {took[f]:.0f} s' for f in slowest)}", flush=True)  # fmt: skip


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
