"""Which cells are scored by all folds: a race of all families and selectors over the same left-out runs.

Four rounds, each on the cells that the one before it left:

1. families: every family with all points and with four, fitted once on the first three quarters of the runs and judged
   on the last one (on every fourth run where it is not known which are later);
2. points: every selector and number of points of the families that are left, on the same fold; slow, iterative families
   with the selectors that served the others best;
3. runs: all folds of the leading protocol, forward where it is known which run is later, else leave-batch-out;
4. finalists: all folds of the other protocols.

After a round a cell is dropped where it is clearly worse than the leader on the same runs, by a one-sided paired t test
(Maron and Moore 1994, Hoeffding races), and so many remain as the next round can afford (successive halving: Jamieson
and Talwalkar 2016): the best first, by their mean S with the cost of choosing, pooled with the families' records
(`models.selection.loss`), of each family no more than a part of them. The best cells of the four best families go on
in any case, as runners-up and members of a stack, and so do the baselines. Of the families that simulate the twin one
goes on only if it leads, since its folds take minutes. Unless the effort is "quick", the best cell of the twin stays
until the third round: a growing error of the twin calls for a diagnosis. With "quick", families that simulate the twin
and families and selectors that train networks are tried only where all others leave much more than the noise of the
error.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from features.design import Design
from models.families import FAMILIES
from models.protocols import Fold
from models.selection.crossing import Cell, Crossing, FamilyResult, Inputs, cross_family
from models.selection.loss import BASELINES, cost_of_choosing, paired, pooled
from models.selection.stack import best_cells, stacked

ROUND_COLUMNS = ["round", "selector", "family", "n_tsp", "n_runs", "S_mean_um", "behind_um", "se_um", "kept", "why",
                 "cpu_s"]  # fmt: skip
_CLEARLY = 0.99  # one-sided level of the paired test: the leader is the best of many, and so flattered
_JUDGED_SHARE, _JUDGED_RUNS = 0.25, 4  # judged in the first rounds; of fewer to learn from rich models look worse
_FIRST_POINTS = ("correlation", 4)  # next to all points: least squares on all of many sensors is no fair trial
# Relative difference of S on every run below which two cells are one model: nets that learned a linear map.
_SAME = 0.02
_FAMILIES_KEPT, _SELECTORS_KEPT = 8, 4  # after the first and the second round
_MUCH = 5.0  # noises of the error: as long as all other families leave more, a quick race tries the late ones too
_LATE = (
    f"the twin and networks are tried where all others leave more than {_MUCH:g} noises of the error, or with effort"
    " usual"
)
_CELLS_PER_FINALIST = 4  # cells of the third round for every finalist
_RUNNERS_UP = 4  # families that are in every round
_FAMILY_SHARE = 4  # a family has a quarter of the places at most: a stack needs unlike members
_POINTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)  # numbers of points tried: neighbours choose nearly the same


@dataclass(frozen=True)
class Job:
    """Cells of one family to be scored; `chosen` are the selectors' choices that it needs."""

    target: str
    family: str
    round: str
    cells: tuple[Cell, ...]
    folds: Mapping[str, Sequence[Fold]]
    keep: bool
    chosen: Mapping[Any, dict[int, Inputs]] = field(default_factory=dict, repr=False)

    @property
    def label(self) -> str:
        return " ".join(filter(None, (self.target, self.family, self.round)))

    def run(self, crossing: Crossing) -> FamilyResult:
        """Score them."""
        begun_s = time.process_time()
        crossing.chosen.update(self.chosen)
        found = cross_family(crossing, self.family, self.cells, self.folds, self.keep)
        return replace(found, cpu_s=time.process_time() - begun_s)


class Raced(NamedTuple):
    """The scores of all cells of the last rounds, who was dropped when, and the best cells of the best families."""

    result: FamilyResult
    race: pd.DataFrame
    stack: pd.DataFrame


Rounds = Generator[list[Job], list[FamilyResult], Raced]


