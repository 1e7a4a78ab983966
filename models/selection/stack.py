"""Family: a weighted sum of other families; and its left-out predictions from theirs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Self

import numpy as np
import pandas as pd
from scipy.optimize import nnls

from data.arrays import Array
from data.errors import InputError
from features.design import Design
from models.base import Family
from models.program import Builder
from models.protocols import Fold
from models.selection.crossing import Crossing, FamilyResult
from models.selection.judging import KEPT, FamilyScores, left_out_by_fold, score_table
from models.selection.loss import pooled
from models.selection.result import CELL_KEYS

MOST_MEMBERS = 5
STACKED = "stack"  # selector of the cell: its members bring their own
_DEFAULT: tuple[tuple[str, tuple[str, ...]], ...] = (("ridge", ()), ("distributed_lag", ()))
_WEIGHT_SD, _SUM_SD = 0.3, 0.1  # of a weight about its share, and of their sum about 1, before any run is known
_PASSES = 2  # the noise is what the weights of the pass before leave
_SHARPNESS = 6.0  # a member that left a tenth more on other machines has half the share
_ROWS_PER_RUN = 5.0  # neighbouring rows of a thermal run repeat each other; so many count as independent


class Stack(Family):
    """error_um = Σ w_i p_i over at most five fitted families, w_i ≥ 0, each with inputs of its own.

    The weights are least squares of the recorded error on predictions of runs that the members had not learned from,
    with a normal prior about shares that follow the members' records on other machines. In a crossing the
    members are the best cells of the best families and the predictions those of its folds (`stacked`); by itself the
    family leaves its training batches out in turn.

    `members` are (family, inputs) with inputs of the design, all where none is named; `weights` None: learned.

    Source: D. Wolpert (1992), Neural Networks 5, 241; L. Breiman (1996), Machine Learning 24, 49, eq. 7, for weights
    that are not negative; R. Caruana et al. (2004), ICML, for few members.
    """

    key = "stack"
    summary = "weighted sum of the best families, weights not negative"
    source = "Breiman (1996), Machine Learning 24, 49"
    closed_form = False
    combines = True
    rank = 60

    def __init__(
        self,
        members: Sequence[tuple[str, Sequence[str]]] = _DEFAULT,
        weights: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        self.members = [(str(family), [str(i) for i in inputs]) for family, inputs in members]
        self.weights = None if weights is None else [float(w) for w in weights]
        if not 1 <= len(self.members) <= MOST_MEMBERS or len(self.weights or self.members) != len(self.members):
            raise InputError(
                f"stack: got {len(self.members)} members and {len(self.weights or [])} weights, expected 1 to "
                f"{MOST_MEMBERS} members and as many weights or none"
            )

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        """Every member on the same batches. Raises: InputError, a member cannot be fitted."""
        try:
            return self._fitted(design, train)
        except InputError as error:
            raise InputError(f"{self.key}: {error}") from None

    def _fitted(self, design: Design, train: Sequence[int]) -> Self:
        from models.families import FAMILIES

        used = [k for k in sorted(train) if np.isfinite(design.y_um[design.rows(k)]).sum() > 1]
        parts, left = [], [(tuple(j for j in used if j != k), (k,)) for k in used]
        predicted: list[list[Array]] = []
        for key, inputs in self.members:
            own = design.subset(tuple(inputs) or design.inputs)
            family = FAMILIES[key]()
            family.zero_start = self.zero_start
            parts.append(family.fit_design(own, train))
            if self.weights is None and len(used) > 1:
                folds = family.fit_folds(own, [past for past, _ in left])
                predicted.append([p[0] for p in folds[0].predict_folds(own, folds, [test for _, test in left])])
        runs = [
            (design.y_um[design.rows(k)], np.column_stack(p))
            for k, p in zip(used, zip(*predicted, strict=True), strict=False)
        ]
        weights = self.weights if self.weights is not None else weights_of(runs, [f for f, _ in self.members])
        fitted = {"weights": np.asarray(weights, float)}
        plain = [p.as_plain() for p in parts]
        about = [json.dumps({k: v for k, v in p.items() if k != "fitted"}) for p in plain]
        fitted |= {f"{i}.{name}": value for i, p in enumerate(plain) for name, value in p["fitted"].items()}
        return self._learned(design, {"members": about, **fitted})

    def parts(self) -> list[Family]:
        """The fitted members, built from plain data by each call."""
        from models.base import family_from_plain

        found = []
        for i, text in enumerate(self.fitted["members"]):
            own = {k.partition(".")[2]: v for k, v in self.fitted.items() if k.startswith(f"{i}.")}
            found.append(family_from_plain({**json.loads(text), "fitted": own}))
        return found

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """NaN where a member has none."""
        each = [p.predict_design(design.subset(p.inputs), batches) for p in self.parts()]
        return [np.column_stack(own) @ self.fitted["weights"] for own in zip(*each, strict=True)]

    def operations(self, b: Builder) -> Sequence[int]:
        ends = [b.join(*p.operations(b)) for p in self.parts()]
        if self.zero_start:
            ends = [b.since_first(e) for e in ends]
        return [b.affine(b.join(*ends), self.fitted["weights"][None])]

    def n_parameters(self) -> int:
        return len(self.fitted["weights"]) + sum(p.n_parameters() for p in self.parts())


def weights_of(runs: Sequence[tuple[Array, Array]], families: Sequence[str]) -> Array:
    """Weights (m,) of the predictions of m families from runs of y (n,) and p (n, m) in µm; their shares for no run."""
    from models.selection.loss import RECORDS, USUAL_RECORD

    share = np.array([RECORDS.get(f, USUAL_RECORD) for f in families]) ** -_SHARPNESS
    share /= share.sum()
    known = [(y[ok], p[ok]) for y, p in runs if (ok := np.isfinite(y) & np.isfinite(p).all(axis=1)).sum() > 1]
    if not known:
        return share
    m = len(share)
    prior = np.vstack([np.eye(m) / _WEIGHT_SD, np.full(m, 1.0 / _SUM_SD)])
    weights, wanted = share, np.append(share / _WEIGHT_SD, 1.0 / _SUM_SD)
    for _ in range(_PASSES):
        variance_um2 = float(np.mean([np.mean((y - p @ weights) ** 2) for y, p in known])) or 1.0
        scale = [np.sqrt(_ROWS_PER_RUN / (len(y) * variance_um2)) for y, _ in known]
        rows = np.concatenate([*(s * p for s, (_, p) in zip(scale, known, strict=True)), prior])
        right = np.concatenate([*(s * y for s, (y, _) in zip(scale, known, strict=True)), wanted])
        q, r = np.linalg.qr(rows)
        weights = np.asarray(nnls(r, q.T @ right)[0])
    return weights


def best_cells(crossing: Crossing, result: FamilyResult, led: str) -> pd.DataFrame:
    """A row per member as in `GridResult.stack`, found by the leading protocol `led`; none for fewer than two."""
    members = _members(result, led)
    if len(members) < 2:
        return pd.DataFrame(columns=[*CELL_KEYS[1:], "inputs", "weight"])
    runs = [run for own in _left_out(crossing, result, led, members) for run in own.values()]
    return pd.DataFrame(members, columns=CELL_KEYS[1:]).assign(
        inputs=["|".join(crossing.inputs(s, crossing.everything, n)) for s, _, n in members],
        weight=weights_of(runs, [family for _, family, _ in members]),
    )


def stacked(crossing: Crossing, result: FamilyResult, cells: pd.DataFrame) -> FamilyResult:
    """The stack of the `best_cells`, scored on their left-out predictions as `cross_family` scores; empty of none.

    A fold is predicted with the weights that the other folds of its protocol give, forward the earlier ones, so that no
    weight knows the run that it predicts. The members have been found by the leading protocol, which flatters the stack
    as the search flatters any other cell.
    """
    members = list(cells[CELL_KEYS[1:]].itertuples(index=False, name=None))
    if not members:
        return FamilyResult(pd.DataFrame(), pd.DataFrame(), {}, [])
    design, parts, families = crossing.design, [], [family for _, family, _ in members]
    trainings = {crossing.everything, *(f.train for p in KEPT for f in crossing.folds.get(p, ()))}
    for train in trainings:
        used = {i for selector, _, n in members for i in crossing.inputs(selector, train, n)}
        crossing.chosen[STACKED, train] = {len(design.inputs): tuple(i for i in design.inputs if i in used)}
    for protocol in [p for p in KEPT if all(_name(p, m) in result.predictions for m in members)]:
        folds, predicted = crossing.folds[protocol], []
        runs = _left_out(crossing, result, protocol, members)
        for i, fold in enumerate(folds):
            known = runs[:i] if protocol == "forward" else [r for r in runs if not set(r) & set(fold.test)]
            weights = weights_of([run for own in known for run in own.values()], families)
            predicted.append({k: p @ weights for k, (_, p) in runs[i].items()})
        parts.append(_scored(crossing, folds, predicted, protocol))
    return FamilyResult.joined(parts)


def _members(result: FamilyResult, led: str) -> list[tuple[str, str, int]]:
    """Of the cells whose predictions are kept the best of each of the best families, by the pooled loss."""
    rows = result.cells[(result.cells["protocol"] == led) & (result.cells["n_tsp"] > 0)].dropna(subset="S_mean_um")
    protocols = {name.partition("|")[0] for name in result.predictions}
    if rows.empty or led not in protocols:
        return []
    loss_um, _ = pooled(rows["S_mean_um"].to_numpy(float), list(rows["family"]), float(rows["n_batches"].max()))
    rows = rows.assign(loss_um=loss_um).sort_values(["loss_um", "rank"], kind="stable")[CELL_KEYS[1:]]
    best: dict[str, tuple[str, str, int]] = {}
    for selector, family, n in rows.itertuples(index=False):
        cell = (str(selector), str(family), int(n))
        if all(_name(p, cell) in result.predictions for p in protocols):
            best.setdefault(cell[1], cell)
    return list(best.values())[:MOST_MEMBERS]


def _left_out(
    crossing: Crossing, result: FamilyResult, protocol: str, members: Sequence[tuple[str, str, int]]
) -> list[dict[int, tuple[Array, Array]]]:
    given = np.column_stack([result.predictions[_name(protocol, m)] for m in members]).astype(float)
    return left_out_by_fold(crossing.design, crossing.folds[protocol], given)


def _name(protocol: str, cell: tuple[str, str, int]) -> str:
    return "|".join([protocol, *map(str, cell)])


def _scored(
    crossing: Crossing, folds: Sequence[Fold], predicted: Sequence[dict[int, Array]], protocol: str
) -> FamilyResult:
    judged = FamilyScores.of_predictions(crossing.design, predicted)
    columns = np.arange(len(folds))[None]
    scores, summary = score_table(crossing.design.batch_ids, folds, judged, columns, protocol)
    n = len(crossing.design.inputs)
    cell = pd.DataFrame([(protocol, STACKED, Stack.key, n)], columns=CELL_KEYS)
    cells = pd.concat([cell, summary.assign(n_parameters=MOST_MEMBERS, rank=Stack.rank)], axis=1)
    repeated = cell.loc[cell.index.repeat(len(scores))].reset_index(drop=True)
    kept = {_name(protocol, (STACKED, Stack.key, n)): judged.left_out(folds, columns[0])}
    return FamilyResult(pd.concat([repeated, scores], axis=1), cells, kept, [])
