"""The promotion rule as pure functions: which cell is best, and whether a newcomer beats the champion."""

from __future__ import annotations

import difflib
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats

from data.errors import InputError, closest
from models.protocols import PromotionRule
from models.result import GridResult

BASELINES = ("zero", "mean_curve")
_SIGN_PATTERNS = 2**16  # of up to 16 batches all are counted, of more so many are drawn
_INTERVAL = 0.90


@dataclass(frozen=True)
class Choice:
    """The cell that the rule picked. `caution` is why it is not to be trusted: a baseline won, no set of points was
    stable, or the search itself explains the score; empty where it is."""

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
    nested_S_mean_um: float = float("nan")  # every batch predicted by the cell that the other batches chose
    nested_S_std_um: float = float("nan")

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
    words: str

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def score_um(cells: pd.DataFrame, rule: PromotionRule) -> pd.Series:
    """The rule's score of every cell, µm, smaller is better."""
    if rule.score == "max_abs":
        return cells["max_abs_um"].astype(float)
    spread = cells["S_std_um"] if rule.score == "S_mean + S_std" else 0.0
    return (cells["S_mean_um"] + spread).astype(float)


def choose(cells: pd.DataFrame, rule: PromotionRule) -> Choice:
    """The cell to promote: least score among stable cells, ties to the simpler.

    Simpler is fewer inputs, then the family's rank, then fewer parameters, then the smaller score. A baseline is
    promoted only where nothing beats it, and then not to be trusted.

    Args:
        cells: `GridResult.cells`.

    Raises:
        InputError: no cell of the rule's protocol, or none with a finite score.
    """
    protocols = sorted(set(cells["protocol"]))
    if rule.protocol not in protocols:
        raise InputError(
            f"promotion rule: protocol {rule.protocol!r} was not run in this training; "
            f"{closest(rule.protocol, protocols)}"
        )
    table = cells[cells["protocol"] == rule.protocol].copy()
    table["score_um"] = score_um(table, rule)
    table = table[np.isfinite(table["score_um"])]
    if table.empty:
        raise InputError(f"promotion rule: no cell of protocol {rule.protocol} has a finite {rule.score}")
    is_baseline = table["family"].isin(BASELINES)
    baselines, candidates = table[is_baseline], table[~is_baseline]
    stable = candidates[candidates["tsp_stability"].fillna(0.0) >= rule.min_tsp_stability]
    caution = ""
    if stable.empty and not candidates.empty:
        top = candidates["tsp_stability"].max()
        caution = f"no set of points is stable (best {top:.2f}, asked {rule.min_tsp_stability:g})"
        stable = candidates
    floor = baselines["score_um"].min() if len(baselines) else np.inf
    if stable.empty or stable["score_um"].min() >= floor:
        winner = _simplest(baselines[baselines["score_um"] <= floor])
        other = "" if stable.empty else f" (best other: {stable['score_um'].min():.2f} µm)"
        return _picked(winner, rule, [], f"nothing beats {winner['family']}{other}")
    best = stable.loc[stable["score_um"].idxmin()]
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
        least = baselines.loc[baselines["score_um"].idxmin()]
        notes.append(f"beats {least['family']} ({least['score_um']:.2f} µm)")
    return _picked(picked, rule, notes, caution)


def pick(cells: pd.DataFrame, rule: PromotionRule, cell: str) -> Choice:
    """A cell chosen by hand, as ``selector|family|n_tsp``.

    Raises:
        InputError: no such cell under the rule's protocol, with the closest.
    """
    table = cells[cells["protocol"] == rule.protocol]
    labels = table["selector"] + "|" + table["family"] + "|" + table["n_tsp"].astype(str)
    if cell not in set(labels):
        near = difflib.get_close_matches(cell, labels, n=3, cutoff=0.3) or list(labels[:3])
        raise InputError(
            f"unknown cell {cell!r} of protocol {rule.protocol}; expected selector|family|n_tsp, such as "
            f"{', '.join(near)}"
        )
    row = table[labels == cell].iloc[0].copy()
    row["score_um"] = score_um(table[labels == cell], rule).iloc[0]
    caution = "a baseline, no model of the temperatures" if row["family"] in BASELINES else ""
    return _picked(row, rule, ["chosen by hand"], caution)


