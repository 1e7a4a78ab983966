"""The report of a diagnosis: what was found, where, how much better, and the evidence, on one self-contained page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from data.units import unit_label
from diagnosis.findings.schema import Finding
from diagnosis.result import Diagnosis
from reports.diagnosis import figures as evidence
from reports.diagnosis import tables
from reports.diagnosis.figures import before_after, by_run, left_out_batches
from reports.diagnosis.first_screen import Continued, Unsealed, limits_sentence, shortened
from reports.diagnosis.map import Mark, mismatch_picture
from reports.diagnosis.tables import by_change, by_channel, chosen_channels, mismatch, telling
from reports.drawing import Picture, picture
from reports.labels import digits_of, number, sentence
from reports.layout import (
    Claim,
    Claims,
    Details,
    Group,
    Heading,
    Items,
    Number,
    Numbers,
    Page,
    Pairs,
    Section,
    Text,
    given,
)
from reports.rendering import write_page
from reports.viewer import Pane, Trace, viewer
from twin.compile import compile_network, expanded
from twin.views.overview import overview

_MOST_LIMITS = 30


def diagnosis_sections(d: Diagnosis, pictures: bool = True) -> Iterator[Section]:
    """Every section that has something to show, in the page's order; without `pictures`, tables and text alone."""
    makers = (_where, _better, _runs, _evidence, _flux, _limits, _next, _equations, _account)
    for make in makers:
        section = make(d, pictures)
        if section is not None:
            yield section


def _account(d: Diagnosis, pictures: bool) -> Section | None:
    account = d.findings.account
    if not account:
        return None
    table = tables.account_table(account, d.simulated)
    blocks = given(Text(sentence(account["summary"]), "lead"), table.folded() if table else None)
    return Section("used", "What of the recordings was used", blocks, "Recordings used")


def _where(d: Diagnosis, pictures: bool) -> Section | None:
    if not len(d.tables["map"]):
        return None
    shown, places = [], mismatch(d.tables["map"])
    if pictures:
        network = compile_network(d.machine, part=d.part_before)
        view = overview(network, expanded(d.part_before), d.machine.description, d.simulated)
        marks = [
            Mark(f"{k} {_short(x.mechanism)}", x.where.kind, x.where.name) for k, x in enumerate(d.findings.findings, 1)
        ]
        figure = mismatch_picture(view, places, marks)
        shown.append(picture(figure, "The machine with the mismatch coloured in", d.simulated, "svg", "network"))
    title = "Where the simulation falls short" if places["shown"].any() else "No place where the simulation falls short"
    note = Text(
        "Coloured is what chance gives in fewer than 1 of 1000 cases (χ² of the runs' z); a body's size on paper grows "
        "with its heat capacity. ± : the sign differs from run to run.",
        "note",
    )
    return Section("where", title, (*shown, note), "Where")


def _short(mechanism: str) -> str:
    known = {"free_flux": "missing heat", "free_shift": "missing displacement", "unlisted": "not listed"}
    return known.get(mechanism) or mechanism.replace("_", " ")


def _better(d: Diagnosis, pictures: bool) -> Section | None:
    rms = d.tables["rms"]
    if not len(rms):
        return None
    changed, channels = bool(d.findings.findings), by_change(by_channel(rms))
    shown = []
    if pictures:
        shown.append(_drawn(before_after(channels, changed, d.simulated), "Left-out rms by channel", d))
    if pictures and rms["batch"].nunique() > 1:
        names = chosen_channels(channels, changed)
        shown.append(_drawn(by_run(rms, names, changed, d.simulated), "Left-out rms run by run", d))
    fit = d.findings.fit
    lead = f"{fit.batches_improved} of {fit.batches} left-out runs are predicted better than before." if changed else ""
    title = "Before and after" if changed else "Error against the noise"
    runs = tables.runs(rms, [str(c) for c in channels["channel"]], changed, d.simulated)
    return Section("better", title, given(Text(lead, "lead"), *shown, runs.folded()))


def _drawn(figure: Figure, label: str, d: Diagnosis) -> Picture:
    """The figure at its full width, which a narrow screen scrolls."""
    return picture(figure, label, d.simulated, look="full")


def _runs(d: Diagnosis, pictures: bool) -> Section | None:
    series, rms = d.tables["series"], d.tables["rms"]
    if not len(series) or not len(rms) or not pictures:
        return None
    changed = bool(d.findings.findings)
    every = viewer("Left-out runs: recording and simulation", _panes(series, rms, changed), d.simulated)
    batches = [b for b in telling(rms, changed) if (series["batch"] == b[0]).any()]
    channels = [c for c in chosen_channels(by_channel(rms), changed) if (series["channel"] == c).any()]
    if not batches or not channels:
        return None
    figure = left_out_batches(series, rms, batches, channels, changed, d.simulated)
    static = Group((_drawn(figure, "Left-out runs: recording and simulation", d),), "static")
    return Section("runs", "Recording and simulation", given(every, static), "Runs")


