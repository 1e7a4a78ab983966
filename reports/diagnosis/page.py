"""The report of a diagnosis: what was found, where, how sure and how much better, on one self-contained page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from diagnosis.result import Diagnosis
from reports.diagnosis import tables
from reports.diagnosis.figures import left_out_run, probabilities
from reports.diagnosis.first_screen import Continued, claim, without_finding
from reports.diagnosis.map import Mark, mismatch_picture
from reports.diagnosis.tables import by_change, by_channel, chosen_channels, mismatch, most_changed
from reports.drawing import picture
from reports.labels import BLUE, INK, ORANGE, count, sentence
from reports.layout import Details, Group, Heading, Items, Key, Page, Pairs, Panel, Plot, Section, Text, given
from reports.rendering import write_page
from reports.viewer import Pane, Trace, Viewer, viewer
from twin.compile import compile_network, expanded
from twin.views.overview import overview

_DRAFTED = (
    "The machine file has no twin part. This diagnosis is against a network that was drafted from the recordings: "
    "places are named after the sensors."
)


def write_diagnosis_report(
    path: Path,
    d: Diagnosis,
    pictures: bool = True,
    above: Group | None = None,
    continued: Continued | None = None,
) -> None:
    """Write the page. It is self-contained; it appears whole or not at all.

    Without `pictures` the tables and text alone.

    Args:
        above: stands above everything else, as the panel of a demonstration does.
        continued: the diagnosis that this one continues; the page says what changed.

    Raises:
        InputError: another suffix than .html, or a place that cannot be written.
    """
    write_page(Path(path), diagnosis_page(d, pictures, above, continued), (".html",))


def diagnosis_page(
    d: Diagnosis, pictures: bool = True, above: Group | None = None, continued: Continued | None = None
) -> Page:
    """The page; whatever table is empty leaves its part out."""
    f, t, changed = d.findings, d.tables, bool(d.findings.findings)
    errors = tables.error_lines(t["rms"], changed)
    found = {(x.mechanism, x.where.name): x.probability for x in f.findings}
    blocks = given(
        *(_pictures(d) if pictures else ()),
        tables.candidates(t["candidates"], found) if len(t["candidates"]) else None,
        _viewer(d) if pictures else None,
        Details("What a laboratory can check", _checks(d)),
    )
    written = "findings.json"
    if f.findings and above is None:
        written += "; the machine file with what was found: machine.yml"
    seconds = "" if f.seconds is None else f" {sentence(f'{tables.seconds_label(f.seconds)} of computing')}"
    chip = tables.CHIPS[f.verdict]
    return Page(
        f"thermodrift diagnosis of {f.machine}",
        f"Diagnosis of {f.machine}: {chip}",
        _sentences(d, errors, continued),
        (Section("found", "", blocks),),
        (
            f"The same in figures: {written}.{seconds} A simulation is computed, never measured; SIMULATED marks "
            "pages and pictures whose recordings are computed too.",
        ),
        d.simulated,
        tables.headline(f.verdict, [x.probability for x in f.findings], tables.most_left(f.fit.left_out_rms)),
        (chip, f.verdict),
        above=given(above),
    )


def _sentences(d: Diagnosis, errors: Sequence[str], continued: Continued | None) -> tuple[Any, ...]:
    """What was found, how sure, and how much better left-out runs are predicted; what it rests on, what comes next."""
    f = d.findings
    if f.findings:
        claims = [claim(x) for x in f.findings]
        leads = [Text(text, "lead", f"{k}. {sure}:") for k, (sure, text) in enumerate(claims, 1)]
        better = f"{f.fit.batches_improved} of {count(f.fit.batches, 'left-out run')} are predicted better"
    else:
        leads = [Text(without_finding(f), "lead")]
        better = f"{count(f.fit.batches, 'left-out run')}, each predicted from the others"
    news = () if continued is None else tuple(continued.sentences(f))
    run = f.next_experiment
    return given(
        *leads,
        Text(f"{better}{': rms ' if errors else ''}{'; '.join(errors)}."),
        Text(_DRAFTED if d.drafted else "", "drafted"),
        Group((Text("", strong="What the new recordings changed"), Items(news)), "changed") if news else None,
        None if run is None else
        Text(
            f"{tables.experiment_sentence(run)} It distinguishes "
            f"{' from '.join(name.replace('_', ' ') for name in run.separates)}."
            + (f" Run plan: {run.file}." if run.file else ""), "settle", "What would settle it.",
        ),
        Items(tuple(d.remarks), "remarks"),
    )  # fmt: skip


def _pictures(d: Diagnosis) -> Iterator[Any]:
    """The machine with the places marked, a left-out run before and after, the explanations with probabilities."""
    t, changed = d.tables, bool(d.findings.findings)
    if len(t["map"]):
        network = compile_network(d.machine, part=d.part_before)
        view = overview(network, expanded(d.part_before), d.machine.description, d.simulated)
        marks = [
            Mark(f"{k} {_short(x.mechanism)}", x.where.kind, x.where.name) for k, x in enumerate(d.findings.findings, 1)
        ]
        figure = mismatch_picture(view, mismatch(t["map"]), marks)
        yield picture(figure, "The machine with the mismatch coloured in", d.simulated, "svg", "network full")
        yield Text("Coloured is what chance gives in fewer than 1 of 1000 cases (χ² of the runs' z).", "note")
    if len(t["series"]) and len(t["rms"]):
        yield _run(t["series"], t["rms"], changed, d.simulated)
    if len(t["candidates"]):
        yield _explanations(d)


def _short(mechanism: str) -> str:
    known = {"free_flux": "missing heat", "free_shift": "missing displacement", "unlisted": "not listed"}
    return known.get(mechanism) or mechanism.replace("_", " ")


def _run(series: pd.DataFrame, rms: pd.DataFrame, changed: bool, simulated: bool) -> Panel:
    batch = most_changed(rms[rms["batch"].isin(series["batch"])], changed)
    own, scores = (table[table["batch"] == batch] for table in (series, rms))
    plots = [
        Plot(left_out_run(part, scores[scores["channel"] == c], c, changed, simulated), f"{batch}: {c}", "third")
        for c in chosen_channels(by_channel(rms), changed)
        if len(part := own[own["channel"] == c])
    ]
    keys = [Key("recorded", INK), *([Key("simulated before", ORANGE)] if changed else [])]
    keys.append(Key("simulated after" if changed else "simulated", BLUE))
    what = "change" if changed else "error"
    return Panel(f"The left-out run of the greatest {what}, {batch}", tuple(plots), keys=tuple(keys))


def _explanations(d: Diagnosis) -> Panel:
    """The probabilities of every finding and of what else it may be; of no finding those of the best that was tried."""
    groups = [(f"finding {k}", tables.explanations(x)) for k, x in enumerate(d.findings.findings, 1)]
    if not groups:
        best = d.tables["candidates"].sort_values("rank", kind="stable")[:5]
        groups = [("none is claimed", [(str(r["words"]), float(r["probability"])) for r in best.to_dict("records")])]
    plots = []
    for title, rows in groups:
        bars = [(name, p, tables.probability_label(p)) for name, p in rows if p == p]
        plots.append(Plot(probabilities(bars, title, d.simulated), f"Probabilities, {title}", "third"))
    return Panel("Explanations and their probabilities", tuple(plots))


def _viewer(d: Diagnosis) -> Viewer | None:
    """A pane per left-out run and channel, the channels that changed most first, then heat that no law explains."""
    series, rms, changed = d.tables["series"], d.tables["rms"], bool(d.findings.findings)
    order = [str(c) for c in by_change(by_channel(rms))["channel"]] if len(rms) else []
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
    return viewer("Every left-out run", [*panes, *_missing(d.tables["flux"])], simulated=False)


def _missing(flux: pd.DataFrame) -> Iterator[Pane]:
    """What would have to arrive at a place for the simulation to meet the recording, with its 90 % band."""
    for (kind, place, batch), own in flux.groupby(["kind", "place", "batch"], sort=False):
        value, band = own["value"].to_numpy(float), 1.645 * own["sd"].to_numpy(float)
        traces = (
            Trace("reconstructed", value, "recorded"), Trace("5 %", value - band, "before"),
            Trace("95 %", value + band, "before"),
        )  # fmt: skip
        time_h = own["time_s"].to_numpy(float) / 3600
        yield Pane(str(batch), f"missing {kind}, {place}", str(own["unit"].iloc[0]), time_h, traces, residual=False)


def _checks(d: Diagnosis) -> tuple[Any, ...]:
    """Everything in the fold."""
    t, f = d.tables, d.findings
    laws: list[Any] = []
    for k, x in enumerate(f.findings, 1):
        head = Heading(f"{k}. {tables.effect_label(x)}, {x.when.regime}")
        laws += [head, Text(x.statement), Text(x.equation, "law")]
    account = tables.account_table(f.account)
    return given(
        Text(f.statement),
        *laws,
        tables.parameters(f.findings) if any(x.parameters for x in f.findings) else None,
        tables.runs(t["rms"], bool(f.findings)) if len(t["rms"]) else None,
        tables.steps(t["steps"]) if len(t["steps"]) else None,
        tables.limits(t["limits"]) if len(t["limits"]) else None,
        *((Heading("Recordings used"), Text(sentence(f.account["summary"])), account) if f.account else ()),
        Heading("How it was done"),
        Items(tables.METHOD, "how", ordered=True),
        Pairs(tables.GLOSSARY, "glossary"),
    )
