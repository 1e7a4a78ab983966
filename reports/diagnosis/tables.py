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
from diagnosis.findings.schema import Alternative, Finding, LeftOutRms, NextExperiment
from diagnosis.policy import POLICY
from reports.labels import NOTHING, digits_of, number, percent, three_digits
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
    ("detection limit", "The least effect that these recordings would have shown."),
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
    the = "The" if most >= POLICY.unhedged_probability else the
    effects = (
        "one effect" if n == 1 else f"{'up to ' if least < POLICY.unhedged_probability else ''}{_spelled(n)} effects"
    )
    return {
        "consistent": "Consistent: no missing effect is supported by these runs" + (f"; {remains}." if left else "."),
        "explained": f"{the} simulation left out {effects}; with {'it' if n == 1 else 'them'} noise alone is left.",
        "partly_explained": f"{the} simulation left out {effects}; {remains or 'more than noise is left'}.",
        "unlisted": "Something is missing that no listed mechanism explains.",
        "undecidable": "Something is missing, but these recordings do not show what.",
    }[verdict]


def mechanism_label(key: str) -> str:
    """A mechanism's name for engineers, from the registry; alternatives that are no mechanism have their own."""
    from twin.mechanisms import MECHANISMS

    if key in _ALTERNATIVES:
        return _ALTERNATIVES[key]
    return MECHANISMS[key].summary if key in MECHANISMS else key.replace("_", " ")


def experiment_sentence(run: NextExperiment) -> str:
    """The run as a sentence, with its hours."""
    hours = "" if run.hours is None else f"; {run.hours:.3g} h in all"
    said = run.run[:1].upper() + run.run[1:].rstrip(".")
    return f"{said}{hours}."


def seconds_label(seconds: float) -> str:
    return f"{number(seconds, 0)} s" if seconds < 120 else f"{number(seconds / 60, 1)} min"


def _spelled(n: int) -> str:
    return {0: "no", 2: "two", 3: "three", 4: "four", 5: "five"}.get(n, str(n))


_MOST_CANDIDATES, _MOST_CHANNELS, _MOST_LIMITS = 12, 10, 30


def candidates(table: pd.DataFrame, accepted: Mapping[tuple[str, str], float]) -> Table:
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
            _chance(accepted.get((str(r["mechanism"]), place(r)), float(r["probability"]))),
            _amplitude(r, "amplitude"),
            _nats(r["gain"], sign=True),
            f"{int(r['improved'])} of {int(r['batches'])}",
            percent(float(r["absorbed"])),
            mark="found" if (str(r["mechanism"]), place(r)) in accepted else "",
        )
        for r in shown.to_dict("records")
    ]
    columns = (
        Column("what may be missing", kind="wide"), Column("probability", kind="number"), Column("size", kind="number"),
        Column("gain", "nats, left out", "number"), Column("runs better", "left out", "number"),
        Column("absorbed", "by recalibrating", "number"),
    )  # fmt: skip
    notes = ["Explanations that these recordings cannot distinguish share their probability.", *_dimensionless(rows, 2)]
    if len(table) > len(shown):
        notes.append(f"Shown: the best {len(shown)} of {len(table)} that were refitted.")
    return Table("Explanations that were tried", columns, tuple(rows), notes=tuple(notes))


_MOST_BARS = 6


def explanations(x: Finding) -> list[tuple[str, float]]:
    """A finding, its alternatives, nothing at all and no listed effect, with their probabilities."""
    rows = [(effect_label(x), x.probability)]
    rows += [(effect_label(o) + (" (not distinguishable)" if o.alike else ""), o.probability) for o in x.alternatives]
    others = {"nothing is missing": "probability_nothing", "not in the library": "probability_unlisted"}
    rows = rows[: _MOST_BARS - len(others)]
    return rows + [(label, float(x.evidence[key])) for label, key in others.items() if x.evidence.get(key) is not None]


def effect_label(x: Finding | Alternative) -> str:
    """``heat to the floor at bed``, ``poorly bonded sensor: column_front``, ``bending of a column in the z error``."""
    what, name = mechanism_label(x.mechanism), x.where.name
    place = {"sensor": f": {name}", "error": f" in the {name} error", "link": f" at the link {name}"}
    return what + place.get(x.where.kind, f" at {name}")


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


def runs(rms: pd.DataFrame, changed: bool) -> Table:
    """Left-out rms of every run (rows) and channel (columns, the 10 that change most), before → after, and of all."""
    channels = by_change(by_channel(rms))
    shown = channels[:_MOST_CHANNELS].to_dict("records")
    at = {(r["batch"], r["channel"]): r for r in rms.to_dict("records")}
    rows = [Row.of("noise", *(number(c["floor"], digits_of(c["floor"])) for c in shown))]
    rows.append(Row.of("all runs", *(_rms(c, changed) for c in shown), look="marked"))
    for batch in dict.fromkeys(rms["batch"]):
        cells = (at.get((batch, c["channel"])) for c in shown)
        rows.append(Row.of(str(batch), *(NOTHING if r is None else _rms(r, changed) for r in cells)))
    columns = (Column("run"), *(Column(str(c["channel"]), unit_label(str(c["unit"])), "number") for c in shown))
    left = len(channels) - len(shown)
    notes = (f"Without {left} more channels, which change less.",) if left > 0 else ()
    return Table("Left-out rms", columns, tuple(rows), notes=notes)


