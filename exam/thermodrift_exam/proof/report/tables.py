"""An opened proof as data of its page: its tables, the extracts for its figures, its goals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pandas as pd

from data.errors import WorkError
from reports.labels import NOTHING, number, p_label, percent
from reports.layout import Column, Gauge, Row, Table
from thermodrift_exam.proof.report.labels import (
    ENDED,
    KIND_WORDS,
    NOT_SEALED,
    PARTIAL,
    key_label,
    measured,
    plant_label,
    plant_letter,
    plant_origin,
    simulated,
    stamp,
)
from thermodrift_exam.proof.spec import PLANT_KINDS, UNSEEN

# The columns that the page reads; others may be present, and any table may be absent or empty.
TABLES: Mapping[str, tuple[str, ...]] = {
    "ledger": ("time", "step", "words"),
    "outcomes": ("case", "kind", "plant", "effect", "verdict", "failed", "seconds", "visible", "probability",
                 "error_before", "error_after", "error_true", "error_floor", "limit_share"),
    "terms": ("case", "kind", "plant", "effect", "mechanism", "place", "visible", "limit_share", "decoy", "found",
              "amplitude_true", "amplitude_found", "low90", "high90"),
    "goals": ("measure", "goal", "wanted", "better", "value", "low90", "high90", "n", "met", "informed",
              "informed_n", "plant"),
    "compared": ("method", "group", "measure", "value", "low90", "high90", "n"),  # group: diagnosis, baseline, ablation
    "reliability": ("low", "high", "claimed", "right", "low90", "high90", "n"),
    "confusion_mechanism": ("true", "named", "count"),
    "confusion_place": ("true", "named", "count"),
    "missed": ("case", "plant", "kind", "effect", "place", "gain_nats", "bar_nats", "named_mechanism", "named_place",
               "told_gain_nats", "reason"),
    "claims": ("case", "plant", "kind", "mechanism", "place", "probability", "gain_nats", "true"),
    "leak": ("question", "auc", "low90", "high90", "chance", "p", "n"),
    "convergence": ("plant", "quantity", "refined", "size", "unit", "error", "order"),  # refined: grid or step
    "worst": ("case", "plant", "effect", "why"),
    "series": ("case", "batch", "channel", "unit", "time_s", "recorded", "before", "after"),  # of the worst cases
    "windows": ("case", "batch", "start_s", "end_s"),  # when a worst case's effects work; none: always
}  # fmt: skip


@dataclass(frozen=True)
class ProofRun:
    """A proof that has been opened.

    Args:
        root: hexadecimal, published before the run.
        suite: the seed of a development suite is known, that of a sealed one secret.
        cases: number of sealed cases; `outcomes` holds those that count.
        sealed, opened: UTC, to the second.
        version: of thermodrift.
        source_digest: digest of the source that answered.
        partial: opened before every case had an answer.
        until: UTC; no case began after this time, which was stated before the first answer.
        isolation: protection of the answering process -> cases that ran under it.
        void: case -> reason why it does not count.
        failed: case -> its error in one line; it counts as a wrong answer.
        tables: by the keys of `TABLES`.

    Raises:
        WorkError: a table that lacks a column.
    """

    root: str
    suite: Literal["development", "sealed"]
    cases: int
    sealed: str
    opened: str
    version: str
    source_digest: str
    partial: bool = False
    until: str | None = None
    isolation: Mapping[str, int] = field(default_factory=dict)
    void: Mapping[str, str] = field(default_factory=dict)
    failed: Mapping[str, str] = field(default_factory=dict)
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What to know before the figures: how the suite was drawn, and where answering or opening ended early."""
        return (
            *([NOT_SEALED] if self.suite != "sealed" else []),
            *([PARTIAL] if self.partial else []),
            *([] if self.until is None else [ENDED.format(until=stamp(self.until))]),
        )

    def __post_init__(self) -> None:
        for name, table in self.tables.items():
            if name not in TABLES:
                raise WorkError(f"proof report: got a table {name!r}, expected one of {', '.join(TABLES)}")
            missing = [c for c in TABLES[name] if c not in table.columns]
            if len(table) and missing:
                raise WorkError(
                    f"proof report, table {name}: got columns {', '.join(map(str, table.columns))}, "
                    f"expected also {', '.join(missing)}; score the proof again"
                )

    def table(self, name: str) -> pd.DataFrame:
        """The table, or one without rows."""
        return self.tables.get(name, pd.DataFrame(columns=list(TABLES[name])))

    @property
    def plants(self) -> tuple[str, ...]:
        """The plants with a case that counts, in the order of `PLANT_KINDS`."""
        there = set(self.table("outcomes")["plant"])
        return tuple(p for p in PLANT_KINDS if p in there)

    @property
    def goal_columns(self) -> tuple[str, ...]:
        """The groups of cases with a column of goals: the unseen kinds of machines together, then every plant."""
        return (*([UNSEEN] if (self.table("goals")["plant"] == UNSEEN).any() else []), *self.plants)


