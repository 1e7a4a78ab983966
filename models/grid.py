"""The grid: every selector × every family × every number of points × every protocol, for one error channel.

Folds share work: the rows are stacked once, a selector learns once per training set, and a set of inputs that
several selectors or numbers of points arrive at is fitted once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from data.batch import Batch
from data.checks import usable_channels
from data.errors import InputError
from features.design import Design
from features.rises import temperature_inputs
from features.selectors import SELECTORS
from features.stability import tsp_stability
from models import FAMILIES
from models.base import Family
from models.judging import Judged, score_rows, summary
from models.protocols import PROTOCOLS, Fold, folds_of, season, speed, start_ambient_degC
from models.result import CELL_KEYS, GridResult

Array = NDArray[np.float64]
Inputs = tuple[str, ...]


@dataclass(frozen=True)
class Plan:
    """What to cross. `n_tsps` None means 1 to all; iterative families (bp, lssvm) take `iterative_n_tsps` and all."""

    selectors: tuple[str, ...] = tuple(SELECTORS)
    families: tuple[str, ...] = tuple(FAMILIES)
    protocols: tuple[str, ...] = tuple(PROTOCOLS)
    n_tsps: tuple[int, ...] | None = None
    iterative_n_tsps: tuple[int, ...] = (2, 4)

    def points(self, family: type[Family], n_inputs: int) -> tuple[int, ...]:
        """The numbers of points a family is tried with."""
        wanted = self.n_tsps or tuple(range(1, n_inputs + 1))
        if not family.closed_form:
            wanted = (*(n for n in self.iterative_n_tsps if n in wanted), wanted[-1])
        return tuple(dict.fromkeys(n for n in wanted if n <= n_inputs))


@dataclass(frozen=True)
class Crossing:
    """All that the families of one error channel share."""

    machine: str
    batches: tuple[Batch, ...]
    design: Design
    plan: Plan
    folds: dict[str, list[Fold]]
    chosen: dict[tuple[str, tuple[int, ...]], dict[int, Inputs]]  # (selector, training batches) -> n -> inputs
    excluded: tuple[tuple[str, str], ...]
    subsets: dict[Inputs, Design] = field(default_factory=dict)

    @property
    def everything(self) -> tuple[int, ...]:
        return tuple(range(self.design.n_batches))

    def subset(self, inputs: Inputs) -> Design:
        if inputs not in self.subsets:
            self.subsets[inputs] = self.design.subset(inputs)
        return self.subsets[inputs]

    def inputs(self, selector: str, train: tuple[int, ...], n_tsp: int) -> Inputs:
        return self.chosen[selector, train][n_tsp] if n_tsp else ()

    def needed(self, folds: Sequence[Fold], cells: Sequence[tuple[str, int]]) -> list[tuple[Design, list[int]]]:
        """Every distinct set of inputs that the cells need, and the folds that need it: equal sets are fitted once."""
        folds_of_inputs: dict[Inputs, dict[int, None]] = {}
        for selector, n_tsp in cells:
            for i, fold in enumerate(folds):
                folds_of_inputs.setdefault(self.inputs(selector, fold.train, n_tsp), {})[i] = None
        return [(self.subset(inputs), sorted(which)) for inputs, which in folds_of_inputs.items()]

    def cells(self, family: type[Family]) -> list[tuple[str, int]]:
        """(selector, n_tsp) pairs that differ for this family; baselines without inputs have one."""
        if not family.uses_inputs:
            return [("none", 0)]
        p = len(self.design.inputs)
        return [
            (s, n)
            for s in self.plan.selectors
            for n in (self.plan.points(family, p) if SELECTORS[s].takes_n_tsp else (p,))
        ]


@dataclass(frozen=True)
class FamilyResult:
    """One family's share of the tables."""

    scores: pd.DataFrame
    cells: pd.DataFrame
    predictions: dict[str, NDArray[np.float32]]
    failures: list[tuple[str, str]]


def with_target(batches: Sequence[Batch], target: str) -> list[Batch]:
    """Batches that can teach or test: their error channel is not masked from end to end."""
    return [b for b in batches if np.isfinite(b.masked(target)).sum() >= 2]


def prepare(batches: Sequence[Batch], target: str, plan: Plan) -> Crossing:
    """Stack the batches and let every selector choose on every training set.

    Raises:
        InputError: fewer than two batches, no usable input channel, or no usable row of the target.
    """
    kept = with_target(batches, target)
    lost = [(target, f"batch {b.batch_id} is left out: no usable {target}") for b in batches if b not in kept]
    if len(kept) < 2:
        raise InputError(
            f"{batches[0].machine if batches else 'training'}: got {len(kept)} batch(es) with a usable {target}, "
            "need at least 2; ingest more recordings or overrule a check in the machine file"
        )
    inputs, excluded = usable_channels(kept, temperature_inputs(kept))
    if not inputs:
        raise InputError(f"{kept[0].machine}: no temperature channel is usable in every batch; {excluded[0][1]}")
    design = Design.build(kept, inputs, target)
    folds = {p: folds_of(p, kept) for p in plan.protocols}
    chosen: dict[tuple[str, tuple[int, ...]], dict[int, Inputs]] = {}
    n_all = range(1, len(inputs) + 1)

    def choose(train: tuple[int, ...]) -> None:
        for key in plan.selectors:
            if (key, train) not in chosen:
                chosen[key, train] = SELECTORS[key]().select_design(design, train, n_all)

    choose(tuple(range(len(kept))))
    for protocol, group in folds.items():
        for fold in list(group):
            try:
                choose(fold.train)
            except InputError as error:
                # A single batch can have too few complete rows to learn from; the other folds still stand.
                group.remove(fold)
                lost.append((target, f"{protocol} without fold {fold.name}: {error}"))
    return Crossing(kept[0].machine, tuple(kept), design, plan, folds, chosen, (*excluded, *lost))