def _panes(series: pd.DataFrame, rms: pd.DataFrame, changed: bool) -> list[Pane]:
    """A pane per left-out run and channel, the channels that changed most first."""
    order = [str(c) for c in by_change(by_channel(rms))["channel"]]
    parts = {(str(b), str(c)): own for (b, c), own in series.groupby(["batch", "channel"], sort=False)}
    panes = []
    for batch in dict.fromkeys(b for b, _ in parts):
        for channel in (c for c in order if (batch, c) in parts):
            own = parts[batch, channel]
            values = {k: own[k].to_numpy(float) for k in ("time_s", "recorded", "before", "after")}
            traces = [Trace("recorded", values["recorded"], "recorded")]
            traces += [Trace("simulated before", values["before"], "before")] if changed else []
            traces.append(Trace("simulated after" if changed else "simulated", values["after"], "computed"))
            panes.append(Pane(batch, channel, str(own["unit"].iloc[0]), values["time_s"] / 3600, tuple(traces)))
    return panes


def _evidence(d: Diagnosis, pictures: bool) -> Section | None:
    t, sim, changed = d.tables, d.simulated, bool(d.findings.findings)
    shown: list[Any] = []
    more: list[Any] = []
    if pictures and len(t["map"]):
        for groups, into in ((("regime", "batch"), shown), (("hour", "since_start"), more)):
            if t["map"]["by"].isin(groups).any():
                grouped = " and ".join(evidence.BY[g] for g in groups)
                into.append(_drawn(evidence.where_when(t["map"], groups, sim), f"Mismatch {grouped}", d))
    if pictures and len(t["acf"]):
        shown.append(_drawn(evidence.autocorrelation(t["acf"], changed, sim), "Residual autocorrelation", d))
    found = {(x.mechanism, x.where.name): x.probability for x in d.findings.findings}
    shown += [tables.candidates(t["candidates"], sim, found)] if len(t["candidates"]) else []
    shown += [tables.steps(t["steps"], sim)] if len(t["steps"]) else []
    shown += [tables.refinements(t["refinements"], sim)] if len(t["refinements"]) else []
    if not shown:
        return None
    shown += [Details("Where × when by time of day and since the run's start", tuple(more))] if more else []
    windows = [tables.windows(x, f"Finding {k}", sim) for k, x in enumerate(d.findings.findings, 1) if x.when.windows]
    return Section("evidence", "Evidence", (*shown, *(w.folded() for w in windows)))


def _flux(d: Diagnosis, pictures: bool) -> Section | None:
    flux = d.tables["flux"]
    if not len(flux) or not pictures:
        return None
    shown = _drawn(evidence.missing_flux(flux, d.simulated), "Reconstructed missing heat over time", d)
    note = "What would have to arrive there for the simulation to meet the recordings; no law is assumed."
    return Section("flux", "What is missing over time", (shown, Text(note, "note")), "Over time")


def _limits(d: Diagnosis, pictures: bool) -> Section | None:
    table = d.tables["limits"]
    if not len(table):
        return None
    own_best = table[table["limit"].notna()].drop_duplicates("mechanism")[:_MOST_LIMITS]
    first = own_best if len(own_best) else table[:_MOST_LIMITS]
    rest = table.drop(first.index)
    notes = (
        "Of each mechanism the place where the least would be claimed; the others below.",
        "A smaller effect may be there: these recordings would not show it.",
    )
    folded = tables.limits(rest, d.simulated).folded() if len(rest) else None
    blocks = given(tables.limits(first, d.simulated), *(Text(n, "note") for n in notes), folded)
    return Section("limits", "What could not be seen", blocks, "Limits")


def _next(d: Diagnosis, pictures: bool) -> Section | None:
    run = d.findings.next_experiment
    if run is None:
        return None
    facts = [("Distinguishes", " from ".join(name.replace("_", " ") for name in run.separates))]
    facts += [("Run plan", run.file)] if run.file else []
    blocks = (Text(tables.experiment_sentence(run), "lead"), Pairs(tuple(facts), "facts quiet"))
    return Section("next", "Next experiment", blocks)


def _equations(d: Diagnosis, pictures: bool) -> Section | None:
    blocks: list[Any] = []
    for k, x in enumerate(d.findings.findings, 1):
        label = f"{k}. {tables.mechanism_label(x.mechanism)}, {tables.place_label(x.where.kind, x.where.name)}"
        if x.equation or x.parameters:
            blocks += [Heading(label), Text(x.equation, "law")]
        if x.parameters:
            blocks.append(Group((tables.parameters(x.parameters, d.simulated, "Parameters"),), "narrow"))
    return Section("equation", "The equation with its numbers", given(*blocks), "Equation") if blocks else None