def _rms(r: Mapping[Any, Any], changed: bool) -> str:
    digits = digits_of(r["before"], r["after"])
    after = number(r["after"], digits)
    return f"{number(r['before'], digits)} → {after}" if changed else after


_MOST_ERRORS, _TELLING = 3, 0.1  # a change by the noise floor


def error_lines(rms: pd.DataFrame, changed: bool) -> tuple[str, ...]:
    """``z 6.2 → 1.3 µm, noise 1.2 µm`` of the channels that change most; where nothing does, that differ most."""
    if rms.empty:
        return ()
    ranked = by_change(by_channel(rms))
    telling = ranked[ranked["change"] > _TELLING]
    ranked = telling if changed and len(telling) else ranked
    return tuple(
        f"{r['channel']} {_rms(r, changed)} {unit_label(str(r['unit']))}, noise "
        f"{number(r['floor'], digits_of(r['floor']))} {unit_label(str(r['unit']))}"
        for r in ranked[:_MOST_ERRORS].to_dict("records")
    )


def steps(table: pd.DataFrame) -> Table:
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
    return Table("Steps of the search", columns, tuple(rows))


def limits(table: pd.DataFrame) -> Table:
    """The least effect that would be claimed, of each mechanism at the place where that is least, and what hides it."""
    own_best = table[table["limit"].notna()].drop_duplicates("mechanism")
    rows = []
    for r in (own_best if len(own_best) else table)[:_MOST_LIMITS].to_dict("records"):
        limit, absorbed = _amplitude(r, "limit"), percent(float(r["absorbed"]))
        rows.append(Row.of(str(r["words"]), limit, absorbed, str(r["absorbed_by"] or NOTHING)))
    columns = (
        Column("effect", kind="wide"), Column("least that would be seen", kind="number"),
        Column("absorbed", "by recalibrating", "number"), Column("mostly by"),
    )  # fmt: skip
    notes = ["A smaller effect may be there: these recordings would not show it.", *_dimensionless(rows, 1)]
    if len(table) > len(rows):
        notes.append("Of each mechanism the place where the least would be claimed; findings.json has all.")
    return Table("Detection limits", columns, tuple(rows), notes=tuple(notes))


def parameters(found: Sequence[Finding]) -> Table:
    """Fitted values of all findings with their 90 % intervals."""
    rows = []
    for k, x in enumerate(found, 1):
        for name, p in x.parameters.items():
            unit = unit_label(p.unit)
            low, high = p.interval90 or (None, None)
            interval = NOTHING
            if low is not None and high is not None:
                interval = f"{three_digits(low)} to {three_digits(high)} {unit}".strip()
            value = NOTHING if p.value is None else f"{three_digits(p.value)} {unit}".strip()
            rows.append(Row.of(f"{k}. {name.replace('_', ' ')}", value, interval))
    columns = (Column("parameter"), Column("value", kind="number"), Column("90 % interval", kind="number"))
    return Table("Parameters of the findings", columns, tuple(rows))


CHANCE = 0.001  # a place is coloured where chance gives as much in fewer cases than this


def by_channel(rms: pd.DataFrame) -> pd.DataFrame:
    """One row a channel, in order of appearance: unit, rows, before, after, floor over all rows, batches, improved.

    Args:
        rms: the diagnosis' table of left-out rms by batch and channel.
    """
    kinds = ["before", "after", "floor"]
    square = rms[kinds].pow(2).mul(rms["rows"], axis=0)
    groups = rms.assign(batches=1, improved=rms["after"] < rms["before"], **square).groupby("channel", sort=False)
    out = groups[["rows", *kinds, "batches", "improved"]].sum()
    out[kinds] = np.sqrt(out[kinds].div(out["rows"].replace(0, np.nan), axis=0))
    return out.assign(unit=groups["unit"].first()).reset_index()


def by_change(channels: pd.DataFrame) -> pd.DataFrame:
    """The same rows, displacements first, the greatest change by the noise floor first."""
    change = (channels["before"] - channels["after"]).abs() / channels["floor"].replace(0.0, np.nan)
    ranked = channels.assign(change=change.fillna(0.0), kelvin=channels["unit"].isin(["K", "degC"]))
    return ranked.sort_values(["kelvin", "change"], ascending=[True, False], kind="stable").drop(columns="kelvin")


def most_changed(rms: pd.DataFrame, changed: bool) -> str:
    """The batch of the greatest change by the noise floor (without a change: of the greatest error)."""
    size = (rms["before"] - rms["after"] if changed else rms["before"]) / rms["floor"].replace(0.0, np.nan)
    of_batch = size.groupby(rms["batch"], sort=False).mean().fillna(0.0)
    return str(of_batch.idxmax())


def chosen_channels(channels: pd.DataFrame, changed: bool, most: int = 3) -> list[str]:
    """Two or three channels that change most (without a change: that differ most), one displacement at least."""
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


def account_table(account: Mapping[str, Any]) -> Table | None:
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
    return Table("Values that are not used", columns, rows)