_RARE = 0.05


def cases(outcomes: pd.DataFrame, plants: Sequence[str]) -> Table:
    """Number of cases of each kind on each plant, and of entirely right answers."""
    columns = [Column("concealed"), *(Column(plant_letter(p), plant_origin(p), "number") for p in plants),
               Column("all", kind="number"), Column("visible", kind="number")]  # fmt: skip
    judged = "right" in outcomes.columns and outcomes["right"].notna().any()
    columns += [Column("entirely right", kind="number")] if judged else []
    rows = []
    kinds = [k for k in KIND_WORDS if (outcomes["kind"] == k).any()]
    for kind in [*kinds, *sorted(set(outcomes["kind"]) - set(kinds)), ""]:
        own = outcomes[outcomes["kind"] == kind] if kind else outcomes
        right = own["right"].dropna().astype(bool) if judged else ()
        cells = [KIND_WORDS.get(kind, key_label(kind)) if kind else "all cases"]
        cells += [f"{int((own['plant'] == p).sum())}" for p in plants]
        cells += [f"{len(own)}", f"{int(own['visible'].eq(True).sum())}"]
        cells += [f"{int(sum(right))} of {len(right)}" if len(right) else NOTHING] if judged else []
        rows.append(Row(tuple(cells)))
    notes = (f"Plants: {'; '.join(f'{plant_label(p)} ({plant_origin(p)})' for p in plants)}.",)
    return Table("Cases by kind and plant", tuple(columns), tuple(rows), notes=notes)


def ledger(table: pd.DataFrame) -> Table:
    """The steps of the chained ledger with their times."""
    rows = [Row.of(_time(str(r["time"])), str(r["step"]), str(r["words"])) for r in table.to_dict("records")]
    columns = (Column("UTC"), Column("step"), Column("what", kind="wide"))
    notes = ("Every line of the ledger holds the hash of the line before it.",)
    return Table("From sealing to opening", columns, tuple(rows), notes=notes)


def uncounted(run: ProofRun) -> Table | None:
    """Void and failed cases with the reason; None if there are none."""
    rows = [Row.of(case, "void, left out", why) for case, why in sorted(run.void.items())]
    rows += [Row.of(case, "failed, counts as wrong", why) for case, why in sorted(run.failed.items())]
    if not rows:
        return None
    columns = (Column("case"), Column("it is"), Column("why", kind="wide"))
    return Table("Void and failed cases", columns, tuple(rows))


def leak(table: pd.DataFrame, plants: Sequence[str]) -> Table:
    """Performance of a classifier on names, sizes and inputs alone; 0.5 is chance."""
    rows = [
        Row.of(
            key_label(str(r["question"])),
            number(_float(r["auc"]), 2),
            _range(r["low90"], r["high90"], 2),
            number(_float(r["chance"]), 2),
            p_label(_float(r["p"])) if math.isfinite(_float(r["p"])) else NOTHING,
            f"{int(r['n'])}",
        )
        for r in table.to_dict("records")
    ]
    columns = (
        Column("predicted quantity", kind="wide"), Column("area under its curve", kind="number"),
        Column("90 %", kind="number"), Column("by chance", kind="number"),
        Column("p (permutations)", kind="number"), Column("cases", kind="number"),
    )  # fmt: skip
    low = int((table["p"] < _RARE).sum())
    notes = (
        "Its features are names, sizes, row counts, gaps and inputs, no temperatures and displacements. By chance: its "
        "area after permutation of the answers.",
        f"Fewer than {percent(_RARE)} of the permutations do as well for {low} of {len(table)} questions; chance alone "
        f"gives about {_RARE * len(table):.1f}.",
    )
    return Table("Leak test", columns, tuple(rows), simulated(plants), notes=notes)


