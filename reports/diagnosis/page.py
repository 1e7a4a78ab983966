"""The report of a diagnosis: what was found, where, how much better, and the evidence, on one self-contained page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

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
from reports.labels import number, sentence
from reports.layout import Table
from reports.rendering import write_page
from twin.compile import compile_network, expanded
from twin.views.overview import overview

_MOST_LIMITS = 30


@dataclass(frozen=True)
class Law:
    """An equation with its numbers."""

    title: str
    equation: str
    parameters: Table


@dataclass(frozen=True)
class Part:
    """A section: a sentence, facts, equations, pictures, tables, notes."""

    anchor: str
    short: str  # for the list of sections
    title: str
    lead: str = ""
    facts: tuple[tuple[str, str], ...] = ()
    laws: tuple[Law, ...] = ()
    pictures: tuple[Picture, ...] = ()
    tables: tuple[Table, ...] = ()
    notes: tuple[str, ...] = ()
    folded: tuple[Table, ...] = ()
    more: tuple[Picture, ...] = ()  # folded too
    more_label: str = ""


def diagnosis_parts(d: Diagnosis, pictures: bool = True) -> Iterator[Part]:
    """Every section that has something to show, in the page's order; without `pictures`, tables and text alone."""
    makers = (_where, _better, _runs, _evidence, _flux, _limits, _next, _equations, _account)
    for make in makers:
        part = make(d, pictures)
        if part is not None:
            yield part


def _account(d: Diagnosis, pictures: bool) -> Part | None:
    account = d.findings.account
    if not account:
        return None
    table = tables.account_table(account, d.simulated)
    title, lead = "What of the recordings was used", sentence(account["summary"])
    return Part("used", "Recordings used", title, lead, folded=(table,) if table else ())


def _where(d: Diagnosis, pictures: bool) -> Part | None:
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
        shown.append(picture(figure, "The machine with the mismatch coloured in", d.simulated, "svg"))
    title = "Where the simulation falls short" if places["shown"].any() else "No place where the simulation falls short"
    notes = (
        "Coloured is what chance gives in fewer than 1 of 1000 cases (χ² of the runs' z); a body's size on paper grows "
        "with its heat capacity. ± : the sign differs from run to run.",
    )
    return Part("where", "Where", title, pictures=tuple(shown), notes=notes)


def _short(mechanism: str) -> str:
    known = {"free_flux": "missing heat", "free_shift": "missing displacement", "unlisted": "not listed"}
    return known.get(mechanism) or mechanism.replace("_", " ")


def _better(d: Diagnosis, pictures: bool) -> Part | None:
    rms = d.tables["rms"]
    if not len(rms):
        return None
    changed, channels = bool(d.findings.findings), by_change(by_channel(rms))
    shown = []
    if pictures:
        figure = before_after(channels, changed, d.simulated)
        shown.append(picture(figure, "Left-out rms by channel", d.simulated))
    if pictures and rms["batch"].nunique() > 1:
        names = chosen_channels(channels, changed)
        shown.append(picture(by_run(rms, names, changed, d.simulated), "Left-out rms run by run", d.simulated))
    fit = d.findings.fit
    lead = f"{fit.batches_improved} of {fit.batches} left-out runs are predicted better than before." if changed else ""
    title = "Before and after" if changed else "Error against the noise"
    folded = (tables.runs(rms, [str(c) for c in channels["channel"]], changed, d.simulated),)
    return Part("better", title, title, lead, pictures=tuple(shown), folded=folded)


def _runs(d: Diagnosis, pictures: bool) -> Part | None:
    series, rms = d.tables["series"], d.tables["rms"]
    if not len(series) or not len(rms) or not pictures:
        return None
    changed = bool(d.findings.findings)
    batches = [b for b in telling(rms, changed) if (series["batch"] == b[0]).any()]
    channels = [c for c in chosen_channels(by_channel(rms), changed) if (series["channel"] == c).any()]
    if not batches or not channels:
        return None
    figure = left_out_batches(series, rms, batches, channels, changed, d.simulated)
    shown = (picture(figure, "Left-out runs: recording and simulation", d.simulated),)
    return Part("runs", "Runs", "Recording and simulation", pictures=shown)


