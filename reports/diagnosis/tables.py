"""Labels and texts of a diagnosis, its tables, and the extracts that its figures draw."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import chi2

from data.units import unit_label
from diagnosis.findings.schema import Finding, FoundParameter, LeftOutRms, NextExperiment
from diagnosis.policy import POLICY
from reports.labels import NOTHING, between, count, listed, number, percent, three_digits
from reports.layout import Column, Row, Table
from reports.twin.tables import quantity

# Mastrandrea et al. 2010, IPCC guidance note on uncertainties, table 1: lower bound of the probability, its term.
_LIKELIHOOD = (
    (0.99, "virtually certain"), (0.95, "extremely likely"), (0.90, "very likely"), (0.66, "likely"),
    (0.50, "more likely than not"), (0.33, "about as likely as not"), (0.10, "unlikely"), (0.0, "very unlikely"),
)  # fmt: skip
_FREE = ("free_flux", "free_shift")  # regressions, whose sizes are per unit of their drivers
NARROW = "\u202f"  # a space that does not break
CHIPS = {
    "consistent": "consistent", "explained": "explained", "partly_explained": "partly explained",
    "unlisted": "not in the library", "undecidable": "undecided",
}  # fmt: skip
_ALTERNATIVES = {
    "wrong_parameter": "a wrong parameter", "free_flux": "missing heat of no listed mechanism",
    "free_shift": "missing displacement of no listed mechanism", "unlisted": "no listed mechanism",
}  # fmt: skip

METHOD = (
    "The simulation was first given its best chance: its free parameters were recalibrated, and what refined twins of "
    "the same machine would show beyond it counts as structure, not as an effect.",
    "Every mechanism of the library was then tried at every place where it may act, together with sensor faults, "
    "clock shifts and wrong parameters as alternatives.",
    "The best were refitted in full; their gain is log evidence with structure integrated out.",
    "A finding is accepted when claims like it were true more often than not on other machines, and when no channel of "
    "a left-out run is predicted worse.",
    "Probabilities include “nothing is missing” and “not in the library”; candidates that these "
    "recordings cannot distinguish share theirs.",
)

GLOSSARY = (
    ("left out", "Fit on the other runs, predict this one; of it only the start is estimated, within its prior."),
    ("rms", "Root mean square of recorded − simulated over a left-out run, or over the rows of all of them. "
     "Displacements count from their first sample."),
    ("before, after", "The recalibrated simulation without and with what was found."),
    ("noise floor", "The rms that noise alone leaves to any simulation."),
    ("gain", "Rise of the log score (log likelihood) of the left-out runs, in nats; from the threshold on an "
     "effect is claimed."),
    ("absorbed", "Share of an effect's signature that recalibrating the other parameters imitates. Near 100 %, only "
     "its prior keeps it apart."),
    ("unexplained heat, displacement, reading", "What a smooth free input at that place would have to be to close the "
     "gap, the free parameters readjusted. + : the recording has more than the simulation."),
    ("z", "Such a value by its own standard deviation."),
    ("cluster", "Candidates whose signatures agree so closely that these recordings cannot distinguish them."),
    ("detection limit", "The least effect that these recordings would have shown."),
    ("autocorrelation", "How alike the residual is to itself some time later: 0 for noise, near 1 for physics that is "
     "missing."),
    ("likelihood terms", "After Mastrandrea et al. 2010: virtually certain from 99 %, extremely likely from 95 %, very "
     "likely from 90 %, likely from 66 %, more likely than not from 50 %."),
)  # fmt: skip


def likelihood(probability: float) -> str:
    """``very likely``, by the scale of the IPCC."""
    return next(term for least, term in _LIKELIHOOD if probability >= least)


def probability_label(probability: float) -> str:
    """``97 %``, never 0 or 100, and never broken over two lines."""
    percent = 100 * probability
    return ("> 99 %" if percent > 99 else "< 1 %" if percent < 1 else f"{percent:.0f} %").replace(" ", NARROW)


def most_left(rms: LeftOutRms) -> str:
    """The channel whose left-out error is the most times its noise: "z at 12 times its noise"; empty where all are
    noise, or no noise is known."""
    times = {k: v / n for k, v in rms.after.items() if v is not None and (n := rms.noise_floor.get(k))}
    key = max(times, key=lambda k: times[k], default="")
    if not key or times[key] <= POLICY.noise_max_ratio:
        return ""
    return f"{key.rpartition('_')[0]} at {times[key]:.2g} times its noise"


def headline(verdict: str, probabilities: Sequence[float], left: str = "") -> str:
    """The verdict as one line for the shop floor, as certain as its surest finding; the others may be fewer.

    `left`: what is left, as `most_left`.
    """
    remains = f"{left} is left" if left else ""
    n, most, least = len(probabilities), max(probabilities, default=1.0), min(probabilities, default=1.0)
    the = "Perhaps the" if most < POLICY.likely_probability else "Most likely the"
    the = "The" if most >= POLICY.plain_probability else the
    effects = "one effect" if n == 1 else f"{'up to ' if least < POLICY.plain_probability else ''}{_spelled(n)} effects"
    return {
        "consistent": "Consistent: no missing effect is supported by these runs" + (f"; {remains}." if left else "."),
        "explained": f"{the} simulation left out {effects}; with {'it' if n == 1 else 'them'} noise alone is left.",
        "partly_explained": f"{the} simulation left out {effects}; {remains or 'more than noise is left'}.",
        "unlisted": "Something is missing that no listed mechanism explains.",
        "undecidable": "Something is missing, but these recordings do not show what.",
    }[verdict]


def below_headline(verdict: str, runs: int, limits: int) -> str:
    """One sentence where a verdict has no finding to speak for it."""
    if verdict != "consistent":
        return ""
    text = f"In {count(runs, 'left-out run')} the simulation misses no more than noise and a coarse network leave"
    return text + ("; an effect above the limits below would be claimed." if limits else ".")


def place_label(kind: str, name: str) -> str:
    """``bed``, ``link bed-floor``, ``sensor z1``, ``error z``."""
    return name if kind == "node" else f"{kind} {name}"


def mechanism_label(key: str) -> str:
    """A mechanism's name for engineers, from the registry; alternatives that are no mechanism have their own."""
    from twin.mechanisms import MECHANISMS

    if key in _ALTERNATIVES:
        return _ALTERNATIVES[key]
    return MECHANISMS[key].summary if key in MECHANISMS else key.replace("_", " ")


