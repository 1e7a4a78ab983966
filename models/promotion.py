"""The promotion rule: which cell is best, whether it is trustworthy, and whether it beats a champion."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import stdtrit

from data.errors import InputError
from models.protocols import PromotionRule
from models.result import GridResult

BASELINES = ("zero", "mean_curve")
KEYS = ["selector", "family", "n_tsp"]
_SIGN_PATTERNS = 2**16  # of up to 16 batches all are counted, of more so many are drawn
_INTERVAL = 0.90


@dataclass(frozen=True)
class Choice:
    """The cell that the rule picked.

    `protocol` is the one that decides: under it the cell's weighted score is worst; `S_mean_um` and `S_std_um` are of
    this protocol. `caution` is why the cell is not trustworthy: a baseline won, no set of points was stable, or the
    cell is not shown to beat a baseline; empty where it is. The nested score predicts every batch by the cell that the
    other batches chose, under the same protocol. `standing` is what the forward runs show: a champion, provisional or
    refused; `authority` is the share of the correction that they support.
    """

    protocol: str
    selector: str
    family: str
    n_tsp: int
    inputs: tuple[str, ...]
    score_um: float
    S_mean_um: float
    S_std_um: float
    tsp_stability: float
    n_batches: int
    caution: str
    summary: str
    nested_S_mean_um: float = float("nan")
    nested_S_std_um: float = float("nan")
    standing: str = "champion"
    authority: float = 1.0

    @property
    def trusted(self) -> bool:
        return not self.caution

    @property
    def cell(self) -> str:
        """The cell's label: ``selector|family|n_tsp``."""
        return f"{self.selector}|{self.family}|{self.n_tsp}"

    @property
    def name(self) -> str:
        """The cell as text."""
        return _cell_words(self.family, self.n_tsp, self.selector)


@dataclass(frozen=True)
class Comparison:
    """Newcomer against champion on the same batches; differences are champion − newcomer in µm, so plus is better."""

    n_batches: int
    n_better: int
    new_S_mean_um: float
    old_S_mean_um: float
    difference_um: float
    low_um: float
    high_um: float
    p_value: float
    better: bool
    evidence: str

    @property
    def words(self) -> str:
        """The evidence with the decision on a champion."""
        if self.better:
            return f"{self.evidence}: the newcomer replaces the champion"
        few = "need at least" in self.evidence
        return f"{self.evidence}: {'' if few else 'not shown to be better, '}the champion stays"

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "words": self.words}


def score_um(cells: pd.DataFrame, rule: PromotionRule) -> pd.Series:
    """The rule's score of every row under its own protocol, µm, smaller is better."""
    if rule.score == "max_abs":
        return cells["max_abs_um"].astype(float)
    spread = cells["S_std_um"] if rule.score == "S_mean + S_std" else 0.0
    return (cells["S_mean_um"] + spread).astype(float)


def judged(cells: pd.DataFrame, rule: PromotionRule) -> pd.DataFrame:
    """One row per cell: its row of `cells` under the deciding protocol, with the combined score in `score_um`.

    `tsp_stability` is the least over the protocols. Cells without a finite score under one of the protocols are left
    out.

    Args:
        cells: `GridResult.cells`.

    Raises:
        InputError: none of the rule's protocols was run, or no cell has a finite score.
    """
    run = sorted(set(cells["protocol"]))
    offered = rule.offered(run)
    if not offered:
        wanted = ", ".join(rule.protocols)
        raise InputError(
            f"promotion rule: got trainings by {', '.join(run)}, expected one of its protocols {wanted}; "
            "add one of them to the training or to promotion.protocols in mlflow.yml"
        )
    table, common = _common_cells(cells, [p for p in dict.fromkeys(cells["protocol"]) if p in offered])
    return _decided(table, len(common), rule)


def _common_cells(cells: pd.DataFrame, protocols: Sequence[str]) -> tuple[pd.DataFrame, pd.MultiIndex]:
    """The rows (P C) of the cells that all of the protocols have, protocol after protocol, and the cells (C,)."""
    own = [cells[cells["protocol"] == p] for p in protocols]
    every = [pd.MultiIndex.from_frame(table[KEYS]) for table in own]
    common = every[0]
    for index in every[1:]:
        common = common[common.isin(index)]
    rows = [t.iloc[i.get_indexer(common)] for t, i in zip(own, every, strict=True)]
    return pd.concat(rows, ignore_index=True), common


