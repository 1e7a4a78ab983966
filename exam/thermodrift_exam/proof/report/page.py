"""The report of the proof: performance of the diagnosis on recordings with concealed effects, on one page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from data.errors import WorkError
from data.files import write_atomic
from reports.drawing import Picture
from reports.labels import NOTHING, count
from reports.layout import Cell, Column, Group, Heading, Items, Page, Pairs, Row, Section, Table, Text, given
from reports.rendering import rendered
from thermodrift_exam.proof.report import figures, labels, shortfall, tables
from thermodrift_exam.proof.report.figures import picture
from thermodrift_exam.proof.report.labels import KIND_WORDS, key_label, plant_label, plant_origin
from thermodrift_exam.proof.report.tables import ProofRun, counted, goal_rows, shortfalls

_GOAL_S = 30.0


def proof_sections(run: ProofRun) -> Iterator[Section]:
    """Every section, in the page's order."""
    for make in (
        _baselines,
        _confusion,
        _detection,
        _shortfall,
        _improvement,
        _amplitude,
        _reliability,
        _worst,
        _cases,
    ):
        yield make(run)


def _baselines(run: ProofRun) -> Section:
    table, own = run.table("compared"), Section("baselines", "Against baselines and ablations", (), "Baselines")
    if not (table["group"].ne("diagnosis") & table["value"].notna()).any():
        return _absent(own, "Baselines and ablations were not scored in this run.")
    lead = (
        "Baselines start from the same first fit. Ablations drop one rule each in the first round; compare them with "
        "“first round, full rules”, which has no further rounds either. Ahead: of a baseline the diagnosis, of an "
        "ablation the first round with full rules, paired by case."
    )
    return replace(own, blocks=(Text(lead), _shown(run, figures.baselines(table, run.plants), own.title)))


def _confusion(run: ProofRun) -> Section:
    own = Section("confusion", "Confusion matrices", (), "Confusion")
    shown = []
    for name, ordered, title in (
        ("confusion_mechanism", tables.mechanism_matrix, "Mechanism: concealed (rows) and named (columns)"),
        ("confusion_place", tables.place_matrix, "Place: concealed (rows) and named (columns)"),
    ):
        table = run.table(name)
        if len(table):
            matrix, bounds = ordered(table)
            shown.append(_shown(run, figures.confusion(matrix, bounds, title, run.plants), title, "dense"))
    if not shown:
        return _absent(own, "No concealed effect was scored.")
    note = "Counts of visible concealed effects, shaded by the row's share; right answers are outlined."
    return replace(own, blocks=(*shown, Text(note, "note")))


def _detection(run: ProofRun) -> Section:
    own = Section("detection", "Found, by effect and size", (), "By effect")
    terms = run.table("terms")
    table = tables.detection_by_size(terms) if len(terms) else terms
    if table.empty:
        return _absent(own, "No concealed effect has a known detection limit in this run.")
    lead = "Sizes go from below the detection limit to ten times it, so the first column should be mostly missed."
    return replace(own, blocks=(Text(lead), _shown(run, figures.detection(table, run.plants), own.title)))


def _shortfall(run: ProofRun) -> Section:
    own = Section("shortfall", "Missed effects and false claims", (), "Shortfall")
    shown = shortfall.tables(run, each=True)
    if not shown:
        return _absent(own, "No visible effect was missed and no claim is false, or none was scored.")
    return replace(own, blocks=(Text(" ".join(shortfall.sentences(run))), *shown))


def _improvement(run: ProofRun) -> Section:
    own = Section("improvement", "Error before, after, and with the true model", (), "Repair")
    o = run.table("outcomes")
    shown = _numeric(o, ["error_before", "error_after", "error_true", "error_floor"])
    shown = shown[shown["visible"].eq(True) & (shown["error_before"] > 0)]
    if shown.empty:
        return _absent(own, "No visible case has left-out errors in this run.")
    return replace(own, blocks=(_shown(run, figures.improvement(shown, run.plants), own.title),))


def _amplitude(run: ProofRun) -> Section:
    own = Section("amplitude", "Amplitude found and true", (), "Amplitude")
    terms = run.table("terms")
    table = tables.with_amplitude(terms) if len(terms) else terms
    if table.empty:
        return _absent(own, "No visible effect has an estimated amplitude in this run.")
    shown = [_shown(run, figures.ratios(table, run.plants), "Amplitude found by true, per effect", "")]
    sized = table[table["true_limits"].notna()]
    if len(sized):
        shown.insert(0, _shown(run, figures.amplitudes(sized, run.plants), "Amplitude found against true", ""))
    note = Text("The grey band is ± 40 %. A bar through a row is its median.", "note")
    return replace(own, blocks=(Group(tuple(shown), "pair"), note))