def alternatives_label(others: Sequence[tuple[str, str, str, float]]) -> str:
    """``radiation at bed (2 %)`` for every (mechanism, kind, name, probability)."""
    said = [
        f"{mechanism_label(key)} at {place_label(kind, name)} ({probability_label(p)})" for key, kind, name, p in others
    ]
    return listed(said, 4)


def experiment_sentence(run: NextExperiment) -> str:
    """The run as a sentence, with its hours."""
    hours = "" if run.hours is None else f"; {run.hours:.3g} h in all"
    said = run.run[:1].upper() + run.run[1:].rstrip(".")
    return f"{said}{hours}."


def seconds_label(seconds: float) -> str:
    return f"{number(seconds, 0)} s" if seconds < 120 else f"{number(seconds / 60, 1)} min"


def _spelled(n: int) -> str:
    return {0: "no", 2: "two", 3: "three", 4: "four", 5: "five"}.get(n, str(n))


_MOST_CANDIDATES, _MOST_CHANNELS = 12, 10


def candidates(table: pd.DataFrame, simulated: bool, accepted: Mapping[tuple[str, str], float]) -> Table:
    """The best of everything that was tried; those accepted are marked.

    Args:
        table: the diagnosis' table of candidates.
        accepted: mechanism and place of what became a finding, with the finding's probability.
    """
    best = table.sort_values("rank", kind="stable")[:_MOST_CANDIDATES]
    shown = best.sort_values("gain", ascending=False, kind="stable")
    rows = [
        Row.of(
            str(r["words"]),
            _nats(r["gain"], sign=True),
            f"{int(r['improved'])} of {int(r['batches'])}",
            _amplitude(r, "amplitude"),
            percent(float(r["absorbed"])),
            _chance(accepted.get((str(r["mechanism"]), place(r)), float(r["probability"]))),
            f"{int(r['cluster'])}",
            mark="found" if (str(r["mechanism"]), place(r)) in accepted else "",
        )
        for r in shown.to_dict("records")
    ]
    columns = (
        Column("what may be missing", kind="wide"), Column("gain", "nats, left out", "number"),
        Column("runs better", "left out", "number"), Column("size", kind="number"),
        Column("absorbed", "by recalibrating", "number"), Column("probability", kind="number"),
        Column("cluster", kind="number"),
    )  # fmt: skip
    notes = ["Candidates of one cluster look the same in these recordings.", *_dimensionless(rows, 3)]
    if len(table) > len(shown):
        notes.append(f"Shown: the best {len(shown)} of {len(table)} that were refitted.")
    return Table("Candidates, best first", columns, tuple(rows), simulated, notes=tuple(notes))