def _evidence(d: Diagnosis, pictures: bool) -> Part | None:
    t, sim, changed = d.tables, d.simulated, bool(d.findings.findings)
    shown: list[Picture] = []
    more: list[Picture] = []
    if pictures and len(t["map"]):
        for groups, into in ((("regime", "batch"), shown), (("hour", "since_start"), more)):
            if t["map"]["by"].isin(groups).any():
                figure = evidence.where_when(t["map"], groups, sim)
                grouped = " and ".join(evidence.BY[g] for g in groups)
                into.append(picture(figure, f"Mismatch {grouped}", sim))
    if pictures and len(t["acf"]):
        shown.append(picture(evidence.autocorrelation(t["acf"], changed, sim), "Residual autocorrelation", sim))
    if pictures and len(t["null"]):
        shown.append(picture(evidence.null_gains(t["null"], t["steps"], sim), "Gains with nothing missing", sim))
    found = frozenset((x.mechanism, x.where.name) for x in d.findings.findings)
    own = [tables.candidates(t["candidates"], sim, found)] if len(t["candidates"]) else []
    own += [tables.steps(t["steps"], sim)] if len(t["steps"]) else []
    own += [tables.refinements(t["refinements"], sim)] if len(t["refinements"]) else []
    if not shown and not own:
        return None
    folded = [tables.windows(x, f"Finding {k}", sim) for k, x in enumerate(d.findings.findings, 1) if x.when.windows]
    return Part("evidence", "Evidence", "Evidence", pictures=tuple(shown), tables=tuple(own), folded=tuple(folded),
                more=tuple(more), more_label="Where × when by time of day and since the run's start")  # fmt: skip


def _flux(d: Diagnosis, pictures: bool) -> Part | None:
    flux = d.tables["flux"]
    if not len(flux) or not pictures:
        return None
    figure = evidence.missing_flux(flux, d.simulated)
    notes = ("What would have to arrive there for the simulation to meet the recordings; no law is assumed.",)
    shown = (picture(figure, "Reconstructed missing heat over time", d.simulated),)
    return Part("flux", "Over time", "What is missing over time", pictures=shown, notes=notes)


def _limits(d: Diagnosis, pictures: bool) -> Part | None:
    table = d.tables["limits"]
    if not len(table):
        return None
    own_best = table[table["limit"].notna()].drop_duplicates("mechanism")[:_MOST_LIMITS]
    first = own_best if len(own_best) else table[:_MOST_LIMITS]
    rest = table.drop(first.index)
    notes = (
        "Of each mechanism the place where least would have been seen; the others below.",
        "A smaller effect may be there: these recordings would not show it.",
    )
    folded = (tables.limits(rest, d.simulated),) if len(rest) else ()
    own = (tables.limits(first, d.simulated),)
    return Part("limits", "Limits", "What could not be seen", tables=own, notes=notes, folded=folded)


def _next(d: Diagnosis, pictures: bool) -> Part | None:
    run = d.findings.next_experiment
    if run is None:
        return None
    facts = [("Distinguishes", " from ".join(name.replace("_", " ") for name in run.separates))]
    facts += [("Run plan", run.file)] if run.file else []
    return Part("next", "Next experiment", "Next experiment", tables.experiment_sentence(run), tuple(facts))


def _equations(d: Diagnosis, pictures: bool) -> Part | None:
    laws = []
    for k, x in enumerate(d.findings.findings, 1):
        label = f"{k}. {tables.mechanism_label(x.mechanism)}, {tables.place_label(x.where.kind, x.where.name)}"
        if x.equation or x.parameters:
            laws.append(Law(label, x.equation, tables.parameters(x.parameters, d.simulated, "Parameters")))
    return Part("equation", "Equation", "The equation with its numbers", laws=tuple(laws)) if laws else None


_MOST_FIGURES, _TELLING = 3, 0.1  # a change by the noise floor
_DRAFTED = (
    "The machine file has no twin part. This diagnosis is against a network that was drafted from the recordings: "
    "places are named after the sensors."
)


@dataclass(frozen=True)
class Found:
    """A finding as it stands on top of the page."""

    number: int
    statement: str
    what: str
    where: str
    when: str
    others: str
    probability: str
    likelihood: str
    percent: float  # of the bar


@dataclass(frozen=True)
class KeyFigure:
    """One large number."""

    label: str
    before: str
    after: str
    unit: str
    small: str


