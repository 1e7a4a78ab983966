"""Plan of a grid, and for one error channel its stacked rows, folds, selected inputs and the scoring of families.

Folds share work: the rows are stacked once, a selector learns once per training set, when it is first needed, and a
set of inputs that several selectors or numbers of points arrive at is fitted once.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.batch import Batch, Channel
from data.checks import usable_channels, why_missing
from data.errors import InputError
from data.machine import Machine
from data.registry import Registry, check_packages, packages_reason
from features.design import Design
from features.rises import temperature_inputs
from features.selectors import SELECTORS
from features.selectors.statistics import training_statistics
from features.stability import tsp_stability
from models.base import Family
from models.families import FAMILIES
from models.protocols import PROTOCOLS, Fold, folds_of, forward_obstacle, placed
from models.selection.judging import KEPT, FamilyScores, score_table
from models.selection.result import CELL_KEYS

Inputs = tuple[str, ...]
STUDIED = ("train-on-one", "forward-gap")  # protocols of published studies and of long pauses, which decide nothing
Cell = tuple[str, int]  # of a family: selector and number of points

Effort = Literal["quick", "usual", "complete"]
# Cells that are scored by all folds; `complete` scores all. More of them cost time in proportion and change little.
FINALISTS: Mapping[Effort, int] = {"quick": 12, "usual": 36, "complete": 0}
NETS = "torch"  # what families and selectors that train networks need


@dataclass(frozen=True)
class Plan:
    """Selectors, families and protocols of a grid; of what is not named, all that suit the machine and are installed.

    `effort` says how many cells are scored by all folds (`FINALISTS`): a race finds them (`models.selection.race`).
    Where both selectors and families are named, or the effort is "complete", every cell is. `n_tsps` None means 1 to
    all; iterative families (bp, lssvm) take `iterative_n_tsps` and all. Without `protocols`: all, after a race without
    those of `STUDIED`.
    """

    selectors: tuple[str, ...] = ()
    families: tuple[str, ...] = ()
    protocols: tuple[str, ...] = ()
    n_tsps: tuple[int, ...] | None = None
    iterative_n_tsps: tuple[int, ...] = (2, 4)
    effort: Effort = "usual"
    left_out: tuple[tuple[str, str], ...] = ()  # what cannot run here, and why
    finalists: int | None = None  # 0: no race; None: not yet known, see `suited`
    late: tuple[str, ...] = ()  # families that a race tries only where the others leave much
    late_selectors: tuple[str, ...] = ()  # selectors likewise

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
        suitable = [f for f in FAMILIES if has_twin or not FAMILIES[f].needs_twin]
        suitable = [f for f in suitable if has_axis or not FAMILIES[f].needs_position]
        suitable = [f for f in suitable if not FAMILIES[f].on_request]
        selectors, without = _runnable("selector", SELECTORS, self.selectors or tuple(SELECTORS))
        families, more = _runnable("family", FAMILIES, self.families or tuple(suitable))
        quick = self.effort == "quick"
        slow = [f for f in families if quick and (NETS in FAMILIES[f].packages or FAMILIES[f].needs_twin)]
        nets = [s for s in selectors if quick and NETS in SELECTORS[s].packages]
        late = self.late if self.families else tuple(slow)
        late_selectors = self.late_selectors if self.selectors else tuple(nets)
        named = bool(self.selectors and self.families)
        finalists = self.finalists if self.finalists is not None else 0 if named else FINALISTS[self.effort]
        protocols = self.protocols or tuple(p for p in PROTOCOLS if not (finalists and p in STUDIED))
        return replace(self, selectors=selectors, families=families, protocols=protocols, finalists=finalists,
                       left_out=(*self.left_out, *without, *more), late=late,
                       late_selectors=late_selectors)  # fmt: skip

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
    excluded: tuple[tuple[str, str], ...]
    chosen: dict[tuple[str, tuple[int, ...]], dict[int, Inputs]] = field(default_factory=dict)  # see `inputs`
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
        """The inputs that a selector chooses on a training set; it learns all numbers of points at the first call."""
        if not n_tsp:
            return ()
        if (selector, train) not in self.chosen:
            n_all = range(1, len(self.design.inputs) + 1)
            self.chosen[selector, train] = SELECTORS[selector]().select_design(self.design, train, n_all)
        return self.chosen[selector, train][n_tsp]

    def select(self, selectors: Iterable[str], folds: Iterable[Fold]) -> dict[Any, dict[int, Inputs]]:
        """What these selectors choose on the training sets of these folds, as `chosen` holds it."""
        for selector in selectors:
            for fold in folds:
                self.inputs(selector, fold.train, 1)
        wanted = {(s, f.train) for s in selectors for f in folds}
        return {key: self.chosen[key] for key in wanted}

    def stability(self, protocol: str, selector: str, n_tsp: int) -> float:
        """Mean Jaccard similarity of the folds' choices; the same for every family."""
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

    def cells(self, family: type[Family]) -> list[Cell]:
        """(selector, n_tsp) pairs that differ for this family; baselines without inputs have one."""
        if family.combines or not suits(family.key, self.batches[0].channels[self.design.target]):
            return []
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
    predictions: dict[str, NDArray[np.float32]]  # "protocol|selector|family|n_tsp" -> by fold and tested batch
    failures: list[tuple[str, str]]
    cpu_s: float = 0.0  # of the process that computed it

    @classmethod
    def joined(cls, parts: Sequence[FamilyResult]) -> FamilyResult:
        """The shares of several families or rounds together."""
        tables = [[getattr(p, name) for p in parts if len(getattr(p, name))] for name in ("scores", "cells")]
        scores, cells = (pd.concat(own, ignore_index=True) if own else pd.DataFrame() for own in tables)
        predictions = {name: values for p in parts for name, values in p.predictions.items()}
        failures = list(dict.fromkeys(f for p in parts for f in p.failures))
        return cls(scores, cells, predictions, failures, sum(p.cpu_s for p in parts))


