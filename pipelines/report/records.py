"""Tables of records: what the checks found, what was left out, what became of earlier trainings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from models.result import GridResult
from pipelines.promotion import Choice
from pipelines.report.layout import Column, Row, Table
from pipelines.report.words import between, cell_label, count, number, plus_minus
from pipelines.tracking import Training

_FINDING_KEYS = ["batch_id", "check", "channel", "start_s", "end_s", "words", "masks", "overruled"]


def findings_of(results: Sequence[GridResult]) -> pd.DataFrame:
    """The findings of all results, each once, by machine, batch and channel."""
    parts = [r.findings.reindex(columns=_FINDING_KEYS).assign(machine=r.machine) for r in results if len(r.findings)]
    if not parts:
        return pd.DataFrame(columns=[*_FINDING_KEYS, "machine"])
    every = pd.concat(parts, ignore_index=True).drop_duplicates()
    return every.sort_values(["machine", "batch_id", "channel", "start_s"], kind="stable").reset_index(drop=True)


def findings_words(found: pd.DataFrame, n_batches: int) -> str:
    """One sentence about all findings."""
    if found.empty:
        return f"The checks raised no finding in {count(n_batches, 'batch')}; every recorded sample was used."
    overruled = found["overruled"].map(_text).astype(bool)
    masked = int((found["masks"].map(_yes) & ~overruled).sum())
    with_any = found[["machine", "batch_id"]].drop_duplicates()
    where = f"{count(len(found), 'finding')} in {len(with_any)} of {count(n_batches, 'batch')}"
    words = f"{where}: {masked} masked for training"
    noted = len(found) - masked - int(overruled.sum())
    words += f", {noted} noted only" if noted else ""
    return words + (f", {int(overruled.sum())} overruled by the machine file" if overruled.any() else "") + "."


def findings(found: pd.DataFrame, simulated: bool) -> Table:
    """Every finding: where, when, what, and whether it was masked."""
    rows = [
        Row(
            (
                str(f["batch_id"]),
                _text(f["channel"]) or "all channels",
                str(f["check"]).replace("_", " "),
                between(_time(f["start_s"]), _time(f["end_s"])),
                _text(f["words"]),
                _effect(f),
            )
        )
        for f in found.to_dict("records")
    ]
    columns = (
        Column("batch"),
        Column("channel"),
        Column("check"),
        Column("when", "h:min from start"),
        Column("what was found", "", "wide"),
        Column("for training"),
    )
    return Table("Every finding", columns, tuple(rows), simulated)


def findings_by_channel(found: pd.DataFrame, simulated: bool) -> Table:
    """The findings counted per check and channel."""
    table = found.assign(
        channel=found["channel"].map(lambda c: _text(c) or "all channels"),
        overruled=found["overruled"].map(_text).astype(bool),
    )
    table["masked"] = table["masks"].map(_yes) & ~table["overruled"]
    rows = []
    for (check, channel), part in table.groupby(["check", "channel"], sort=True):
        rows.append(
            Row(
                (
                    str(check).replace("_", " "), str(channel), str(len(part)), str(part["batch_id"].nunique()),
                    str(int(part["masked"].sum())), str(int(part["overruled"].sum())),
                )
            )
        )  # fmt: skip
    columns = (
        Column("check"),
        Column("channel"),
        Column("findings", "", "number"),
        Column("batches", "", "number"),
        Column("masked", "", "number"),
        Column("overruled", "", "number"),
    )
    return Table("Findings per check and channel", columns, tuple(rows), simulated)


def excluded(results: Sequence[tuple[str, GridResult]], simulated: bool) -> Table:
    """Channels that no cell may use, batches and folds left out, families that failed, with the error channels."""
    of: dict[tuple[str, str], list[str]] = {}
    for name, result in results:
        for row in result.excluded.to_dict("records"):
            targets = of.setdefault((str(row["channel"]), str(row["reason"])), [])
            if name not in targets:
                targets.append(name)
    rows = [
        Row((what, why, "all" if len(targets) == len(results) > 1 else ", ".join(targets)))
        for (what, why), targets in of.items()
    ]
    columns = (Column("what"), Column("why", "", "wide"), Column("error channel"))
    return Table("Left out: channels, folds and failed families", columns, tuple(rows), simulated)


def trainings(rows: Sequence[tuple[Training, Choice, int]]) -> Table:
    """The trainings of one channel, newest first."""
    out = []
    for i, (t, choice, digits) in enumerate(rows):
        earlier = rows[i + 1][0].result.batches if i + 1 < len(rows) else None
        new, gone = changed_batches(t.result.batches, earlier) if earlier is not None else ([], [])
        p = t.promotion
        out.append(
            Row(
                (
                    f"{t.started:%Y-%m-%d %H:%M}",
                    str(len(t.result.batches)),
                    f"+{len(new)}" + (f" −{len(gone)}" if gone else "") if earlier is not None else "–",
                    cell_label(choice.selector, choice.family, choice.n_tsp),
                    plus_minus(choice.S_mean_um, choice.S_std_um, digits),
                    f"{p['outcome']} (version {p['version']})" if p else "not promoted",
                )
            )
        )
    columns = (
        Column("trained (UTC)"),
        Column("batches", "", "number"),
        Column("new batches", "", "number"),
        Column("model"),
        Column("S_mean ± S_std", "µm", "number"),
        Column("outcome"),
    )
    caption = "The trainings, each judged on its own batches"
    return Table(caption, columns, tuple(out), rows[0][0].simulated)


def changed_batches(now: pd.DataFrame, earlier: pd.DataFrame) -> tuple[list[str], list[str]]:
    """Batches of now that the earlier training lacked (or knew with other content), and those that are gone."""
    a = dict(zip(now["batch_id"].astype(str), now["digest"].astype(str), strict=True))
    b = dict(zip(earlier["batch_id"].astype(str), earlier["digest"].astype(str), strict=True))
    return [k for k, digest in a.items() if b.get(k) != digest], [k for k in b if k not in a]


def _effect(finding: dict[Any, Any]) -> str:
    reason = _text(finding["overruled"])
    if reason:
        return f"used; overruled: {reason}"
    return "masked" if _yes(finding["masks"]) else "used; noted only"


def _time(value: object) -> float:
    return float(value) if isinstance(value, int | float | np.floating) else math.nan


def _text(value: object) -> str:
    return "" if value is None or (isinstance(value, float) and math.isnan(value)) or value is pd.NA else str(value)


def _yes(value: object) -> bool:
    return bool(value) if isinstance(value, bool | np.bool_) else True


def interval_words(comparison: dict[str, float], digits: int = 2) -> str:
    """``0.60 µm better (90 %: 0.20 to 1.00)`` of a paired comparison."""
    d = float(comparison["difference_um"])
    sign = 1.0 if d >= 0 else -1.0
    ends = sorted([sign * float(comparison["low_um"]), sign * float(comparison["high_um"])])
    words = f"{number(abs(d), digits)} µm {'better' if d >= 0 else 'worse'}"
    return f"{words} (90 %: {number(ends[0], digits)} to {number(ends[1], digits)} µm)"
