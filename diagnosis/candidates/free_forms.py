"""Terms of no listed mechanism at every place: each driver, power, product and temperature as a candidate.

A term is one parameter of `free_flux` or `free_shift`. Terms are screened and refitted as listed mechanisms are, since
only a refit shows how far a fit without them is bent.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from data.batch import Batch
from data.machine import Machine
from diagnosis.contracts import Candidate, CandidateKind, Where
from diagnosis.formatting import as_given, few, listed, with_unit
from twin.mechanisms import MECHANISMS
from twin.mechanisms.free_form import REFERENCE_DEGC
from twin.schema import MechanismPart, TwinPart

BODY_PARAMETERS = ("per_K", "product")  # parameters that a body's temperature goes with


@dataclass(frozen=True)
class Level:
    """A driver; `top` is its largest size in the recordings, at which terms are stated."""

    name: str
    unit: str
    top: float
    switched: bool  # 0 or one other value

    @property
    def following(self) -> str:
        """How an effect follows the driver, as a phrase."""
        return f"while {self.name} is on" if self.switched else f"in proportion to {self.label}"

    @property
    def label(self) -> str:
        return f"{self.name} (at {with_unit(as_given(self.top), self.unit)})"


@dataclass(frozen=True)
class Form:
    """One term: its place, the parameter that states it, its drivers, and the body whose temperature it follows."""

    where: Where
    role: str
    level: Level | None = None
    other: Level | None = None
    body: str = ""

    @property
    def heat(self) -> bool:
        return self.where.kind == "node"

    @property
    def linear(self) -> bool:
        """Whether it is proportional to one quantity: a product or a square hardly shows where neither factor does."""
        return self.role in ("constant", "linear", "per_K")

    @property
    def label(self) -> str:
        """The term as an expression: ``spindle_rpm (T_head - 20)``."""
        names = [d.name for d in (self.level, self.other) if d is not None]
        if self.role in ("square", "square_cross"):
            names[0] += "^2"
        if self.body:
            rise = f"T_{self.body} - {REFERENCE_DEGC:g}" if self.heat else f"θ_{self.body}"
            names.append(f"({rise})" if self.heat and names else rise)
        return " ".join(names) or "1"

    def phrase(self, value: float) -> str:
        """``60 W into column while coolant is on``, ``−2 µm of z per K of bed's rise``; `value` of the parameter."""
        value *= self.top
        size = with_unit(few(abs(value), 2), "W" if self.heat else "um")
        way = "into" if value >= 0 else "out of"
        where = f"{way} {self.where.name}" if self.heat else f"of {self.where.name}"
        sign = "" if self.heat or value >= 0 else "−"
        return " ".join([f"{sign}{size} {where}", *self._tail()])

    def _tail(self) -> Iterator[str]:
        one, other = self.level, self.other
        if self.body:
            above = f"{self.body} above {REFERENCE_DEGC:g} degC" if self.heat else f"{self.body}'s rise"
            yield f"per K of {above}" + ("," if one else "")
        if one is None:
            return
        yield f"with the square of {one.label}" if self.role in ("square", "square_cross") else one.following
        if other is not None:
            same = one.switched == other.switched and self.role == "cross"
            yield f"{'and ' if same else ''}{other.following}"

    @property
    def top(self) -> float:
        """What the parameter is multiplied by where its drivers are largest."""
        one, other = (d.top if d is not None else 1.0 for d in (self.level, self.other))
        return one ** (2 if self.role in ("square", "square_cross") else 1) * other

    def goes_with(self, forms: Sequence[Form]) -> bool:
        """Whether one mechanism states it and these: of one place, a driver, a second one, and one body."""
        every = (*forms, self)
        named = (
            {d.name for f in every if (d := f.level)}, {d.name for f in every if (d := f.other)},
            {f.body for f in every if f.body},
        )  # fmt: skip
        fresh = self.where == forms[0].where and self.role not in {f.role for f in forms}
        return fresh and all(len(names) < 2 for names in named)


def candidate_of(forms: Sequence[Form], body: str = "") -> Candidate:
    """One instance that states these terms; `body` is taken where none of them has one."""
    first = forms[0]
    body = next((f.body for f in forms if f.body), first.where.name if first.heat else body)
    law = (CandidateKind.FREE_FLUX if first.heat else CandidateKind.FREE_SHIFT).value
    level, other = (next((d.name for f in forms if (d := getattr(f, r))), None) for r in ("level", "other"))
    roles = [f.role for f in forms]
    also = [n for n in ("" if first.heat else body, *roles, level, other) if n]
    return Candidate(
        mechanism=law,
        where=first.where,
        name=re.sub(r"\W", "_", "_".join([law, first.where.name, *also])),
        label=f"{MECHANISMS[law].summary}: {first.where.name} ({listed([f.label for f in forms])})",
        part=MechanismPart(
            law=law,
            at={"body": body},
            into=first.where.name if first.heat else None,
            acts_on=None if first.heat else first.where.name,
            drivers={role: name for role, name in (("level", level), ("other", other)) if name} or None,
        ),
        amplitudes=dict.fromkeys(roles, 0.0),
    )


def free_forms(machine: Machine, part: TwinPart, batches: Sequence[Batch]) -> list[Form]:
    """Every term at every body and error, the simpler ones of a place first."""
    drivers = list(levels(batches))
    bodies = list(part.bodies)
    errors = [e for e in part.errors if machine.channels[e].unit == "um"]
    return [f for b in bodies for f in _at_body(b, drivers)] + [
        f for e in errors for f in _at_error(e, bodies, drivers)
    ]


def _at_body(body: str, drivers: Sequence[Level]) -> Iterator[Form]:
    where = Where("node", body)
    yield Form(where, "constant")
    yield from _driven(where, drivers)
    yield Form(where, "per_K", body=body)
    yield from (Form(where, "product", d, body=body) for d in drivers)


def _at_error(error: str, bodies: Sequence[str], drivers: Sequence[Level]) -> Iterator[Form]:
    where = Where("error", error)
    yield from _driven(where, drivers)
    for body in bodies:
        yield Form(where, "per_K", body=body)
        yield from (Form(where, "product", d, body=body) for d in drivers)


def _driven(where: Where, drivers: Sequence[Level]) -> Iterator[Form]:
    for d in drivers:
        yield Form(where, "linear", d)
        if not d.switched:
            yield Form(where, "square", d)
    for one, other in combinations(sorted(drivers, key=lambda d: d.switched), 2):
        yield Form(where, "cross", one, other)
        if other.switched and not one.switched:
            yield Form(where, "square_cross", one, other)


def levels(batches: Sequence[Batch]) -> Iterator[Level]:
    """The drivers that every recording has and that change."""
    for name, channel in batches[0].channels.items():
        if channel.role != "driver" or not all(name in b.table.columns for b in batches):
            continue
        by_batch = [v[np.isfinite(v)] for b in batches for v in [b.masked(name)]]
        if not all(len(v) for v in by_batch):
            continue
        values = np.concatenate(by_batch)
        if np.ptp(values) > 0:
            yield Level(name, channel.unit, float(np.abs(values).max()), len(np.unique(values[values != 0])) == 1)


def phrases(forms: Sequence[Form], values: Mapping[str, float]) -> str:
    """One phrase: how much, where, following what; `values` by parameter."""
    return listed([f.phrase(values[f.role]) for f in forms])
