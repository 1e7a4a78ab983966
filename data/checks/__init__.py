"""Checks for faults in recordings: the registry and the functions that run it.

Checks run in the order of the registry, each on what the earlier ones left unmasked. Thresholds come from resolution,
noise and physics, never from one machine's history.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np

from data.batch import Batch, Finding
from data.machine import Machine, Overrule
from data.registry import Registry

CHECKS = Registry(
    "check",
    {
        "wrong_unit": "data.checks.value_range:WrongUnit",
        "out_of_range": "data.checks.value_range:OutOfRange",
        "saturated": "data.checks.value_range:Saturated",
        "interruption": "data.checks.timeline:Interruption",
        "error_held": "data.checks.held_values:ErrorHeld",
        "dead": "data.checks.held_values:Dead",
        "frozen": "data.checks.held_values:Frozen",
        "jump_no_return": "data.checks.steps:JumpNoReturn",
        "spike": "data.checks.steps:Spike",
        "gap": "data.checks.timeline:Gap",
        "clock": "data.checks.timeline:Clock",
        "offset": "data.checks.across_batches:Offset",
        "swapped": "data.checks.across_batches:Swapped",
        "unexplained": "data.checks.across_batches:Unexplained",
    },
)
USER = "user"  # the check's name in findings that the machine file's overrule adds
MOST_MASKED = 0.2  # an input that lacks more than this share of any batch cannot serve all batches


def check_batch(batch: Batch, machine: Machine) -> tuple[Finding, ...]:
    """Run every check of one recording; findings in the registry's order, those the batch came with not repeated."""
    seen = batch.with_findings(())
    for check in CHECKS.values():
        if found := check().batch(seen, machine):
            seen = seen.with_findings((*seen.findings, *found))
    return seen.findings


def check_machine(batches: Sequence[Batch], machine: Machine) -> list[Batch]:
    """Add what only the batches together can show, then the machine file's overrules; idempotent.

    Returns the batches in the given order with findings of `check_batch` kept, those of several batches added, and
    `machine.overrule` applied: matching findings get its reason, `mask: true` adds a mask of its own.
    """
    known = [b.with_findings(_own(b)) for b in batches]
    for check in CHECKS.values():
        for k, found in check().across(known, machine).items():
            known[k] = known[k].with_findings(known[k].findings + tuple(found))
    return [overruled(b, machine.overrule) for b in known]


def usable_channels(
    batches: Sequence[Batch], names: Sequence[str]
) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Channels that can be model inputs in every batch, and the others with the reason.

    A channel that is missing or masked in more than a fifth of the rows of any batch is left out: otherwise
    that batch could not be predicted.
    """
    usable, excluded = [], []
    for name in names:
        bad = [w for b in batches if (w := _shortage(b, name))]
        if bad:
            more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
            excluded.append((name, f"{name} is {', '.join(bad[:3])}{more}"))
        else:
            usable.append(name)
    return tuple(usable), tuple(excluded)


def _shortage(batch: Batch, name: str) -> str:
    """Why a channel of one batch is not usable; empty when it is."""
    if name not in batch.table.columns or not np.isfinite(batch.values(name)).any():
        return f"missing in {batch.batch_id}"
    lacking = float(np.mean(~np.isfinite(batch.masked(name))))
    if lacking <= MOST_MASKED:
        return ""
    causes = sorted({f.check for f in batch.findings if f.masks and not f.overruled and f.channel in (name, None)})
    return f"unusable in {lacking:.0%} of {batch.batch_id} ({', '.join(causes) or 'not recorded'})"


def _own(batch: Batch) -> tuple[Finding, ...]:
    """Findings of the batch alone, without what an earlier `check_machine` added."""
    alone = {k for k, c in CHECKS.items() if "batch" in vars(c)}
    kept = [replace(f, overruled="") for f in batch.findings if f.check in alone or f.check not in (*CHECKS, USER)]
    return tuple(dict.fromkeys(kept))


def overruled(batch: Batch, rules: Sequence[Overrule]) -> Batch:
    """The batch with the overrules applied: matching findings get the reason, `mask: true` adds a mask."""
    findings = list(batch.findings)
    for rule in rules:
        if not fnmatchcase(batch.batch_id, rule.batch):
            continue
        if rule.mask:
            named = [None] if rule.channel == "*" else [n for n in batch.channels if fnmatchcase(n, rule.channel)]
            findings += [Finding(USER, n, rule.reason, rule.start_s, rule.end_s) for n in named]
            continue
        findings = [replace(f, overruled=rule.reason) if _meant(f, rule) else f for f in findings]
    return batch.with_findings(tuple(findings))


def _meant(f: Finding, rule: Overrule) -> bool:
    if f.check == USER or not fnmatchcase(f.check, rule.check) or not fnmatchcase(f.channel or "*", rule.channel):
        return False
    begin, end = f.start_s or 0.0, np.inf if f.end_s is None else f.end_s
    return begin <= (np.inf if rule.end_s is None else rule.end_s) and end >= (rule.start_s or 0.0)
