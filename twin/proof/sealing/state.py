"""Where a proof stands, from its ledger alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from data.errors import InputError
from twin.proof.sealing.ledger import Entry

LATE = "it was answered after the proof had been opened"
TWICE = "it was answered twice"


@dataclass(frozen=True)
class State:
    """`answered`: digest of each case's answer since the last restart; `void`: why a case does not count.

    `begun`: cases that a process was started for and that were not finished. `source`: digest of the source that
    answers, as it was sealed or, after a restart, begun anew; `ran` says whether anybody was asked.
    """

    root: str
    source: str
    ran: bool = False
    answered: Mapping[str, str] = field(default_factory=dict)
    begun: frozenset[str] = frozenset()
    void: Mapping[str, str] = field(default_factory=dict)
    restarts: int = 0
    interrupted: int = 0
    opened: str | None = None


def state_of(entries: Iterable[Entry], where: str) -> State:
    """Replay a ledger.

    Raises:
        InputError: it does not begin with the seal.
    """
    entries = list(entries)
    if not entries or entries[0].step != "sealed":
        raise InputError(f"{where}: its ledger does not begin with the seal; seal a new proof")
    source, ran, opened = str(entries[0].details["source"]), False, None
    answered: dict[str, str] = {}
    void: dict[str, str] = {}
    begun: set[str] = set()
    restarts = interrupted = 0
    for e in entries[1:]:
        case = str(e.details.get("case", ""))
        if e.step == "run":
            source, ran = str(e.details["source"]), True
        elif e.step == "started":
            begun.add(case)
        elif e.step == "interrupted":
            begun.discard(case)
            interrupted += 1
        elif e.step == "answered":
            begun.discard(case)
            if opened is not None:
                void.setdefault(case, LATE)
            elif case in answered:
                void[case] = TWICE
            answered.setdefault(case, str(e.details["answer"]))
        elif e.step == "void":
            void.setdefault(case, str(e.details["why"]))
        elif e.step == "restarted":
            answered, void, begun, restarts = {}, {}, set(), restarts + 1
        elif e.step == "opened" and opened is None:
            opened = e.at
    root = str(entries[0].details["root"])
    return State(root, source, ran, answered, frozenset(begun), void, restarts, interrupted, opened)