def rounds(crossing: Crossing) -> Rounds:
    """Yields the jobs of every round and takes their results; returns the result and a table of who was dropped when.

    The table has the columns `ROUND_COLUMNS`: S_mean_um over the n_runs of that round, how far behind the leader with
    the standard error of that difference, why a cell is not kept, and the CPU time of its family in that round, in s.
    """
    every = {key: tuple(crossing.cells(FAMILIES[key])) for key in crossing.plan.families}
    every = {key: cells for key, cells in every.items() if cells}
    folds = {p: own for p, own in crossing.folds.items() if own}
    led = next((p for p in ("forward", "leave-batch-out") if p in folds), next(iter(folds)))
    if not crossing.plan.finalists:
        results = yield _jobs(crossing, "", every, folds)
        return _with_stack(crossing, FamilyResult.joined(results), pd.DataFrame(columns=ROUND_COLUMNS), led)
    table: list[pd.DataFrame] = []
    few = {"last": [_last(crossing, folds.get("forward", ()))]}
    cells = {key: _first(own) for key, own in every.items()}
    twin = crossing.plan.effort != "quick"
    late = {key: own for key, own in cells.items() if key in crossing.plan.late}
    first = yield _jobs(crossing, "families", {key: cells[key] for key in cells if key not in late}, few, keep=False)
    untried = [*(("family", f) for f in late), *(("selector", s) for s in crossing.plan.late_selectors)]
    if untried and _least_um(first) > _MUCH * _noise_um(crossing.design):
        first += yield _jobs(crossing, "late", late, few, keep=False)
        untried = []
    without = {key for kind, key in untried if kind == "selector"}
    every = {key: tuple(c for c in own if c[0] not in without) for key, own in every.items()}
    left = _kept(first, "families", _FAMILIES_KEPT, table, twin, most=1)
    kept = {key for _, key, _ in left}
    more = {key: _tried(every[key], crossing) for key in every if key in kept}
    quick = {key: own for key, own in more.items() if FAMILIES[key].closed_form}
    second = yield _jobs(crossing, "points", quick, few, keep=False)
    known = {selector for selector, _, _ in _kept(second, "points", len(every), [], False, selectors=_SELECTORS_KEPT)}
    slow = {
        key: tuple(c for c in own if c[0] in known or c[1] == _most(own))
        for key, own in more.items()
        if key not in quick
    }
    second += yield _jobs(crossing, "points of slow families", slow, few, keep=False)
    places = _CELLS_PER_FINALIST * crossing.plan.finalists
    left = _kept(second, "points", places, table, twin, selectors=_SELECTORS_KEPT)
    third = yield _jobs(crossing, "runs", _by_family(left), {led: folds[led]})
    left = _kept(third, "runs", crossing.plan.finalists, table, False)
    rest = {p: own for p, own in folds.items() if p != led}
    last = yield _jobs(crossing, "finalists", _by_family(left), rest) if rest else []
    found = FamilyResult.joined([*third, *last])
    found.failures.extend((f"{kind} {key}", _LATE) for kind, key in untried)
    return _with_stack(crossing, found, pd.concat(table, ignore_index=True), led)


def _least_um(results: Sequence[FamilyResult]) -> float:
    """The least mean S of a cell, µm."""
    scores = FamilyResult.joined(results).scores
    return float(scores.groupby(["selector", "family", "n_tsp"])["S_um"].mean().min())


def _noise_um(design: Design) -> float:
    """The sd of white noise that second differences of the error show, µm: median over the runs (von Neumann 1941)."""
    steps = [np.diff(design.y_um[design.group == b], 2) for b in np.unique(design.group)]
    return float(np.median([np.sqrt(np.mean(d**2) / 6.0) for d in steps if len(d)] or [0.0]))


def _with_stack(crossing: Crossing, result: FamilyResult, race: pd.DataFrame, led: str) -> Raced:
    cells = best_cells(crossing, result, led)
    if any(FAMILIES[key].combines for key in crossing.plan.families):
        result = FamilyResult.joined([result, stacked(crossing, result, cells)])
    return Raced(result, race, cells)


def drive(crossings: Mapping[str, Crossing], cross: Callable[[list[Job]], list[FamilyResult]]) -> dict[str, Raced]:
    """The races of several error channels, round by round together; `cross` scores the jobs of a round."""
    races = {target: rounds(crossing) for target, crossing in crossings.items()}
    waiting = {target: next(race) for target, race in races.items()}
    done = {}
    while waiting:
        jobs = in_order([job for own in waiting.values() for job in own])
        scored = dict(zip((job.label for job in jobs), cross(jobs), strict=True))
        for target, own in list(waiting.items()):
            try:
                waiting[target] = races[target].send([scored[job.label] for job in own])
            except StopIteration as end:
                del waiting[target]
                done[target] = end.value
    return {target: done[target] for target in crossings}


def in_order(jobs: Sequence[Job]) -> list[Job]:
    """The slow, iterative families first, so that none of them is alone at the end.

    Of families that share work over the error channels one goes before all others; those that wait for it come last.
    """
    sharing = [j for j in jobs if FAMILIES[j.family].shares_targets]
    rest = sorted((j for j in jobs if j not in sharing), key=lambda j: FAMILIES[j.family].closed_form)
    return [*sharing[:1], *rest, *sharing[1:]]


def _jobs(
    crossing: Crossing,
    name: str,
    cells: Mapping[str, Sequence[Cell]],
    folds: Mapping[str, Sequence[Fold]],
    keep: bool = True,
) -> list[Job]:
    trained = [f for own in folds.values() for f in own]
    jobs = []
    for key in cells:
        selectors = dict.fromkeys(selector for selector, n in cells[key] if n)
        chosen = crossing.select(selectors, trained)
        jobs.append(Job(crossing.design.target, key, name, tuple(cells[key]), folds, keep, chosen))
    return jobs


