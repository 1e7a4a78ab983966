"""The page as data: a sentence for each error channel, three pictures, one table, the viewer, and one fold."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from data.errors import InputError, check_suffix
from data.registry import Registry
from data.units import unit_label
from features.selectors import SELECTORS
from models.families import FAMILIES
from models.protocols import PromotionRule
from models.selection.result import GridResult, Training
from reports.comparison import pictures, story, tables
from reports.comparison.channel import Channel, leaders, leads
from reports.labels import count, family_label, listed, number, selector_label
from reports.layout import Details, Group, Heading, Items, Page, Pairs, Section, Text, given, with_unit
from reports.rendering import FORMATS, write_page


def page(trainings: Sequence[Training], rule: PromotionRule) -> Page:
    """The page. Trainings of one machine and channel are compared; the newest stands for the channel, the channel with
    the largest error first.

    Raises:
        InputError: no training, or one without a judged cell.
    """
    if not trainings:
        raise InputError("report: got no training; give at least one tracked training")
    machines = list(dict.fromkeys(t.result.machine for t in trainings))
    mixed = len({_simulated(t) for t in trainings}) > 1
    channels = [Channel.of(_name(g[0], len(machines) > 1, mixed), g, rule) for g in _grouped(trainings)]
    channels.sort(key=lambda c: -np.nan_to_num(c.none_um))
    units = {c.unit for c in channels}
    unit = unit_label(units.pop()) if len(units) == 1 else "own unit"
    said = [with_unit(text, c.unit) for c in channels for text in leads(c, rule)]
    left_out = pictures.left_out_panels(channels)
    models = given(pictures.tried_panel(channels), pictures.time_panel(channels))
    blocks = given(
        None if left_out else Text("No left-out prediction of these models was kept.", "soft"),
        *left_out,
        leaders(channels, rule, unit),
        *(models if len(channels) > 1 else (Group(models, "pair"),)),
        pictures.runs_viewer(channels),
        Details("What a laboratory can check", _checks(channels, rule)),
    )
    sources = [f"{c.name}, {t.started:%Y-%m-%d %H:%M} UTC: {t.training_id}" for c in channels for t in c.trainings]
    return Page(
        "thermodrift comparison report",
        f"Thermal error models of {listed(machines)}",
        (*said, Text(_recordings(channels), "note")),
        (Section("models", "", blocks),),
        (f"From tracked trainings: {'; '.join(sources)}.",),
        any(_simulated(t) for t in trainings),
    )


def _checks(channels: Sequence[Channel], rule: PromotionRule) -> tuple[Any, ...]:
    """All that stands in the fold: the channels one by one, the recordings' findings, the terms."""
    blocks = [b for c in channels for b in with_unit(_channel(c, rule), c.unit)]
    results = [(c.name, c.result) for c in channels]
    found = story.findings_of([r for _, r in results])
    left = story.excluded(results)
    members = (
        ("families", _members(FAMILIES, results, "family", family_label)),
        ("selectors", _members(SELECTORS, results, "selector", selector_label)),
        ("champion, provisional, challenger", f"{_STANDINGS} {_rule_sentence(rule)}"),
    )
    return given(
        *blocks,
        Heading("Findings in the recordings"),
        Text(story.findings_summary(found, _n_batches(channels))),
        story.findings(found) if len(found) else None,
        left if left.rows else Text("No channel was excluded and no family failed."),
        Heading("What the numbers mean"),
        Pairs((*GLOSSARY, *members), "glossary"),
    )


def _channel(c: Channel, rule: PromotionRule) -> tuple[Any, ...]:
    """What stands behind one channel's row."""
    result, choice, digits = c.result, c.choice, c.digits
    inside = story.certainty(result, choice)
    facts = [("points", ", ".join(choice.inputs)), ("inside the stated 90 % interval", inside)]
    facts.append(("later runs against the promise", c.expected.kept))
    facts += [("weakness of the selector", text) for text in story.weaknesses(result, choice)]
    facts += story.comparison_rows(c.trainings[0].promotion)
    return given(
        Heading(c.name, (c.verdict.chip, c.verdict.outcome)),
        Text(c.verdict.summary),
        Pairs(tuple((k, v) for k, v in facts if v), "pairs"),
        Items(tuple(story.changes(c.trainings, c.choices, rule))),
        story.trainings(c.name, c.trainings, c.choices) if len(c.trainings) > 1 else None,
        tables.groups(c.name, result, choice, c.expected.protocol, digits),
        tables.families(c.name, result, choice, digits, c.mark),
        tables.bounds(c.name, result.distances, digits),
        tables.readings(c.name, result, digits),
        tables.batches(c.name, result, choice, digits),
    )


def _members(
    registry: Registry, results: Sequence[tuple[str, GridResult]], column: str, label: Callable[[str], str]
) -> str:
    """Label and summary of every member that was tried, in the registry's order."""
    tried = set().union(*(r.cells[column] for _, r in results))
    said = [f"{label(k)} ({registry[k].summary.removeprefix(f'{label(k)}: ')})" for k in registry if k in tried]
    return f"{'; '.join(said)}."


def _grouped(trainings: Sequence[Training]) -> list[list[Training]]:
    """Per machine and channel in the given order, newest first."""
    groups: dict[tuple[str, str], list[Training]] = {}
    for t in trainings:
        groups.setdefault((t.result.machine, t.result.target), []).append(t)
    return [sorted(g, key=lambda t: t.started, reverse=True) for g in groups.values()]


def _name(training: Training, several: bool, mixed: bool) -> str:
    """The channel, with its machine where there are several; SIMULATED where not the whole page is."""
    name = f"{training.result.machine} {training.result.target}" if several else training.result.target
    return f"{name} (SIMULATED)" if mixed and _simulated(training) else name


def _simulated(training: Training) -> bool:
    return training.simulated or training.result.simulated


def _n_batches(channels: Sequence[Channel]) -> int:
    ids = {(c.result.machine, b) for c in channels for b in c.result.batches["batch_id"]}
    return len(ids)


def _recordings(channels: Sequence[Channel]) -> str:
    """How much was recorded when, at which start ambient and speeds, and when it was learned."""
    batches = pd.concat([c.result.batches for c in channels], ignore_index=True)
    once = batches.drop_duplicates(["batch_id", "digest"])
    read, dropped = (int(once[c].sum()) if c in once else 0 for c in ("rows_read", "rows_dropped"))
    starts = sorted(str(s)[:10] for s in batches.get("start", pd.Series(dtype=str)).dropna() if str(s))
    span = f", {starts[0]} to {starts[-1]}" if starts else ""
    ambient = batches.get("start_ambient_degC", pd.Series(dtype=float)).to_numpy(float)
    ambient = ambient[np.isfinite(ambient)]
    speeds = sorted(set(batches.get("speed", pd.Series(dtype=str)).astype(str)), key=tables.group_order)
    trained = sorted(f"{c.trainings[0].started:%Y-%m-%d %H:%M}" for c in channels)
    said = [
        f"{count(_n_batches(channels), 'batch')}{span}",
        f"{read} rows read, {dropped} dropped" if read else "",
        f"start ambient {number(ambient.min())} to {number(ambient.max())} °C" if len(ambient) else "",
        listed([s for s in speeds if s != "unknown"]),
        f"trained {trained[0]}" + (f" to {trained[-1]}" if trained[-1] != trained[0] else "") + " UTC",
    ]
    return f"{'; '.join(s for s in said if s)}."


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
