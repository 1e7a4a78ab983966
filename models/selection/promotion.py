"""The promotion rule: which cell has the least expected loss, how far it may be trusted, whether it beats a champion.

The expected loss of a cell in a future run is a weighted mean of its S over left-out runs. A run predicted from earlier
ones counts most, since a future run is predicted so; a season or speed that was left out counts by its number of runs,
pooled with the others (`PromotionRule.group_runs`). To it comes the cost of choosing among the cells of a family
(`models.selection.loss.cost_of_choosing`). Of few runs most differences are chance: the loss is pooled with what the
family reached on other machines (`models.selection.loss.pooled`).
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import stdtrit

from data.arrays import Array
from data.errors import InputError
from models.metrics import residual_std_um
from models.protocols import PromotionRule
from models.selection.loss import BASELINES, cost_of_choosing, paired, pooled
from models.selection.result import GridResult

Standing = Literal["champion", "provisional", "refused"]
KEYS = ["selector", "family", "n_tsp"]
_SIGN_PATTERNS = 2**16  # of up to 16 batches all are counted, of more so many are drawn
_INTERVAL = 0.90
_MAJORITY, _FEWEST = 2 / 3, 3  # share of the runs that a provisional model must improve, and fewest runs
_GROUPED = ("leave-season-out", "leave-speed-out")
_SHARES = np.linspace(0.05, 1.0, 20)  # of a correction that are tried as authority
_UNMEASURED = 0.5  # authority of a provisional model whose left-out predictions are not known


@dataclass(frozen=True)
class Choice:
    """The cell that the rule picked.

    `score_um` is its expected loss, with the cost of choosing; `protocol` the leading one, `S_mean_um` and `S_std_um`
    are of this protocol. The nested score predicts every run by the cell that the other runs chose, under the same
    protocol. `standing`: "champion", where it is shown to be better than no model; "provisional", where it is expected
    to be, and is in two of three runs, but this is not shown beyond doubt; "refused", where it may harm.
    `caution` is why it is no champion; `lacking` how many runs a champion needs, where there are fewer. `authority` is
    the share of the correction that a provisional model is worth.
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
    standing: Standing = "champion"
    authority: float = 1.0
    lacking: str = ""

    @property
    def trusted(self) -> bool:
        return self.standing == "champion"

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