def _decided(table: pd.DataFrame, n: int, rule: PromotionRule) -> pd.DataFrame:
    """`judged` of `n` cells, given their rows by protocol as `_common_cells` orders them.

    Raises:
        InputError: no cell has a finite score.
    """
    weight = table["protocol"].map(rule.protocols).to_numpy(float)
    score = (score_um(table, rule).to_numpy() * weight).reshape(-1, n)
    kept = np.flatnonzero(np.isfinite(score).all(axis=0))
    if not len(kept):
        run = ", ".join(rule.offered(set(table["protocol"])))
        raise InputError(f"promotion rule: no cell of {run} has a finite {rule.score}")
    decides, score = score[:, kept].argmax(axis=0), score[:, kept]
    combined = score.max(axis=0) if rule.combine == "worst" else score.sum(axis=0) / weight[::n].sum()
    stability = table["tsp_stability"].to_numpy(float).reshape(-1, n)[:, kept]
    out = table.take(decides * n + kept).reset_index(drop=True)
    return out.assign(score_um=combined, tsp_stability=np.fmin.reduce(stability, axis=0))


def ranked(cells: pd.DataFrame, rule: PromotionRule) -> pd.DataFrame:
    """The best cell of every family, the smallest combined score first; columns as `judged`.

    Raises:
        InputError: as `judged`.
    """
    table = judged(cells, rule)
    order = table.sort_values(["score_um", "rank", "n_tsp"], kind="stable")
    return order.drop_duplicates("family").reset_index(drop=True)


def choose(cells: pd.DataFrame, rule: PromotionRule) -> Choice:
    """The cell to promote: least score among stable cells, ties to the simpler.

    Simpler is fewer inputs, then the family's rank, then fewer parameters, then the smaller score. A baseline is
    chosen only where nothing beats it, and then it is not trustworthy.

    Args:
        cells: `GridResult.cells`.

    Raises:
        InputError: as `judged`.
    """
    return _choose(judged(cells, rule), rule)


def _choose(table: pd.DataFrame, rule: PromotionRule) -> Choice:
    """`choose` from the table of `judged`."""
    is_baseline = table["family"].isin(BASELINES)
    baselines, candidates = table[is_baseline], table[~is_baseline]
    stable = candidates[candidates["tsp_stability"].fillna(0.0) >= rule.min_tsp_stability]
    caution = ""
    if stable.empty and not candidates.empty:
        top = candidates["tsp_stability"].max()
        caution = f"no set of points is stable (best {top:.2f}, required {rule.min_tsp_stability:g})"
        stable = candidates
    floor = baselines["score_um"].min() if len(baselines) else np.inf
    if stable.empty or stable["score_um"].min() >= floor:
        winner = _simplest(baselines[baselines["score_um"] <= floor])
        other = "" if stable.empty else f" (best other: {stable['score_um'].min():.2f} µm)"
        return _picked(winner, rule, [], f"nothing beats {winner['family']}{other}")
    best = stable.nsmallest(1, "score_um").iloc[0]
    limit = best["score_um"] * (1 + rule.tie_percent / 100)
    tied = stable[(stable["score_um"] <= limit) & (stable["score_um"] < floor)]
    picked = _simplest(tied)
    notes = []
    # Selectors that arrive at the same points give the same model: one of them counts.
    models = len(tied.drop_duplicates(["family", "inputs"]))
    if (picked["family"], picked["inputs"]) != (best["family"], best["inputs"]):
        notes.append(
            f"the simplest of {models} within {rule.tie_percent:g} % of the best "
            f"({_cell_words(best['family'], best['n_tsp'], best['selector'])}, {best['score_um']:.2f} µm)"
        )
    if len(baselines):
        least = baselines.nsmallest(1, "score_um").iloc[0]
        notes.append(f"{least['family']} has {least['score_um']:.2f} µm")
    return _picked(picked, rule, notes, caution)


