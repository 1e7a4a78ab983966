"""The grid: every selector × every family × every number of points × every protocol, for several error channels."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
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
from models.families import FAMILIES
from models.protocols import Fold, season, speed, start_ambient_degC
from models.selection.crossing import Crossing, FamilyResult, Plan, prepare
from models.selection.race import Job, drive
from models.selection.result import CELL_KEYS, GridResult

R = TypeVar("R")


class Pool(Protocol):
    """Where jobs run: worker processes of this computer (`data.processes.Processes`), or of others."""

    def __enter__(self) -> object: ...

    def __exit__(self, *error: Any) -> None: ...

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

    def cross(self, job: Job) -> FamilyResult:
        """The scores of a job; waits for them."""
        pool = self._sharing if FAMILIES[job.family].shares_targets else self._pool
        return pool.submit(_cross, self._crossings, job)()

    def __enter__(self) -> Self:
        self._pool.__enter__()
        self._sharing.__enter__()
        self._crossings = self._pool.shared(self._crossings)
        return self

    def __exit__(self, *error: Any) -> None:
        self._sharing.__exit__(*error)
        self._pool.__exit__(*error)


def workers_for(families: Sequence[str]) -> int:
    """How many processes pay: one per core where an iterative family is among them, else this one."""
    return (os.cpu_count() or 1) if any(not FAMILIES[f].closed_form for f in families) else 1


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
    with threadpool_limits(limits=1), Workers(crossings := {t: prepare(batches, t, plan, machine) for t in targets},
                                              workers) as crew:  # fmt: skip

        def cross(jobs: list[Job]) -> list[FamilyResult]:
            return in_threads(
                crew.cross, jobs, workers, lambda job, n: progress(job.label, n, len(jobs)) if progress else None
            )

        return {t: (crossings[t], assemble(crossings[t], *done)) for t, done in drive(crossings, cross).items()}


def assemble(crossing: Crossing, result: FamilyResult, race: pd.DataFrame, stack: pd.DataFrame) -> GridResult:
    """The tables of one error channel from the scores of its cells and the table of the race."""
    design = crossing.design
    predictions = {
        "batch_id": np.array(design.batch_ids, dtype=object)[design.group],
        "time_s": design.time_s,
        "recorded_um": design.y_um,
    }
    if design.along:
        predictions["position_mm"] = design.position_mm(design.along)
    every = "leave-batch-out|"
    predictions |= {k.removeprefix(every): v for k, v in result.predictions.items() if k.startswith(every)}
    cells, scores = _with_points(crossing, result.cells), result.scores
    first = [*CELL_KEYS, "fold", "batch_id"]
    return GridResult(
        machine=crossing.machine,
        target=design.target,
        simulated=any(b.simulated for b in crossing.batches),
        batches=batch_table(crossing.batches),
        scores=scores[[*first, *(c for c in scores if c not in first)]],
        cells=cells,
        subsets=_subset_table(crossing, cells),
        predictions=pd.DataFrame(predictions),
        findings=finding_table((b.batch_id, b.findings) for b in crossing.batches),
        excluded=pd.DataFrame([*crossing.excluded, *result.failures], columns=["channel", "reason"]),
        selector_diagnostics=_diagnostics_table(crossing, cells),
        race=race,
        stack=stack,
    )


def _with_points(crossing: Crossing, cells: pd.DataFrame) -> pd.DataFrame:
    """The cells with the points that they choose from all runs, and the similarity of the folds' choices."""
    own = list(cells[CELL_KEYS].itertuples(index=False))
    chosen = [crossing.inputs(selector, crossing.everything, n) for _, selector, _, n in own]
    return cells.assign(
        tsp_stability=[crossing.stability(protocol, selector, n) for protocol, selector, _, n in own],
        inputs=["|".join(i) for i in chosen],
        n_inputs=[len(i) for i in chosen],
        simulated=any(b.simulated for b in crossing.batches),
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
                "rows_read": b.repairs.get("rows_in", b.n_rows),
                "rows_dropped": b.repairs.get("rows_dropped", 0),
                "speed": speed(b),
                "start_ambient_degC": start_ambient_degC(b),
                "season": season(b),
            }
            for b in batches
        ]
    )


def _subset_table(crossing: Crossing, cells: pd.DataFrame) -> pd.DataFrame:
    rows = []
    n_all = range(1, len(crossing.design.inputs) + 1)
    own = cells[cells["selector"].isin(SELECTORS) & (cells["n_tsp"] > 0)]
    selecting = list(own[["protocol", "selector"]].drop_duplicates().itertuples(index=False))
    for protocol, selector in [*selecting, *(("all", s) for s in own["selector"].unique())]:
        for fold in crossing.folds.get(protocol, [Fold("all", crossing.everything, ())]):
            for n in n_all if SELECTORS[selector].takes_n_tsp else n_all[-1:]:
                rows.append((protocol, selector, n, fold.name, "|".join(crossing.inputs(selector, fold.train, n))))
    return pd.DataFrame(rows, columns=["protocol", "selector", "n_tsp", "fold", "inputs"])


def _diagnostics_table(crossing: Crossing, cells: pd.DataFrame) -> pd.DataFrame:
    rows = []
    protocol = cells["protocol"].iloc[0] if (p := "leave-batch-out") not in set(cells["protocol"]) else p
    fewer = cells[(cells["protocol"] == protocol) & (cells["n_inputs"] < len(crossing.design.inputs))]
    for key in dict.fromkeys(fewer["selector"].astype(str)):
        own = fewer[fewer["selector"] == key].dropna(subset="S_mean_um")
        if key in SELECTORS and SELECTORS[key].takes_n_tsp and len(own):
            n = int(own["n_tsp"].iloc[int((own["S_mean_um"] + own["S_std_um"].fillna(0.0)).argmin())])
            stable = stability_over_batches([crossing.inputs(key, f.train, n) for f in crossing.folds[protocol]])
            found = SELECTORS[key]().diagnostics(crossing.design, crossing.everything, n)
            rows += [{"selector": key, "n_tsp": n, **asdict(d)} for d in (stable, *found)]
    return pd.DataFrame(rows, columns=["selector", "n_tsp", *(f.name for f in fields(Diagnostic))])


def _start() -> None:
    """First call in a worker process: to find it here loads the families, since only loaded libraries are limited."""
    one_thread()


def _cross(crossings: Shared[dict[str, Crossing]], job: Job) -> FamilyResult:
    return job.run(crossings.get()[job.target])