def convergence(table: pd.DataFrame) -> Table:
    """Numerical errors of the plants from coarse to fine, with observed orders; a row per study."""
    rows = []
    for (plant, quantity, refined), own in table.groupby(["plant", "quantity", "refined"], sort=False):
        unit = str(own["unit"].iloc[0])
        sizes = " → ".join(f"{_float(v):g}" for v in own["size"])
        errors = " → ".join(f"{_float(v):.2g}" for v in own["error"])
        orders = ", ".join(number(_float(v), 2) for v in own["order"].dropna())
        name = str(quantity).replace(", um", ", µm")
        rows.append(Row.of(plant_label(str(plant)), name, str(refined), f"{sizes} {unit}", errors, orders or NOTHING))
    columns = (Column("plant"), Column("quantity", kind="wide"), Column("refined"), Column("size", kind="number"),
               Column("error", kind="number"), Column("observed orders", kind="number"))  # fmt: skip
    notes = ("An error is against a closed form or the finest of the study; the order is its rate of convergence.",)
    return Table("Numerical convergence of the plants", columns, tuple(rows), True, notes=notes)


def _range(low: object, high: object, digits: int) -> str:
    a, b = _float(low), _float(high)
    return f"{number(a, digits)} to {number(b, digits)}" if math.isfinite(a) and math.isfinite(b) else NOTHING


def _time(stamp: str) -> str:
    return stamp.replace("T", " ").removesuffix("Z").split("+")[0].split(".")[0]


def _float(value: object) -> float:
    return math.nan if value is None or pd.isna(value) else float(value)  # type: ignore[call-overload, arg-type]


SIZES = ("below 1×", "1 to 2×", "2 to 4×", "4 to 10×", "above 10×")
_EDGES = (0.0, 1.0, 2.0, 4.0, 10.0, np.inf)
_MOST_ROWS = 34
NOTHING_NAMED, UNLISTED, OTHER = "nothing", "unlisted", "other"
_MOST_RUNS = 4


def detection_by_size(terms: pd.DataFrame) -> pd.DataFrame:
    """effect, size (of `SIZES`), found, n for every true term of known size; `all effects` first, then by registry."""
    known = terms[terms["limit_share"].notna() & ~terms["decoy"].astype(bool)]
    share = known["limit_share"].astype(float)
    known = known.assign(size=pd.cut(share, list(_EDGES), labels=list(SIZES), right=False).astype(str),
                         found=known["found"].fillna(False).astype(bool))  # fmt: skip
    parts = [known.assign(effect="all effects"), known]
    counted = pd.concat(parts).groupby(["effect", "size"], sort=False)["found"].agg(["sum", "count"]).reset_index()
    counted = counted.rename(columns={"sum": "found", "count": "n"})
    order = {e: k for k, e in enumerate(["all effects", *_by_group(set(known["effect"]))])}
    places = [(order[e], SIZES.index(s)) for e, s in zip(counted["effect"], counted["size"], strict=True)]
    return counted.iloc[sorted(range(len(counted)), key=places.__getitem__)].reset_index(drop=True)


def with_amplitude(terms: pd.DataFrame) -> pd.DataFrame:
    """Visible terms with an amplitude: ratio found / true, both in detection limits, whether the interval holds it."""
    columns = ["amplitude_true", "amplitude_found", "low90", "high90", "limit_share"]
    out = terms[terms["visible"].eq(True)].copy()
    out[columns] = out[columns].apply(pd.to_numeric, errors="coerce").astype(float)
    out = out[out["amplitude_found"].notna() & out["amplitude_true"].notna() & (out["amplitude_true"] != 0)]
    true = out["amplitude_true"]
    out["ratio"] = (out["amplitude_found"] / true).clip(lower=1e-3)
    scale = out["limit_share"] / true
    out["true_limits"] = out["limit_share"]
    out["found_limits"] = out["ratio"] * out["limit_share"]
    ends = np.sort(np.stack([out["low90"] * scale, out["high90"] * scale]), axis=0)
    out["low_limits"], out["high_limits"] = np.maximum(ends[0], 1e-3 * out["limit_share"]), ends[1]
    known = out["low90"].notna() & out["high90"].notna()
    out["covers"] = ((out["low90"] <= true) & (true <= out["high90"])).where(known)
    order = {e: k for k, e in enumerate(_by_group(set(out["effect"])))}
    return out.sort_values("effect", key=lambda c: c.map(order), kind="stable").reset_index(drop=True)