@dataclass(frozen=True)
class Losses:
    """S of the C cells that all of the rule's protocols have scored, in R left-out runs.

    `cells` (C rows): the row of `GridResult.cells` under the leading protocol, with the least `tsp_stability`. `S_um`
    (C, R); `protocol`, `group` (what was left out), `batch_id`, `weight`: of the runs (R,). `tried`: the
    most cells of each family in a round of the race.
    """

    cells: pd.DataFrame
    S_um: Array
    protocol: NDArray[np.object_]
    group: NDArray[np.object_]
    batch_id: NDArray[np.object_]
    weight: Array
    rule: PromotionRule
    tried: Mapping[str, int]

    @classmethod
    def of(cls, result: GridResult, rule: PromotionRule) -> Self:
        """Cells without a finite S in every run are left out.

        Raises:
            InputError: none of the rule's protocols was run, or no cell has a finite score.
        """
        run = sorted(set(result.cells["protocol"]))
        offered = rule.offered(run)
        if not offered:
            raise InputError(
                f"promotion rule: got trainings by {', '.join(run)}, expected one of its protocols "
                f"{', '.join(rule.protocols)}; add one of them to the training or to promotion.protocols in mlflow.yml"
            )
        tables = []
        for p in offered:
            own = result.scores[result.scores["protocol"] == p]
            ids = own["batch_id"].where(own["batch_id"] != "*", own["fold"]).astype(str)
            own = own.assign(run=ids)[[*KEYS, "protocol", "fold", "run", "S_um"]]
            tables.append(own.pivot(index=KEYS, columns=["protocol", "fold", "run"], values="S_um"))
        wide = pd.concat(tables, axis=1, join="inner")
        wide = wide[np.isfinite(wide.to_numpy(float)).all(axis=1)]
        if wide.empty:
            raise InputError(f"promotion rule: no cell of {', '.join(offered)} has a finite S")
        by_cell = result.cells.set_index(KEYS)
        led = by_cell[by_cell["protocol"] == offered[0]].loc[wide.index]
        stability = by_cell.loc[by_cell["protocol"].isin(offered), "tsp_stability"].groupby(level=[0, 1, 2]).min()
        cells = led.assign(tsp_stability=stability.reindex(wide.index)).reset_index()
        protocol, group, ids = (wide.columns.get_level_values(k).to_numpy(object) for k in range(3))
        weight = np.array([rule.protocols[p] for p in protocol])
        race = result.race
        counts = race.groupby(["round", "family"]).size().sort_values() if len(race) else pd.Series(dtype=int)
        tried = {str(key[-1]): int(n) for key, n in zip(counts.index, counts, strict=True)} if len(race) else {}
        return cls(cells, wide.to_numpy(float), protocol, group, ids, weight, rule, tried)

    def counted(self, without: str | None = None) -> Array:
        """What each run counts (R,), 0 for the batch that is left out; sums up to 1.

        The mean of a group of n runs that was left out is pooled with the protocol's mean by n : `group_runs`.
        """
        out = np.where(self.batch_id == without, 0.0, self.weight)
        for p in dict.fromkeys(self.protocol):
            own = (self.protocol == p) & (out > 0)
            if p in _GROUPED and own.any():
                _, place, n = np.unique(self.group[own].astype(str), return_inverse=True, return_counts=True)
                alone = (n / (n + self.rule.group_runs))[place]
                out[own] *= alone + np.mean(1.0 - alone)
        return np.asarray(out / out.sum()) if out.any() else out

    def choosing_um(self) -> Array:
        """Cost of choosing among the cells of each family (C,)."""
        by_batch, share = self.by_batch(self.counted())
        cells = list(self.cells[KEYS].itertuples(index=False, name=None))
        return cost_of_choosing(by_batch, cells, self.tried, share)

    def by_batch(self, counted: Array) -> tuple[Array, Array]:
        """Means over the scores of a batch (C, K), and what each batch counts (K,)."""
        ids, place = np.unique(self.batch_id.astype(str), return_inverse=True)
        share = np.bincount(place, counted, len(ids)).astype(float)
        out = np.zeros((len(self.S_um), len(ids)))
        np.add.at(out.T, place, (self.S_um * counted).T)
        return out[:, share > 0] / share[share > 0], share[share > 0]

    def behind(self, cell: int, counted: Array) -> tuple[Array, Array]:
        """How far every cell is behind one, with the standard error over batches, (C,) each."""
        by_batch, share = self.by_batch(counted)
        return paired(by_batch, by_batch[cell], share)


def judged(result: GridResult, rule: PromotionRule) -> pd.DataFrame:
    """One row per cell that all of the rule's protocols have scored: its row of `GridResult.cells` under the leading
    protocol, with `own_um`, the loss on this machine's runs, of which `choosing_um` is the cost of choosing, and
    `score_um`, the expected loss, pooled with the record of the family.

    Raises:
        InputError: as `Losses.of`.
    """
    return _scored(Losses.of(result, rule))


def _scored(losses: Losses) -> pd.DataFrame:
    choosing_um = losses.choosing_um()
    own_um = losses.S_um @ losses.counted() + choosing_um
    loss_um, _ = pooled(own_um, list(losses.cells["family"]), float(losses.weight.sum()), losses.rule.record_runs)
    return losses.cells.assign(own_um=own_um, score_um=loss_um, choosing_um=choosing_um)


def ranked(result: GridResult, rule: PromotionRule, than: str = "") -> pd.DataFrame:
    """The best cell of every family, the smallest expected loss first; columns as `judged`, and `behind_um` the loss
    on this machine's runs against a cell with its standard error `se_um`, without the cost of choosing.

    Args:
        than: the cell, as ``selector|family|n_tsp``; default: the first that is no baseline.

    Raises:
        InputError: as `judged`.
    """
    losses = Losses.of(result, rule)
    table = _scored(losses)
    labels = table["selector"] + "|" + table["family"] + "|" + table["n_tsp"].astype(str)
    known = np.flatnonzero(labels == than) if than else np.flatnonzero(~table["family"].isin(BASELINES))
    at = int(known[np.argmin(table["score_um"].to_numpy()[known])]) if len(known) else 0
    behind_um, se_um = losses.behind(at, losses.counted())
    order = table.assign(behind_um=behind_um, se_um=se_um).sort_values(["score_um", "rank", "n_tsp"], kind="stable")
    return order.drop_duplicates("family").reset_index(drop=True)