def decide(result: GridResult, rule: PromotionRule, cell: str = "") -> Choice:
    """The rule's choice (or the cell picked by hand) with what choosing itself costs: the nested score.

    Where the nested score is no better than the best baseline, the choice is not to be trusted: on these batches the
    search cannot distinguish a good model from a lucky one.

    Raises:
        InputError: as `choose` and `pick`.
    """
    choice = pick(result.cells, rule, cell) if cell else choose(result.cells, rule)
    nested = score_of_choice(result, rule)
    if nested.empty or cell:
        return choice
    mean, std = float(nested["S_um"].mean()), float(nested["S_um"].std())
    words = f"{choice.summary}; each batch by the cell that the others chose: {mean:.2f} ± {std:.2f} µm"
    cells = result.cells[(result.cells["protocol"] == rule.protocol) & result.cells["family"].isin(BASELINES)]
    caution = choice.caution
    if not caution and len(cells) and rule.score != "max_abs":
        floor = cells.assign(score_um=score_um(cells, rule)).nsmallest(1, "score_um").iloc[0]
        reached = mean + (std if rule.score == "S_mean + S_std" else 0.0)
        if reached >= floor["score_um"]:
            beaten_by = f"no better than {floor['family']} ({floor['S_mean_um']:.2f} ± {floor['S_std_um']:.2f} µm)"
            caution = (
                f"predicted by the cell that the other batches chose, each batch comes to {mean:.2f} ± {std:.2f} µm, "
                f"by {rule.score} {beaten_by}"
            )
            words += f", {beaten_by}: do not trust"
    return replace(choice, caution=caution, summary=words, nested_S_mean_um=mean, nested_S_std_um=std)


def left_out(result: GridResult, protocol: str, selector: str, family: str, n_tsp: int) -> pd.DataFrame:
    """Per-batch left-out S of one cell: batch_id, digest, S_um. For train-on-one a row is the batch trained on."""
    s = result.scores
    rows = s[(s["protocol"] == protocol) & (s["selector"] == selector) & (s["family"] == family)]
    rows = rows[rows["n_tsp"] == n_tsp]
    ids = rows["batch_id"].where(rows["batch_id"] != "*", rows["fold"]).astype(str)
    table = pd.DataFrame({"batch_id": ids.to_numpy(), "S_um": rows["S_um"].to_numpy(float)})
    return table.merge(result.batches[["batch_id", "digest"]].astype(str), on="batch_id")


def score_of_choice(result: GridResult, rule: PromotionRule) -> pd.DataFrame:
    """Every batch judged by the cell that the other batches would have chosen: batch_id, cell, S_um.

    The best of many cells has been chosen for its left-out score, which flatters it (Varma & Simon 2006,
    BMC Bioinformatics 7:91). Here batch k is not used in the choice that predicts it. Empty for train-on-one, where a
    score belongs to the batch trained on, and for two batches, where the other one alone has no spread.
    """
    columns = ["batch_id", "cell", "S_um"]
    scores = result.scores[result.scores["protocol"] == rule.protocol]
    if scores.empty or (scores["batch_id"] == "*").any() or scores["batch_id"].nunique() < 3:
        return pd.DataFrame(columns=columns)
    cells = result.cells[result.cells["protocol"] == rule.protocol].reset_index(drop=True)
    keys = ["selector", "family", "n_tsp"]
    table = scores.pivot(index=keys, columns="batch_id", values="S_um")
    table = table.loc[pd.MultiIndex.from_frame(cells[keys])]
    worst = scores.pivot(index=keys, columns="batch_id", values="max_abs_um").loc[table.index]
    rows = []
    for batch_id in table.columns:
        others = table.drop(columns=batch_id)
        seen = cells.assign(
            S_mean_um=others.mean(axis=1).to_numpy(),
            S_std_um=others.std(axis=1).to_numpy(),
            max_abs_um=worst.drop(columns=batch_id).max(axis=1).to_numpy(),
        )
        choice = choose(seen, rule)
        rows.append((batch_id, choice.cell, table.loc[(choice.selector, choice.family, choice.n_tsp), batch_id]))
    return pd.DataFrame(rows, columns=columns)


