"""What became of a training, in plain sentences."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from data.errors import InputError
from pipelines.promotion import Choice, decide, pick
from pipelines.report.extracts import picked
from pipelines.report.records import interval_words
from pipelines.report.words import cell_label, count, decimals, number, p_words, plus_minus
from pipelines.settings import PromotionRule
from pipelines.tracking import Training

_CHIPS = {"champion": "champion", "challenger": "challenger", "unchanged": "unchanged", "": "not promoted"}


@dataclass(frozen=True)
class Verdict:
    """One channel's outcome: a chip, a sentence, a caution (empty where there is none)."""

    channel: str
    outcome: str
    chip: str
    words: str
    caution: str = ""


def promoted_cell(training: Training, rule: PromotionRule, protocol: str, nested: bool = False) -> Choice:
    """The cell that was promoted; without a promotion the one that the rule would take.

    Args:
        nested: with the score of choosing itself, as recorded at the promotion, else computed now.
    """
    mean, std = (float(training.promotion.get(f"nested_S_{n}_um", math.nan)) for n in ("mean", "std"))
    if nested and not math.isfinite(mean) and protocol == rule.protocol:
        own = decide(training.result, rule)
    else:
        own = replace(picked(training.result, rule, protocol), nested_S_mean_um=mean, nested_S_std_um=std)
    cell = str(training.promotion.get("cell", ""))
    if cell and cell != own.cell:
        try:
            return pick(training.result.cells, rule.model_copy(update={"protocol": protocol}), cell)
        except InputError:
            pass  # promoted from another grid: the rule's own choice is shown instead
    return own


def verdict(channel: str, training: Training, choice: Choice) -> Verdict:
    """Who is champion and why."""
    p = training.promotion
    outcome = str(p.get("outcome", ""))
    digits = decimals(choice.S_std_um, choice.n_batches)
    score = (
        f"{plus_minus(choice.S_mean_um, choice.S_std_um, digits)} µm on left-out batches "
        f"({choice.protocol}, {count(choice.n_batches, 'batch')}{_nested(choice, digits)})"
    )
    model = cell_label(choice.selector, choice.family, choice.n_tsp)
    if outcome == "champion":
        words = f"Version {p['version']}, {model}, is champion: {score}; {_why_champion(p)}."
    elif outcome == "challenger":
        words = (
            f"Version {p['champion_version']} stays champion; version {p['version']}, {model}, is challenger: "
            f"{score}; {_why_challenger(p)}."
        )
    elif outcome == "unchanged":
        words = (
            f"Nothing new: batches, cell and machine file are those of version {p['version']}, {model}: {score}. "
            f"Version {p['champion_version']} is champion."
        )
    else:
        words = f"Nothing was promoted. The rule would take {model}: {score}."
    why = str(p.get("caution", "")) if p else choice.caution
    caution = f"Do not trust this model: {why}." if why else ""
    return Verdict(channel, outcome, _CHIPS.get(outcome, outcome), words, caution)


def mark_of(training: Training) -> str:
    """What the chosen cell's model is now: champion, challenger, or only chosen."""
    p = training.promotion
    if not p:
        return "chosen"
    return "champion" if p["version"] == p["champion_version"] else "challenger"


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
        ("newcomer against champion", interval_words(c) if math.isfinite(c["low_um"]) else number(math.nan)),
        ("better on", f"{c['n_better']} of {count(c['n_batches'], 'batch')}"),
        ("one-sided paired sign-flip test", p_words(c["p_value"]) if math.isfinite(c["p_value"]) else "–"),
        ("decision", "replaces the champion" if promotion["outcome"] == "champion" else "the champion stays"),
    ]


def _why_champion(p: dict[str, Any]) -> str:
    c = p.get("comparison")
    forced = p.get("forced", False)
    if not c:
        return "put in place by force" if forced else "it is the first model of this machine and channel"
    old = p.get("against")
    words = f"replaces version {old}" if old else "replaces the former champion"
    words += " by force" if forced and not c["better"] else ""
    if not math.isfinite(c["difference_um"]):
        return words
    return f"{words}, {interval_words(c)} on {count(c['n_batches'], 'batch')}"


def _why_challenger(p: dict[str, Any]) -> str:
    c = p.get("comparison")
    if not c:
        return "it could not be compared with the champion" + (f" ({p['obstacle']})" if p.get("obstacle") else "")
    if "need at least" in str(c.get("words", "")):
        return str(c["words"]).replace(": the champion stays", "")
    return (
        f"on {count(c['n_batches'], 'batch')} it is {interval_words(c)}, {p_words(c['p_value'])}: "
        "not shown to be better"
    )


def _nested(choice: Choice, digits: int) -> str:
    if not math.isfinite(choice.nested_S_mean_um):
        return ""
    score = plus_minus(choice.nested_S_mean_um, choice.nested_S_std_um, digits)
    return f"; {score} µm when a batch has no say in the choice of its model either"