def with_target(batches: Sequence[Batch], target: str) -> list[Batch]:
    """Batches whose error channel has at least two usable values."""
    return [b for b in batches if np.isfinite(b.masked(target)).sum() >= 2]


def prepare(batches: Sequence[Batch], target: str, plan: Plan, machine: Machine | None = None) -> Crossing:
    """Stack the batches and cut them into folds.

    Raises:
        InputError: fewer than two batches, no usable input channel, or no usable row of the target.
    """
    batches = placed(batches, machine.recording.order) if machine else batches
    known = [b.channels[target] for b in batches[:1] if target in b.channels]
    plan = plan.suited(machine, () if plan.families else known)
    kept = with_target(batches, target)
    lost = [
        (target, f"batch {b.batch_id} is left out: no usable {target}{why_missing(b, target)}")
        for b in batches
        if b not in kept
    ]
    if len(kept) < 2:
        first = f"; {lost[0][1]}" if lost else ""
        raise InputError(
            f"{batches[0].machine if batches else 'training'}: got {len(kept)} batch(es) with a usable {target}, "
            f"need at least 2; ingest more recordings or overrule a check in the machine file{first}"
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
    for protocol, group in folds.items():
        for fold in list(group):
            try:
                training_statistics(design, fold.train, "none")
            except InputError as error:
                # A single batch can have too few complete rows to learn from; the other folds are still valid.
                group.remove(fold)
                lost.append((target, f"{protocol} without fold {fold.name}: {error}"))
    return Crossing(kept[0].machine, tuple(kept), design, plan, folds, (*excluded, *lost, *plan.left_out))


def cross_family(
    crossing: Crossing,
    key: str,
    cells: Sequence[Cell] | None = None,
    folds: Mapping[str, Sequence[Fold]] | None = None,
    keep: bool = True,
) -> FamilyResult:
    """Fit and score one family.

    Args:
        cells: which; None: all that differ.
        folds: of which protocols; None: all of the crossing.
        keep: whether to keep the predictions under the protocols of `KEPT`.
    """
    family = FAMILIES[key]
    cells = crossing.cells(family) if cells is None else list(cells)
    scores, summaries = [], []
    predictions: dict[str, NDArray[np.float32]] = {}
    run = {p: own for p, own in (crossing.folds if folds is None else folds).items() if own and cells}
    every, protocols = [f for own in run.values() for f in own], [p for p, own in run.items() for _ in own]
    judged = FamilyScores.run(crossing.design, family(), every, crossing.needed(every, cells), protocols, keep)
    end = 0
    for protocol, tested in run.items():
        own, end = range(end, end + len(tested)), end + len(tested)
        picked = {cell: [judged.column.get((crossing.inputs(cell[0], f.train, cell[1]), i), -1)
                         for i, f in zip(own, tested, strict=True)] for cell in cells}  # fmt: skip
        scored = [cell for cell in cells if min(picked[cell]) >= 0]
        if not scored:
            continue
        columns = np.array([picked[cell] for cell in scored], int)
        table, summary = score_table(crossing.design.batch_ids, tested, judged, columns, protocol)
        names = pd.DataFrame(scored, columns=["selector", "n_tsp"]).assign(protocol=protocol, family=key)[CELL_KEYS]
        summary = summary.assign(n_parameters=judged.parameters(own), rank=family.rank)
        repeated = names.loc[names.index.repeat(len(table) // len(scored))].reset_index(drop=True)
        scores.append(pd.concat([repeated, table], axis=1))
        summaries.append(pd.concat([names, summary], axis=1))
        if keep and protocol in KEPT:
            for (selector, n_tsp), row in zip(scored, columns, strict=True):
                predictions[f"{protocol}|{selector}|{key}|{n_tsp}"] = judged.left_out(tested, row)
    failures = [(f"family {key}", f"{protocol}, {text}") for protocol, text in judged.failures]
    return FamilyResult.joined([
        FamilyResult(pd.DataFrame(), pd.DataFrame(), predictions, failures),
        *(FamilyResult(a, b, {}, []) for a, b in zip(scores, summaries, strict=True)),
    ])  # fmt: skip


def refit(crossing: Crossing, selector: str, family: str, n_tsp: int, members: pd.DataFrame | None = None) -> Family:
    """A cell's model fitted on all batches; a stack is made of `members`, see `GridResult.stack`."""
    every = crossing.everything
    model = unfitted(family, members)
    inputs = crossing.inputs(selector, every, n_tsp)
    fitted: Family = model.fit_design(crossing.subset(inputs), every)
    return fitted


def unfitted(family: str, members: pd.DataFrame | None = None) -> Family:
    """A family with its usual options; a stack with these members and weights."""
    if members is None or not FAMILIES[family].combines:
        plain: Family = FAMILIES[family]()
        return plain
    own = [(f, inputs.split("|")) for f, inputs in zip(members["family"], members["inputs"], strict=True)]
    stack: Family = FAMILIES[family](own, members["weight"].tolist())
    return stack
