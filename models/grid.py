"""The grid: every selector × every family × every number of points × every protocol, for several error channels."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from data.batch import Batch, finding_table
from data.machine import Machine
from data.processes import Processes, Shared, in_threads, one_thread
from features.selectors import SELECTORS
from features.selectors.base import Diagnostic
from features.stability import stability_over_batches
from models import FAMILIES
from models.crossing import Crossing, FamilyResult, Plan, cross_family, prepare
from models.protocols import Fold, season, speed, start_ambient_degC
from models.result import CELL_KEYS, GridResult
from models.trust import LeftOut, left_out_runs
from models.updating import COLUMNS, updated_scores

R = TypeVar("R")


class Pool(Protocol):
    """Where jobs run: worker processes of this computer (`data.processes.Processes`), or of others."""

    def __enter__(self) -> object: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def shared(self, value: Any) -> Any:
        """A handle on state that every worker loads once; a job receives it as a `data.processes.Shared`."""

    def submit(self, work: Callable[..., R], *args: Any) -> Callable[[], R]:
        """Begin a job; what is returned waits for its result."""


Pools = Callable[[int], tuple[Pool, Pool]]  # of n processes; the second one for families that share work


def local_pools(n: int) -> tuple[Pool, Pool]:
    """`n` processes of this computer, and one more for families that share work; n = 1: all in this one."""
    return Processes(n, _start), Processes(1, _start, spawn=n > 1)


class Workers:
    """Crosses families of the given crossings (by error channel) in `n` processes; results do not depend on where.

    Most of a small fit's time is Python's own, so threads would take turns; processes do not. Calls may come from
    several threads. Families that share work over the error channels are all in one process.
    """

    def __init__(self, crossings: Mapping[str, Crossing], n: int, pools: Pools = local_pools) -> None:
        self._pool, self._sharing = pools(n)
        self._crossings: Any = dict(crossings)

    def cross(self, job: tuple[str, str]) -> FamilyResult:
        """`cross_family` of (error channel, family); waits for it."""
        return self._pool_of(job[1]).submit(_cross, self._crossings, job)()

    def distances(self, cell: tuple[str, str, str, int]) -> LeftOut:
        """`left_out_runs` of (error channel, selector, family, n_tsp), where the crossing left its results."""
        return self._pool_of(cell[2]).submit(_distances, self._crossings, cell)()

    def readings(self, cell: tuple[str, str, str, int]) -> pd.DataFrame:
        """`updated_scores` forward in time of the same; empty for iterative families, whose many fits take hours."""
        if not FAMILIES[cell[2]].closed_form:
            return pd.DataFrame(columns=COLUMNS)
        return self._pool_of(cell[2]).submit(_readings, self._crossings, cell)()

    def _pool_of(self, family: str) -> Pool:
        return self._sharing if FAMILIES[family].shares_targets else self._pool

    def __enter__(self) -> Self:
        self._pool.__enter__()
        self._sharing.__enter__()
        self._crossings = self._pool.shared(self._crossings)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._sharing.__exit__(kind, error, at)
        self._pool.__exit__(kind, error, at)


def workers_for(families: Sequence[str]) -> int:
    """How many processes pay: one per core where an iterative family is among them, else this one."""
    return (os.cpu_count() or 1) if any(not FAMILIES[f].closed_form for f in families) else 1


def jobs_of(plan: Plan, targets: Sequence[str]) -> list[tuple[str, str]]:
    """(error channel, family) pairs, the slow, iterative families first, so that none of them is alone at the end.

    Of families that share work over the error channels one goes before all others; those that wait for it come last.
    """
    jobs = [(t, f) for f in sorted(plan.families, key=lambda f: FAMILIES[f].closed_form) for t in targets]
    sharing = [(t, f) for f in plan.families if FAMILIES[f].shares_targets for t in targets]
    return [*sharing[:1], *(j for j in jobs if j not in sharing), *sharing[1:]]


def run_grid(
    batches: Sequence[Batch],
    targets: Sequence[str],
    plan: Plan,
    machine: Machine | None = None,
    *,
    workers: int = 1,
    progress: Callable[[str, int, int], None] | None = None,
) -> dict[str, tuple[Crossing, GridResult]]:
    """The whole crossing of several error channels; results do not depend on `workers`, the number of processes.

    `progress` is called with what was done, how many of how many.
    """
    plan = plan.suited(machine, [b.channels[t] for b in batches[:1] for t in targets if t in b.channels])
    with threadpool_limits(limits=1):
        crossings = {t: prepare(batches, t, plan, machine) for t in targets}
        jobs = jobs_of(plan, targets)

        def finished(job: tuple[str, str], n: int) -> None:
            if progress:
                progress(f"{job[0]} {job[1]}", n, len(jobs))

        with Workers(crossings, workers) as crew:
            done = dict(zip(jobs, in_threads(crew.cross, jobs, workers, finished), strict=True))
    return {t: (crossings[t], assemble(crossings[t], [done[t, f] for f in plan.families])) for t in targets}


def assemble(crossing: Crossing, results: Sequence[FamilyResult]) -> GridResult:
    """One result from the families' shares."""
    design = crossing.design
    predictions = {
        "batch_id": np.array(design.batch_ids, dtype=object)[design.group],
        "time_s": design.time_s,
        "recorded_um": design.y_um,
    }
    if design.along:
        predictions["position_mm"] = design.position_mm(design.along)
    for r in results:
        predictions |= r.predictions
    failures = [f for r in results for f in r.failures]
    cells = pd.concat([r.cells for r in results if len(r.cells)], ignore_index=True)
    scores = pd.concat([r.scores for r in results if len(r.scores)], ignore_index=True)
    first = [*CELL_KEYS, "fold", "batch_id"]
    return GridResult(
        machine=crossing.machine,
        target=design.target,
        simulated=any(b.simulated for b in crossing.batches),
        batches=batch_table(crossing.batches),
        scores=scores[[*first, *(c for c in scores if c not in first)]],
        cells=cells,
        subsets=_subset_table(crossing),
        predictions=pd.DataFrame(predictions),
        findings=finding_table((b.batch_id, b.findings) for b in crossing.batches),
        excluded=pd.DataFrame([*crossing.excluded, *failures], columns=["channel", "reason"]),
        selector_diagnostics=_diagnostics_table(crossing, cells),
    )


