"""How many cases of each kind a suite has."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from twin.proof.spec import Kind

MIX: Mapping[Kind, float] = MappingProxyType({
    "nothing": 0.15, "decoy": 0.15, "one": 0.35, "two": 0.12, "three": 0.05, "confounded": 0.07, "unlisted": 0.07,
    "invisible": 0.04,
})  # fmt: skip
LACKING: tuple[Kind, ...] = ("one", "two", "three", "confounded", "unlisted", "invisible")  # physics is left out


def counts(cases: int) -> dict[Kind, int]:
    """Cases of each kind that add up to `cases`: the largest remainders are rounded up (Hamilton's method)."""
    exact = {kind: share * cases for kind, share in MIX.items()}
    out = {kind: int(n + 1e-9) for kind, n in exact.items()}
    by_rest = sorted(exact, key=lambda kind: (out[kind] - exact[kind], list(MIX).index(kind)))
    for kind in by_rest[: cases - sum(out.values())]:
        out[kind] += 1
    return out