def place(row: Mapping[Any, Any]) -> str:
    """The place by its name, or what follows the mechanism's key in a candidate's unique name."""
    return str(row["name"]).removeprefix(f"{row['mechanism']}_")


def _nats(value: Any, sign: bool = False) -> str:
    return number(float(value), 0 if abs(float(value)) >= 9.95 else 1, sign)


def _amplitude(row: Mapping[Any, Any], column: str) -> str:
    """``31.2 W``; of a free form per its drivers, as in its label: ``1.8e−07 µm per spindle_rpm^2``."""
    value, unit = float(row[column]), str(row["unit"])
    if not math.isfinite(value):
        return NOTHING
    drivers = []
    if str(row["mechanism"]) in _FREE and str(row["words"]).endswith(")"):
        terms = re.sub(r"\(T_[^)]*\)", "", str(row["words"])[:-1].partition(": ")[2].partition("(")[2]).split()
        drivers = [t for t in terms if t != "1" and not t.startswith("θ_")]
    per = f" per {' · '.join(drivers)}" if drivers else ""
    return quantity(float(f"{value:.3g}"), unit) + per


def _dimensionless(rows: Sequence[Row], column: int) -> list[str]:
    """A note where a size has no unit."""
    bare = any(re.fullmatch(r"[−\d.e+]+", str(r.cells[column])) for r in rows)
    return ["A size without a unit is dimensionless: a factor or a coefficient of the effect's equation."] * bare


def _chance(p: float) -> str:
    return probability_label(p) if math.isfinite(p) else NOTHING


def runs(rms: pd.DataFrame, channels: Sequence[str], changed: bool, simulated: bool) -> Table:
    """Left-out rms of every run (rows) and channel (columns, at most 10), before → after."""
    shown = list(channels[:_MOST_CHANNELS])
    unit = rms.drop_duplicates("channel").set_index("channel")["unit"]
    at = {(r["batch"], r["channel"]): (float(r["before"]), float(r["after"])) for r in rms.to_dict("records")}
    rows = []
    for batch in dict.fromkeys(rms["batch"]):
        cells = []
        for c in shown:
            before, after = at.get((batch, c), (math.nan, math.nan))
            digits = 1 if max(before, after) >= 0.95 else 2
            cells.append(f"{number(before, digits)} → {number(after, digits)}" if changed else number(after, digits))
        rows.append(Row.of(str(batch), *cells))
    columns = (Column("run"), *(Column(c, unit_label(unit[c]), "number") for c in shown))
    left = len(channels) - len(shown)
    notes = (f"Without {left} more channels, which change less.",) if left > 0 else ()
    return Table("Left-out rms of every run", columns, tuple(rows), simulated, notes=notes)


def steps(table: pd.DataFrame, simulated: bool) -> Table:
    """The search, step by step."""
    rows = []
    for r in table.to_dict("records"):
        gain, threshold = _nats(r["gain"], sign=True), _nats(r["threshold"])
        verdict = "accepted" if r["accepted"] else "rejected"
        sure, better = f"{100 * r['probability']:.0f} %", f"{int(r['improved'])}"
        rows.append(Row.of(f"{r['step']}", str(r["words"]), gain, threshold, sure, better, verdict))
    columns = (
        Column("step"), Column("tried", kind="wide"), Column("gain", "nats", "number"),
        Column("threshold", "nats", "number"), Column("probability", kind="number"),
        Column("runs better", kind="number"), Column("verdict"),
    )  # fmt: skip
    return Table("Steps of the search", columns, tuple(rows), simulated)


