"""Mechanisms of surroundings and start: enclosure air, stratification, floor, initial state.

Enclosure air and floor are structural: they write bodies, surroundings and exposures into the twin part.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from data.arrays import Numeric
from data.errors import closest
from twin.mechanisms.base import Mechanism, PortRole, View
from twin.quantity import Spec
from twin.schema import Body, Exposure, MechanismPart, Surrounding, TwinPart, several


class EnclosureAir(Mechanism):
    """Air inside sheet metal: a body under the mechanism's own name, between the surfaces and what is outside.

    `acts_on` names the exposures that lead into it, or a surrounding, which means all to that; without it, all to the
    only recorded surrounding. They are moved to the air and keep their names and values.
    """

    key = "enclosure_air"
    summary = "air inside the enclosure"
    equation = "capacity dT_air/dt = sum of heat from the surfaces - conductance (T_air - T_room)"
    source = "energy balance of a stirred volume; 2 to 8 K above the room, time constant 5 to 30 min"
    signature = "all surfaces share a fast mode that the room's sensor does not show"
    needs = "enclosure"
    acts_at = ("exposure", "surrounding")
    parameters = (
        Spec("capacity", "J/K", "heat capacity of the air with the sheet metal", 25e3, 0.7, 10.0, 1e7),
        Spec("conductance", "W/K", "exchange of the enclosure with the room", 70.0, 0.7, 0.1, 5000.0),
    )
    off = None  # it moves exposures; no value of its own leaves them where they were

    def expand(self, name: str, part: MechanismPart, twin: TwinPart) -> TwinPart:
        """Raises ValueError: a name that is taken, unknown exposures; the message starts with the key."""
        values = self.given(name, part)
        _new(name, twin)
        moved, outside = _moved(name, several(part.acts_on), twin)
        wall = f"{name}-{outside}"
        if wall in twin.exposures:
            raise ValueError(f"exposures.{wall}: {self.key} adds this one; state it as mechanisms.{name}.conductance")
        exposures = {k: e.model_copy(update={"to": name}) if k in moved else e for k, e in twin.exposures.items()}
        exposures[wall] = Exposure(of=name, to=outside, conductance=values["conductance"])
        bodies = {**twin.bodies, name: Body(capacity=values["capacity"], words=part.words or self.summary)}
        return twin.model_copy(update={"bodies": bodies, "exposures": exposures})


class Stratification(Mechanism):
    """Air that is warmer higher up: added to the surroundings in `acts_on`, `height` above the air's sensor."""

    key = "stratification"
    summary = "layers of warm air in the hall"
    equation = "T_air(height) = T_sensor + gradient height"
    source = "linear profile of a heated hall's air; 0.3 to 2 K/m"
    signature = "the upper column leads; a constant offset between heights"
    acts_at = ("surrounding",)
    parameters = (
        Spec("gradient", "K/m", "rise of the air's temperature per metre of height", 0.6, 0.8, 0.0, 10.0),
        Spec("height", "m", "height above the air's sensor, negative below it", 1.0, 0.2, -20.0, 20.0, "linear"),
    )
    off: ClassVar[Mapping[str, float]] = {"gradient": 0.0}

    def surrounding_K(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["gradient"] * p["height"])


