"""Plan of a grid, and for one error channel its stacked rows, folds, selected inputs and the scoring of families.

Folds share work: the rows are stacked once, a selector learns once per training set, and a set of inputs that
several selectors or numbers of points arrive at is fitted once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.batch import Batch, Channel
from data.checks import usable_channels, why_missing
from data.errors import InputError
from data.machine import Machine
from data.registry import EFFORTS, Effort, Registry, check_packages, packages_reason
from features.design import Design
from features.rises import temperature_inputs
from features.selectors import SELECTORS
from features.stability import tsp_stability
from models import FAMILIES
from models.base import Family
from models.judging import FamilyScores, score_table
from models.protocols import PROTOCOLS, Fold, folds_of, forward_obstacle
from models.result import CELL_KEYS

Inputs = tuple[str, ...]


@dataclass(frozen=True)
class Plan:
    """Selectors, families and protocols of a grid. If none are named: those that this `effort` includes.

    `n_tsps` None means 1 to all; iterative families (bp, lssvm) take `iterative_n_tsps` and all.
    """

    selectors: tuple[str, ...] = ()
    families: tuple[str, ...] = ()
    protocols: tuple[str, ...] = tuple(PROTOCOLS)
    n_tsps: tuple[int, ...] | None = None
    iterative_n_tsps: tuple[int, ...] = (2, 4)
    effort: Effort = "usual"
    left_out: tuple[tuple[str, str], ...] = ()  # what the effort includes and cannot run here, and why

    def suited(self, machine: Machine | None, channels: Sequence[Channel] = ()) -> Plan:
        """The plan with its selectors and families by name; `channels` are the error channels that it is for.

        Raises:
            InputError: a family that the plan names needs a twin part, and the machine file has none, or a position,
                and a channel is not measured along an axis; or one that it names needs a package that is not installed.
        """
        for kind, keys, registry in (("selector", self.selectors, SELECTORS), ("family", self.families, FAMILIES)):
            for key in keys:
                check_packages(kind, registry[key])
        has_twin = machine is not None and machine.twin is not None
        has_axis = any(c.position for c in channels) or bool(machine is not None and machine.axes())
        for key in self.families:
            for channel in channels:
                if not suits(key, channel):
                    raise _not_along_an_axis(key, channel.name)
            if FAMILIES[key].needs_twin and not has_twin:
                raise InputError(
                    f"family {key} needs the twin part of the machine file; add 'twin' to the file of "
                    f"{machine.machine if machine else 'the machine'}, or leave the family out"
                )
        taken = EFFORTS[: EFFORTS.index(self.effort) + 1]
        suitable = [f for f in FAMILIES if has_twin or not FAMILIES[f].needs_twin]
        suitable = [f for f in suitable if has_axis or not FAMILIES[f].needs_position]
        included = (s for s in SELECTORS if SELECTORS[s].effort in taken)
        selectors, without = _runnable("selector", SELECTORS, self.selectors or tuple(included))
        included = (f for f in suitable if FAMILIES[f].effort in taken)
        families, more = _runnable("family", FAMILIES, self.families or tuple(included))
        return replace(self, selectors=selectors, families=families, left_out=(*self.left_out, *without, *more))

    def points(self, family: type[Family], n_inputs: int) -> tuple[int, ...]:
        """The numbers of points a family is tried with."""
        wanted = self.n_tsps or tuple(range(1, n_inputs + 1))
        if not family.closed_form:
            wanted = (*(n for n in self.iterative_n_tsps if n in wanted), wanted[-1])
        return tuple(dict.fromkeys(n for n in wanted if n <= n_inputs))


def _runnable(
    kind: str, registry: Registry, keys: Sequence[str]
) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
    """The keys whose packages are installed, and the others with the reason."""
    lacking = {key: why for key in keys if (why := packages_reason(kind, registry[key]))}
    return tuple(k for k in keys if k not in lacking), tuple((f"{kind} {k}", why) for k, why in lacking.items())


def suits(family: str, channel: Channel) -> bool:
    """True if the family can be used on this error channel."""
    return bool(channel.position) or not FAMILIES[family].needs_position


def _not_along_an_axis(family: str, target: str) -> InputError:
    return InputError(
        f"family {family} needs the position of every reading, and error channel {target} has none; add position: to "
        "the channel in the machine file, train channels along an axis alone, or leave the family out"
    )


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
    stabilities: dict[tuple[str, str, int], float] = field(default_factory=dict)

    @property
    def everything(self) -> tuple[int, ...]:
        return tuple(range(self.design.n_batches))

    def subset(self, inputs: Inputs) -> Design:
        if inputs not in self.subsets:
            self.subsets[inputs] = self.design.subset(inputs)
        return self.subsets[inputs]

    def inputs(self, selector: str, train: tuple[int, ...], n_tsp: int) -> Inputs:
        return self.chosen[selector, train][n_tsp] if n_tsp else ()

    def stability(self, protocol: str, selector: str, n_tsp: int) -> float:
        """How alike the folds' choices are (mean Jaccard similarity); the same for every family."""
        key = (protocol, selector, n_tsp)
        if key not in self.stabilities:
            sets = [self.inputs(selector, f.train, n_tsp) for f in self.folds[protocol]]
            self.stabilities[key] = tsp_stability(sets) if n_tsp else 1.0
        return self.stabilities[key]

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
    """Batches whose error channel has at least two usable values."""
    return [b for b in batches if np.isfinite(b.masked(target)).sum() >= 2]