def refinements(table: pd.DataFrame, simulated: bool) -> Table:
    """What was made finer before any physics was named."""
    rows = [
        Row.of(str(r["what"]), str(r["why"]), _figure(r["before"]), _figure(r["after"]))
        for r in table.to_dict("records")
    ]
    columns = (
        Column("refined", kind="wide"), Column("why", kind="wide"),
        Column("left-out log score before (nats)", kind="number"), Column("after", kind="number"),
    )  # fmt: skip
    notes = ("A network that is too coarse looks like missing physics, so it is refined first.",)
    return Table("Refinements of the baseline", columns, tuple(rows), simulated, notes=notes)


def _figure(value: Any) -> str:
    return number(float(value), 2) if isinstance(value, int | float) else str(value)


def limits(table: pd.DataFrame, simulated: bool) -> Table:
    """The least effect that would be claimed, per candidate, and what hides it."""
    rows = []
    for r in table.to_dict("records"):
        limit, absorbed = _amplitude(r, "limit"), percent(float(r["absorbed"]))
        rows.append(Row.of(str(r["words"]), limit, absorbed, str(r["absorbed_by"] or NOTHING)))
    columns = (
        Column("effect", kind="wide"), Column("least that would be seen", kind="number"),
        Column("absorbed", "by recalibrating", "number"), Column("mostly by"),
    )  # fmt: skip
    return Table("Detection limits", columns, tuple(rows), simulated, notes=tuple(_dimensionless(rows, 1)))


def parameters(given: Mapping[str, FoundParameter], simulated: bool, caption: str) -> Table:
    """Fitted values with their 90 % intervals."""
    rows = []
    for name, p in given.items():
        unit = unit_label(p.unit)
        low, high = p.interval90 or (None, None)
        interval = (
            NOTHING if low is None or high is None else f"{three_digits(low)} to {three_digits(high)} {unit}".strip()
        )
        value = NOTHING if p.value is None else f"{three_digits(p.value)} {unit}".strip()
        rows.append(Row.of(name.replace("_", " "), value, interval))
    columns = (Column("parameter"), Column("value", kind="number"), Column("90 % interval", kind="number"))
    return Table(caption, columns, tuple(rows), simulated)


def windows(finding: Finding, label: str, simulated: bool) -> Table:
    """In which stretches of which runs a finding shows."""
    rows = [Row.of(batch, between(start_s, end_s)) for batch, start_s, end_s in finding.when.windows]
    return Table(f"{label}: windows", (Column("run"), Column("from, to", "h:min of the run")), tuple(rows), simulated)


CHANCE = 0.001  # a place is coloured where chance gives as much in fewer cases than this
SEEN_Z = 2.0  # a cell of where × when below it is pale


def by_channel(rms: pd.DataFrame) -> pd.DataFrame:
    """One row a channel, in order of appearance: unit, rows, before, after, floor over all rows, batches, improved.

    Args:
        rms: the diagnosis' table of left-out rms by batch and channel.
    """
    out = []
    for channel, part in rms.groupby("channel", sort=False):
        rows = part["rows"].to_numpy(float)
        kept = rows > 0
        square = [
            float(np.sqrt(np.average(part[k].to_numpy(float)[kept] ** 2, weights=rows[kept]))) if kept.any() else np.nan
            for k in ("before", "after", "floor")
        ]
        improved = int((part["after"] < part["before"]).sum())
        out.append((channel, part["unit"].iloc[0], int(rows.sum()), *square, len(part), improved))
    columns = ["channel", "unit", "rows", "before", "after", "floor", "batches", "improved"]
    return pd.DataFrame(out, columns=columns)


def by_change(channels: pd.DataFrame) -> pd.DataFrame:
    """The same rows, displacements first, the greatest change by the noise floor first."""
    change = (channels["before"] - channels["after"]).abs() / channels["floor"].replace(0.0, np.nan)
    ranked = channels.assign(change=change.fillna(0.0), kelvin=channels["unit"].isin(["K", "degC"]))
    return ranked.sort_values(["kelvin", "change"], ascending=[True, False], kind="stable").drop(columns="kelvin")


