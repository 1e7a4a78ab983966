"""What reports, findings, the command line and the documentation show of every registered member."""

from __future__ import annotations

from typing import Any

import pytest

from compensation.connectors import SINKS, SOURCES
from compensation.exports import EXPORTS
from compensation.exports.base import Exporter
from data.checks import CHECKS
from data.checks.base import Check
from data.readers import READERS
from data.readers.base import Reader
from features.selectors import SELECTORS
from features.selectors.base import Selector
from models.base import Family
from models.families import FAMILIES
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism

SHOWN = (
    (SELECTORS, Selector, ("summary", "source")), (FAMILIES, Family, ("summary", "source")),
    (MECHANISMS, Mechanism, ("summary", "equation", "source", "signature", "__doc__")),
    (CHECKS, Check, ("summary",)), (EXPORTS, Exporter, ("summary", "suffix")),
)  # fmt: skip
KEYED = [pytest.param(r[key], key, base, shown, id=f"{r.kind} {key}") for r, base, shown in SHOWN for key in r]


@pytest.mark.parametrize(("member", "key", "base", "shown"), KEYED)
def test_a_member_has_its_key_and_says_what_it_is(member: Any, key: str, base: type, shown: tuple[str, ...]) -> None:
    assert issubclass(member, base) and member.key == key and key.isidentifier()
    assert all(isinstance(text := getattr(member, name), str) and text for name in shown)
    assert "\n" not in member.summary and isinstance(getattr(member, "rank", 0), int)


@pytest.mark.parametrize("registry", [READERS, SOURCES, SINKS], ids=lambda r: r.kind)
def test_readers_and_connectors_have_what_is_called(registry: Any) -> None:
    names = {"source": ("samples", "close"), "sink": ("write", "close")}.get(registry.kind, ("open",))
    assert all(callable(getattr(member, name)) for member in registry.values() for name in names)
    assert registry is not READERS or all(issubclass(member, Reader) for member in registry.values())
