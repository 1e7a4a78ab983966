"""The answer key of a case as stored in the vault, parsed and checked."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pandas as pd

from data.batch import Batch
from data.errors import InputError
from data.machine import Machine
from diagnosis.findings.schema import Findings, read_findings
from thermodrift_exam.plants.real import SCHEMA
from thermodrift_exam.proof.sealing.examinee import FINDINGS, REPLIES

Active = Literal["always"] | tuple[tuple[str, float, float], ...]


@dataclass(frozen=True)
class Spot:
    """A place by kind (node, link, sensor, error; empty: any) and name."""

    kind: str
    name: str


@dataclass(frozen=True)
class TrueTerm:
    """One effect that the recordings contain and the machine file lacks. `mechanism` None: no listed one.

    `also` are places that mean the same, `neighbours` bodies that touch it, `parameters` values in the mechanism's own
    names and units, `active` the windows (batch, start s, end s), `partners` what these recordings cannot distinguish
    from it. `form` states an unlisted effect: a parameter of `free_flux` or `free_shift` and the channels that drive
    it.
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
    """Everything concealed in a case."""

    case: str
    kind: str
    plant: str
    suite: str
    simulated: bool
    words: str
    terms: tuple[TrueTerm, ...]

    @classmethod
    def from_json(cls, raw: Mapping[str, Any]) -> AnswerKey:
        """From the JSON of the vault.

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
        """The terms that are not decoys."""
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


AGAIN = "again.json"  # findings with the proposed run among the others


@dataclass(frozen=True)
class Stored:
    """An answer, and the `replies` of baselines and ablations.

    `findings` None: the diagnosis failed; `again` is the diagnosis once the proposed run was executed.

    `length_s` of every batch and `body_of` every sensor are the case's own.
    """

    findings: Findings | None
    run: Mapping[str, Any] = field(default_factory=dict)
    replies: Mapping[str, Any] | None = None
    length_s: Mapping[str, float] = field(default_factory=dict)
    body_of: Mapping[str, str] = field(default_factory=dict)
    again: Findings | None = None

    @property
    def seconds(self) -> float | None:
        """Wall time of the diagnosis; its time limit if it did not end."""
        seconds = self.run.get("seconds")
        if seconds is None and self.failed and self.run.get("started") and self.run.get("ended"):
            return (pd.Timestamp(self.run["ended"]) - pd.Timestamp(self.run["started"])).total_seconds()
        return seconds

    @property
    def failed(self) -> bool:
        return self.findings is None or bool(self.run.get("error"))


def read_stored(folder: Path, machine: Machine, batches: Sequence[Batch]) -> Stored:
    """The folder of one case's answers: `run.json` and, where there are any, findings, replies and `again.json`.

    Raises:
        InputError: a file that cannot be read.
    """
    findings, replies, again = folder / FINDINGS, folder / REPLIES, folder / AGAIN
    return Stored(
        read_findings(findings) if findings.exists() else None,
        _read(folder / "run.json"),
        _read(replies) if replies.exists() else None,
        lengths_s(batches),
        bodies_of_sensors(machine),
        read_findings(again) if again.exists() else None,
    )


def lengths_s(batches: Sequence[Batch]) -> dict[str, float]:
    """Seconds from each batch's first row to its last."""
    return {b.batch_id: float(b.time_s[-1] - b.time_s[0]) for b in batches}


def bodies_of_sensors(machine: Machine) -> dict[str, str]:
    """The body that each sensor of the machine file sits at; empty where the file has no twin part."""
    sensors = (machine.twin or {}).get("sensors", {})
    return {name: str(given["at"]).partition("@")[0] for name, given in sensors.items() if "at" in given}


def _read(path: Path) -> dict[str, Any]:
    try:
        out: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"answer {path}: cannot be read ({error}); run the case again") from None
    return out
