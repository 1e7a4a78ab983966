"""The account of a result: what of the recordings it could not use, by channel and by check, with the time span."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from data.batch import Batch, Finding
from data.checks import CHECKS, OF_CELLS, USER
from data.checks.base import Bools, clock, overrule_line
from data.recording import DROPPED

LARGE = 0.05  # of a channel's rows in a batch: `ingest` says what masks more
DECIDES = 0.1  # a result whose deciding channel lost more says so first


@dataclass(frozen=True)
class Lost:
    """Rows of one channel that one check took away in one batch; `state`: masked, or missing from the file."""

    batch_id: str
    channel: str
    check: str
    state: str
    rows: int
    share: float
    start_s: float
    end_s: float


@dataclass(frozen=True)
class Account:
    """Rows read and dropped of all batches, and what was lost of their channels."""

    batches: int
    rows_read: int
    rows_dropped: int
    values: int
    lost: tuple[Lost, ...]
    reasons: str = ""  # of the rows dropped
    repeated: int = 0  # rows averaged with another one of the same time

    @classmethod
    def of(cls, batches: Iterable[Batch]) -> Account:
        """The account of checked batches (`data.checks.check_machine`)."""
        known = list(batches)
        read = sum(b.repairs.get("rows_in", b.n_rows) for b in known)
        dropped = sum(b.repairs.get("rows_dropped", 0) for b in known)
        values = sum(int(np.isfinite(b.values(n)).sum()) for b in known for n in b.channels if n in b.table.columns)
        counts = {why: sum(b.repairs.get(key, 0) for b in known) for key, why in DROPPED.items()}
        reasons = ", ".join(f"{n} {why}" for why, n in counts.items() if n)
        repeated = sum(b.repairs.get("duplicates", 0) for b in known)
        return cls(len(known), read, dropped, values, tuple(x for b in known for x in _lost(b)), reasons, repeated)

    @property
    def rows(self) -> str:
        """How many rows were read, dropped and why, and averaged."""
        why = f" ({self.reasons})" if self.reasons else ""
        repeated = f", {self.repeated} averaged with another row of the same time" if self.repeated else ""
        return f"rows: {self.rows_read} read, {self.rows_dropped} dropped{why}{repeated}"

    @property
    def summary(self) -> str:
        """One line."""
        masked = [x for x in self.lost if x.state == "masked"]
        if not self.lost:
            return f"{self.rows}; nothing masked"
        by = {c: sum(x.rows for x in masked if x.channel == c) for c in dict.fromkeys(x.channel for x in masked)}
        most = sorted(by, key=lambda c: -by[c])[:3]
        named = ", ".join(
            f"{c} {by[c]} ({'/'.join(sorted({x.check for x in masked if x.channel == c}))})" for c in most
        )
        more = f" and {len(by) - 3} more channels" if len(by) > 3 else ""
        missing = sum(x.rows for x in self.lost if x.state == "missing")
        out = f"{self.rows}; {sum(by.values())} values masked" + (f": {named}{more}" if by else "")
        out += f"; {missing} cells without a value" if missing else ""
        return "; ".join([out, *map(_explained, dict.fromkeys(x.check for x in masked if x.channel in most))])

    def as_dict(self) -> dict[str, Any]:
        """For JSON: totals, the summary and a row for each batch, channel and check."""
        totals = {"batches": self.batches, "rows_read": self.rows_read, "rows_dropped": self.rows_dropped}
        return {**totals, "summary": self.summary, "lost": [asdict(x) for x in self.lost]}

    def warning(self, channel: str) -> str:
        """What opens a result that this channel decides, where it lost more than a tenth of its values; else ""."""
        mine = [x for x in self.lost if x.channel == channel and x.state == "masked"]
        rows = sum(x.rows for x in mine)
        total = sum(round(x.rows / x.share) for x in {x.batch_id: x for x in mine}.values())
        every = total / max(len({x.batch_id for x in mine}), 1) * self.batches
        if not rows or rows <= DECIDES * every:
            return ""
        checks = "; ".join(map(_explained, sorted({x.check for x in mine})))
        return f"{rows / every:.0%} of the rows of {channel} are masked ({checks}). "

    def large(self, batch_ids: Collection[str]) -> list[str]:
        """One line a channel and check that masks more than 5 % of the rows of a batch: how to lift or confirm it."""
        groups: dict[tuple[str, str], list[Lost]] = {}
        confirmed = {(x.batch_id, x.channel) for x in self.lost if x.check == USER}
        for x in self.lost:
            known = (x.batch_id, x.channel) in confirmed or x.batch_id not in batch_ids
            if x.state == "masked" and x.share > LARGE and not known:
                groups.setdefault((x.channel, x.check), []).append(x)
        lines = []
        for (channel, check), found in groups.items():
            worst = max(found, key=lambda x: x.share)
            where = f"{worst.batch_id} from {clock(worst.start_s)} to {clock(worst.end_s)}"
            where += f" and {len(found) - 1} more" if len(found) > 1 else ""
            lift = overrule_line(channel, check)
            lines.append(
                f"{channel}: {check} masks {worst.share:.0%} of {where}; to lift it, add to overrule: {lift}; to "
                f"confirm it: {lift.replace(', reason', ', mask: true, reason')}"
            )
        return lines


def _explained(check: str) -> str:
    return f"{check}: {CHECKS[check].summary}" if check in CHECKS else check


def _lost(batch: Batch) -> list[Lost]:
    out = []

    def add(name: str, check: str, state: str, hit: Bools) -> None:
        if len(rows := np.flatnonzero(hit)):
            span = float(batch.time_s[rows[0]]), float(batch.time_s[rows[-1]])
            out.append(Lost(batch.batch_id, name, check, state, len(rows), len(rows) / batch.n_rows, *span))

    taken: dict[tuple[str, str], list[Finding]] = {}
    for f in batch.findings:
        if f.masks and not f.overruled:
            for name in (f.channel,) if f.channel else batch.channels:
                taken.setdefault((name, f.check), []).append(f)
    for (name, check), found in taken.items():
        if name in batch.table.columns:
            left = batch.with_findings(tuple(found)).masked(name)
            add(name, check, "masked", np.isfinite(batch.values(name)) & ~np.isfinite(left))
    for f in batch.findings:
        if f.check in OF_CELLS and f.channel is not None and f.channel in batch.table.columns:
            add(f.channel, f.check, "missing", ~np.isfinite(batch.values(f.channel)))
    return out