_MOST_FIGURES, _TELLING = 3, 0.1  # a change by the noise floor
_DRAFTED = (
    "The machine file has no twin part. This diagnosis is against a network that was drafted from the recordings: "
    "places are named after the sensors."
)


def write_diagnosis_report(
    path: Path,
    d: Diagnosis,
    pictures: bool = True,
    unsealed: Unsealed | None = None,
    continued: Continued | None = None,
) -> None:
    """Write the page. It is self-contained; it appears whole or not at all.

    Without `pictures` the tables and text alone.

    Args:
        unsealed: a demonstration's panel, above everything else.
        continued: the diagnosis that this one continues; the page says what changed.

    Raises:
        InputError: another suffix than .html, or a place that cannot be written.
    """
    write_page(Path(path), diagnosis_page(d, pictures, unsealed, continued), (".html",))


def diagnosis_page(
    d: Diagnosis, pictures: bool = True, unsealed: Unsealed | None = None, continued: Continued | None = None
) -> Page:
    """The page; whatever table is empty leaves its section out."""
    f = d.findings
    lead = f.statement or tables.below_headline(f.verdict, f.fit.batches, bool(len(d.tables["limits"])))
    if f.verdict == "consistent" and not f.findings:
        lead = f"{shortened(lead)} {limits_sentence(f.detection_limits)}".strip()
    written = "findings.json"
    if f.findings and unsealed is None:
        written += "; the machine file with what was found: machine.yml"
    chip, figures = tables.CHIPS[f.verdict], tuple(_figures(d))
    changed = () if continued is None else tuple(continued.sentences(f))
    news = Group((Text("", strong="What the new recordings changed"), Items(changed)), "changed") if changed else None
    top = given(
        Text("" if f.findings else shortened(lead), "lead"),  # the findings say it themselves
        Text(_DRAFTED if d.drafted else "", "drafted"),
        Claims(tuple(_claim(k, x) for k, x in enumerate(f.findings, 1))),
        news,
        None if f.next_experiment is None else
        Text(tables.experiment_sentence(f.next_experiment), "settle", "What would settle it.", ("More", "next")),
        Numbers(figures, "figures"),
        Items(tuple(d.remarks), "remarks"),
    )  # fmt: skip
    glossary = (Heading("What the figures mean"), Pairs(tables.GLOSSARY, "glossary"))
    how = Section("how", "How it was done", (Items(tables.METHOD, "how", ordered=True), *glossary))
    seconds = "" if f.seconds is None else f" {sentence(f'{tables.seconds_label(f.seconds)} of computing')}"
    return Page(
        f"thermodrift diagnosis of {f.machine}",
        f"Diagnosis of {f.machine}: {chip}",
        top,
        (*diagnosis_sections(d, pictures), how),
        (
            f"The same in figures: {written}.{seconds} A simulation is computed, never measured; SIMULATED marks "
            "figures and tables whose recordings are computed too.",
        ),
        d.simulated,
        tables.headline(f.verdict, [x.probability for x in f.findings], tables.most_left(f.fit.left_out_rms)),
        (chip, f.verdict),
        above=() if unsealed is None else (unsealed.panel(figures, bool(f.findings)),),
    )


def _claim(k: int, x: Finding) -> Claim:
    others = [(o.mechanism, o.where.kind, o.where.name, o.probability) for o in x.alternatives]
    where = [
        ("what", tables.mechanism_label(x.mechanism)),
        ("where", tables.place_label(x.where.kind, x.where.name)),
        ("when", x.when.regime),
        ("or else", tables.alternatives_label(others)),
    ]
    sure = tables.probability_label(x.probability), tables.likelihood(x.probability), round(100 * x.probability, 1)
    return Claim(k, shortened(x.statement), tuple(w for w in where if w[1]), *sure)


def _figures(d: Diagnosis) -> list[Number]:
    """The channels that changed most (or, where nothing did, that differ most), then the runs that improved."""
    f, changed = d.findings, bool(d.findings.findings)
    out = []
    if len(d.tables["rms"]):
        ranked = by_change(by_channel(d.tables["rms"]))
        telling = ranked[ranked["change"] > _TELLING]
        ranked = telling if changed and len(telling) else ranked
        for r in ranked[:_MOST_FIGURES].to_dict("records"):
            digits = digits_of(r["before"], r["after"], r["floor"])
            unit = unit_label(str(r["unit"]))
            before = number(r["before"], digits) if changed else ""
            noise = f"noise {number(r['floor'], digits)} {unit}"
            out.append(Number(f"{r['channel']}, left-out rms", f"{number(r['after'], digits)} {unit}", noise, before))
    improved = f"{f.fit.batches_improved} of {f.fit.batches}" if changed else f"{f.fit.batches}"
    label = "left-out runs that improve" if changed else "left-out runs"
    return [*out, Number(label, improved, "each predicted from the others")]