def batch_table(batches: Sequence[Batch]) -> pd.DataFrame:
    """One row a batch: identity, origin and the labels that protocols group by."""
    return pd.DataFrame(
        [
            {
                "batch_id": b.batch_id,
                "start": b.start.isoformat() if b.start is not None else "",
                "digest": b.digest,
                "version": b.version,
                "source": b.source,
                "simulated": b.simulated,
                "n_rows": b.n_rows,
                "speed": speed(b),
                "start_ambient_degC": start_ambient_degC(b),
                "season": season(b),
            }
            for b in batches
        ]
    )


def _subset_table(crossing: Crossing) -> pd.DataFrame:
    rows = []
    n_all = range(1, len(crossing.design.inputs) + 1)
    for protocol, folds in [*crossing.folds.items(), ("all", [Fold("all", crossing.everything, ())])]:
        for fold in folds:
            for selector in crossing.plan.selectors:
                for n in n_all if SELECTORS[selector].takes_n_tsp else n_all[-1:]:
                    rows.append((protocol, selector, n, fold.name, "|".join(crossing.inputs(selector, fold.train, n))))
    return pd.DataFrame(rows, columns=["protocol", "selector", "n_tsp", "fold", "inputs"])


def _diagnostics_table(crossing: Crossing, cells: pd.DataFrame) -> pd.DataFrame:
    rows = []
    protocol = "leave-batch-out" if crossing.folds.get("leave-batch-out") else next(iter(crossing.folds))
    fewer = cells[(cells["protocol"] == protocol) & (cells["n_inputs"] < len(crossing.design.inputs))]
    for key in crossing.plan.selectors:
        own = fewer[fewer["selector"] == key].dropna(subset="S_mean_um")
        if SELECTORS[key].takes_n_tsp and len(own):
            n = int(own["n_tsp"].iloc[int((own["S_mean_um"] + own["S_std_um"].fillna(0.0)).argmin())])
            stable = stability_over_batches([crossing.inputs(key, f.train, n) for f in crossing.folds[protocol]])
            found = SELECTORS[key]().diagnostics(crossing.design, crossing.everything, n)
            rows += [{"selector": key, "n_tsp": n, **asdict(d)} for d in (stable, *found)]
    return pd.DataFrame(rows, columns=["selector", "n_tsp", *(f.name for f in fields(Diagnostic))])


def _start() -> None:
    """First call in a worker process: to find it here loads the families, since only loaded libraries are limited."""
    one_thread()


def _cross(crossings: Shared[dict[str, Crossing]], job: tuple[str, str]) -> FamilyResult:
    return cross_family(crossings.get()[job[0]], job[1])


def _distances(crossings: Shared[dict[str, Crossing]], cell: tuple[str, str, str, int]) -> LeftOut:
    return left_out_runs(crossings.get()[cell[0]], *cell[1:])


def _readings(crossings: Shared[dict[str, Crossing]], cell: tuple[str, str, str, int]) -> pd.DataFrame:
    return updated_scores(crossings.get()[cell[0]], *cell[1:], protocols=("forward",))