def cross_family(crossing: Crossing, key: str) -> FamilyResult:
    """Fit and judge one family over all its cells, folds and protocols."""
    family = FAMILIES[key]
    cells = crossing.cells(family)
    scores, rows, failures = [], [], []
    predictions: dict[str, NDArray[np.float32]] = {}
    for protocol, folds in crossing.folds.items():
        if not folds:
            continue
        judged = Judged.run(crossing.design, family(), folds, crossing.needed(folds, cells))
        failures += [(f"family {key}", f"{protocol}, {text}") for text in judged.failures]
        for selector, n_tsp in cells:
            label = f"{selector}|{key}|{n_tsp}"
            picked = [judged.column.get((crossing.inputs(selector, f.train, n_tsp), i)) for i, f in enumerate(folds)]
            if any(c is None for c in picked):
                continue
            columns = np.array(picked, int)
            keys: dict[str, Any] = {"protocol": protocol, "selector": selector, "family": key, "n_tsp": n_tsp}
            table = score_rows(crossing.design.batch_ids, folds, judged, columns, protocol)
            scores.append(table.assign(**keys))
            inputs = crossing.inputs(selector, crossing.everything, n_tsp)
            stability = tsp_stability([crossing.inputs(selector, f.train, n_tsp) for f in folds])
            rows.append(
                {
                    **keys,
                    **summary(table, protocol),
                    "n_parameters": judged.n_parameters,
                    "rank": family.rank,
                    "tsp_stability": stability if n_tsp else 1.0,
                    "inputs": "|".join(inputs),
                    "n_inputs": len(inputs),
                    "simulated": any(b.simulated for b in crossing.batches),
                }
            )
            if protocol == "leave-batch-out":
                predictions[label] = judged.left_out(crossing.design, folds, columns)
    return FamilyResult(
        pd.concat(scores, ignore_index=True) if scores else pd.DataFrame(),
        pd.DataFrame(rows),
        predictions,
        failures,
    )


def assemble(crossing: Crossing, results: Sequence[FamilyResult]) -> GridResult:
    """One result from the families' shares."""
    design = crossing.design
    predictions = {
        "batch_id": np.array(design.batch_ids, dtype=object)[design.group],
        "time_s": design.time_s,
        "recorded_um": design.y_um,
    }
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
        findings=finding_table(crossing.batches),
        excluded=pd.DataFrame([*crossing.excluded, *failures], columns=["channel", "reason"]),
    )


def run_grid(
    batches: Sequence[Batch],
    targets: Sequence[str],
    plan: Plan,
    *,
    threads: int = 2,
    progress: Callable[[str, int, int], None] | None = None,
) -> dict[str, tuple[Crossing, GridResult]]:
    """The whole crossing of several error channels; results do not depend on `threads`.

    `progress` is called with what was done, how many of how many.
    """
    with threadpool_limits(limits=1), ThreadPoolExecutor(threads) as pool:
        crossings = dict(zip(targets, pool.map(lambda t: prepare(batches, t, plan), targets), strict=True))
        # The slow, iterative families first, so that no thread is left with one of them at the end.
        order = sorted(plan.families, key=lambda f: FAMILIES[f].closed_form)
        jobs = {(t, f): pool.submit(cross_family, crossings[t], f) for f in order for t in targets}
        done: dict[tuple[str, str], FamilyResult] = {}
        for i, (job, future) in enumerate(jobs.items()):
            done[job] = future.result()
            if progress:
                progress(f"{job[0]} {job[1]}", i + 1, len(jobs))
    return {t: (crossings[t], assemble(crossings[t], [done[t, f] for f in plan.families])) for t in targets}


def refit(crossing: Crossing, selector: str, family: str, n_tsp: int) -> Family:
    """A cell's model learned from all batches, ready to be promoted."""
    inputs = crossing.inputs(selector, crossing.everything, n_tsp)
    fitted: Family = FAMILIES[family]().fit_design(crossing.subset(inputs), crossing.everything)
    return fitted


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


def finding_table(batches: Sequence[Batch]) -> pd.DataFrame:
    """One row a finding."""
    columns = ["batch_id", "check", "channel", "start_s", "end_s", "words", "masks", "overruled"]
    rows = [{"batch_id": b.batch_id, **f.as_dict()} for b in batches for f in b.findings]
    return pd.DataFrame(rows, columns=columns).astype({"start_s": float, "end_s": float, "masks": bool})


def _subset_table(crossing: Crossing) -> pd.DataFrame:
    rows = []
    n_all = range(1, len(crossing.design.inputs) + 1)
    for protocol, folds in [*crossing.folds.items(), ("all", [Fold("all", crossing.everything, ())])]:
        for fold in folds:
            for selector in crossing.plan.selectors:
                for n in n_all if SELECTORS[selector].takes_n_tsp else n_all[-1:]:
                    rows.append((protocol, selector, n, fold.name, "|".join(crossing.inputs(selector, fold.train, n))))
    return pd.DataFrame(rows, columns=["protocol", "selector", "n_tsp", "fold", "inputs"])
