"""The specification of a case of the proof, before any plant is built."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

Kind = Literal["nothing", "decoy", "one", "two", "three", "confounded", "unlisted", "invisible"]
PlantKind = Literal[
    "elements", "volumes", "lathe", "board", "horizontal", "gantry", "bench", "battery", "grafted", "withheld"
]
KINDS: tuple[Kind, ...] = get_args(Kind)
PLANT_KINDS: tuple[PlantKind, ...] = get_args(PlantKind)
CENTRES: tuple[PlantKind, ...] = ("elements", "volumes")  # vertical machining centres
KIND_PLANTS: tuple[PlantKind, ...] = ("lathe", "board", "horizontal", "gantry", "bench", "battery")
SIMULATED: tuple[PlantKind, ...] = (*CENTRES, *KIND_PLANTS)
REAL: tuple[PlantKind, ...] = ("grafted", "withheld")  # their cases are those that the recordings give, each once
DEVELOPED_ON: tuple[PlantKind, ...] = CENTRES
"""Kinds of machines on which the diagnosis was developed; a table of results counts the others together."""
UNSEEN = "unseen"  # all simulated kinds but those


def is_unseen(plant: str) -> bool:
    """Whether it is a simulated kind of machine that the diagnosis was not developed on."""
    return plant in SIMULATED and plant not in DEVELOPED_ON


@dataclass(frozen=True)
class CaseSpec:
    """One case. `effects` are keys of the plant's effects with their sizes, `decoys` as well (faults of a recording or
    of the file that an answer may name). Of a machining centre they are keys of `plants.effects.EFFECTS`, `options` of
    `plants.options.Options`. Of another kind of machine they are keys of `plants.kinds`, their sizes sigmas, and
    `options` what `other_kinds.drawn_kind` takes. Of a real case `options` has its own name and, where it has one, its
    reference's.

    Plants: elements (A, finite elements), volumes (B, finite volumes), lathe to battery (other kinds of machines on an
    engine of their own), grafted (C, an effect's response on real recordings), withheld (D, real recordings with an
    input or effect withheld).
    """

    name: str  # reveals nothing: case_0001, in random order
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