def compare_paired(new: pd.DataFrame, old: pd.DataFrame, rule: PromotionRule) -> Comparison:
    """Is the newcomer better on the same batches? One-sided paired sign-flip test of the mean difference of S.

    Under "no difference" the sign of every batch's difference is a coin toss (Fisher 1935); all 2^n patterns are
    counted up to 16 batches, above that a seeded draw. The 90 % interval is Student's over batches.

    Args:
        new, old: batch_id, digest, S_um (µm); a batch counts where id and digest agree and both S are finite.
    """
    both = new.merge(old, on=["batch_id", "digest"], suffixes=("_new", "_old")).sort_values("batch_id")
    both = both[np.isfinite(both["S_um_new"]) & np.isfinite(both["S_um_old"])]
    n = len(both)
    d = (both["S_um_old"] - both["S_um_new"]).to_numpy(float)
    new_mean = float(both["S_um_new"].mean()) if n else float("nan")
    old_mean = float(both["S_um_old"].mean()) if n else float("nan")
    mean = float(d.mean()) if n else float("nan")
    half = float(stats.t.ppf(0.5 + _INTERVAL / 2, n - 1) * d.std(ddof=1) / np.sqrt(n)) if n > 1 else float("nan")
    p = sign_flip_p(d) if n else float("nan")
    better = n >= rule.min_batches and mean > 0 and p <= rule.significance
    n_better = int((d > 0).sum())
    if n < rule.min_batches:
        words = f"{n} batches in common, need at least {rule.min_batches}: the champion stays"
    else:
        sign = "better" if mean >= 0 else "worse"
        words = (
            f"S {new_mean:.2f} against {old_mean:.2f} µm over {n} batches, {abs(mean):.2f} µm {sign} on average "
            f"(90 % interval {mean - half:+.2f} to {mean + half:+.2f}), better on {n_better} of {n}, p = {p:.3g} "
            f"{'≤' if p <= rule.significance else '>'} {rule.significance:g}: "
            + ("the newcomer replaces the champion" if better else "not shown to be better, the champion stays")
        )
    return Comparison(n, n_better, new_mean, old_mean, mean, mean - half, mean + half, p, better, words)


def sign_flip_p(difference: NDArray[np.float64]) -> float:
    """One-sided p of mean(difference) > 0 when every sign is a coin toss; (n,) -> p. Ties count against."""
    d = np.asarray(difference, float)
    if len(d) < 2:
        return 0.5 if d.sum() > 0 else 1.0
    size = np.abs(d).sum() or 1.0

    def total(flipped: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
        """Rounded, so that equal sums of different rounding errors are ties."""
        return np.round(flipped.sum(axis=axis) / size, 9)

    found = stats.permutation_test(
        (d,), total, permutation_type="samples", alternative="greater", n_resamples=_SIGN_PATTERNS, rng=0
    )
    return float(found.pvalue)


def _simplest(table: pd.DataFrame) -> pd.Series:
    order = ["n_inputs", "rank", "n_parameters", "score_um", "selects", "selector", "family", "n_tsp"]
    return table.assign(selects=table["selector"] != "none").sort_values(order, kind="stable").iloc[0]


def _picked(row: pd.Series, rule: PromotionRule, notes: list[str], caution: str) -> Choice:
    name = _cell_words(row["family"], row["n_tsp"], row["selector"])
    if rule.score == "S_mean + S_std":
        score = f"S_mean {row['S_mean_um']:.2f} + S_std {row['S_std_um']:.2f} = {row['score_um']:.2f} µm"
    else:
        score = f"{rule.score} {row['score_um']:.2f} µm"
    words = f"{name}: {score}, {rule.protocol} over {int(row['n_batches'])} batches"
    if caution:
        notes = [*notes, f"{caution}: do not trust"]
    return Choice(
        protocol=rule.protocol,
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