def pick(cells: pd.DataFrame, rule: PromotionRule, cell: str) -> Choice:
    """A cell chosen by hand, as ``selector|family|n_tsp``.

    Raises:
        InputError: no such cell under the rule's protocols, with the closest; or as `judged`.
    """
    table = judged(cells, rule)
    labels = table["selector"] + "|" + table["family"] + "|" + table["n_tsp"].astype(str)
    if cell not in set(labels):
        near = difflib.get_close_matches(cell, labels, n=3, cutoff=0.3) or list(labels[:3])
        raise InputError(
            f"unknown cell {cell!r} of {', '.join(sorted(set(table['protocol'])))}; expected selector|family|n_tsp, "
            f"such as {', '.join(near)}"
        )
    row = table[labels == cell].iloc[0]
    caution = "a baseline, no model of the temperatures" if row["family"] in BASELINES else ""
    return _picked(row, rule, ["chosen by hand"], caution)


def decide(result: GridResult, rule: PromotionRule, cell: str = "") -> Choice:
    """The rule's choice (or the cell picked by hand), with its nested score, tested against the baselines.

    The choice is trustworthy where the paired test shows it better than every baseline. The choice's own scores are
    flattered by the search, so each batch enters the test with the nested score where there is one.

    Raises:
        InputError: as `choose` and `pick`.
    """
    choice = pick(result.cells, rule, cell) if cell else choose(result.cells, rule)
    own = left_out(result, rule, choice.selector, choice.family, choice.n_tsp)
    nested = pd.DataFrame() if cell else score_of_choice(result, rule)
    words, caution = choice.summary, choice.caution
    if len(nested):
        S_um = nested.loc[nested["protocol"] == choice.protocol, "S_um"]
        mean, std = float(S_um.mean()), float(S_um.std())
        words += f"; each batch by the cell that the others chose: {mean:.2f} ± {std:.2f} µm"
        choice = replace(choice, nested_S_mean_um=mean, nested_S_std_um=std)
        own = nested.merge(result.batches[["batch_id", "digest"]].astype(str), on="batch_id")
    if not caution:
        for baseline in BASELINES:
            rest = left_out(result, rule, "none", baseline, 0)
            if len(rest) and not (test := compare_paired(own, rest, rule)).better:
                caution = f"not shown to be better than {baseline} ({test.evidence})"
                words += f"; {caution}: no trustworthy model"
                break
    return replace(choice, caution=caution, summary=words)


def left_out(result: GridResult, rule: PromotionRule, selector: str, family: str, n_tsp: int) -> pd.DataFrame:
    """Left-out S of one cell under the rule's protocols: batch_id, digest, protocol, S_um times the protocol's weight.

    For train-on-one a row is the batch trained on.
    """
    s = result.scores
    rows = s[s["protocol"].isin(rule.protocols) & (s["selector"] == selector) & (s["family"] == family)]
    rows = rows[rows["n_tsp"] == n_tsp]
    ids = rows["batch_id"].where(rows["batch_id"] != "*", rows["fold"]).astype(str)
    weight = rows["protocol"].map(rule.protocols).to_numpy(float)
    table = pd.DataFrame({
        "batch_id": ids.to_numpy(), "protocol": rows["protocol"].to_numpy(str),
        "S_um": rows["S_um"].to_numpy(float) * weight,
    })  # fmt: skip
    return table.merge(result.batches[["batch_id", "digest"]].astype(str), on="batch_id")


def score_of_choice(result: GridResult, rule: PromotionRule) -> pd.DataFrame:
    """Every batch judged by the cell that the other batches would have chosen: batch_id, protocol, cell, S_um.

    The best of many cells has been chosen for its left-out score, which flatters it (Varma & Simon 2006,
    BMC Bioinformatics 7:91). Here batch k is not used in the choice that predicts it. Empty for train-on-one, where a
    score belongs to the batch trained on, and for two batches, where the other one alone has no spread.
    """
    columns = ["batch_id", "protocol", "cell", "S_um"]
    offered = rule.offered(set(result.cells["protocol"]))
    scores = result.scores[result.scores["protocol"].isin(offered)]
    if scores.empty or (scores["batch_id"] == "*").any() or scores["batch_id"].nunique() < 3:
        return pd.DataFrame(columns=columns)
    left = _Left.of(result, offered)
    rows = []
    for batch_id in scores["batch_id"].unique():
        table = left.judged_without(batch_id, rule)
        choice = _choose(table, rule)
        for p, S_um in left.scores_of(choice, batch_id).items():
            rows.append((batch_id, p, choice.cell, S_um * rule.protocols[p]))
    return pd.DataFrame(rows, columns=columns)


