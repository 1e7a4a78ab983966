"""The terms that an unlisted effect is described with: drivers and their powers, states, products, time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch
from twin.calibration.fit_problem import Array
from twin.diagnosis.places.regimes import held_driver
from twin.diagnosis.telling.honest_digits import as_given, few, with_unit
from twin.mechanisms.free_form import REFERENCE_DEGC

ALIKE = 0.9999  # correlation beyond which two terms are the same in these recordings
SMALLEST = 1e-6  # of a term's own size: it does not move


@dataclass(frozen=True)
class Term:
    """One term: its series and how it is read. The coefficient is in `unit` per unit of the series.

    `role` is the parameter of `free_flux` or `free_shift` that states it, empty where none does; `driver` what it
    follows, `other` a second driver beside it, and `body` whose temperature. `exchange`: heat that flows between
    places as ever, which a network's own conductances may have too large or too small.
    """

    name: str
    tail: str  # behind "60 W into column": when, or per what
    series: Array
    per: str = ""  # "K" where the coefficient is per kelvin
    role: str = ""
    driver: str = ""
    body: str = ""
    top: float = 1.0  # of the driver, or of both, by which its series is divided
    other: str = ""
    exchange: bool = False

    def unit(self, of: str) -> str:
        return f"{of}/{self.per}" if self.per else of


@dataclass(frozen=True)
class Level:
    """A driver on the grid of a library; `top` is its largest size, by which its terms are divided."""

    name: str
    unit: str
    series: Array
    switched: bool  # 0 or one other value
    top: float

    def at(self, intervals: NDArray[np.int64]) -> Level:
        """In some of the intervals."""
        return replace(self, series=self.series[:, intervals])

    def at_ends(self) -> Level:
        """At both ends of every interval, (B, M, 2)."""
        return replace(self, series=np.repeat(self.series[..., None], 2, axis=-1))

    @property
    def words(self) -> str:
        return f"{self.name} (at {with_unit(as_given(self.top), self.unit)})"


@dataclass(frozen=True)
class States:
    """What terms are built of, every series of the same shape (B, …): drivers, temperatures (degC or rises), time."""

    drivers: Sequence[Level]
    bodies: Mapping[str, Array]
    rooms: Mapping[str, Array] = field(default_factory=dict)
    time_s: Array = field(default_factory=lambda: np.zeros(0))
    clock_h: Array = field(default_factory=lambda: np.zeros(0))


def levels(batches: Sequence[Batch], intervals: int, every: int) -> list[Level]:
    """The drivers of all batches in every interval (B, M), `every` of them from one row to the next."""
    out = []
    for name, channel in batches[0].channels.items():
        if channel.role != "driver" or not all(
            name in b.table.columns and np.isfinite(b.masked(name)).any() for b in batches
        ):
            continue
        rows = [np.repeat(held_driver(b, name)[:-1], every) for b in batches]
        series = np.stack([np.pad(r, (0, intervals - len(r)), mode="edge") for r in rows])
        top = float(np.abs(series).max())
        if np.ptp(series) > 0:
            switched = len(np.unique(series[series != 0])) == 1
            out.append(Level(name, channel.unit, series, switched, top))
    return out


def heat_terms(body: str, neighbours: Sequence[str], states: States) -> list[Term]:
    """Terms of heat into a body; temperatures in degC, drivers and time in intervals' ends."""
    own = states.bodies[body]
    out = [Term("1", "", np.ones_like(own), role="constant")]
    out += _driven(states.drivers)
    above = Term(
        f"T_{body} - {REFERENCE_DEGC:g}", f"per K of {body} above {REFERENCE_DEGC:g} degC", own - REFERENCE_DEGC, "K",
        "per_K", body=body,
    )  # fmt: skip
    leads = [above]
    for room, degC in states.rooms.items():
        leads.append(Term(f"T_{body} - T_{room}", f"per K of {body} above {room}", own - degC, "K", exchange=True))
        out.append(Term(f"T_{room} - {REFERENCE_DEGC:g}", f"per K of {room} above {REFERENCE_DEGC:g} degC",
                        degC - REFERENCE_DEGC, "K"))  # fmt: skip
    for n in neighbours:
        lead = Term(f"T_{n} - T_{body}", f"per K of {n} above {body}", states.bodies[n] - own, "K", exchange=True)
        leads.append(lead)
    out += leads
    for lead in leads:
        out += _products(lead, states.drivers)
    return [*out, *_timed(states)]