def _last(crossing: Crossing, forward: Sequence[Fold]) -> Fold:
    """The last quarter of the runs against those before them; without an order in time, every fourth run."""
    order = [*forward[-1].train, *forward[-1].test] if forward else list(crossing.everything)
    n = min(max(_JUDGED_RUNS, round(_JUDGED_SHARE * len(order))), len(order) // 2)
    test = order[-n:] if forward else order[:: -(-len(order) // n)]
    return Fold("last", tuple(k for k in order if k not in test), tuple(test))


def _first(cells: Sequence[Cell]) -> tuple[Cell, ...]:
    return tuple(
        c for c in cells if c == _FIRST_POINTS or (c[1] in (0, _most(cells)) and c[0] in ("none", cells[0][0]))
    )


def _most(cells: Sequence[Cell]) -> int:
    return max(n for _, n in cells)


def _tried(cells: Sequence[Cell], crossing: Crossing) -> tuple[Cell, ...]:
    named = crossing.plan.n_tsps is not None
    return tuple(c for c in cells if named or c[1] in (0, *_POINTS, _most(cells)))


def _by_family(left: Sequence[tuple[str, str, int]]) -> dict[str, list[Cell]]:
    found: dict[str, list[Cell]] = {}
    for selector, family, n in left:
        found.setdefault(family, []).append((selector, n))
    return found


def _kept(
    results: Sequence[FamilyResult],
    name: str,
    places: int,
    table: list[pd.DataFrame],
    twin: bool,
    most: int | None = None,
    selectors: int | None = None,
) -> list[tuple[str, str, int]]:
    """The cells that go on, and a row for each in `table`.

    Args:
        twin: whether the best cell of the twin goes on in any case.
        most: of a family; None: its share of the places.
        selectors: how many may go on, those of the best cells, next to "none"; None: all.
    """
    scores = FamilyResult.joined(results).scores
    keys = ["selector", "family", "n_tsp"]
    wide = scores.pivot(index=keys, columns=["fold", "batch_id"], values="S_um")
    S_um = np.where(np.isfinite(wide.to_numpy(float)), wide.to_numpy(float), np.inf)
    S_mean_um = S_um.mean(axis=1)
    names = list(wide.index)
    is_base = np.array([family in BASELINES for _, family, _ in names])
    cost_um = cost_of_choosing(S_um, names, Counter(f for _, f, _ in names))
    loss_um, own_share = pooled(S_mean_um + cost_um, [f for _, f, _ in names], S_um.shape[1])
    order = np.lexsort(([s != "none" for s, _, _ in names], [FAMILIES[f].rank for _, f, _ in names], loss_um))
    behind_um, se_um = paired(S_um, S_um[order[0]])
    clear = loss_um - loss_um[order[0]] > stdtrit(max(S_um.shape[1] - 1, 1), _CLEARLY) * own_share * se_um
    share = most if most is not None else -(-places // _FAMILY_SHARE)
    why, taken, seen = ["" for _ in names], dict[str, int](), list[int]()
    n, through = 0, {"none"}
    for i in order:
        selector, family, _ = names[i]
        if is_base[i]:
            continue
        if not np.isfinite(S_mean_um[i]):
            why[i] = "not fitted"
        elif FAMILIES[family].needs_twin and taken and not twin:
            why[i] = "slow, and not the leader"
        elif any(np.allclose(S_um[i], S_um[k], rtol=_SAME) for k in seen):
            why[i] = "the same as a better or simpler cell"
        elif family not in taken and (len(taken) < _RUNNERS_UP or FAMILIES[family].needs_twin):
            twin = twin and not FAMILIES[family].needs_twin
            n, taken[family] = n + 1, 1
            seen.append(i)
            through.add(selector)
        elif clear[i]:
            why[i] = "clearly worse than the leader"
        elif n >= places or taken.get(family, 0) >= share:
            why[i] = "not among the best"
        elif selectors is not None and selector not in through and len(through) > selectors:
            why[i] = "its selector is not among the best"
        else:
            through.add(selector)
            n, taken[family] = n + 1, taken.get(family, 0) + 1
            seen.append(i)
    kept = [not w for w in why]
    own = pd.DataFrame(names, columns=keys).assign(
        round=name, n_runs=S_um.shape[1], S_mean_um=S_mean_um, behind_um=behind_um, se_um=se_um, kept=kept, why=why
    )
    spent = Counter[str]()
    for r in results:
        spent.update(dict.fromkeys(r.scores["family"].astype(str).unique()[:1] if len(r.scores) else (), r.cpu_s))
    own = own.assign(cpu_s=own["family"].map(spent).astype(float).round(4))
    table.append(own.iloc[order][ROUND_COLUMNS])
    return [names[i] for i in range(len(names)) if kept[i]]
