"""Outcome of a training in plain sentences and tables: findings, exclusions, trainings, promotion."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from data.errors import InputError
from models.protocols import PromotionRule
from models.selection.promotion import Choice, choose, compare_paired, decide, left_out, pick
from models.selection.result import GridResult, Training
from reports.comparison.tables import MAIN_PROTOCOL, protocols_of, scores_of
from reports.labels import between, cell_label, count, decimals, family_label, listed, number, p_label, plus_minus
from reports.layout import Column, Row, Table

_FINDING_KEYS = ["batch_id", "check", "channel", "start_s", "end_s", "words", "masks", "overruled"]


def findings_of(results: Sequence[GridResult]) -> pd.DataFrame:
    """The findings of all results, each once, by machine, batch and channel."""
    parts = [r.findings.reindex(columns=_FINDING_KEYS).assign(machine=r.machine) for r in results if len(r.findings)]
    if not parts:
        return pd.DataFrame(columns=[*_FINDING_KEYS, "machine"])
    every = pd.concat(parts, ignore_index=True).drop_duplicates()
    every = every.assign(masks=every["masks"].ne(False)).fillna({"channel": "", "words": "", "overruled": ""})
    return every.sort_values(["machine", "batch_id", "channel", "start_s"], kind="stable").reset_index(drop=True)


def findings_summary(found: pd.DataFrame, n_batches: int) -> str:
    """One sentence about all findings."""
    if found.empty:
        return f"The checks raised no finding in {count(n_batches, 'batch')} and masked no sample."
    overruled = found["overruled"].astype(bool)
    masked = int((found["masks"] & ~overruled).sum())
    with_any = found[["machine", "batch_id"]].drop_duplicates()
    where = f"{count(len(found), 'finding')} in {len(with_any)} of {count(n_batches, 'batch')}"
    summary = f"{where}: {masked} masked for training"
    noted = len(found) - masked - int(overruled.sum())
    summary += f", {noted} noted only" if noted else ""
    return summary + (f", {int(overruled.sum())} overruled by the machine file" if overruled.any() else "") + "."


def findings(found: pd.DataFrame) -> Table:
    """Every finding: where, when, what, and whether it was masked."""
    rows = [
        Row.of(
            str(f["batch_id"]),
            str(f["channel"]) or "all channels",
            str(f["check"]).replace("_", " "),
            between(float(f["start_s"]), float(f["end_s"])),
            str(f["words"]),
            _effect(f),
        )
        for f in found.to_dict("records")
    ]
    columns = (
        Column("batch"),
        Column("channel"),
        Column("check"),
        Column("when", "h:min from start"),
        Column("what was found", "", "wide"),
        Column("for training"),
    )
    return Table("Every finding", columns, tuple(rows))


def excluded(results: Sequence[tuple[str, GridResult]]) -> Table:
    """Channels that no cell may use, batches and folds left out, families that failed, with the error channels."""
    of: dict[tuple[str, str], list[str]] = {}
    for name, result in results:
        for row in result.excluded.to_dict("records"):
            targets = of.setdefault((str(row["channel"]), str(row["reason"])), [])
            if name not in targets:
                targets.append(name)
    rows = [
        Row.of(what, why, "all" if len(targets) == len(results) > 1 else ", ".join(targets))
        for (what, why), targets in of.items()
    ]
    columns = (Column("what"), Column("why", "", "wide"), Column("error channel"))
    return Table("Left out: channels, folds and failed families", columns, tuple(rows))


def trainings(name: str, group: Sequence[Training], choices: Sequence[Choice]) -> Table:
    """The trainings of one channel, newest first."""
    out = []
    for i, (t, choice) in enumerate(zip(group, choices, strict=True)):
        earlier = group[i + 1].result.batches if i + 1 < len(group) else None
        new, gone = changed_batches(t.result.batches, earlier) if earlier is not None else ([], [])
        p = t.promotion
        out.append(
            Row.of(
                f"{t.started:%Y-%m-%d %H:%M}",
                str(len(t.result.batches)),
                f"+{len(new)}" + (f" −{len(gone)}" if gone else "") if earlier is not None else "–",
                cell_label(choice.selector, choice.family, choice.n_tsp),
                plus_minus(choice.S_mean_um, choice.S_std_um, decimals(choice.S_std_um, choice.n_batches)),
                f"{p['outcome']} (version {p['version']})" if p else "not promoted",
            )
        )
    columns = (
        Column("trained (UTC)"),
        Column("batches", "", "number"),
        Column("new batches", "", "number"),
        Column("model"),
        Column("S_mean ± S_std", "µm", "number"),
        Column("outcome"),
    )
    caption = f"{name}: the trainings, each judged on its own batches"
    return Table(caption, columns, tuple(out))


def changes(group: Sequence[Training], choices: Sequence[Choice], rule: PromotionRule) -> list[str]:
    """What the newest training has that the one before it had not, and both on the batches they share."""
    if len(group) < 2:
        return []
    now, before = group[0].result, group[1].result
    new, gone = changed_batches(now.batches, before.batches)
    said = [f"New since {group[1].started:%Y-%m-%d %H:%M} UTC: {listed(new)}." if new else "No new batch."]
    if gone:
        said.append(f"No longer in the training: {listed(gone)}.")
    run = [set(r.cells["protocol"]) for r in (now, before)]
    shared = [p for p in (MAIN_PROTOCOL, *rule.protocols) if p in run[0] & run[1]]
    if not shared:
        return [*said, "The trainings were judged by different protocols and are not compared."]
    rule = rule.only(shared[0]).model_copy(update={"min_batches": 2})
    a, b = (left_out(r, rule, c.selector, c.family, c.n_tsp) for r, c in zip((now, before), choices[:2], strict=True))
    paired = compare_paired(a, b, rule)
    if paired.n_batches < 2:
        return [*said, f"{count(paired.n_batches, 'batch')} in common: nothing to compare."]
    return [
        *said,
        f"On the {count(paired.n_batches, 'batch')} that both know the newest model is "
        f"{interval_label(paired.as_dict())} on average, better on {paired.n_better}.",
    ]


def changed_batches(now: pd.DataFrame, earlier: pd.DataFrame) -> tuple[list[str], list[str]]:
    """Batches of now that the earlier training lacked (or knew with other content), and those that are gone."""
    a = dict(zip(now["batch_id"].astype(str), now["digest"].astype(str), strict=True))
    b = dict(zip(earlier["batch_id"].astype(str), earlier["digest"].astype(str), strict=True))
    return [k for k, digest in a.items() if b.get(k) != digest], [k for k in b if k not in a]


def _effect(finding: dict[Any, Any]) -> str:
    if finding["overruled"]:
        return f"used; overruled: {finding['overruled']}"
    return "masked" if finding["masks"] else "used; noted only"


def interval_label(comparison: dict[str, float], digits: int = 2) -> str:
    """``0.60 µm better (90 %: 0.20 to 1.00)`` of a paired comparison."""
    d = float(comparison["difference_um"])
    sign = 1.0 if d >= 0 else -1.0
    ends = sorted([sign * float(comparison["low_um"]), sign * float(comparison["high_um"])])
    text = f"{number(abs(d), digits)} µm {'better' if d >= 0 else 'worse'}"
    return f"{text} (90 %: {number(ends[0], digits)} to {number(ends[1], digits)} µm)"


_CHIPS = {
    "champion": "champion",
    "provisional": "provisional",
    "former": "former champion",
    "challenger": "challenger",
    "unchanged": "unchanged",
    "": "not promoted",
}


@dataclass(frozen=True)
class Verdict:
    """One channel's outcome: a chip, what was promoted and why, a caution (empty where there is none)."""

    outcome: str
    chip: str
    summary: str
    caution: str = ""


