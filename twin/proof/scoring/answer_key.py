"""The answer key of a case, as the vault keeps it, read once and checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from data.errors import InputError

SCHEMA = "thermodrift.proof_answer/1"
Active = Literal["always"] | tuple[tuple[str, float, float], ...]


@dataclass(frozen=True)
class Spot:
    """A place by kind (node, link, sensor, error; empty: any) and name."""

    kind: str
    name: str


@dataclass(frozen=True)
class TrueTerm:
    """One thing that the recordings hold and the machine file does not. `mechanism` None: no listed one.

    `also` are places that mean the same, `neighbours` bodies that touch it, `parameters` values in the mechanism's own
    names and units, `active` the windows (batch, start s, end s), `partners` what these recordings cannot tell from it.
    `form` states what no list has: a parameter of `free_flux` or `free_shift` and the channels that drive it.
    """

    effect: str
    mechanism: str | None
    where: Spot
    also: tuple[Spot, ...] = ()
    neighbours: tuple[str, ...] = ()
    parameters: Mapping[str, tuple[float, str]] | None = None
    words: str = ""
    size: float = 1.0
    limit_share: float | None = None
    decoy: bool = False
    active: Active = "always"
    driver: str | None = None
    partners: tuple[tuple[str, Spot], ...] = ()
    form: tuple[str, ...] = ()


@dataclass(frozen=True)
class AnswerKey:
    """All of a case that was concealed."""

    case: str
    kind: str
    plant: str
    suite: str
    simulated: bool
    words: str
    terms: tuple[TrueTerm, ...]

    @classmethod
    def from_json(cls, raw: Mapping[str, Any]) -> AnswerKey:
        """From what the vault's JSON gives.

        Raises:
            InputError: another schema, or a key that is missing.
        """
        if raw.get("schema") != SCHEMA:
            raise InputError(f"answer key: schema is {raw.get('schema')!r}, expected {SCHEMA!r}; seal the cases again")
        try:
            return cls(
                case=raw["case"],
                kind=raw["kind"],
                plant=raw["plant"],
                suite=raw["suite"],
                simulated=bool(raw["simulated"]),
                words=raw.get("words", ""),
                terms=tuple(_term(t) for t in raw["terms"]),
            )
        except KeyError as missing:
            raise InputError(
                f"answer key of {raw.get('case', 'a case')}: key {missing} is missing; seal the cases again"
            ) from None

    @property
    def physics(self) -> tuple[TrueTerm, ...]:
        """The terms that are no decoys."""
        return tuple(t for t in self.terms if not t.decoy)


def _term(raw: Mapping[str, Any]) -> TrueTerm:
    active = raw.get("active", "always")
    return TrueTerm(
        effect=raw["effect"],
        mechanism=raw["mechanism"],
        where=_spot(raw["where"]),
        also=tuple(_spot(place) for place in raw.get("also", ())),
        neighbours=tuple(raw.get("neighbours", ())),
        parameters={k: (float(v["value"]), str(v["unit"])) for k, v in raw.get("parameters", {}).items()},
        words=raw.get("words", ""),
        size=float(raw.get("size", 1.0)),
        limit_share=raw.get("limit_share"),
        decoy=bool(raw.get("decoy", False)),
        active="always" if active == "always" else tuple((str(b), float(s), float(e)) for b, s, e in active),
        driver=raw.get("driver"),
        partners=tuple((p["mechanism"], _spot(p["where"])) for p in raw.get("same_as", ())),
        form=tuple(raw.get("form", ())),
    )


def _spot(raw: Any) -> Spot:
    return Spot("", raw) if isinstance(raw, str) else Spot(raw.get("kind", ""), raw["name"])