class FloorSink(Mechanism):
    """The foundation under a body: a surrounding under the mechanism's own name that holds through a batch.

    The ground follows the season, in part, and not the day: `temperature` + `follow` x (the room's first reading -
    `temperature`). `at`: the body, or {body: …, room: …}. With a constant room it is `temperature` alone.
    """

    key = "floor_sink"
    summary = "heat to the floor"
    equation = "P = conductance (T_floor - T), T_floor = temperature + follow (T_room(0) - temperature)"
    source = (
        "Carslaw and Jaeger 1959, Conduction of Heat in Solids, ch. 2: days to months of lag in the ground; 5 to 30 W/K"
    )
    signature = "bed offset to the room whose sign follows the season"
    acts_at = ("node",)
    ports = ("body",)
    parameters = (
        Spec("conductance", "W/K", "exchange with the floor", 10.0, 0.7, 0.0, 1000.0),
        Spec("temperature", "degC", "annual mean of the ground", 18.0, 4.0, -20.0, 40.0, "linear"),
        Spec("follow", "1", "share of the room's deviation that the ground follows", 0.5, 0.8, 0.0, 1.0, "logit"),
    )
    off: ClassVar[Mapping[str, float]] = {"conductance": 0.0}
    shape = ("temperature", "follow")
    scan: ClassVar[Mapping[str, tuple[float, ...]]] = {"temperature": (12.0, 24.0)}
    port_roles: ClassVar[Mapping[str, PortRole]] = {"body": "itself", "room": "surrounding"}

    def expand(self, name: str, part: MechanismPart, twin: TwinPart) -> TwinPart:
        """Raises ValueError: a name that is taken, no place, no such surrounding; the message starts with the key."""
        values, at = self.given(name, part), _places(name, part)
        _new(name, twin)
        room = _room(name, at.get("room"), twin)
        first = (room.channel,) if room.channel else room.first
        words = part.words or self.summary
        if first is None:
            floor = Surrounding(value=values["temperature"], words=words)
        else:
            floor = Surrounding(value=values["temperature"], first=first, follow=values["follow"], words=words)
        sink = Exposure(of=at["body"], to=name, conductance=values["conductance"])
        return twin.model_copy(
            update={
                "surroundings": {**twin.surroundings, name: floor},
                "exposures": {**twin.exposures, f"{at['body']}-{name}": sink},
            }
        )


def _new(name: str, twin: TwinPart) -> None:
    if name in twin.bodies or name in twin.surroundings:
        raise ValueError(f"mechanisms.{name}: a body or surrounding is called {name!r} already; rename the mechanism")


def _moved(name: str, acts_on: tuple[str, ...], twin: TwinPart) -> tuple[set[str], str]:
    """The exposures that lead into the enclosure, and where they led before."""
    acts_on = acts_on or (_recorded(name, "acts_on", twin),)
    moved = {k for k, e in twin.exposures.items() if k in acts_on or e.to in acts_on}
    for target in acts_on:
        if not any(target in (k, twin.exposures[k].to) for k in moved):
            allowed = [*twin.exposures, *twin.surroundings]
            raise ValueError(f"mechanisms.{name}.acts_on: no exposure {target!r}; {closest(target, allowed)}")
    outside = sorted({twin.exposures[k].to for k in moved})
    if len(outside) > 1:
        raise ValueError(
            f"mechanisms.{name}.acts_on: these exposures lead to {' and '.join(outside)}; name those to one of them"
        )
    return moved, outside[0]


def _places(name: str, part: MechanismPart) -> dict[str, str]:
    """The body that stands on the floor and, if stated, the surrounding whose deviation the ground follows."""
    at = {"body": part.at} if isinstance(part.at, str) else part.at or {}
    if "body" not in at or not set(at) <= {"body", "room"} or not all(isinstance(place, str) for place in at.values()):
        example = "bed or {body: bed, room: hall}"
        raise ValueError(f"mechanisms.{name}.at: expected the body that stands on the floor, e.g. at: {example}")
    return {role: str(place) for role, place in at.items()}


def _room(name: str, given: str | None, twin: TwinPart) -> Surrounding:
    given = given or _recorded(name, "at", twin)
    if given not in twin.surroundings:
        raise ValueError(f"mechanisms.{name}.at.room: no surrounding {given!r}; {closest(given, twin.surroundings)}")
    return twin.surroundings[given]


def _recorded(name: str, key: str, twin: TwinPart) -> str:
    """The only surrounding that is recorded."""
    recorded = [k for k, s in twin.surroundings.items() if s.channel]
    if len(recorded) != 1:
        which = " and ".join(recorded) or "none"
        raise ValueError(f"mechanisms.{name}.{key}: recorded surroundings are {which}; name the one that is meant")
    return recorded[0]


class InitialState(Mechanism):
    """A body that is warmer or colder at the first sample than the first readings."""

    key = "initial_state"
    summary = "start away from equilibrium"
    equation = "T(0) = first reading + excess"
    source = "Carslaw and Jaeger (1959), Conduction of Heat in Solids: an initial state as a sum of decaying modes"
    signature = "drift before any load that decays with the slow time constants and does not depend on the speed"
    acts_at = ("start",)
    parameters = (
        Spec(
            "excess", "K", "temperature at the start above what the first readings say", 0.0, 2.0, -50.0, 50.0, "linear"
        ),
    )
    off: ClassVar[Mapping[str, float]] = {"excess": 0.0}

    def start_K(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["excess"])
