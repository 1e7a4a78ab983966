"""Mechanisms of displacement: growth, bending, shift with speed, screw elongation, joint slip.

Growth and bending are structural: written out as links of the error's chain, so that they stay part of its sum. Their
one parameter is a signed gain: recordings determine neither lengths, lever and expansion separately nor the side that a
candidate acts on. A machine file whose lengths are known states them in `errors`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from data.arrays import Numeric
from data.errors import closest
from twin.mechanisms.base import Mechanism, PortRole, View, real
from twin.quantity import Spec, Value
from twin.schema import Body, ChainLink, Exposure, Link, MechanismPart, Tilt, TwinPart, several


class ColumnBending(Mechanism):
    """A column, head or bed that is warmer on one side bends; the error is its angle times a lever.

    For the error along the column's depth the lever is half its height, for the one along it the head's reach. Each
    error in `acts_on` has its own gain.
    """

    key = "column_bending"
    summary = "bending of a column"
    equation = "error = gain · (θ_hot - θ_cold),  gain = ± α · height · lever / depth"
    source = "Mayr et al. (2012), Thermal issues in machine tools, CIRP Annals 61(2); Timoshenko (1925), one material"
    signature = "sideways error and pitch first, in step with a temperature difference; a uniform warm-up does nothing"
    acts_at = ("error",)
    ports = ("hot", "cold")
    parameters = (
        Spec("gain", "um/K", "displacement per kelvin between the sides, signed", 10.0, 15.0, -500.0, 500.0, "linear"),
    )
    off: ClassVar[Mapping[str, float]] = {"gain": 0.0}
    port_roles: ClassVar[Mapping[str, PortRole]] = {"hot": "body", "cold": "neighbour"}

    def expand(self, name: str, part: MechanismPart, twin: TwinPart) -> TwinPart:
        at, given = _places(name, self, part, twin), _given(self, name, part)
        tilt = Tilt(hot=at["hot"], cold=at["cold"], gain=given["gain"], words=part.words or name)
        return _on_errors(name, self, part, twin, tilt)


class SpindleGrowth(Mechanism):
    """A spindle, or any length, that grows from where it is held."""

    key = "spindle_growth"
    summary = "growth of the spindle from its locating bearing"
    equation = "error = gain · θ_spindle,  gain = ± α · length"
    source = "Mayr et al. (2012), Thermal issues in machine tools, CIRP Annals 61(2): linear expansion"
    signature = (
        "Z moves fast, time constant 20-50 min, in step with the spindle's temperature and not with the housing's"
    )
    acts_at = ("error",)
    ports = ("spindle",)
    parameters = (
        Spec(
            "gain", "um/K", "displacement per kelvin of the spindle's rise, signed", 1.2, 2.5, -100.0, 100.0, "linear"
        ),
    )
    off: ClassVar[Mapping[str, float]] = {"gain": 0.0}
    port_roles: ClassVar[Mapping[str, PortRole]] = {"spindle": "body"}

    def expand(self, name: str, part: MechanismPart, twin: TwinPart) -> TwinPart:
        at, given = _places(name, self, part, twin), _given(self, name, part)
        grows = ChainLink(body=at["spindle"], gain=given["gain"], words=part.words or name)
        return _on_errors(name, self, part, twin, grows)


class MandrelFixture(Mechanism):
    """A test bar in the spindle, or the probe's fixture on the table: an additional body without a sensor.

    It exchanges heat with its seat, with the air (any surrounding, or a body of air), or with both: `at` names one or
    both. The body takes the instance's name, so that the file may expose it to more: ``exposures: {NAME-hall: 1 W/K}``.
    """

    key = "mandrel_fixture"
    summary = "growth of the test bar or of the probe's fixture"
    equation = "capacity · dT/dt = conductance · (T_seat - T) + film · (T_air - T),  error = gain · θ"
    source = "ISO 230-3 (2020), test mandrel and fixture as part of the measuring set-up; linear expansion"
    signature = "looks like spindle growth but lags the nose by 5-30 min; every temperature is predicted well"
    needs = "test bar"
    acts_at = ("error",)
    ports = ("seat", "air")
    optional_ports: ClassVar[frozenset[str]] = frozenset({"seat", "air"})
    parameters = (
        Spec("gain", "um/K", "displacement per kelvin of the bar's rise, signed", 2.3, 2.5, -50.0, 50.0, "linear"),
        Spec("capacity", "J/K", "heat capacity of the bar or fixture", 2000.0, 0.7, 1.0, 1e5),
        Spec("conductance", "W/K", "conductance from its seat", 3.0, 0.7, 1e-3, 200.0),
        Spec("film", "W/K", "exchange with the air", 0.5, 0.7, 1e-4, 50.0),
    )
    off: ClassVar[Mapping[str, float]] = {"gain": 0.0}
    shape = ("capacity", "conductance", "film")
    # a thousandth of the usual: as late as it
    null_values: ClassVar[Mapping[str, float]] = {"capacity": 2.0, "conductance": 0.003, "film": 0.0005}
    of_port: ClassVar[Mapping[str, tuple[str, float | None]]] = {"conductance": ("seat", None), "film": ("air", None)}
    port_roles: ClassVar[Mapping[str, PortRole]] = {"seat": "body"}

    def expand(self, name: str, part: MechanismPart, twin: TwinPart) -> TwinPart:
        at, given = _places(name, self, part, twin), _given(self, name, part)
        if name in twin.bodies:
            raise ValueError(f"mechanisms.{name}: a body is called {name!r} already; give the mechanism another name")
        words = part.words or self.summary
        links, exposures = dict(twin.links), dict(twin.exposures)
        if "seat" in at:
            conductance = given["conductance"]
            links[f"{name}-{at['seat']}"] = Link(between=(name, at["seat"]), conductance=conductance, words=words)
        if "air" in at:
            wall = f"{name}-{at['air']}"
            if wall in exposures:
                raise ValueError(f"exposures.{wall}: {self.key} adds this one; state it as mechanisms.{name}.film")
            exposures[wall] = Exposure(of=name, to=at["air"], conductance=given["film"], words=words)
        bodies = {**twin.bodies, name: Body(capacity=given["capacity"], words=words)}
        grown = twin.model_copy(update={"bodies": bodies, "links": links, "exposures": exposures})
        return _on_errors(name, self, part, grown, ChainLink(body=name, gain=given["gain"], words=words))


class SpeedShift(Mechanism):
    """The shaft moves with the speed itself: the balls' centrifugal load against the preload, and a thinner shaft.

    Either direction of rotation moves it the same way.
    """

    key = "speed_shift"
    summary = "axial shift of the shaft with the speed"
    equation = "error = shift · (n / rated)²"
    source = "Harris and Kotzalas (2006), Rolling Bearing Analysis: centrifugal ball load, proportional to n²"
    signature = "step within seconds of a speed change, back at the stop, while temperatures do not move"
    needs = "bearings"
    acts_at = ("error",)
    drivers: ClassVar[Mapping[str, str]] = {"speed": "rpm"}
    parameters = (
        Spec("shift", "um", "displacement at the rated speed, signed", 3.0, 5.0, -200.0, 200.0, "linear"),
        Spec("rated", "rpm", "speed at which `shift` is stated", 6000.0, 0.01, 1.0, 2e5),
    )
    off: ClassVar[Mapping[str, float]] = {"shift": 0.0}

    def displacement(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["shift"] * (view.driver["speed"] / p["rated"]) ** 2)


class ScrewElongation(Mechanism):
    """A ball screw that positions without a linear scale: the error grows with the distance from its fixed end.

    A screw stretched between two bearings first loses its tension: nothing moves until its rise has used up
    `pretension`. Held at one end (pretension 0, fixed) it grows and shrinks with every kelvin.
    """

    key = "screw_elongation"
    summary = "elongation of a ball screw"
    equation = "error = expansion · (θ_screw - pretension) · (position - fixed_end)"
    source = "Slocum (1992), Precision Machine Design: thermal growth of a pretensioned lead screw"
    signature = "proportional to the position, zero at the fixed end; absent with a linear scale"
    needs = "ball screw"
    acts_at = ("error",)
    drivers: ClassVar[Mapping[str, str]] = {"position": "mm"}
    ports = ("screw",)
    parameters = (
        Spec(
            "expansion", "um/m/K", "the screw's expansion, minus where the error counts against the position",
            11.5, 12.0, -40.0, 40.0, "linear",
        ),
        Spec("fixed_end", "mm", "position of the locating bearing", 0.0, 200.0, -1e4, 1e4, "linear"),
        Spec("pretension", "K", "rise that uses up the screw's stretch", 3.0, 0.5, 0.0, 20.0),
    )  # fmt: skip
    off: ClassVar[Mapping[str, float]] = {"expansion": 0.0}
    shape = ("fixed_end", "pretension")
    port_roles: ClassVar[Mapping[str, PortRole]] = {"screw": "body"}

    def displacement(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        over_K = view.rise_K["screw"] - p["pretension"]
        grows = (real(over_K) > 0) | (real(p["pretension"]) <= 0)
        distance_m = (view.driver["position"] - p["fixed_end"]) / 1000.0
        return np.asarray(p["expansion"] * np.where(grows, over_K, 0.0) * distance_m)


class JointSlip(Mechanism):
    """A joint that friction holds up to a limit and that then slips: one Maxwell-slip element."""

    key = "joint_slip"
    summary = "slip in a bolted or guided joint"
    equation = "error(t + dt) = clip(error(t) + gain · dθ, -limit, +limit)"
    source = "Iwan (1966), J. Appl. Mech. 33(4), one elastic-slip element (stop operator)"
    signature = "another path on cooling than on warming; a loop is left over after the temperatures return"
    acts_at = ("error",)
    ports = ("part",)
    parameters = (
        Spec("gain", "um/K", "displacement per kelvin while the joint sticks, signed", 1.0, 2.0, -50.0, 50.0, "linear"),
        Spec("limit", "um", "displacement at which the joint slips", 3.0, 0.7, 0.0, 200.0),
    )
    along_time = True
    off: ClassVar[Mapping[str, float]] = {"limit": 0.0}  # with no gain it would be a growth that never slips
    shape = ("gain",)
    port_roles: ClassVar[Mapping[str, PortRole]] = {"part": "body"}

    def displacement(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        free, limit = np.broadcast_arrays(p["gain"] * view.rise_K["part"], p["limit"])
        out = np.empty(free.shape, np.result_type(free, limit))
        stuck = before = np.zeros(free.shape[:-1])
        for k in range(free.shape[-1]):
            stuck, before = _within(stuck + free[..., k] - before, limit[..., k]), free[..., k]
            out[..., k] = stuck
        return out


def _within(a: Numeric, limit: Numeric) -> Numeric:
    """Clipped to ± limit, analytic on each branch."""
    return np.where(real(a) > real(limit), limit, np.where(real(a) < -real(limit), -limit, a))


def _places(name: str, mechanism: Mechanism, part: MechanismPart, twin: TwinPart) -> dict[str, str]:
    """The body or point of every port; a bare place is that of the first port.

    Raises:
        ValueError: a port missing or unknown, several places for one, or an unknown body or surrounding.
    """
    key, at = f"mechanisms.{name}.at", part.at or {}
    if isinstance(at, str):
        at = {mechanism.ports[0]: at}
    missing = set(mechanism.ports) - set(at) - mechanism.optional_ports
    if missing or not at or set(at) - set(mechanism.ports):
        named = (" or " if mechanism.optional_ports else ", ").join(mechanism.ports)
        raise ValueError(f"{key}: {mechanism.key} needs {named}, got {list(at)}")
    out = {}
    for port, place in at.items():
        if not isinstance(place, str):
            raise ValueError(f"{key}.{port}: got {len(place)} places, expected one; give each a mechanism of its own")
        airy = twin.surroundings if mechanism.port_roles[port] == "surrounding" else {}
        if place.partition("@")[0] not in twin.bodies and place not in airy:
            which = "body or surrounding" if airy else "body"
            raise ValueError(f"{key}.{port}: no {which} {place!r}; {closest(place, [*twin.bodies, *airy])}")
        out[port] = place
    return out


def _given(mechanism: Mechanism, name: str, part: MechanismPart) -> dict[str, Value]:
    """`Mechanism.given` with units: the chain may have another one (mm, nm), a bare number has the mechanism's."""
    given = mechanism.given(name, part)
    return {spec.name: _with_unit(given[spec.name], spec) for spec in mechanism.parameters}