def choose(result: GridResult, rule: PromotionRule) -> Choice:
    """The cell to promote: least expected loss, ties within `ties_se` standard errors to the simpler.

    Simpler is fewer inputs, then the family's rank, then fewer parameters, then the smaller loss. A baseline is chosen
    only where nothing beats it.

    Raises:
        InputError: as `judged`.
    """
    losses = Losses.of(result, rule)
    table = _scored(losses)
    at = _least(losses, table["own_um"].to_numpy(float), losses.counted())
    return _picked(table, at, rule)


def _least(losses: Losses, own_um: Array, counted: Array) -> int:
    """The cell of least loss, or the simplest that is not behind it by more than the ties allow.

    A baseline wins where its own loss `own_um` (C,), not pooled with any record, is the least.
    """
    table, runs = losses.cells, float(losses.weight.sum())
    is_baseline = table["family"].isin(BASELINES).to_numpy()
    floor_um = float(own_um[is_baseline].min()) if is_baseline.any() else np.inf
    better = ~is_baseline & (own_um < floor_um)
    if not better.any():
        return _simplest(table, own_um, is_baseline & (own_um <= floor_um))
    loss_um, share = pooled(own_um, list(table["family"]), runs, losses.rule.record_runs)
    best = int(np.argmin(np.where(better, loss_um, np.inf)))
    _, se_um = losses.behind(best, counted)
    return _simplest(table, loss_um, better & (loss_um - loss_um[best] <= losses.rule.ties_se * share * se_um))


def pick(result: GridResult, rule: PromotionRule, cell: str) -> Choice:
    """A cell chosen by hand, as ``selector|family|n_tsp``.

    Raises:
        InputError: no such cell under the rule's protocols, with the closest; or as `judged`.
    """
    table = judged(result, rule)
    labels = table["selector"] + "|" + table["family"] + "|" + table["n_tsp"].astype(str)
    if cell not in set(labels):
        near = difflib.get_close_matches(cell, labels, n=3, cutoff=0.3) or list(labels[:3])
        raise InputError(
            f"unknown cell {cell!r} of {', '.join(sorted(set(table['protocol'])))}; expected selector|family|n_tsp, "
            f"such as {', '.join(near)}"
        )
    at = int(np.flatnonzero(labels == cell)[0])
    choice = _picked(table, at, rule, ["chosen by hand"])
    if choice.family in BASELINES:
        choice = replace(choice, standing="refused", caution="a baseline, no model of the temperatures")
    return choice


def decide(result: GridResult, rule: PromotionRule, cell: str = "") -> Choice:
    """The rule's choice (or the cell picked by hand), with its nested score, and how far it may be trusted.

    A champion is shown to be better than no model by the paired test. The choice's own scores are flattered by
    the search, so each run enters the test with the nested score where there is one.

    Raises:
        InputError: as `choose` and `pick`.
    """
    choice = pick(result, rule, cell) if cell else choose(result, rule)
    led = rule.only(choice.protocol)
    own = left_out(result, led, choice.selector, choice.family, choice.n_tsp)
    nested = pd.DataFrame() if cell else score_of_choice(result, led)
    summary = choice.summary
    if len(nested):
        mean, std = float(nested["S_um"].mean()), float(nested["S_um"].std())
        if mean > choice.S_mean_um:
            summary = f"each run by the cell that the others chose: S {mean:.2f} ± {std:.2f} µm; {summary}"
        choice = replace(choice, nested_S_mean_um=mean, nested_S_std_um=std)
        own = nested.merge(result.batches[["batch_id", "digest"]].astype(str), on="batch_id")
    nothing = left_out(result, led, "none", "zero", 0)
    if not choice.caution and len(nothing) and not (test := compare_paired(own, nothing, led)).better:
        choice = replace(choice, caution=f"not shown to be better than no model ({test.evidence})")
        clear = test.n_batches >= _FEWEST and test.n_better >= _MAJORITY * test.n_batches
        if test.difference_um > 0 and clear:
            share = authority(result.curves, choice)
            choice = replace(choice, standing="provisional", authority=share)
            summary += f"; provisional, {100 * share:.3g} % of the correction: {choice.caution}"
        else:
            choice = replace(choice, standing="refused")
            summary += f"; {choice.caution}: no trustworthy model"
    return replace(choice, summary=summary, lacking=lacking(result, rule, choice))


