"""Registry of classes by key; the module of a member is imported at its first use."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from data.errors import InputError, closest


class Registry(Mapping[str, Any]):
    """Maps a key to a class given as ``"module:Class"``; the module loads at the first look-up.

    A lazy look-up keeps `thermodrift --help` from importing torch. Iteration gives keys in the
    order of the registry file.

    Raises:
        InputError: an unknown key, with the closest and the allowed ones.
    """

    def __init__(self, kind: str, members: Mapping[str, str]) -> None:
        self.kind = kind
        self._members = dict(members)

    def __getitem__(self, key: str) -> Any:
        if key not in self._members:
            raise InputError(f"unknown {self.kind} {key!r}: {closest(key, self._members)}")
        module, name = self._members[key].split(":")
        return getattr(import_module(module), name)

    def __contains__(self, key: object) -> bool:
        return key in self._members  # Mapping's own waits for a KeyError

    def add(self, key: str, where: str) -> None:
        """Add a member at run time, for trying one out: `where` is ``"module:Class"``."""
        self._members[key] = where

    def __iter__(self) -> Iterator[str]:
        return iter(self._members)

    def __len__(self) -> int:
        return len(self._members)


def packages_reason(kind: str, member: Any) -> str:
    """Why a member cannot be used where one of its `packages` is not installed; "" where all are."""
    missing = [name for name in getattr(member, "packages", ()) if find_spec(name) is None]
    if not missing:
        return ""
    named = " and ".join(missing)
    return f"{kind} {member.key} needs {named}, not installed; install it (pip install {' '.join(missing)})"


def check_packages(kind: str, member: Any) -> None:
    """Raises InputError where one of a member's `packages` is not installed."""
    if reason := packages_reason(kind, member):
        raise InputError(f"{reason}, or leave the {kind} out")