def _reliability(run: ProofRun) -> Section:
    own = Section("reliability", "Calibration of probabilities, and time", (), "Calibration, time")
    table, timed = run.table("reliability"), _numeric(run.table("outcomes"), ["seconds"])
    shown, notes = [], []
    if len(table) and table["n"].sum() > 0:
        stated = _numeric(run.table("outcomes"), ["probability"])["probability"].dropna().to_numpy()
        figure = figures.reliability(table, stated, _calibration_error(run.table("goals")), run.plants)
        shown.append(_shown(run, figure, "Share right against probability claimed", ""))
    else:
        notes.append("No finding stated a probability in this run.")
    if timed["seconds"].notna().any():
        goals = run.table("goals")
        wanted = goals.loc[goals["measure"].astype(str).str.startswith("time"), "wanted"]
        goal_s = float(wanted.iloc[0]) if len(wanted) else _GOAL_S
        shown.append(_shown(run, figures.times(timed, goal_s, run.plants), "Time for a case", ""))
    else:
        notes.append("The times were not recorded in this run.")
    return replace(own, blocks=given(Group(tuple(shown), "pair"), *(Text(n, "note") for n in notes)))


def _worst(run: ProofRun) -> Section:
    own = Section("worst", "The worst cases", (), "Worst cases")
    table = run.table("worst")
    if table.empty:
        return _absent(own, "Every answer was right, or none was judged.")
    series, windows = run.table("series"), run.table("windows")
    shown = []
    for k, r in enumerate(table.to_dict("records"), 1):
        case, plant = str(r["case"]), str(r["plant"])
        names = [e for e in str(r["effect"]).split("+") if e not in ("", "nan", "nothing", "<NA>")]
        effects = " + ".join(map(key_label, names))
        own_series = series[series["case"] == case]
        drawn = None
        if len(own_series):
            active = windows[windows["case"] == case] if names else None
            figure = figures.worst_case(tables.worst_channel(own_series), active, plant)
            drawn = picture(figure, f"{case}: residual before and after", (plant,))
        kind = str(r.get("kind") or "")
        what = f"{KIND_WORDS.get(kind, key_label(kind))}{': ' if kind and effects else ''}{effects}"
        head = Heading(f"{k}. {case}", simulated=plant_origin(plant) == "SIMULATED")
        said = (Text(f"{what}; plant {plant_label(plant)}", "soft"), Text(_sentence(str(r["why"]))))
        shown.append(Group(given(head, *said, drawn), "claim"))
    lead = "False alarms first, then wrong names by their probability, then missed effects."
    return replace(own, blocks=(Text(lead), *shown))


def _cases(run: ProofRun) -> Section:
    shown: list[Table] = []
    notes: list[str] = []
    if len(run.table("outcomes")):
        shown.append(tables.cases(run.table("outcomes"), run.plants))
    without = tables.uncounted(run)
    if without is not None:
        shown.append(without)
    for name, made, absent in (
        ("ledger", tables.ledger, "The ledger is not part of this page."),
        ("leak", lambda t: tables.leak(t, run.plants), "The leak test was not run."),
        ("convergence", tables.convergence, "The plants' convergence was not studied in this run."),
    ):
        table = run.table(name)
        if len(table):
            shown.append(made(table))
        else:
            notes.append(absent)
    if run.isolation:
        protections = "; ".join(f"{protection}: {count(n, 'case')}" for protection, n in sorted(run.isolation.items()))
        notes.insert(0, f"Isolation of the answering process: {protections}.")
    said = (Text(n, "note") for n in notes)
    return Section("how", "Procedure", (Items(labels.METHOD, "how", ordered=True), *said, *shown))


def _sentence(why: str) -> str:
    """Keys as readable text, capitalised."""
    said = key_label(why).replace("+", " + ")
    return said[:1].upper() + said[1:]


def _calibration_error(goals: pd.DataFrame) -> float:
    own = goals[(goals["plant"] == "all") & goals["measure"].astype(str).str.contains("calibration")]
    return float(own["value"].iloc[0]) if len(own) and pd.notna(own["value"].iloc[0]) else math.nan


def _absent(section: Section, why: str) -> Section:
    return replace(section, blocks=(Text(why, "note"),))


def _shown(run: ProofRun, figure: Figure, said: str, look: str = "full") -> Picture:
    return picture(figure, said, run.plants, look)


def _numeric(table: pd.DataFrame, columns: list[str]) -> pd.DataFrame:
    """Cells that do not apply become nan."""
    return table.assign(**{c: pd.to_numeric(table[c], errors="coerce").astype(float) for c in columns})


REPORT = "report.html"
_MOST_MISSED = 4