def lacking(result: GridResult, rule: PromotionRule, choice: Choice) -> str:
    """How many runs a champion needs and how many there are; empty where enough are left out."""
    if choice.n_batches >= rule.least_tested:
        return ""
    dated = bool(len(result.batches)) and all(map(str, result.batches["start"].fillna("")))
    return rule.few(len(result.batches), dated or choice.protocol == "forward")


def authority(curves: pd.DataFrame, choice: Choice) -> float:
    """The share of a correction that a provisional model is worth, 0.05 to 1.

    The smallest share whose mean S over left-out runs is within a standard error of the best share's.

    Args:
        curves: the choice's left-out predictions, see `GridResult.curves`; without them 0.5.
    """
    own = curves[curves["protocol"] == choice.protocol] if len(curves) else curves
    runs = [g for _, g in own.groupby(["fold", "batch_id"], sort=False)] if len(own) else []
    S_um = np.array([
        [residual_std_um(g["recorded_um"].to_numpy(float) - a * g["predicted_um"].to_numpy(float)) for g in runs]
        for a in _SHARES
    ])  # fmt: skip
    known = np.isfinite(S_um).all(axis=0) if len(runs) else np.zeros(0, bool)
    if known.sum() < 2:
        return _UNMEASURED
    S_um = S_um[:, known]
    behind_um, se_um = paired(S_um, S_um[np.argmin(S_um.mean(axis=1))])
    return float(_SHARES[np.argmax(behind_um <= np.where(np.isfinite(se_um), se_um, 0.0))])


def left_out(result: GridResult, rule: PromotionRule, selector: str, family: str, n_tsp: int) -> pd.DataFrame:
    """Left-out S of one cell under the rule's protocols: batch_id, digest, protocol, S_um (µm).

    For train-on-one a row is the batch trained on.
    """
    s = result.scores
    rows = s[s["protocol"].isin(rule.protocols) & (s["selector"] == selector) & (s["family"] == family)]
    rows = rows[rows["n_tsp"] == n_tsp]
    ids = rows["batch_id"].where(rows["batch_id"] != "*", rows["fold"]).astype(str)
    table = pd.DataFrame({
        "batch_id": ids.to_numpy(), "protocol": rows["protocol"].to_numpy(str), "S_um": rows["S_um"].to_numpy(float),
    })  # fmt: skip
    return table.merge(result.batches[["batch_id", "digest"]].astype(str), on="batch_id")


def score_of_choice(result: GridResult, rule: PromotionRule) -> pd.DataFrame:
    """Every batch judged by the cell that the other batches would have chosen: batch_id, protocol, cell, S_um.

    By one protocol all cells of the last rounds of a race take part, not the finalists alone. Empty for train-on-one,
    where a score belongs to the batch trained on, and for two batches, where the other one alone would choose.
    """
    columns = ["batch_id", "protocol", "cell", "S_um"]
    losses = Losses.of(result, rule)
    ids = [str(k) for k in dict.fromkeys(losses.batch_id)]
    if len(ids) < 3 or (losses.protocol == "train-on-one").all():
        return pd.DataFrame(columns=columns)
    rows = []
    for k in ids:
        counted = losses.counted(k)
        c = _least(losses, losses.S_um @ counted, counted)
        cell = "|".join(str(v) for v in losses.cells.loc[c, KEYS])
        rows += [(k, losses.protocol[r], cell, losses.S_um[c, r]) for r in np.flatnonzero(losses.batch_id == k)]
    return pd.DataFrame(rows, columns=columns)


