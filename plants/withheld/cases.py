"""The cases of plant D by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from data.errors import InputError, closest
from plants.real import RealCase, answer, recorded, there
from plants.withheld import board, cell, lathe, spindle
from plants.withheld.kept_back import KeptBack

CASES: Mapping[str, KeptBack] = MappingProxyType(
    {c.name: c for c in (*board.CASES, *cell.CASES, *lathe.CASES, *spindle.CASES)}
)


def cases(data: Path) -> list[str]:
    """Names of all cases whose recordings lie in the folder `data`."""
    return [name for name, c in CASES.items() if there(c.machine, data)]


def build(name: str, data: Path, seed: int) -> RealCase:
    """A case; the seed picks the runs where there are many, and their hours where only dates are known.

    Raises:
        InputError: an unknown name, no recordings in `data`; one line.
    """
    if name not in CASES:
        raise InputError(f"withheld: unknown case {name!r}; {closest(name, CASES)}")
    case = CASES[name]
    machine, batches = recorded(case.machine, data, seed)
    terms = case.terms(machine.twin or {}, batches)
    bare, seen = case.hidden_from(machine, batches)
    key = answer(name, "withheld", case.kind, bare, seed, terms, f"real recordings: {case.words}")
    return RealCase(bare, seen, key)
