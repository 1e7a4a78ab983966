"""The two errors that end a command, each with a one-line message, and suggestions for unknown names."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar


class InputError(Exception):
    """What the user gave cannot be used: what, where, got, expected, what to do. Exit code 2."""


class WorkError(Exception):
    """The input was fine but the work failed. Exit code 1."""


def place_of(error: OSError, otherwise: object) -> object:
    """The file that could not be written or read; of a copy its target, which is what a full disk is about."""
    return error.filename2 or error.filename or otherwise


def closest(got: str, allowed: Iterable[str]) -> str:
    """Suggestion for an unknown name with all allowed ones: ``did you mean 'ridge'? Allowed: bp, ridge``."""
    names = sorted(allowed)
    near = difflib.get_close_matches(got, names, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return f"{hint}Allowed: {', '.join(names)}"


T = TypeVar("T", bound=str)


def one_of(given: str, allowed: Iterable[T], option: str) -> T:
    """The allowed value that was given.

    Raises:
        InputError: another one, with the closest.
    """
    known = tuple(allowed)
    for value in known:
        if value == given:
            return value
    raise InputError(f"{option}: unknown value {given!r}: {closest(given, known)}")


def check_suffix(what: str, path: Path, allowed: Sequence[str]) -> None:
    """Raises InputError where a file's suffix is none of `allowed`."""
    if path.suffix not in allowed:
        *first, last = allowed
        known = f"{', '.join(first)} or {last}" if first else last
        raise InputError(f"{what} {path}: unsupported file extension {path.suffix!r}; give {known}")


_USER = re.compile(r"://(?:[^:/@\s]*:.*|[^/?#\s]*)@")  # a password that is not encoded may hold anything
_QUERY = re.compile(r"(://[^\s?]*\?)(\S+)")


def masked(text: str) -> str:
    """An address, or a text with some, without what may be secret: the user part, and every value of the query."""
    return _QUERY.sub(lambda found: found[1] + _keys_of(found[2]), _USER.sub("://***@", text))


def _keys_of(query: str) -> str:
    keys = (re.match(r"[\w.-]+=", part) for part in query.split("&"))
    return "&".join(f"{key[0] if key else ''}***" for key in keys)
