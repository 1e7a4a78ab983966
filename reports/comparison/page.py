"""The page as data: header, one part per error channel, the findings of the recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from data.errors import InputError, check_suffix
from data.registry import Registry
from features.selectors import SELECTORS
from models.families import FAMILIES
from models.protocols import PromotionRule
from models.selection.result import GridResult, Training
from reports.comparison import story as records
from reports.comparison.channel import channel_part
from reports.comparison.headline import overview
from reports.comparison.story import promoted_cell, verdict
from reports.comparison.tables import group_order, protocols_of, scored
from reports.labels import count, decimals, family_label, listed, number, selector_label
from reports.layout import Page, Pairs, Section, Text, given, with_unit
from reports.rendering import FORMATS, write_page

_FEW_FINDINGS = 12


def page(trainings: Sequence[Training], rule: PromotionRule) -> Page:
    """The page. Trainings of one machine and channel are compared; the newest stands for the channel.

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
    machine = listed(machines)
    n_batches = sum(len(set().union(*(r.batches["batch_id"] for r in results if r.machine == m))) for m in machines)
    first = with_unit(overview(rows, simulated), common) if len(rows) > 1 else None
    sources = [f"{_name(t, len(machines) > 1)}, {t.started:%Y-%m-%d %H:%M} UTC: {t.training_id}" for t in trainings]
    return Page(
        "thermodrift comparison report",
        f"Thermal error models of {machine}",
        given(Pairs(_facts(newest, n_batches), "facts compact"), first),
        (*channels, _findings(list(zip(names, results, strict=True)), n_batches, simulated), _glossary(results, rule)),
        (f"From tracked trainings: {'; '.join(sources)}.",),
        simulated,
    )


def _findings(results: Sequence[tuple[str, GridResult]], n_batches: int, simulated: bool) -> Section:
    found = records.findings_of([r for _, r in results])
    left = records.excluded(results, simulated)
    every = records.findings(found, simulated) if len(found) else None
    if every is not None and len(found) > _FEW_FINDINGS:
        shown: tuple[Any, ...] = (records.findings_by_channel(found, simulated), every.folded())
    else:
        shown = (every,)
    none = Text("No channel was excluded and no family failed.")
    blocks = given(Text(records.findings_summary(found, n_batches)), *shown, left if left.rows else none)
    return Section("findings", "Data findings", blocks, simulated=simulated)


def _glossary(results: Sequence[GridResult], rule: PromotionRule) -> Section:
    members = (
        ("families", _members(FAMILIES, results, "family", family_label)),
        ("selectors", _members(SELECTORS, results, "selector", selector_label)),
        ("champion, provisional, challenger", f"{_STANDINGS} {_rule_sentence(rule)}"),
    )
    return Section("glossary", "What the numbers mean", (Pairs((*GLOSSARY, *members), "glossary"),))


def _members(registry: Registry, results: Sequence[GridResult], column: str, label: Callable[[str], str]) -> str:
    """Label and summary of every member that was tried, in the registry's order."""
    tried = set().union(*(r.cells[column] for r in results))
    said = [f"{label(k)} ({registry[k].summary.removeprefix(f'{label(k)}: ')})" for k in registry if k in tried]
    return f"{'; '.join(said)}."


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
    write_page(path, page(trainings, rule))
    return path


_STANDINGS = (
    "The version that runs on the machine; without a champion one that is better than no model, but not beyond doubt; "
    "and one that was not shown to be better."
)
GLOSSARY = (
    ("S", "Residual standard deviation of one batch, S = √(Σ (recorded − predicted)² / (n − 1)), over its n usable "
     "samples. Recorded errors are zeroed at the batch's first sample, along an axis at each position by the first "
     "sweep."),
    ("S_mean", "Accuracy: mean of S over the batches that were not used in the fit. Smaller is better."),
    ("S_std", "Robustness: standard deviation (n − 1) of S over the same batches. Smaller is better."),
    ("max |e|", "Largest |recorded − predicted| of any sample of any such batch."),
    ("fitted S", "Mean S on the batches of the fit. Far below S_mean means that the model has learned its batches by "
     "heart."),
    ("nested", "S_mean ± S_std when every batch is predicted by the cell that the other batches chose. The best of "
     "many cells looks better than it is; this number does not."),
    ("of no model", "S_mean as a share of what is left when nothing is compensated."),
    ("points", "Temperature-sensitive points (TSP): the sensors that a model takes as inputs."),
    ("stability of points", "Mean Jaccard similarity |A∩B| / |A∪B| of the sets chosen in different folds. 1: always "
     "the same points."),
    ("expected next season", "Mean S under forward, the nearest to what the machine will do. Without dates no later "
     "run can be predicted from earlier ones, and the number is optimistic."),
    ("forward, forward-gap", "Order the runs by date, fit on the past, predict the next block of runs; each block "
     "then joins the past. With a gap the four weeks before the block are left out too."),
    ("leave-batch-out", "Fit on all batches but one, predict that one; every batch is left out once."),
    ("train-on-one", "Fit on one batch, predict every other; mean over all such models. S_std is the mean over the "
     "models of their spread."),
    ("leave-season-out, leave-speed-out", "Leave out all batches of a season (band of start ambient) or of a spindle "
     "speed."),
)  # fmt: skip
