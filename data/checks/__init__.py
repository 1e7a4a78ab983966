"""Checks for faults in recordings: the registry and the functions that run it.

Checks run in the order of the registry, each on what the earlier ones left unmasked. Thresholds come from resolution,
noise and physics, never from one machine's history. A check whose evidence is only that a run is unusual masks nothing
where most runs of the machine show the same.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import overrule_line
from data.machine import Machine, Overrule
from data.registry import Registry

CHECKS = Registry(
    "check",
    {
        "text_cells": "data.checks.invalid:TextCells",
        "sentinel": "data.checks.invalid:Sentinel",
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
        "short": "data.checks.timeline:Short",
        "truncated": "data.checks.timeline:Truncated",
        "copied": "data.checks.across_batches:Copied",
    },
)
USER = "user"  # the check's name in findings that the machine file's overrule adds
MOST_MASKED = 0.2  # an input that lacks more than this share of any batch cannot serve all batches
OF_CELLS = frozenset({"text_cells", "sentinel"})  # their values are missing from the table, not masked
NOT_RECORDED = "not recorded"
_COMMON_RUNS = 3  # at least, and more than half of the machine's runs: one sensor rarely fails again in every run
_COMMON_SHARE = 0.5
_PERIODS = 3  # a fault of whole runs stays until it is repaired: over the year it begins once or twice

Habit = tuple[str | None, str]  # channel and habit of findings that are the same behaviour
Common = Mapping[Habit, str]  # -> in how many runs


def checked(batch: Batch, machine: Machine) -> Batch:
    """The batch with the findings of its reading and of every check of one recording."""
    return batch.with_findings((*_of_reading(batch), *check_batch(batch, machine)))


def check_batch(batch: Batch, machine: Machine, common: Common | None = None) -> tuple[Finding, ...]:
    """Run every check of one recording; findings in the registry's order, those of the reading not repeated.

    A finding that `common` names masks nothing, and its message says why.
    """
    read = _of_reading(batch)
    seen = batch.with_findings(read)
    for check in CHECKS.values():
        if found := check().batch(seen, machine):
            seen = seen.with_findings((*seen.findings, *_unless_common(found, batch, machine, common or {})))
    return seen.findings[len(read) :]


def check_machine(batches: Sequence[Batch], machine: Machine) -> list[Batch]:
    """Add what only the batches together can show, then the machine file's overrules; idempotent.

    Returns the batches in the given order with findings of `check_batch` kept, those of several batches added, and
    `machine.overrule` applied: matching findings get its reason, `mask: true` adds a mask of its own. What most batches
    share (see `Check.habit`) is reported and not masked; the other checks run again on these batches.
    """
    alone = [b.with_findings(_own(b)) for b in batches]
    common: dict[Habit, str] = {}
    while True:
        alone = [_rechecked(b, machine, common) for b in alone]
        known = list(alone)
        for check in CHECKS.values():
            for k, found in check().across(known, machine).items():
                found = _unless_common(found, known[k], machine, common)
                known[k] = known[k].with_findings((*known[k].findings, *found))
        if not (more := {key: why for key, why in _shared(known).items() if key not in common}):
            return [overruled(b, machine.overrule) for b in known]
        common |= more


def _shared(batches: Sequence[Batch]) -> dict[Habit, str]:
    """Habits that most batches have in common, or that come and go over the year as no fault does; and how often."""
    where: dict[Habit, list[int]] = {}
    in_part: set[Habit] = set()
    starts = [b.start for b in batches if b.start is not None]
    if len(starts) == len(batches):  # else in the order given
        batches = [batches[i] for i in sorted(range(len(batches)), key=starts.__getitem__)]
    masked = [{f.channel for f in b.findings if f.masks} for b in batches]
    for k, batch in enumerate(batches):
        habits = [(f, (f.channel, habit)) for f in batch.findings if (habit := _habit(batch, f))]
        in_part |= {key for f, key in habits if f.start_s is not None}
        for key in {key for _, key in habits}:
            where.setdefault(key, []).append(k)
    out = {}
    for key, at in where.items():
        between = [masked[a + 1 : b] for a, b in itertools.pairwise(at)]  # a masked channel shows nothing
        periods = 1 + sum(any(key[0] not in channels for channels in runs) for runs in between)
        if len(at) >= _COMMON_RUNS and len(at) > _COMMON_SHARE * len(batches):
            out[key] = f"{len(at)} of {len(batches)} runs"
        elif key not in in_part and periods >= _PERIODS:
            out[key] = f"{len(at)} of {len(batches)} runs, in {periods} separate periods"
    return out


def _habit(batch: Batch, f: Finding) -> str:
    return CHECKS[f.check]().habit(batch, f) if f.check in CHECKS else ""


def _unless_common(found: Sequence[Finding], batch: Batch, machine: Machine, common: Common) -> list[Finding]:
    """The findings of one check, of which those with a common habit, or at the moment of one of them, mask nothing."""
    habits = [_habit(batch, f) for f in found]
    often = {k: common[f.channel, habits[k]] for k, f in enumerate(found) if (f.channel, habits[k]) in common}
    out = list(found)
    for k, f in enumerate(found):
        with_it = next((j for j in often if habits[j] == habits[k] and f.start_s == found[j].start_s is not None), None)
        if not f.masks or (k not in often and with_it is None):
            continue
        what = f"In {often[k]}" if k in often else f"At the same time as {found[with_it or 0].channel}"
        message = (
            f"{f.message}. {what}, so probably {CHECKS[f.check].common_cause.format(machine)}: not masked. If it is a "
            f"fault, overrule: {{channel: {f.channel}, mask: true, reason: ...}}"
        )
        out[k] = replace(f, masks=False, message=message)
    return out


def _rechecked(batch: Batch, machine: Machine, common: Common) -> Batch:
    """The batch checked again where a habit changes what is masked; the same one where none does."""
    habits = [(f.masks, (f.channel, habit) in common) for f in batch.findings if (habit := _habit(batch, f))]
    if all(masks != shared for masks, shared in habits):
        return batch
    return batch.with_findings((*_of_reading(batch), *check_batch(batch, machine, common)))


def usable_channels(
    batches: Sequence[Batch], names: Sequence[str]
) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Channels that can be model inputs in every batch, and the others with the reason.

    A channel that is missing or masked in more than a fifth of the rows of any batch is left out: otherwise
    that batch could not be predicted. The reason names the checks and the entries of `overrule` that lift their masks.
    """
    usable, excluded = [], []
    for name in names:
        bad = [b for b in batches if _lacking(b, name) > MOST_MASKED]
        if bad:
            parts = [f"{_lacking(b, name):.0%} of {b.batch_id} ({', '.join(_causes(b, name))})" for b in bad[:3]]
            more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
            lift = how_to_lift(name, {c for b in bad for c in _causes(b, name)})
            excluded.append((name, f"{name} has no value in {', '.join(parts)}{more}{lift}"))
        else:
            usable.append(name)
    return tuple(usable), tuple(excluded)