def shift_terms(states: States) -> list[Term]:
    """Terms of a displacement; `states.bodies` are rises in K, drivers and time at the rows."""
    out = _driven(states.drivers)
    for body, rise_K in states.bodies.items():
        lead = Term(f"θ_{body}", f"per K of {body}'s rise", rise_K, "K", "per_K", body=body)
        out += [lead, *_products(lead, states.drivers)]
    return [*out, *_timed(states)]


def _driven(drivers: Sequence[Level]) -> list[Term]:
    out = []
    for d in drivers:
        u = d.series / d.top
        out.append(Term(d.name, _following(d), u, role="linear", driver=d.name, top=d.top))
        if d.switched:
            continue
        out.append(Term(f"{d.name}^2", f"with the square of {d.words}", u**2, role="square", driver=d.name, top=d.top))
        out.append(Term(f"sqrt|{d.name}|", f"with the root of {d.words}", np.sqrt(np.abs(u)), driver=d.name))
        out.append(Term(f"{d.name} on", f"while {d.name} is on", (u != 0).astype(float), driver=d.name))
    for one, other in combinations(sorted(drivers, key=lambda d: d.switched), 2):
        tail = f"{_following(one)}{' and' if one.switched == other.switched else ''} {_following(other)}"
        both = one.series / one.top * (other.series / other.top)
        out.append(
            Term(f"{one.name} {other.name}", tail, both, role="cross", driver=one.name, top=one.top * other.top,
                 other=other.name)
        )  # fmt: skip
        if other.switched and not one.switched:
            tail = f"with the square of {one.words} {_following(other)}"
            square = Term(f"{one.name}^2 {other.name}", tail, both * one.series / one.top, role="square_cross",
                          driver=one.name, top=one.top**2 * other.top, other=other.name)  # fmt: skip
            out.append(square)
    return out


def _following(d: Level) -> str:
    return f"while {d.name} is on" if d.switched else f"in proportion to {d.words}"


def _products(lead: Term, drivers: Sequence[Level]) -> Iterator[Term]:
    role = "product" if lead.role == "per_K" else ""
    for d in drivers:
        u = d.series / d.top
        yield Term(f"{d.name} ({lead.name})", f"{lead.tail}, {_following(d)}", u * lead.series, "K", role,
                   driver=d.name, body=lead.body, top=d.top)  # fmt: skip
        if not d.switched:
            on = (u != 0).astype(float)
            yield Term(f"({d.name} on) ({lead.name})", f"{lead.tail}, while {d.name} is on", on * lead.series, "K",
                       driver=d.name, body=lead.body)  # fmt: skip


def _timed(states: States) -> Iterator[Term]:
    hours = states.time_s / 3600.0
    yield Term("t", "per hour since the start", hours, "h")
    yield Term("exp(-t / 1 h)", "at the start, fading within an hour", np.exp(-hours))
    if np.isfinite(states.clock_h).all() and states.clock_h.size:
        angle = 2 * np.pi * states.clock_h / 24.0
        yield Term("cos(day)", "at midnight, as much less at noon", np.cos(angle))
        yield Term("sin(day)", "at 6 h, as much less at 18 h", np.sin(angle))


def told(term: Term, value: float, unit: str, place: str, heat: bool) -> str:
    """``60 W into column while coolant is on``, ``−2 µm of z per K of bed's rise``; `unit` without what it is per."""
    size = with_unit(few(abs(value), 2), unit)
    where = (f"into {place}" if value >= 0 else f"out of {place}") if heat else f"of {place}"
    sign = "" if heat or value >= 0 else "−"
    return f"{sign}{size} {where} {term.tail}".strip()