def telling(rms: pd.DataFrame, changed: bool, most: int = 3) -> list[tuple[str, str]]:
    """Batches worth drawing, each with the reason: the greatest change (or error) and the one of median change."""
    if rms.empty:
        return []
    size = (rms["before"] - rms["after"] if changed else rms["before"]) / rms["floor"].replace(0.0, np.nan)
    of_batch = size.groupby(rms["batch"], sort=False).mean().fillna(0.0).sort_values(ascending=False, kind="stable")
    what = "change" if changed else "error"
    names = [str(b) for b in of_batch.index]
    great = names[: max(min(most - 1, len(names) - 1), 1)]
    reasons = [f"greatest {what}", f"second greatest {what}", f"third greatest {what}"]
    chosen = list(zip(great, reasons, strict=False))
    typical = names[len(names) // 2]
    return chosen if typical in great else [*chosen, (typical, f"typical, median {what}")]


def chosen_channels(channels: pd.DataFrame, changed: bool, most: int = 4) -> list[str]:
    """Two to four channels that change most (without a change: that differ most), one displacement at least."""
    size = (channels["before"] - channels["after"] if changed else channels["before"]) / channels["floor"]
    ranked = channels.assign(size=size.fillna(0.0)).sort_values("size", ascending=False, kind="stable")
    strong = ranked[ranked["size"] > 0.1 * ranked["size"].max()] if len(ranked) else ranked
    names = [str(c) for c in (strong if len(strong) >= 2 else ranked)["channel"][:most]]
    errors = [str(c) for c in ranked["channel"][~ranked["unit"].isin(["K", "degC"])]]
    if errors and not set(errors) & set(names):
        names = [*names[: most - 1], errors[0]]
    return [str(c) for c in by_change(channels)["channel"] if c in names]


def mismatch(where: pd.DataFrame) -> pd.DataFrame:
    """One row a kind and place over all batches: unit, size (rms), mean, shown (whether chance can be ruled out).

    Args:
        where: the diagnosis' table "map"; only its rows by batch count.
    """
    out = []
    for (kind, place), part in where[where["by"] == "batch"].groupby(["kind", "place"], sort=False):
        value, z = part["value"].to_numpy(float), part["z"].to_numpy(float)
        good = np.isfinite(value) & np.isfinite(z)
        if not good.any():
            continue
        shown = float(chi2.sf(float(np.sum(z[good] ** 2)), int(good.sum()))) < CHANCE
        size = float(np.sqrt(np.mean(value[good] ** 2)))
        out.append((kind, place, part["unit"].iloc[0], size, float(np.mean(value[good])), shown))
    return pd.DataFrame(out, columns=["kind", "place", "unit", "size", "mean", "shown"])


def strongest(where: pd.DataFrame, kind: str, most: int) -> list[str]:
    """Places of a kind by their greatest |z|, at most `most`, in the table's order."""
    own = where[where["kind"] == kind]
    z = own["z"].abs().groupby(own["place"], sort=False).max().sort_values(ascending=False, kind="stable")
    chosen = set(z.index[:most])
    return [str(p) for p in dict.fromkeys(own["place"]) if p in chosen]


def ordered(where: pd.DataFrame, by: str) -> list[str]:
    """Labels of a group in the table's order."""
    return [str(x) for x in dict.fromkeys(where[where["by"] == by]["label"])]


def account_table(account: Mapping[str, Any], simulated: bool) -> Table | None:
    """A row for each batch, channel and check that took values away; `account` as `data.account.Account.as_dict`."""
    if not account.get("lost"):
        return None
    rows = tuple(
        Row.of(
            x["batch_id"], x["channel"], x["check"].replace("_", " "), x["state"], str(x["rows"]),
            f"{100 * x['share']:.2g}", f"{x['start_s'] / 3600:.2f} to {x['end_s'] / 3600:.2f}",
        )
        for x in account["lost"]
    )  # fmt: skip
    columns = (
        Column("batch"), Column("channel"), Column("check"), Column("state"), Column("rows", "", "number"),
        Column("of the batch", "%", "number"), Column("between", "h", "number"),
    )  # fmt: skip
    return Table("Values that are not used", columns, rows, simulated)