def promoted_cell(training: Training, rule: PromotionRule) -> Choice:
    """The cell that was promoted; without a promotion the one that the rule would take.

    A grid without any of the rule's protocols is judged by the first that it has. The nested score is as recorded at
    the promotion, else computed now.
    """
    result = training.result
    if not rule.offered(set(result.cells["protocol"])):
        rule = rule.only(protocols_of(result)[0])
    mean, std = (float(training.promotion.get(f"nested_S_{n}_um", math.nan)) for n in ("mean", "std"))
    if not math.isfinite(mean):
        own = decide(result, rule)
    else:
        own = replace(choose(result, rule), nested_S_mean_um=mean, nested_S_std_um=std)
    cell = str(training.promotion.get("cell", ""))
    if cell and cell != own.cell:
        try:
            return pick(result, rule, cell)
        except InputError:
            pass  # promoted from another grid: the rule's own choice is shown instead
    return own


def verdict(training: Training, choice: Choice) -> Verdict:
    """Who is champion and why, as the promotion recorded it."""
    p = training.promotion
    outcome, now = str(p.get("outcome", "")), p.get("champion_version")
    model = cell_label(choice.selector, choice.family, choice.n_tsp)
    summary = f"{p['words']}." if p else f"Nothing was promoted. The rule would take {model}: {choice.summary}."
    if p and p["version"] != now:
        outcome = "former" if outcome == "champion" else outcome  # replaced or rolled back since
        summary += f" Version {now} is champion now." if now else " There is no champion."
    if p.get("faults"):
        summary += f" At the machine {p['faults']}."
    why = str(p.get("caution", "")) if p else choice.caution
    why = re.sub(r"\b(zero|mean_curve)\b", lambda m: family_label(m[0]), why)
    short = why.partition(" (")[0]
    provisional = (p.get("standing") if p else choice.standing) == "provisional"
    lacking, doubt = ("Provisional", "Not beyond doubt") if provisional else ("No trustworthy model", "Not trustworthy")
    caution = f"{lacking}: {short}." if why else ""
    summary += f" {doubt}: {why}." if why != short else ""
    chip = lacking.lower() if (why or provisional) and not p.get("champion_version") else _CHIPS.get(outcome, outcome)
    return Verdict("untrusted" if why else outcome, chip, summary, caution)


