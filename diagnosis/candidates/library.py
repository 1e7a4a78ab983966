"""Every mechanism of the registry at every place where it may act: what a diagnosis screens."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, product

from data.machine import Machine
from diagnosis.contracts import Candidate, Kind, Where
from diagnosis.policy import POLICY
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism, PortRole, Target
from twin.quantity import Value, same_dimension
from twin.schema import Link, MechanismPart, TwinPart, several

KIND: Mapping[Target, Kind] = {
    "node": "node", "start": "node", "surrounding": "node", "heat": "node", "link": "link", "exposure": "link",
    "sensor": "sensor", "error": "error",
}  # fmt: skip
DRIVING = ("driver", "position")  # roles of channels that a law may be driven by

# Stems of words, English and German, that hint at equipment; a stem of five letters or more also inside a word.
HINTS: Mapping[str, tuple[str, ...]] = {
    "battery cell": ("cell", "batter", "akku", "zelle", "anode", "cathode", "kathode", "electrode", "elektrode"),
    "bearings": ("bearing", "lager", "spindle", "spindel", "shaft", "welle", "nose", "quill", "pinole", "rotor"),
    "ball screw": ("screw", "ballscrew", "gewinde", "kgt", "nut", "mutter", "spindelmutter"),
    "belt": ("belt", "riemen", "pulley"),
    "cabinet": ("cabinet", "schrank", "electronic", "elektronik", "inverter", "umrichter", "auxiliar", "hilfsaggregat"),
    "coolant jacket": ("coolant", "chiller", "cooler", "cooling", "kuehl", "jacket", "kuehlmantel", "pump"),
    "cutting": ("cutting", "workpiece", "werkstueck", "tool", "werkzeug", "zerspan", "chuck", "spannfutter"),
    "cutting fluid": ("coolant", "fluid", "emulsion", "kss", "kuehl", "schmierstoff", "flood", "tank", "pump"),
    "enclosure": ("enclos", "hood", "cover", "sheet", "kabine", "haube", "verkleid", "einhaus", "arbeitsraum"),
    "guides": ("guide", "guideway", "rail", "slide", "carriage", "saddle", "fuehrung", "schlitten", "schiene"),
    "heater": ("heater", "heiz", "resistor", "transistor"),
    "hydraulic unit": ("hydraul", "pump", "aggregat", "powerpack"),
    "motor": ("motor", "stator", "antrieb"),
    "rotating parts": ("spindle", "spindel", "shaft", "welle", "rotor", "turntable", "drehtisch", "drehzahl", "rpm"),
    "test bar": ("mandrel", "testbar", "fixture", "probe", "nest", "dorn", "taster"),
    "window": ("window", "fenster", "sun", "sonne", "skylight", "oberlicht"),
}

# What a driver implies: parts that turn have bearings and a motor, axes that move have guides and screws, and
# every machine with a control has its cabinet. What moves is measured against a bar or a fixture.
BY_SPEED = frozenset({"rotating parts", "bearings", "motor", "belt", "cutting", "cabinet", "test bar"})
BY_FEED = frozenset({"guides", "ball screw", "motor", "cutting", "cabinet", "test bar"})
OF_MACHINES = (BY_SPEED | BY_FEED | {"coolant jacket", "cutting fluid", "hydraulic unit"}) - {"cabinet"}
MOVING = frozenset({"rotating parts", "bearings", "guides", "ball screw"})

# Machine files name the parts that their writer knew. A twentieth has what its file does not hint at; a board or a cell
# without a moving part has no chiller, bearings or screws, short of a mistake in the file.


@dataclass(frozen=True)
class Site:
    """One place of one kind: `acts_on` or `into` names it; `outlets` are the bodies that its heat goes into.

    `others` are acted on by the same instance.
    """

    kind: Kind
    name: str
    outlets: tuple[str, ...] = ()
    others: tuple[str, ...] = ()


def candidates(machine: Machine, part: TwinPart, keys: Iterable[str] = MECHANISMS) -> list[Candidate]:
    """All candidates for a machine, sorted by mechanism and place; those that the file has already are left out."""
    out: dict[str, Candidate] = {}
    taken = {*part.mechanisms, *part.bodies, *part.surroundings, *part.links}
    for key in keys:
        mechanism: type[Mechanism] = MECHANISMS[key]
        if not mechanism.proposable:
            continue
        for target in mechanism.acts_at:
            for site in _sites(part, mechanism, target):
                for c in _at(machine, part, mechanism, target, site):
                    if _fits(machine, mechanism, c) and not _there_already(part, c):
                        name = c.name
                        while name in out or name in taken:  # names of places may run into each other
                            name += "_"
                        out |= {v.name: v for v in _variants(replace(c, name=name), mechanism)}
    return [out[name] for name in sorted(out)]


def log_prior_odds(machine: Machine, part: TwinPart | None, candidate: Candidate) -> float:
    """Natural logarithm of the odds that a machine has the equipment that a candidate needs, 0 where nothing is needed.

    0 too where the machine file names the equipment or a driver implies it. Lower where nothing hints at it, and lowest
    where it belongs to machines that move and nothing moves here.
    """
    if candidate.mechanism not in MECHANISMS:
        return 0.0
    needs = MECHANISMS[candidate.mechanism].needs
    if not needs or needs in (named := equipment_named(machine, part)):
        return 0.0
    hinted = needs not in OF_MACHINES or named & MOVING
    return math.log(POLICY.unnamed_equipment_odds if hinted else POLICY.machinery_where_nothing_moves_odds)


def equipment_named(machine: Machine, part: TwinPart | None) -> frozenset[str]:
    """The equipment (of `twin.mechanisms.base.EQUIPMENT`) that a machine file hints at.

    By the laws that it states, by drivers (a speed in rpm, a feed, a position), and by words in the names and the
    `words` of channels, bodies, surroundings and mechanisms, English or German. `part` None: by the channels alone.
    """
    found = {MECHANISMS[given.law].needs for given in part.mechanisms.values()} - {""} if part else set()
    found |= BY_SPEED if _driven_in(machine, "rpm") else frozenset()
    found |= BY_FEED if _driven_in(machine, "mm/min", "mm") else frozenset()
    return frozenset(found) | _hinted(frozenset(_words_of(machine, part)))


@lru_cache(maxsize=64)
def _hinted(words: frozenset[str]) -> frozenset[str]:
    """The equipment that words hint at; of one machine file for hundreds of candidates."""
    hints = {
        e for e, stems in HINTS.items() for s in stems for w in words if w.startswith(s) or (len(s) >= 5 and s in w)
    }
    return frozenset(hints)


def _driven_in(machine: Machine, *units: str) -> bool:
    channels = (c for c in machine.channels.values() if c.role in DRIVING)
    return any(same_dimension(c.unit, unit) for c in channels for unit in units)


def _words_of(machine: Machine, part: TwinPart | None) -> set[str]:
    """The words of a machine file, small letters, umlauts written out."""
    texts = [*machine.channels]
    for group in (part.bodies, part.surroundings, part.mechanisms) if part else ():
        texts += [text for name, given in group.items() for text in (name, given.words)]
    text = " ".join(texts).lower()
    for umlaut, written in (("ä", "ae"), ("ö", "oe"), ("ü", "ue"), ("ß", "ss")):
        text = text.replace(umlaut, written)
    return set(re.findall(r"[a-z]+", text))


def _at(
    machine: Machine, part: TwinPart, mechanism: type[Mechanism], target: Target, site: Site
) -> Iterator[Candidate]:
    for drivers in _drivers(machine, mechanism):
        for ports in _ports(part, mechanism, target, site):
            kind = KIND[target]
            where = Where(kind, site.outlets[0] if target == "heat" and site.outlets else site.name)
            also = [*site.others, *drivers.values(), *(place for role, place in ports.items() if place != site.name)]
            name = re.sub(r"\W", "_", "_".join([mechanism.key, site.name, *also]))
            into = target in ("node", "start")
            idle = {p for p, (port, _) in mechanism.of_port.items() if port not in ports}
            yield Candidate(
                mechanism.key,
                where,
                name,
                _words(mechanism, site, also),
                MechanismPart(
                    law=mechanism.key,
                    at=ports or None,
                    into=site.name if into and "expand" not in mechanism.effects() else None,
                    acts_on=None if into else (site.name, *site.others) if site.others else site.name,
                    drivers=drivers or None,
                    parameters={**_levels(machine, mechanism, drivers), **_of_ports(mechanism, ports)},
                ),
                dict(mechanism.off or {}),
                tuple(p for p in mechanism.shape if p not in idle),
                mechanism.fault,
            )


def _variants(c: Candidate, mechanism: type[Mechanism]) -> Iterator[Candidate]:
    """The candidate begun at every value at which it is looked for.

    What happens at another time has no trace yet, and a floor at the temperature of a body takes no heat from it: the
    amplitude is screened at each value. Where the value itself is the amplitude (a lag, a clock's skew) no slope shows
    what a large one does: each is a finite change, without amplitudes, and its value is free in a fit.
    """
    yield c
    if c.part is None or c.where.kind == "link" or set(c.part.drivers or ()) & mechanism.optional_drivers:
        return
    points = [{name: value} for name, values in mechanism.scan.items() for value in values]
    for k, point in enumerate([*points, *mechanism.scan_points]):
        given = {name: _fixed(mechanism, name, value) for name, value in point.items()}
        begun = [f"{name} begun at {value.value}" for name, value in given.items()]
        finite = tuple(name for name in point if name in c.amplitudes)
        yield replace(
            c,
            name=f"{c.name}_{k + 2}",  # a number: what its fit comes to is another value
            label=", ".join([c.label, *begun]),
            part=c.part.model_copy(update={"parameters": {**c.part.parameters, **given}}),
            amplitudes={} if finite else c.amplitudes,
            shape=(*finite, *c.shape),
            variant_of=c.name,
        )


def _of_ports(mechanism: type[Mechanism], ports: Mapping[str, str]) -> dict[str, Value]:
    """Values that go with the optional ports named: coolant that follows a room follows it entirely."""
    named = {p: value for p, (port, value) in mechanism.of_port.items() if port in ports and value is not None}
    return {p: _fixed(mechanism, p, value) for p, value in named.items()}


def _fixed(mechanism: type[Mechanism], parameter: str, number: float) -> Value:
    unit = mechanism.spec(parameter).unit
    return Value(value=number if unit == "1" else f"{number:g} {unit}")


def _levels(machine: Machine, mechanism: type[Mechanism], drivers: Mapping[str, str]) -> dict[str, Value]:
    """The level at which an effect is stated, of a driver in its channel's own unit: the top of the channel's range."""
    tops = [c.range[1] for c in (machine.channels[name] for name in drivers.values()) if c.range]
    stated = [s for s in mechanism.parameters if s.name == "rated" and s.unit == "1" and tops]
    return {s.name: Value(value=min(tops[0], s.high)) for s in stated if tops[0] > s.low}


def _words(mechanism: type[Mechanism], site: Site, also: Sequence[str]) -> str:
    with_ = f" ({', '.join(also)})" if also else ""
    return f"{mechanism.summary}: {site.name}{with_}"


def _sites(part: TwinPart, mechanism: type[Mechanism], target: Target) -> list[Site]:
    kind = KIND[target]
    if target == "exposure" and "surrounding" in mechanism.acts_at and "expand" in mechanism.effects():
        return []  # it is between a surrounding and all that it surrounds
    if target in ("node", "start"):
        return [Site(kind, name) for name in list(part.bodies)]
    if target == "heat":
        return [
            Site(kind, name, outlets_of(given))
            for name, given in part.mechanisms.items()
            if "heat_W" in MECHANISMS[given.law].effects() and given.law in (mechanism.multiplies or (given.law,))
        ]
    groups: dict[Target, Mapping[str, object]] = {
        "link": part.links, "exposure": part.exposures, "sensor": part.sensors, "error": part.errors,
        "surrounding": part.surroundings,
    }  # fmt: skip
    if target == "surrounding":  # ground that follows the season is no air
        groups["surrounding"] = {name: s for name, s in part.surroundings.items() if s.follow is None}
    chosen = list(combinations(groups[target], mechanism.together))
    if target == "error" and mechanism.all_errors and len(groups[target]) > 1:
        chosen.append(tuple(groups[target]))
    if target == "surrounding" and mechanism.all_air:
        shared = [s.channel for s in part.surroundings.values() if s.channel]
        every = [[n for n, s in part.surroundings.items() if s.channel == c] for c in dict.fromkeys(shared)]
        chosen += [tuple(names) for names in every if len(names) > 1]
    return [Site(kind, first, others=tuple(others)) for first, *others in chosen]


def outlets_of(given: MechanismPart) -> tuple[str, ...]:
    """The bodies that a mechanism's heat goes into."""
    if isinstance(given.into, Mapping):
        return tuple(given.into)
    return (given.into,) if given.into else (given.at,) if isinstance(given.at, str) else ()


def _drivers(machine: Machine, mechanism: type[Mechanism]) -> Iterator[dict[str, str]]:
    """Channels by the law's drivers, every combination; an optional driver is left out, or named where it switches."""
    choices: list[list[tuple[str, str | None]]] = []
    for role, unit in mechanism.drivers.items():
        fits: list[tuple[str, str | None]] = [
            (role, name)
            for name, channel in machine.channels.items()
            if channel.role in DRIVING and same_dimension(channel.unit, unit)
        ]
        choices.append([(role, None), *fits] if role in mechanism.optional_drivers else fits)
    for chosen in product(*choices):
        named = {role: name for role, name in chosen if name is not None}
        if len(set(named.values())) == len(named) and (named or not mechanism.only_driven):
            yield named


def _ports(part: TwinPart, mechanism: type[Mechanism], target: Target, site: Site) -> Iterator[dict[str, str]]:
    """Places by the law's ports, every combination that its roles allow, with at most one optional port and never
    none; of two signed sides one order."""
    choices: list[list[tuple[str, str | None]]] = []
    for port, role in mechanism.port_roles.items():
        left_out: list[tuple[str, str | None]] = [(port, None)] if port in mechanism.optional_ports else []
        choices.append([*left_out, *((port, place) for place in _places(part, port, role, site))])
    seen: set[frozenset[str]] = set()
    two_sides = target == "error" and "neighbour" in mechanism.port_roles.values()  # bending: signed, one order does
    for chosen in product(*choices):
        ports = {port: place for port, place in chosen if place is not None}
        places = list(ports.values())
        if len(set(places)) < len(places) or len(ports.keys() & mechanism.optional_ports) > 1:
            continue
        if mechanism.optional_ports and not ports:
            continue
        if two_sides:
            if frozenset(places) in seen or places[1] not in linked(part, places[0]):
                continue
            seen.add(frozenset(places))
        yield ports


def _places(part: TwinPart, port: str, role: PortRole, site: Site) -> list[str]:
    if role == "itself":
        return [site.name]
    if role == "surrounding":  # what follows a room follows one that is recorded
        return [name for name, s in part.surroundings.items() if s.channel or port != "room"]
    if role == "facing":
        return [*part.surroundings, *_unlinked(part, site.name)]
    if role == "outlet":
        return list(site.outlets)
    if role == "neighbour" and site.kind == "sensor":
        return linked(part, part.sensors[site.name].at.partition("@")[0])
    if role == "neighbour" and site.name in part.bodies:
        return linked(part, site.name)
    if role == "unlinked":
        return _unlinked(part, site.name)
    return list(part.bodies)


def _unlinked(part: TwinPart, body: str) -> list[str]:
    """The bodies further down in the file that no link or exposure joins with a body: each pair comes once."""
    own, near = list(part.bodies), linked(part, body)
    exposed = {frozenset((e.of.partition("@")[0], e.to)) for e in part.exposures.values()}
    return [n for n in own[own.index(body) + 1 :] if n not in near and frozenset((n, body)) not in exposed]


def linked(part: TwinPart, body: str) -> list[str]:
    """The bodies that a body has a link with, in the file's order."""
    near = {b if a == body else a for a, b in map(ends_of, part.links.values()) if body in (a, b)}
    return [name for name in part.bodies if name in near and name != body]


def ends_of(link: Link) -> list[str]:
    """The bodies that a link is between, without the places in them."""
    return [place.partition("@")[0] for place in link.between]


def _there_already(part: TwinPart, c: Candidate) -> bool:
    """Whether the machine file has this law at this place with these drivers: its values are the baseline's to fit."""
    assert c.part is not None
    own = _ends(c.part)
    either_way = {"unlinked", "facing"} & set(MECHANISMS[c.mechanism].port_roles.values())
    for given in part.mechanisms.values():
        if given.law != c.mechanism or driver_channels(given) != driver_channels(c.part):
            continue
        ends = _ends(given)
        if either_way and set(ends.values()) == set(own.values()):
            return True
        if c.part.into is not None:
            same = all(own[port] == ends.get(port, own[port]) for port in own if port in _exchanging(c))
            if same and c.part.into in outlets_of(given):
                return True
        elif (set(several(c.part.acts_on)) <= set(several(given.acts_on)) and (not ends or ends == own)) or (
            c.part.acts_on is None and ends == own
        ):
            return True
    sensor = part.sensors.get(str(c.part.acts_on))
    stated = {"sensor_lag": "lag", "sensor_bonding": "bonding", "sensor_offset": "offset"}.get(c.mechanism)
    return sensor is not None and stated is not None and getattr(sensor, stated) is not None


def _ends(given: MechanismPart) -> dict[str, object]:
    """Places by port, bodies without the place in them; a bare place is that of the law's first port."""
    at: Mapping[str, object] = given.at if isinstance(given.at, Mapping) else {}
    if isinstance(given.at, str) and MECHANISMS[given.law].ports:
        at = {MECHANISMS[given.law].ports[0]: given.at}
    return {port: place.partition("@")[0] if isinstance(place, str) else place for port, place in at.items()}


def _exchanging(c: Candidate) -> set[str]:
    """The ports that distinguish two instances at one body: with what it exchanges heat."""
    mechanism = MECHANISMS[c.mechanism]
    return {port for port in mechanism.ports if port == mechanism.takes_from}


def _fits(machine: Machine, mechanism: type[Mechanism], c: Candidate) -> bool:
    """Whether what a law adds to an error channel can be in the channel's unit: per kelvin, or by a travel."""
    if c.where.kind != "error" or c.fault or not mechanism.off:
        return True
    unit, own = machine.channels[c.where.name].unit, mechanism.spec(next(iter(mechanism.off))).unit
    by_travel = any(same_dimension(u, "mm") for u in mechanism.drivers.values())
    return by_travel or same_dimension(own, unit) or same_dimension(own, f"{unit}/K")


def driver_channels(given: MechanismPart) -> set[str]:
    """The channels of a mechanism's drivers."""
    if isinstance(given.drivers, str):
        return {given.drivers}
    return set((given.drivers or {}).values())