def _with_unit(value: Value, spec: Spec) -> Value:
    def with_unit(v: Any) -> Any:
        return f"{v} {spec.unit}" if v is not None and len(str(v).split()) == 1 else v

    update = {key: with_unit(getattr(value, key)) for key in ("value", "prior")}
    if spec.scale == "linear":
        update["spread"] = with_unit(value.spread)
    return value.model_copy(update=update | {"bounds": tuple(with_unit(b) for b in value.bounds or ())})


def _on_errors(
    name: str, mechanism: Mechanism, part: MechanismPart, twin: TwinPart, piece: ChainLink | Tilt
) -> TwinPart:
    """The twin part with one more piece in the chain of every error in `acts_on`.

    Raises:
        ValueError: no error named, or an unknown one.
    """
    if not part.acts_on:
        raise ValueError(f"mechanisms.{name}.acts_on is missing; name the errors that {mechanism.key} moves")
    errors = dict(twin.errors)
    for channel in several(part.acts_on):
        if channel not in errors:
            raise ValueError(f"mechanisms.{name}.acts_on: no error {channel!r}; {closest(channel, errors)}")
        key = "tilts" if isinstance(piece, Tilt) else "chain"
        given = errors[channel]
        errors[channel] = given.model_copy(update={key: (*getattr(given, key), piece)})
    return twin.model_copy(update={"errors": errors})