@dataclass(frozen=True)
class _Left:
    """The C cells that all of the protocols have, with the left-out scores by batch.

    `table` has P C rows, protocol after protocol; `S_um`, `max_abs_um` (C, K) and `batch_ids` (K,) by protocol.
    """

    protocols: tuple[str, ...]
    table: pd.DataFrame
    cells: pd.MultiIndex
    batch_ids: dict[str, list[str]]
    S_um: dict[str, NDArray[np.float64]]
    max_abs_um: dict[str, NDArray[np.float64]]

    @classmethod
    def of(cls, result: GridResult, protocols: Sequence[str]) -> Self:
        table, common = _common_cells(result.cells, protocols)
        texts = {c: object for c in table if not pd.api.types.is_numeric_dtype(table[c])}  # quicker to take from
        ids, S_um, max_abs_um = {}, {}, {}
        for p in protocols:
            scores = result.scores[result.scores["protocol"] == p]
            wide = scores.pivot(index=KEYS, columns="batch_id", values=["S_um", "max_abs_um"]).loc[common]
            S_um[p], max_abs_um[p] = (wide[name].to_numpy(float) for name in ("S_um", "max_abs_um"))
            ids[p] = [str(k) for k in wide["S_um"].columns]
        return cls(tuple(protocols), table.astype(texts), common, ids, S_um, max_abs_um)

    def judged_without(self, batch_id: str, rule: PromotionRule) -> pd.DataFrame:
        """`judged` as the other batches show it.

        Raises:
            InputError: no cell has a finite score.
        """
        others = {p: np.array([k != batch_id for k in self.batch_ids[p]]) for p in self.protocols}
        run = [p for p in self.protocols if others[p].sum() > 1]
        found = []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a cell without any score has NaN, as intended
            for p in run:
                S_um = self.S_um[p][:, others[p]]
                worst = np.nanmax(self.max_abs_um[p][:, others[p]], axis=1)
                found.append({
                    "S_mean_um": np.nanmean(S_um, axis=1), "S_std_um": np.nanstd(S_um, axis=1, ddof=1),
                    "max_abs_um": worst,
                })  # fmt: skip
        rows = self.table[self.table["protocol"].isin(run)].reset_index(drop=True)
        own = {name: np.concatenate([f[name] for f in found]) for name in found[0]}
        return _decided(rows.assign(**own), len(self.cells), rule)

    def scores_of(self, choice: Choice, batch_id: str) -> dict[str, float]:
        """The left-out S in µm of a batch by a cell, by protocol."""
        cell = self.cells.get_loc((choice.selector, choice.family, choice.n_tsp))
        ids = {p: self.batch_ids[p] for p in self.protocols if batch_id in self.batch_ids[p]}
        return {p: float(self.S_um[p][cell, own.index(batch_id)]) for p, own in ids.items()}