def mechanism_matrix(counts: pd.DataFrame) -> tuple[pd.DataFrame, list[int]]:
    """Concealed (rows) against named (columns), ordered by the groups of the registry; then the columns that are only
    named, `unlisted` and `nothing`. With it the rows after which a group ends.
    """
    names = _by_group(set(counts["true"]) | set(counts["named"]))
    wide = _wide(counts)
    rows = [n for n in names if n in wide.index]
    order = [*rows, *(n for n in names if n not in rows and n in wide.columns)]
    ordered = wide.reindex(index=rows, columns=order, fill_value=0)
    own = [_group(n) for n in rows]
    ends = [k for k in range(1, len(rows)) if own[k] != own[k - 1]]
    return ordered, [*ends, len(rows)]


def place_matrix(counts: pd.DataFrame) -> tuple[pd.DataFrame, list[int]]:
    """The same for places, by name; the rarest are merged as `other`."""
    total = pd.concat([counts.groupby("true")["count"].sum(), counts.groupby("named")["count"].sum()])
    often = (
        total.groupby(level=0).sum().drop(NOTHING_NAMED, errors="ignore").sort_values(ascending=False, kind="stable")
    )
    kept = {*often.index[:_MOST_ROWS], NOTHING_NAMED}
    folded = counts.assign(true=counts["true"].where(counts["true"].isin(kept), OTHER),
                           named=counts["named"].where(counts["named"].isin(kept), OTHER))  # fmt: skip
    wide = _wide(folded)
    rows = sorted(wide.index, key=_place_order)
    order = [*rows, *sorted(set(wide.columns) - set(rows), key=_place_order)]
    return wide.reindex(index=rows, columns=order, fill_value=0), [len(rows)]


def worst_channel(series: pd.DataFrame) -> pd.DataFrame:
    """The channel of one case whose residual after the diagnosis is largest relative to its noise (of differences), in
    its worst runs, in their order.
    """
    left = series.assign(after_left=(series["recorded"] - series["after"]).astype(float))
    by_channel = left.groupby("channel", sort=False)["after_left"]
    size = by_channel.agg(_rms) / by_channel.agg(_roughness)
    own = left[left["channel"] == size.idxmax()]
    rms = own.groupby("batch", sort=False)["after_left"].agg(_rms)
    chosen = set(rms.sort_values(ascending=False, kind="stable").index[:_MOST_RUNS])
    return own[own["batch"].isin(chosen)].drop(columns="after_left").reset_index(drop=True)


def _rms(residual: pd.Series) -> float:
    return float(np.sqrt(np.nanmean(residual.to_numpy(float) ** 2)))


def _roughness(residual: pd.Series) -> float:
    """Median absolute difference from row to row, a robust measure of noise; 1 where the recording is constant."""
    steps = np.abs(np.diff(residual.to_numpy(float)))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return float(np.median(steps)) if len(steps) else 1.0


def _wide(counts: pd.DataFrame) -> pd.DataFrame:
    return counts.pivot_table(index="true", columns="named", values="count", aggfunc="sum", fill_value=0)


def _by_group(names: set[str]) -> list[str]:
    """Mechanisms in the registry's order, which is by groups; then others by name; `unlisted`, `nothing` last."""
    from twin.mechanisms import MECHANISMS

    keys = list(MECHANISMS)
    last = {OTHER: 1, UNLISTED: 2, NOTHING_NAMED: 3}
    return sorted(names, key=lambda n: (last.get(n, 0), keys.index(n) if n in keys else len(keys), n))


def _group(name: str) -> str:
    """The module of a mechanism."""
    from twin.mechanisms import MECHANISMS

    if name in MECHANISMS:
        module: str = MECHANISMS[name].__module__
        return module
    return "last" if name in (OTHER, UNLISTED, NOTHING_NAMED) else ""