def prepare(batches: Sequence[Batch], target: str, plan: Plan, machine: Machine | None = None) -> Crossing:
    """Stack the batches and run every selector on every training set.

    Raises:
        InputError: fewer than two batches, no usable input channel, or no usable row of the target.
    """
    known = [b.channels[target] for b in batches[:1] if target in b.channels]
    plan = plan.suited(machine, () if plan.families else known)
    kept = with_target(batches, target)
    lost = [
        (target, f"batch {b.batch_id} is left out: no usable {target}{why_missing(b, target)}")
        for b in batches
        if b not in kept
    ]
    if len(kept) < 2:
        raise InputError(
            f"{batches[0].machine if batches else 'training'}: got {len(kept)} batch(es) with a usable {target}, "
            f"need at least 2; ingest more recordings or overrule a check in the machine file{_first_lost(lost)}"
        )
    if not any(suits(f, kept[0].channels[target]) for f in plan.families):
        raise _not_along_an_axis(plan.families[0], target)
    inputs, excluded = usable_channels(kept, temperature_inputs(kept))
    if not inputs:
        raise InputError(f"{kept[0].machine}: no temperature channel is usable in every batch; {excluded[0][1]}")
    design = Design.build(kept, inputs, target, machine)
    folds = {p: folds_of(p, kept) for p in plan.protocols}
    if "forward" in plan.protocols and (obstacle := forward_obstacle(kept)):
        lost.append(("forward", obstacle))
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
    return Crossing(kept[0].machine, tuple(kept), design, plan, folds, chosen, (*excluded, *lost, *plan.left_out))


def _first_lost(lost: Sequence[tuple[str, str]]) -> str:
    return f"; {lost[0][1]}" if lost else ""


def cross_family(crossing: Crossing, key: str) -> FamilyResult:
    """Fit and score one family over all its cells, folds and protocols."""
    family = FAMILIES[key]
    target = crossing.design.target
    cells = crossing.cells(family) if suits(key, crossing.batches[0].channels[target]) else []
    scores, summaries = [], []
    predictions: dict[str, NDArray[np.float32]] = {}
    run = {p: folds for p, folds in crossing.folds.items() if folds and cells}
    every, protocols = [f for folds in run.values() for f in folds], [p for p, folds in run.items() for _ in folds]
    judged = FamilyScores.run(crossing.design, family(), every, crossing.needed(every, cells), protocols)
    end = 0
    for protocol, folds in run.items():
        own, end = range(end, end + len(folds)), end + len(folds)
        picked = {cell: [judged.column.get((crossing.inputs(cell[0], f.train, cell[1]), i), -1)
                         for i, f in zip(own, folds, strict=True)] for cell in cells}  # fmt: skip
        scored = [cell for cell in cells if min(picked[cell]) >= 0]
        if not scored:
            continue
        columns = np.array([picked[cell] for cell in scored], int)
        table, summary = score_table(crossing.design.batch_ids, folds, judged, columns, protocol)
        names = pd.DataFrame(scored, columns=["selector", "n_tsp"]).assign(protocol=protocol, family=key)[CELL_KEYS]
        inputs = [crossing.inputs(selector, crossing.everything, n_tsp) for selector, n_tsp in scored]
        summary = summary.assign(
            n_parameters=judged.parameters(own),
            rank=family.rank,
            tsp_stability=[crossing.stability(protocol, *cell) for cell in scored],
            inputs=["|".join(i) for i in inputs],
            n_inputs=[len(i) for i in inputs],
            simulated=any(b.simulated for b in crossing.batches),
        )
        repeated = names.loc[names.index.repeat(len(table) // len(scored))].reset_index(drop=True)
        scores.append(pd.concat([repeated, table], axis=1))
        summaries.append(pd.concat([names, summary], axis=1))
        if protocol == "leave-batch-out":
            for (selector, n_tsp), row in zip(scored, columns, strict=True):
                predictions[f"{selector}|{key}|{n_tsp}"] = judged.left_out(crossing.design, folds, row)
    return FamilyResult(
        pd.concat(scores, ignore_index=True) if scores else pd.DataFrame(),
        pd.concat(summaries, ignore_index=True) if summaries else pd.DataFrame(),
        predictions,
        [(f"family {key}", f"{protocol}, {text}") for protocol, text in judged.failures],
    )


def refit(crossing: Crossing, selector: str, family: str, n_tsp: int) -> Family:
    """A cell's model fitted on all batches."""
    inputs = crossing.inputs(selector, crossing.everything, n_tsp)
    fitted: Family = FAMILIES[family]().fit_design(crossing.subset(inputs), crossing.everything)
    return fitted