def compare_paired(new: pd.DataFrame, old: pd.DataFrame, rule: PromotionRule) -> Comparison:
    """Is the newcomer better on the same batches? One-sided paired sign-flip test of the mean difference of S.

    Batches are the independent samples: of several protocols a batch counts once, with the worst of its scores (or
    their mean, as the rule combines them). Under "no difference" the sign of every batch's difference is a coin toss
    (Fisher 1935); all 2^n patterns are counted up to 16 batches, above that a seeded draw. The 90 % interval is
    Student's over batches.

    Args:
        new, old: batch_id, digest, protocol, S_um (µm) as from `left_out`; a row counts where batch, content and
            protocol agree and both S are finite.
    """
    both = new.merge(old, on=["batch_id", "digest", "protocol"], suffixes=("_new", "_old"))
    both = both[np.isfinite(both["S_um_new"]) & np.isfinite(both["S_um_old"])]
    by_batch = both.groupby("batch_id")[["S_um_new", "S_um_old"]]
    both = by_batch.max() if rule.combine == "worst" else by_batch.mean()
    n = len(both)
    d = (both["S_um_old"] - both["S_um_new"]).to_numpy(float)
    new_mean = float(both["S_um_new"].mean()) if n else float("nan")
    old_mean = float(both["S_um_old"].mean()) if n else float("nan")
    mean = float(d.mean()) if n else float("nan")
    half = float(stdtrit(n - 1, 0.5 + _INTERVAL / 2) * d.std(ddof=1) / np.sqrt(n)) if n > 1 else float("nan")
    p = sign_flip_p(d) if n else float("nan")
    better = n >= rule.min_batches and mean > 0 and p <= rule.significance
    n_better = int((d > 0).sum())
    if n < rule.min_batches:
        evidence = f"{n} batches in common, need at least {rule.min_batches}"
    else:
        sign = "better" if mean >= 0 else "worse"
        evidence = (
            f"S {new_mean:.2f} against {old_mean:.2f} µm over {n} batches, {abs(mean):.2f} µm {sign} on average "
            f"(90 % interval {mean - half:+.2f} to {mean + half:+.2f}), better on {n_better} of {n}, p = {p:.3g} "
            f"{'≤' if p <= rule.significance else '>'} {rule.significance:g}"
        )
    return Comparison(n, n_better, new_mean, old_mean, mean, mean - half, mean + half, p, better, evidence)


def sign_flip_p(difference: NDArray[np.float64]) -> float:
    """One-sided p of mean(difference) > 0 when every sign is a coin toss; (n,) -> p. Ties count against."""
    d = np.asarray(difference, float)
    if len(d) < 2:
        return 0.5 if d.sum() > 0 else 1.0
    size = np.abs(d).sum() or 1.0

    def total(flipped: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
        """Rounded, so that equal sums of different rounding errors are ties."""
        return np.round(flipped.sum(axis=axis) / size, 9)

    from scipy.stats import permutation_test  # takes long to load

    found = permutation_test(
        (d,), total, permutation_type="samples", alternative="greater", n_resamples=_SIGN_PATTERNS, rng=0
    )
    return float(found.pvalue)


def _simplest(table: pd.DataFrame) -> pd.Series:
    order = ["n_inputs", "rank", "n_parameters", "score_um", "selects", "selector", "family", "n_tsp"]
    return table.assign(selects=table["selector"] != "none").sort_values(order, kind="stable").iloc[0]


def _picked(row: pd.Series, rule: PromotionRule, notes: list[str], caution: str) -> Choice:
    name = _cell_words(row["family"], row["n_tsp"], row["selector"])
    mean, std = row["S_mean_um"], row["S_std_um"]
    if rule.score == "S_mean + S_std" and np.isclose(mean + std, row["score_um"]):
        score = f"S_mean {mean:.2f} + S_std {std:.2f} = {row['score_um']:.2f} µm"
    else:
        score = f"{rule.score} {row['score_um']:.2f} µm"
    words = f"{name}: {score}, {row['protocol']} over {int(row['n_batches'])} batches"
    if caution:
        notes = [*notes, f"{caution}: no trustworthy model"]
    return Choice(
        protocol=str(row["protocol"]),
        selector=str(row["selector"]),
        family=str(row["family"]),
        n_tsp=int(row["n_tsp"]),
        inputs=tuple(i for i in str(row["inputs"]).split("|") if i),
        score_um=float(row["score_um"]),
        S_mean_um=float(row["S_mean_um"]),
        S_std_um=float(row["S_std_um"]),
        tsp_stability=float(row["tsp_stability"]),
        n_batches=int(row["n_batches"]),
        caution=caution,
        summary="; ".join([words, *notes]),
    )


def _cell_words(family: str, n_tsp: int, selector: str) -> str:
    if family in BASELINES or not n_tsp:
        return family
    return f"{family} on {n_tsp} point{'s' if n_tsp > 1 else ''} by {selector}"
