"""What became of a training, in plain sentences."""

from __future__ import annotations

import math
import re
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


_NESTED = re.compile(r"by the cell that the others chose: ([\d.]+) ± ([\d.]+) µm")


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
    said = _NESTED.search(str(training.promotion.get("words", "")))
    if nested and not said and protocol == rule.protocol:
        own = decide(training.result, rule)
    else:
        own = picked(training.result, rule, protocol)
    if said:
        own = replace(own, nested_S_mean_um=float(said[1]), nested_S_std_um=float(said[2]))
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
    caution = ""
    if not (p.get("trusted", True) if p else choice.trusted):
        caution = "Do not trust this model: " + _distrust(f"{choice.words}; {p.get('words', '')}")
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
    old = _against(promotion)
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
    forced = "by force" in str(p.get("words", ""))
    if not c:
        return "put in place by force" if forced else "it is the first model of this machine and channel"
    old = _against(p)
    words = f"replaces version {old}" if old else "replaces the former champion"
    words += " by force" if forced and not c["better"] else ""
    if not math.isfinite(c["difference_um"]):
        return words
    return f"{words}, {interval_words(c)} on {count(c['n_batches'], 'batch')}"


def _why_challenger(p: dict[str, Any]) -> str:
    c = p.get("comparison")
    if not c:
        return "it could not be compared with the champion" + _detail(p)
    if "need at least" in str(c.get("words", "")):
        return str(c["words"]).replace(": the champion stays", "")
    return (
        f"on {count(c['n_batches'], 'batch')} it is {interval_words(c)}, {p_words(c['p_value'])}: "
        "not shown to be better"
    )


def _detail(p: dict[str, Any]) -> str:
    found = re.search(r"cannot be compared \((.*?)\); it stays", str(p.get("words", "")))
    return f" ({found[1]})" if found else ""


def _against(p: dict[str, Any]) -> str:
    """The version that was compared with: the words name it, the record does not."""
    found = re.search(r"against version (\d+)", str(p.get("words", "")))
    return found[1] if found else ""


def _nested(choice: Choice, digits: int) -> str:
    if not math.isfinite(choice.nested_S_mean_um):
        return ""
    score = plus_minus(choice.nested_S_mean_um, choice.nested_S_std_um, digits)
    return f"; {score} µm when a batch has no say in the choice of its model either"


def _distrust(words: str) -> str:
    said = [s for s in words.split("; ") if s.endswith(": do not trust")]
    return (said[0].removesuffix(": do not trust") if said else "the rule found nothing that beats a baseline") + "."
