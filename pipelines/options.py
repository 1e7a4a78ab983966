"""Options that several commands share, and checks of what the command line gives."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from data.errors import InputError, closest

MachineFile = Annotated[Path, typer.Option("--machine", help="machine file (.yml)")]
Json = Annotated[bool, typer.Option("--json", help="print JSON instead of tables")]


def split(given: str) -> tuple[str, ...]:
    """Names between commas, each once."""
    return tuple(dict.fromkeys(n.strip() for n in given.split(",") if n.strip()))


def names(given: str, allowed: Iterable[str], kind: str) -> tuple[str, ...]:
    """Names between commas; all that are allowed where none is given.

    Raises:
        InputError: one that is not allowed, with the closest.
    """
    known = tuple(allowed)
    chosen = split(given)
    for n in chosen:
        if n not in known:
            raise InputError(f"unknown {kind} {n!r}: {closest(n, known)}")
    return chosen or known