def compare_paired(new: pd.DataFrame, old: pd.DataFrame, rule: PromotionRule) -> Comparison:
    """Is the newcomer better on the same batches? One-sided paired sign-flip test of the mean difference of S.

    Batches are the independent samples: of several protocols a batch counts once, with the mean of its scores as the
    rule weights them. Under "no difference" the sign of every batch's difference is a coin toss
    (Fisher 1935); all 2^n patterns are counted up to 16 batches, above that a seeded draw. The 90 % interval is
    Student's over batches.

    Args:
        new, old: batch_id, digest, protocol, S_um (µm) as from `left_out`; a row counts where batch, content and
            protocol agree and both S are finite.
    """
    both = new.merge(old, on=["batch_id", "digest", "protocol"], suffixes=("_new", "_old"))
    both = both[np.isfinite(both["S_um_new"]) & np.isfinite(both["S_um_old"])]
    weight = both["protocol"].map(rule.protocols).astype(float).fillna(1.0)
    own = both[["S_um_new", "S_um_old"]].astype(float).mul(weight, axis=0).groupby(both["batch_id"]).sum()
    both = own.div(weight.groupby(both["batch_id"]).sum(), axis=0)
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


def _simplest(table: pd.DataFrame, loss_um: Array, among: NDArray[np.bool_]) -> int:
    order = ["n_inputs", "rank", "n_parameters", "loss_um", "selects", "selector", "family", "n_tsp"]
    own = table.assign(selects=table["selector"] != "none", loss_um=loss_um)[among]
    return int(own.sort_values(order, kind="stable").index[0])


def _picked(table: pd.DataFrame, at: int, rule: PromotionRule, notes: Sequence[str] = ()) -> Choice:
    """The cell in that row of `judged`, with what the best other cell and the baselines have."""
    row, notes = table.iloc[at], list(notes)
    name = _cell_words(row["family"], row["n_tsp"], row["selector"])
    mean, std, loss = row["S_mean_um"], row["S_std_um"], row["score_um"]
    others = table[~table["family"].isin(BASELINES)]
    best = others.nsmallest(1, "score_um").iloc[0] if len(others) else row
    if (best["family"], best["inputs"]) != (row["family"], row["inputs"]) and best["score_um"] < loss and not notes:
        words = _cell_words(best["family"], best["n_tsp"], best["selector"])
        notes.append(f"simpler than the best ({words}, {best['score_um']:.2f} µm) and not shown to be worse")
    least = table[table["family"].isin(BASELINES)].nsmallest(1, "own_um")
    caution = ""
    if len(least) and row["family"] in BASELINES:
        other = f" (best other: {others['own_um'].min():.2f} µm)" if len(others) else ""
        caution = f"nothing beats {row['family']}{other}"
        notes.append(f"{caution}: no trustworthy model")
    elif len(least):
        notes.append(f"{least.iloc[0]['family']} has {least.iloc[0]['own_um']:.2f} µm")
    summary = (
        f"{name}: expected loss {loss:.2f} µm; S {mean:.2f} ± {std:.2f} µm, {row['protocol']} over "
        f"{int(row['n_batches'])} batches"
    )
    return Choice(
        protocol=str(row["protocol"]),
        selector=str(row["selector"]),
        family=str(row["family"]),
        n_tsp=int(row["n_tsp"]),
        inputs=tuple(i for i in str(row["inputs"]).split("|") if i),
        score_um=float(loss),
        S_mean_um=float(mean),
        S_std_um=float(std),
        tsp_stability=float(row["tsp_stability"]),
        n_batches=int(row["n_batches"]),
        caution=caution,
        summary="; ".join([summary, *notes]),
        standing="refused" if caution else "champion",
    )


def _cell_words(family: str, n_tsp: int, selector: str) -> str:
    if family in BASELINES or not n_tsp:
        return family
    by = "" if selector == family else f" by {selector}"  # a stack's members bring their own points
    return f"{family} on {n_tsp} point{'s' if n_tsp > 1 else ''}{by}"