@dataclass(frozen=True)
class DiagnosisPage:
    """Everything that the template shows."""

    title: str
    machine: str
    simulated: bool
    verdict: str
    chip: str
    headline: str
    lead: str
    drafted: str
    found: tuple[Found, ...]
    figures: tuple[KeyFigure, ...]
    settle: str  # the run that would distinguish tied causes
    unsealed: Unsealed | None  # of a demonstration
    changed: tuple[str, ...]  # by further recordings
    improved: str  # how many left-out runs are predicted better, where something was found
    mostly_better: bool
    written: str  # the files next to the page
    remarks: tuple[str, ...]
    parts: tuple[Part, ...]
    method: tuple[str, ...]
    glossary: tuple[tuple[str, str], ...]
    seconds: str


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
    write_page(Path(path), "diagnosis", diagnosis_page(d, pictures, unsealed, continued), (".html",))


def diagnosis_page(
    d: Diagnosis, pictures: bool = True, unsealed: Unsealed | None = None, continued: Continued | None = None
) -> DiagnosisPage:
    """Collect the page; whatever table is empty leaves its section out."""
    f = d.findings
    lead = f.statement or tables.below_headline(f.verdict, f.fit.batches, bool(len(d.tables["limits"])))
    if f.verdict == "consistent" and not f.findings:
        lead = f"{shortened(lead)} {limits_sentence(f.detection_limits)}".strip()
    written = "findings.json"
    if f.findings and unsealed is None:
        written += "; the machine file with what was found: machine.yml"
    return DiagnosisPage(
        title=f"Diagnosis of {f.machine}: {tables.CHIPS[f.verdict]}",
        machine=f.machine,
        simulated=d.simulated,
        verdict=f.verdict,
        chip=tables.CHIPS[f.verdict],
        headline=tables.headline(f.verdict, [x.probability for x in f.findings], tables.most_left(f.fit.left_out_rms)),
        lead="" if f.findings else shortened(lead),  # the findings say it themselves
        drafted=_DRAFTED if d.drafted else "",
        found=tuple(_found(k, x) for k, x in enumerate(f.findings, 1)),
        figures=tuple(_figures(d)),
        settle="" if f.next_experiment is None else tables.experiment_sentence(f.next_experiment),
        unsealed=unsealed,
        changed=() if continued is None else tuple(continued.sentences(f)),
        improved=f"{f.fit.batches_improved} of {f.fit.batches} left-out runs improve" if f.findings else "",
        mostly_better=2 * f.fit.batches_improved > f.fit.batches,
        written=written,
        remarks=d.remarks,
        parts=tuple(diagnosis_parts(d, pictures)),
        method=tables.METHOD,
        glossary=tables.GLOSSARY,
        seconds="" if f.seconds is None else tables.seconds_label(f.seconds),
    )


def _found(k: int, x: Finding) -> Found:
    what = tables.mechanism_label(x.mechanism)
    others = [(o.mechanism, o.where.kind, o.where.name, o.probability) for o in x.alternatives]
    return Found(
        k,
        shortened(x.statement),
        what,
        tables.place_label(x.where.kind, x.where.name),
        x.when.regime,
        tables.alternatives_label(others),
        tables.probability_label(x.probability),
        tables.likelihood(x.probability),
        round(100 * x.probability, 1),
    )


def _figures(d: Diagnosis) -> list[KeyFigure]:
    """The channels that changed most (or, where nothing did, that differ most), then the runs that improved."""
    f, changed = d.findings, bool(d.findings.findings)
    out = []
    if len(d.tables["rms"]):
        ranked = by_change(by_channel(d.tables["rms"]))
        telling = ranked[ranked["change"] > _TELLING]
        ranked = telling if changed and len(telling) else ranked
        for r in ranked[:_MOST_FIGURES].to_dict("records"):
            digits = 1 if max(r["before"], r["after"]) >= 0.95 else 2
            unit = unit_label(str(r["unit"]))
            before = number(r["before"], digits) if changed else ""
            small = f"noise {number(r['floor'], digits)} {unit}"
            out.append(KeyFigure(f"{r['channel']}, left-out rms", before, number(r["after"], digits), unit, small))
    runs = f.fit.batches
    if changed:
        improved = f"{f.fit.batches_improved} of {runs}"
        out.append(KeyFigure("left-out runs that improve", "", improved, "", "each predicted from the others"))
    else:
        out.append(KeyFigure("left-out runs", "", f"{runs}", "", "each predicted from the others"))
    return out
