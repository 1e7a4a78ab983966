"""What a report of the proof is made from: what was sealed, how it was run, and the tables of its scoring."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import pandas as pd

from data.errors import WorkError

# The columns that the page reads; others may stand beside them, and any table may be absent or empty.
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
        root: hexadecimal, what was published before the run.
        suite: a development suite has a known seed, a sealed one nobody's.
        cases: as many as were sealed; `outcomes` holds those that count.
        sealed, opened: UTC, to the second.
        version: of thermodrift.
        source_digest: of the source that answered.
        partial: opened before every case had an answer.
        isolation: protection of the answering process -> cases that ran under it.
        void: case -> why it does not count.
        failed: case -> the one line of its error; it counts, as a wrong answer.
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
    isolation: Mapping[str, int] = field(default_factory=dict)
    void: Mapping[str, str] = field(default_factory=dict)
    failed: Mapping[str, str] = field(default_factory=dict)
    tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)

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
        """The plants with a case that counts, in the order of the proof: elements, volumes, grafted, withheld."""
        from twin.proof.spec import PLANT_KINDS

        there = set(self.table("outcomes")["plant"])
        return tuple(p for p in PLANT_KINDS if p in there)
