"""Every mechanism of the registry at every place where it may act: what a diagnosis screens."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

from data.machine import Machine
from diagnosis.contracts import Candidate, Kind, Where, pieces_of
from twin.compiling.cells import several
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism, PortRole, Target
from twin.quantity import Value, same_dimension
from twin.schema import Link, MechanismPart, TwinPart

KIND: Mapping[Target, Kind] = {
    "node": "node", "start": "node", "surrounding": "node", "heat": "node", "link": "link", "exposure": "link",
    "sensor": "sensor", "error": "error",
}  # fmt: skip
DRIVING = ("driver", "position")  # roles of channels that a law may be driven by


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
                    parameters=_levels(machine, mechanism, drivers),
                ),
                dict(mechanism.off or {}),
                mechanism.shape,
                mechanism.fault,
            )


def _variants(c: Candidate, mechanism: type[Mechanism]) -> Iterator[Candidate]:
    """The candidate begun at every value at which its shape is looked for: what happens at another time has no trace
    yet, and a floor at the temperature of a body takes no heat from it."""
    yield c
    if c.part is None or c.where.kind == "link":
        return
    for name, values in mechanism.scan.items():
        unit = mechanism.spec(name).unit
        for k, value in enumerate(values):  # a number in its name: what its fit comes to is another value
            given = {**c.part.parameters, name: Value(value=f"{value:g} {unit}")}
            part = c.part.model_copy(update={"parameters": given})
            label = f"{c.label}, {name} begun at {value:g} {unit}"
            yield replace(c, name=f"{c.name}_{k + 2}", label=label, part=part, variant_of=c.name)


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
        return []  # it stands between a surrounding and all that it surrounds
    if target in ("node", "start"):
        return [Site(kind, name) for name in own_bodies(part)]
    if target == "heat":
        return [
            Site(kind, name, outlets_of(given))
            for name, given in part.mechanisms.items()
            if "heat_W" in MECHANISMS[given.law].effects() and given.law in (mechanism.multiplies or (given.law,))
        ]
    groups: dict[Target, Mapping[str, object]] = {
        "link": _own_links(part), "exposure": part.exposures, "sensor": part.sensors, "error": part.errors,
        "surrounding": part.surroundings,
    }  # fmt: skip
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
    """Places by the law's ports, every combination that its roles allow; of two signed sides one order."""
    choices = [
        [(port, place) for place in _places(part, role, site, port not in mechanism.ports)]
        for port, role in mechanism.port_roles.items()
    ]
    seen: set[frozenset[str]] = set()
    two_sides = len(mechanism.ports) == 2 and target == "error"  # of a body that bends: signed, so one order does
    for chosen in product(*choices):
        places = [place for _, place in chosen]
        if len(set(places)) < len(places):
            continue
        if mechanism.far_apart:
            one, other = linked(part, places[0]), linked(part, places[-1])
            if places[-1] in one or set(one) & set(other):  # linked, or with a common neighbour
                continue
        if two_sides:
            if frozenset(places) in seen or places[1] not in linked(part, places[0]):
                continue
            seen.add(frozenset(places))
        yield dict(chosen)


def _places(part: TwinPart, role: PortRole, site: Site, recorded: bool = False) -> list[str]:
    if role == "itself":
        return [site.name]
    if role == "surrounding":
        return [name for name, s in part.surroundings.items() if s.channel or not recorded]
    if role == "outlet":
        return list(site.outlets)
    if role == "neighbour" and site.kind == "sensor":
        return linked(part, part.sensors[site.name].at.partition("@")[0])
    if role == "neighbour" and site.name in part.bodies:
        return linked(part, site.name)
    if role == "unlinked":
        own = own_bodies(part)
        return [name for name in own[own.index(site.name) + 1 :] if name not in linked(part, site.name)]
    return own_bodies(part)


def own_bodies(part: TwinPart) -> list[str]:
    """The machine's bodies: physics at a piece that a finer network invented would be the network's, not hers."""
    pieces = pieces_of(part)
    return [name for name in part.bodies if name not in pieces]


def _own_links(part: TwinPart) -> dict[str, Link]:
    """Those between the machine's bodies."""
    whole = pieces_of(part)
    return {k: link for k, link in part.links.items() if len({whole.get(n, n) for n in ends_of(link)}) > 1}


def linked(part: TwinPart, body: str) -> list[str]:
    """The bodies that a body has a link with, in the file's order; a piece of a body counts as the body."""
    whole = pieces_of(part)
    ends = [tuple(whole.get(name, name) for name in ends_of(link)) for link in part.links.values()]
    body = whole.get(body, body)
    near = {b if a == body else a for a, b in ends if body in (a, b)}
    return [name for name in part.bodies if name in near and name != body]


def ends_of(link: Link) -> list[str]:
    """The bodies that a link is between, without the places in them."""
    return [place.partition("@")[0] for place in link.between]


def _there_already(part: TwinPart, c: Candidate) -> bool:
    """Whether the machine file has this law at this place with these drivers: its values are the baseline's to fit."""
    assert c.part is not None
    pieces = pieces_of(part)
    for given in part.mechanisms.values():
        if given.law != c.mechanism or _channels(given) != _channels(c.part):
            continue
        if c.part.into is not None:
            if c.part.into in [pieces.get(name, name) for name in outlets_of(given)]:
                return True
        elif (set(several(c.part.acts_on)) <= set(several(given.acts_on)) and given.at in (None, c.part.at)) or (
            c.part.acts_on is None and given.at == c.part.at
        ):
            return True
    sensor = part.sensors.get(str(c.part.acts_on))
    own = {"sensor_lag": "lag", "sensor_bonding": "bonding", "sensor_offset": "offset"}.get(c.mechanism)
    return sensor is not None and own is not None and getattr(sensor, own) is not None


def _fits(machine: Machine, mechanism: type[Mechanism], c: Candidate) -> bool:
    """Whether what a law adds to an error channel can be in the channel's unit: per kelvin, or by a travel."""
    if c.where.kind != "error" or c.fault or not mechanism.off:
        return True
    unit, own = machine.channels[c.where.name].unit, mechanism.spec(next(iter(mechanism.off))).unit
    by_travel = any(same_dimension(u, "mm") for u in mechanism.drivers.values())
    return by_travel or same_dimension(own, unit) or same_dimension(own, f"{unit}/K")


def _channels(given: MechanismPart) -> set[str]:
    if isinstance(given.drivers, str):
        return {given.drivers}
    return set((given.drivers or {}).values())