def _place_order(place: str) -> tuple[int, str]:
    return {OTHER: 1, UNLISTED: 2, NOTHING_NAMED: 3}.get(place, 0), place


_WIDTH = 100.0


@dataclass(frozen=True)
class Cell:
    """A value as it is shown; `met` is yes, no or empty where it is not known."""

    value: str
    interval: str
    n: str
    met: str
    bar: Gauge | None = None


_NONE = Cell(NOTHING, "", "", "")


@dataclass(frozen=True)
class GoalRow:
    """One goal: a cell over all plants, one for the true model, and one for each plant."""

    measure: str
    goal: str
    whole: Cell
    informed: Cell
    plants: tuple[Cell, ...]


def goal_rows(goals: pd.DataFrame, plants: Sequence[str]) -> tuple[GoalRow, ...]:
    """The rows in the table's order."""
    out = []
    for measure, part in goals.groupby("measure", sort=False):
        by_plant = {str(r["plant"]): r for r in part.to_dict("records")}
        first = next(iter(by_plant.values()))
        every = [_cell(by_plant.get(p), False) for p in plants]
        out.append(
            GoalRow(
                str(measure),
                str(first["goal"]),
                _cell(by_plant.get("all"), True),
                _informed(by_plant.get("all")),
                tuple(every),
            )
        )
    return tuple(out)


def counted(goals: pd.DataFrame) -> tuple[int, int, int]:
    """Goals met, missed, and not measured, over all plants."""
    met = goals.loc[goals["plant"] == "all", "met"]
    yes, no = int(met.eq(True).sum()), int(met.eq(False).sum())
    return yes, no, len(met) - yes - no


def shortfalls(goals: pd.DataFrame, plant: str = "all") -> list[str]:
    """``detection, visible: 95.5 %, goal ≥ 97 %`` for every goal that was missed."""
    missed = goals[(goals["plant"] == plant) & goals["met"].eq(False)]
    return [f"{r['measure']}: {_value(r)}, goal {r['goal']}" for r in missed.to_dict("records")]


def _cell(r: Mapping[Any, Any] | None, picture: bool) -> Cell:
    if r is None or not math.isfinite(_float(r["value"])):
        return _NONE
    low, high = _float(r["low90"]), _float(r["high90"])
    known = math.isfinite(low) and math.isfinite(high)
    interval = _interval(r, low, high) if known else ""
    met = "" if pd.isna(r["met"]) else "yes" if bool(r["met"]) else "no"
    return Cell(_value(r), interval, f"{int(r['n'])}", met, _bar(r, low, high) if picture else None)


def _informed(r: Mapping[Any, Any] | None) -> Cell:
    value = math.nan if r is None else _float(r["informed"])
    return Cell(_value(r, value), "", f"{int(r['informed_n'])}", "") if r and math.isfinite(value) else _NONE


def _value(r: Mapping[Any, Any], value: float | None = None) -> str:
    return measured(_float(r["value"]) if value is None else value, str(r["goal"]), _float(r["wanted"]))


def _interval(r: Mapping[Any, Any], low: float, high: float) -> str:
    """``93.6 to 97.4 %``: the unit once."""
    first, last = _value(r, low), _value(r, high)
    unit = last.partition(" ")[2]
    return f"{first.removesuffix(f' {unit}') if unit else first} to {last}"


def _bar(r: Mapping[Any, Any], low: float, high: float) -> Gauge:
    value, wanted = _float(r["value"]), _float(r["wanted"])
    low, high = (low, high) if math.isfinite(low) and math.isfinite(high) else (value, value)
    share = "%" in str(r["goal"]) and wanted > 0.5
    first = max(0.0, min(wanted - 3 * (1 - wanted), low - 0.02)) if share else 0.0
    last = 1.0 if share else 1.1 * max(2 * wanted, high, value)

    def at(x: float) -> float:
        return round(_WIDTH * min(max((x - first) / (last - first), 0.0), 1.0), 1) if math.isfinite(x) else 0.0

    return Gauge((at(low), at(high)), (("wanted", at(wanted)),), (at(value),))
