"""The specification of a case of the proof, before any plant is built."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

Kind = Literal["nothing", "decoy", "one", "two", "three", "confounded", "unlisted", "invisible"]
PlantKind = Literal["elements", "volumes", "grafted", "withheld"]
KINDS: tuple[Kind, ...] = get_args(Kind)
PLANT_KINDS: tuple[PlantKind, ...] = get_args(PlantKind)


@dataclass(frozen=True)
class CaseSpec:
    """One case. `effects` are keys of `plants.effects.EFFECTS` with their sizes, `decoys` as well (faults of a
    recording or of the file that an answer may name); `options` of `plants.options.Options`; of a real case
    its own name and, where it has one, its reference's.

    Plants: elements (A, finite elements), volumes (B, finite volumes), grafted (C, an effect's response on real
    recordings), withheld (D, real recordings with an input or effect withheld).
    """

    name: str  # reveals nothing: case_0001 in an order drawn by lot
    kind: Kind
    plant: PlantKind
    seed: int
    effects: Mapping[str, float] = field(default_factory=dict)
    decoys: Mapping[str, float] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    suite: Literal["development", "sealed"] = "development"

    def plain(self) -> dict[str, Any]:
        """As plain data; `CaseSpec(**spec.plain())` is the same again."""
        maps = {name: dict(getattr(self, name)) for name in ("effects", "decoys", "options")}
        return {f.name: getattr(self, f.name) for f in fields(self)} | maps