def why_missing(batch: Batch, name: str) -> str:
    """The checks that masked values of a channel and what lifts their masks, in brackets; "" where none did."""
    causes = [c for c in _causes(batch, name) if c != NOT_RECORDED]
    return f" (masked by {', '.join(causes)}{how_to_lift(name, causes, batch.batch_id)})" if causes else ""


def how_to_lift(name: str, checks: Iterable[str], batch_id: str = "") -> str:
    """The entries of the machine file's `overrule` that lift these checks' masks of a channel; "" without checks."""
    lifted = [c for c in sorted(checks) if c not in (USER, NOT_RECORDED, "text_cells")]
    lines = " and ".join(overrule_line(name, c, batch_id) for c in lifted)
    return f"; if the values are right, add to overrule: {lines}" if lines else ""


def _lacking(batch: Batch, name: str) -> float:
    """Share of the rows without a usable value."""
    return float(np.mean(~np.isfinite(batch.masked(name)))) if name in batch.table.columns and batch.n_rows else 1.0


def _causes(batch: Batch, name: str) -> list[str]:
    """The checks that took values of a channel away; NOT_RECORDED where there was none to take."""
    found = {
        f.check for f in batch.findings
        if f.channel in (name, None) and ((f.masks and not f.overruled) or f.check in OF_CELLS)
    }  # fmt: skip
    recorded = name in batch.table.columns and bool(np.isfinite(batch.values(name)).any())
    return sorted(found) if found and (recorded or found & OF_CELLS) else [NOT_RECORDED]


def _own(batch: Batch) -> tuple[Finding, ...]:
    """Findings of the reading and of the batch alone, without what an earlier `check_machine` added."""
    added = {k for k, c in CHECKS.items() if "across" in vars(c) and "batch" not in vars(c)} | {USER}
    return tuple(dict.fromkeys(replace(f, overruled="") for f in batch.findings if f.check not in added))


def _of_reading(batch: Batch) -> tuple[Finding, ...]:
    """Findings that the file's reader made: those of no check that runs on a batch."""
    run = {k for k, c in CHECKS.items() if "batch" in vars(c) or "across" in vars(c)} | {USER}
    return tuple(f for f in batch.findings if f.check not in run)


def overruled(batch: Batch, rules: Sequence[Overrule]) -> Batch:
    """The batch with the overrules applied: matching findings get the reason, `mask: true` adds a mask."""
    findings = list(batch.findings)
    for rule in rules:
        if not fnmatchcase(batch.batch_id, rule.batch):
            continue
        if rule.mask and rule.check != "*":  # confirms what a check found, or masks what it only noted
            findings += [Finding(USER, f.channel, rule.reason, f.start_s, f.end_s) for f in findings if _meant(f, rule)]
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