def mark_of(training: Training) -> str:
    """What the chosen cell's model is now: champion, former champion, provisional, challenger, or only chosen."""
    p = training.promotion
    if not p:
        return "chosen"
    if p["version"] == p["champion_version"]:
        return "champion"
    return {"champion": "former champion", "provisional": "provisional"}.get(p["outcome"], "challenger")


def comparison_rows(promotion: dict[str, Any]) -> list[tuple[str, str]]:
    """The paired comparison with the champion as label and value; empty where there was none."""
    c = promotion.get("comparison")
    if not c:
        return []
    old = promotion.get("against")
    return [
        ("batches in common", f"{c['n_batches']}"),
        ("mean S of the newcomer", f"{number(c['new_S_mean_um'], 2)} µm"),
        (f"mean S of the champion{f' (version {old})' if old else ''}", f"{number(c['old_S_mean_um'], 2)} µm"),
        ("newcomer against champion", interval_label(c) if math.isfinite(c["low_um"]) else number(math.nan)),
        ("better on", f"{c['n_better']} of {count(c['n_batches'], 'batch')}"),
        ("one-sided paired sign-flip test", p_label(c["p_value"]) if math.isfinite(c["p_value"]) else "–"),
        ("decision", "replaces the champion" if promotion["outcome"] == "champion" else "the champion stays"),
    ]


_MEANT, _TOLERATED = 0.90, 0.05
_BEYOND_CHANCE = 1.6449  # standard errors of a mean over batches


def certainty(result: GridResult, choice: Choice) -> str:
    """How many samples of left-out batches lie inside the model's own 90 % interval; empty where it states none."""
    scores = scores_of(result, choice.selector, choice.family, choice.n_tsp)
    if "coverage90" not in scores or not np.isfinite(scores["coverage90"]).any():
        return ""
    by = {p: own["coverage90"].dropna().to_numpy(float) for p, own in scores.groupby("protocol")}
    inside = by.get(choice.protocol, np.array([]))
    mean, spread = (float(f(inside)) if len(inside) > 1 else math.nan for f in (np.mean, lambda v: np.std(v, ddof=1)))
    seasons = by.get("leave-season-out", np.array([])) if choice.protocol != "leave-season-out" else np.array([])
    season = float(seasons.mean()) if len(seasons) else math.nan
    said = f"{plus_minus(100 * mean, 100 * spread, 0)} % ({choice.protocol}, mean ± std of batches)"
    said += f", {100 * season:.0f} % where whole seasons are left out" if math.isfinite(season) else ""
    return f"{said}: {certainty_verdict(mean, spread, len(inside), season)}"


def certainty_verdict(mean: float, spread: float, n_batches: int, season: float = math.nan) -> str:
    """A verdict on a mean share inside the 90 % interval, with its spread over batches.

    Within five per cent of nine tenths it is calibrated; beyond that "perhaps", unless the mean lies further off than
    chance would put it (one-sided 95 % of a mean over batches). `season`: the share where whole seasons are left out.
    """
    if not math.isfinite(mean):
        return number(mean)
    if abs(mean - _MEANT) <= _TOLERATED:
        return "calibrated, but too sure of a new season" if season < _MEANT - _TOLERATED else "calibrated"
    label = "too sure" if mean < _MEANT else "too careful"
    if math.isfinite(spread) and abs(mean - _MEANT) > _BEYOND_CHANCE * spread / math.sqrt(n_batches):
        return label
    return f"perhaps {label}"


def weaknesses(result: GridResult, choice: Choice) -> list[str]:
    """The known weaknesses of the chosen selector that its choice shows."""
    found = result.selector_diagnostics
    if found.empty:
        return []
    own = found[(found["selector"] == choice.selector) & ~found["ok"].astype(bool)]
    return [f"{r['statistic']} {number(r['value'], 2)}: {r['comment']}" for r in own.to_dict("records")]