def write_proof_report(folder: Path, run: ProofRun) -> Path:
    """Write `report.html` into the proof's folder. It is self-contained; it appears whole or not at all.

    Raises:
        WorkError: the folder cannot be written.
    """
    path = Path(folder) / REPORT
    try:
        write_atomic(path, rendered(proof_page(run), ".html"))
    except OSError as error:
        raise WorkError(f"report {path}: cannot be written ({error.strerror}); free the place and open again") from None
    return path


def proof_page(run: ProofRun) -> Page:
    """The page. A section without its table shows a sentence instead."""
    goals = run.table("goals")
    sealed = run.suite == "sealed"
    scored = _goals(run) if len(goals) else Text("The goals were not scored in this run.", "note")
    return Page(
        "thermodrift prove",
        f"The diagnosis examined: {count(run.cases, 'sealed case' if sealed else 'development case')}",
        given(
            Text(lead(goals), "lead"),
            *(Text(said, "warning") for said in run.remarks),
            Pairs(tuple(_facts(run))),
            Text(f"Sealed root: {run.root}", "note digest"),
            Text(f"Source that answered: {run.source_digest}", "note digest"),
        ),
        (
            Section("goals", "Goals", (scored,)),
            *proof_sections(run),
            Section("terms", "Terms", (Pairs(labels.GLOSSARY, "glossary"),)),
        ),
        (
            "The same in figures: outcomes.csv, terms.csv, goals.csv. SIMULATED marks recordings that a plant "
            "computed; none of those was measured on a machine.",
        ),
        headline=headline(run),
        badge=labels.origin(run.plants),
    )


def _goals(run: ProofRun) -> Table:
    """A row per goal: measured over all plants, where the truth was known, and by plant."""
    origin, chips = labels.origin(run.plants), {"yes": ("met", "met"), "no": ("missed", "missed")}
    columns = [
        Column("measure", kind="wide"), Column("goal", kind="number"), Column("measured", origin, "number"),
        Column("goal (line) and 90 %"), Column("met"), Column("truth known", origin, "number"),
        *(Column(plant_label(p), plant_origin(p), "number") for p in run.goal_columns),
    ]  # fmt: skip
    rows = []
    for g in goal_rows(run.table("goals"), run.goal_columns):
        met = Cell("", chip=chips[g.whole.met]) if g.whole.met else Cell(NOTHING)
        plants = (Cell(c.value, f"n {c.n}" if c.n else "", c.met == "no") for c in g.plants)
        interval = ", ".join(t for t in (g.whole.interval, f"n {g.whole.n}" if g.whole.n else "") if t)
        informed = Cell(g.informed.value, f"n {g.informed.n}" if g.informed.n else "")
        rows.append(Row.of(g.measure, g.goal, Cell(g.whole.value, interval), Cell("", gauge=g.whole.bar), met, informed,
                           *plants))  # fmt: skip
    note = (
        "Each picture has a scale of its own. Orange: the plant alone misses the goal. n counts what a measure is "
        "taken over: cases, findings or concealed effects."
    )
    return Table("", tuple(columns), tuple(rows), notes=(note,))


def headline(run: ProofRun) -> str:
    """``11 of 13 goals met on 299 sealed cases.``"""
    met, missed, _ = counted(run.table("goals"))
    cases = count(len(run.table("outcomes")), "sealed case" if run.suite == "sealed" else "development case")
    if not met + missed:
        return f"No goal could be evaluated on {cases}."
    share = "Every goal" if not missed else "No goal" if not met else f"{met} of {met + missed} goals"
    return f"{share} met on {cases}."


def lead(goals: pd.DataFrame) -> str:
    """The missed goals, the first ones by name; then the goals without a case."""
    _, missed, unknown = counted(goals)
    more = [f"{missed - _MOST_MISSED} more, in the table"] if missed > _MOST_MISSED else []
    parts = [f"Missed: {'; '.join([*shortfalls(goals)[:_MOST_MISSED], *more])}."] if missed else []
    if unknown:
        parts.append(f"Without a case: {count(unknown, 'goal')}.")
    return " ".join(parts)


def _facts(run: ProofRun) -> list[tuple[str, str]]:
    counts = run.table("outcomes")["plant"].value_counts()
    plants = ", ".join(f"{labels.plant_letter(p)} {counts[p]}" for p in run.plants)
    return [
        ("Cases sealed", f"{run.cases}"),
        ("Cases that count", f"{len(run.table('outcomes'))}" + (f" (plant {plants})" if plants else "")),
        ("Void, left out", f"{len(run.void)}"),
        ("Failed, counted as wrong", f"{len(run.failed)}"),
        ("Sealed root", run.root[:16]),
        ("Sealed", labels.stamp(run.sealed)),
        ("Opened", labels.stamp(run.opened)),
        ("thermodrift", run.version),
    ]
