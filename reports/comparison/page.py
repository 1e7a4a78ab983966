"""The page as data: header, one part per error channel, the findings of the recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from data.errors import InputError, check_suffix
from data.registry import Registry
from features.selectors import SELECTORS
from models import FAMILIES
from models.protocols import PromotionRule
from models.result import GridResult, Training
from reports.comparison import story as records
from reports.comparison.channel import Channel, channel_part
from reports.comparison.headline import overview
from reports.comparison.story import promoted_cell, verdict
from reports.comparison.tables import group_order, protocols_of, scored
from reports.labels import count, decimals, family_label, listed, number, selector_label
from reports.layout import Table, with_unit
from reports.rendering import FORMATS, write_page

_FEW_FINDINGS = 12


@dataclass(frozen=True)
class Page:
    """Everything that the templates show."""

    title: str
    machines: str
    simulated: bool
    facts: tuple[tuple[str, str], ...]
    overview: Table | None
    channels: tuple[Channel, ...]
    findings_summary: str
    findings: tuple[Table, ...]  # a summary where there are many, then every finding
    few_findings: bool
    excluded: Table | None
    rule: str
    families: tuple[tuple[str, str], ...]
    selectors: tuple[tuple[str, str], ...]
    sources: tuple[tuple[str, str], ...]


def page(trainings: Sequence[Training], rule: PromotionRule) -> Page:
    """Collect the page. Trainings of one machine and channel are compared; the newest stands for the channel.

    Raises:
        InputError: no training, or one without a judged cell.
    """
    if not trainings:
        raise InputError("report: got no training; give at least one tracked training")
    groups = _grouped(trainings)
    machines = list(dict.fromkeys(t.result.machine for t in trainings))
    newest = [group[0] for group in groups]
    names = [_name(t, len(machines) > 1) for t in newest]
    channels, rows, units = [], [], []
    for i, (name, group) in enumerate(zip(names, groups, strict=True)):
        protocol = protocols_of(group[0].result)[0]
        cells = scored(group[0].result, protocol)
        if cells.empty:
            raise InputError(f"report: training {group[0].training_id} has no cell with a finite score; train again")
        choices = [promoted_cell(t, rule) for t in group]
        digits = decimals(choices[0].S_std_um, choices[0].n_batches)
        said = verdict(name, group[0], choices[0])
        rows.append((name, group[0], choices[0], said, digits))
        units.append(group[0].params.get("unit", "um"))
        channels.append(with_unit(channel_part(f"c{i + 1}", name, group, choices, said, rule), units[-1]))
    common = units[0] if len({*units}) == 1 else "its own unit"
    results = [t.result for t in newest]
    simulated = any(t.simulated or t.result.simulated for t in trainings)
    found = records.findings_of(results)
    n_batches = sum(len(set().union(*(r.batches["batch_id"] for r in results if r.machine == m))) for m in machines)
    left = records.excluded(list(zip(names, results, strict=True)), simulated)
    every = (records.findings(found, simulated),) if len(found) else ()
    many = (records.findings_by_channel(found, simulated),) if len(found) > _FEW_FINDINGS else ()
    return Page(
        title=f"Thermal error models of {listed(machines)}",
        machines=listed(machines),
        simulated=simulated,
        facts=_facts(newest, n_batches),
        overview=with_unit(overview(rows, simulated), common) if len(rows) > 1 else None,
        channels=tuple(channels),
        findings_summary=records.findings_summary(found, n_batches),
        findings=many + every,
        few_findings=not many,
        excluded=left if left.rows else None,
        rule=_rule_sentence(rule),
        families=_members(FAMILIES, results, "family", family_label),
        selectors=_members(SELECTORS, results, "selector", selector_label),
        sources=tuple(
            (f"{_name(t, len(machines) > 1)}, {t.started:%Y-%m-%d %H:%M} UTC", t.training_id) for t in trainings
        ),
    )


def _members(
    registry: Registry, results: Sequence[GridResult], column: str, label: Callable[[str], str]
) -> tuple[tuple[str, str], ...]:
    """Label and summary of every member that was tried, in the registry's order."""
    tried = set().union(*(r.cells[column] for r in results))
    return tuple(
        (label(key), registry[key].summary.removeprefix(f"{label(key)}: ")) for key in registry if key in tried
    )


def _grouped(trainings: Sequence[Training]) -> list[list[Training]]:
    """Per machine and channel in the given order, newest first."""
    groups: dict[tuple[str, str], list[Training]] = {}
    for t in trainings:
        groups.setdefault((t.result.machine, t.result.target), []).append(t)
    return [sorted(g, key=lambda t: t.started, reverse=True) for g in groups.values()]


def _name(training: Training, several: bool) -> str:
    return f"{training.result.machine} {training.result.target}" if several else training.result.target


def _facts(newest: Sequence[Training], n_batches: int) -> tuple[tuple[str, str], ...]:
    batches = pd.concat([t.result.batches for t in newest], ignore_index=True)
    once = batches.drop_duplicates(["batch_id", "digest"])
    read, dropped = (int(once[c].sum()) if c in once else 0 for c in ("rows_read", "rows_dropped"))
    starts = sorted(str(s)[:10] for s in batches.get("start", pd.Series(dtype=str)).dropna() if str(s))
    span = f", {starts[0]} to {starts[-1]}" if starts else ""
    ambient = batches.get("start_ambient_degC", pd.Series(dtype=float)).to_numpy(float)
    ambient = ambient[np.isfinite(ambient)]
    speeds = sorted(set(batches.get("speed", pd.Series(dtype=str)).astype(str)), key=group_order)
    trained = sorted(f"{t.started:%Y-%m-%d %H:%M}" for t in newest)
    facts = [
        ("Recordings", f"{count(n_batches, 'batch')}{span}"),
        ("Rows", f"{read} read, {dropped} dropped" if read else ""),
        ("Start ambient", f"{number(ambient.min())} to {number(ambient.max())} °C" if len(ambient) else ""),
        ("Spindle", listed([s for s in speeds if s != "unknown"])),
        ("Trained", trained[0] + (f" to {trained[-1]}" if trained[-1] != trained[0] else "") + " UTC"),
    ]
    return tuple((k, v) for k, v in facts if v)


def _rule_sentence(r: PromotionRule) -> str:
    return (
        "The rule takes the cell of least expected loss in a future run, a mean of S over left-out runs weighted "
        f"{listed([f'{w:g} by {p}' for p, w in r.protocols.items()])}, with the cost of choosing; within "
        f"{r.ties_se:g} standard error{'s' if r.ties_se != 1 else ''} of the difference the simpler one. "
        "A newcomer replaces the champion only if it is better on the same batches "
        f"(paired sign-flip test, {100 * r.significance:g} %, at least {r.min_batches} batches)."
    )


def write_report(trainings: Sequence[Training], path: Path, rule: PromotionRule) -> Path:
    """One page from tracked trainings; the suffix of `path`, .html or .md, decides the format.

    The HTML page is self-contained. The folder is made; the file appears whole or not at all.

    Raises:
        InputError: no training given, one without a judged cell, another suffix, or a place that cannot be written.
    """
    path = Path(path)
    check_suffix("report", path, FORMATS)
    write_page(path, "report", page(trainings, rule))
    return path
