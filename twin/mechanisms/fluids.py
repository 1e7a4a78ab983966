"""Mechanisms of fluids: coolant in a jacket, by a thermostat or all the time, and cutting fluid."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from data.arrays import Numeric
from twin.mechanisms.base import REFERENCE_DEGC, Mechanism, PortRole, View, real, size, steps_s
from twin.quantity import Spec

FOLLOW = Spec(
    "follow", "1", "share of the room's deviation from 20 degC that the coolant follows", 0.0, 0.5, 0.0, 1.0, "linear"
)


class JacketChiller(Mechanism):
    """Coolant of one temperature, let through by a thermostat: on above set_point + hysteresis, off below - hysteresis.

    Where a `room` is named (any surrounding or body), supply and set point are those at 20 degC there and follow it by
    a share: 1 for a chiller that is controlled by the difference to the room or to the bed.

    `heat_W` scans the control temperature at the times along the last axis and holds over the interval that follows
    each. It starts on where the first temperature exceeds the set point. A switch within an interval is only seen at
    its end: what flowed too long or too little since the crossing, found by linear interpolation, is made up for in
    the next interval, so the energy is right and nothing depends on what comes later. Steps well below UA's time
    constant. `starts_on`, `switched` and `flow_W` are the same law for a solver that steps from event to event.
    """

    key = "jacket_chiller"
    summary = "cooling jacket with a thermostat"
    equation = "P = on conductance (supply - T); on from T > set_point + hysteresis to T < set_point - hysteresis"
    source = "Incropera et al. 2007, Fundamentals of Heat and Mass Transfer, ch. 11: UA of a stream of constant inlet"
    signature = "sawtooth of 3 to 15 min that aliases where samples are minutes apart"
    needs = "coolant jacket"
    acts_at = ("node",)
    ports = ("jacket", "room")
    optional_ports: ClassVar[frozenset[str]] = frozenset({"room"})
    along_time = True
    parameters = (
        Spec("conductance", "W/K", "UA between the jacket and the coolant", 150.0, 0.6, 0.0, 5000.0),
        Spec("supply", "degC", "temperature of the coolant that is let in", 16.0, 3.0, -10.0, 60.0, "linear"),
        Spec("set_point", "degC", "middle of the thermostat's band", 22.0, 2.0, -10.0, 80.0, "linear"),
        Spec("hysteresis", "K", "half of the thermostat's band", 1.0, 0.5, 0.01, 20.0),
        FOLLOW,
    )
    off: ClassVar[Mapping[str, float]] = {"conductance": 0.0}
    shape = ("supply", "set_point", "follow")
    of_port: ClassVar[Mapping[str, tuple[str, float | None]]] = {"follow": ("room", 1.0)}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        names = ("conductance", "supply", "set_point", "hysteresis")
        now_p = {**p, "supply": _followed(p["supply"], view, p), "set_point": _followed(p["set_point"], view, p)}
        jacket, step_s, *shared = np.broadcast_arrays(view.degC["jacket"], steps_s(view), *(now_p[n] for n in names))
        q = dict(zip(names, shared, strict=True))
        on = self._states(jacket, q)
        heat = np.where(on, self.flow_W(jacket, q), 0.0)
        before, now, held = jacket[..., :-1], jacket[..., 1:], {k: v[..., 1:] for k, v in q.items()}
        turned = on[..., 1:].astype(int) - on[..., :-1]  # 1: came on within the interval before, -1: went off
        moved = now - before
        crossed = (turned != 0) & (
            moved != 0
        )  # a set point that follows the room may pass a jacket at constant temperature
        crossing = np.where(crossed, held["set_point"] + turned * held["hysteresis"], now)
        since = (now - crossing) / np.where(crossed, moved, 1.0)  # share of that interval
        # flow is linear in temperature: its mean since the crossing is the flow at the mean temperature
        missed_W = turned * since * self.flow_W((crossing + now) / 2, held)
        missed_W = missed_W * step_s[..., :-1] / step_s[..., 1:]
        return np.asarray(heat + np.concatenate([0.0 * heat[..., :1], missed_W], axis=-1))

    def starts_on(self, jacket_degC: Numeric, p: Mapping[str, Numeric]) -> Numeric:
        """Whether coolant flows at the start, bool, in the shape that the arguments broadcast to."""
        return np.asarray(real(jacket_degC) > real(p["set_point"]))

    def switched(self, on: Numeric, jacket_degC: Numeric, p: Mapping[str, Numeric]) -> Numeric:
        """The state after a temperature is reached, bool, from the state before it."""
        beyond = real(jacket_degC - p["set_point"])
        return np.asarray((beyond >= real(p["hysteresis"])) | (on & (beyond > -real(p["hysteresis"]))))

    def flow_W(self, jacket_degC: Numeric, p: Mapping[str, Numeric]) -> Numeric:
        """Heat into the jacket while the coolant flows, W."""
        return np.asarray(p["conductance"] * (p["supply"] - jacket_degC))

    def _states(self, jacket: Numeric, p: Mapping[str, Numeric]) -> Numeric:
        """On or off at every time: by the last temperature outside the band, all times at once."""
        above, below = self.switched(np.asarray(False), jacket, p), ~self.switched(np.asarray(True), jacket, p)
        outside = above | below
        outside[..., 0] = True
        at = np.maximum.accumulate(np.where(outside, np.arange(jacket.shape[-1]), 0), axis=-1)
        above[..., 0] |= self.starts_on(jacket[..., 0], {k: v[..., 0] for k, v in p.items()}) & ~below[..., 0]
        return np.asarray(np.take_along_axis(above, at, axis=-1))


class CoolantJacket(Mechanism):
    """Coolant that flows all the time, of a temperature that holds or follows a room, or any surrounding or body.

    A mixing valve or an inverter's compressor keeps it so, without a thermostat's sawtooth. A recorded supply: name it
    as a surrounding of its channel, with follow 1 and supply 20 degC.
    """

    key = "coolant_jacket"
    summary = "coolant that flows through a jacket all the time"
    equation = "P = conductance (T_supply - T), T_supply = supply + follow (T_room - 20 degC)"
    source = "Incropera et al. 2007, Fundamentals of Heat and Mass Transfer, ch. 11; supply 1 to 5 K about the room"
    signature = "one body is drawn to a temperature of its own, or to the room's, faster than its neighbours"
    needs = "coolant jacket"
    acts_at = ("node",)
    ports = ("jacket", "room")
    optional_ports: ClassVar[frozenset[str]] = frozenset({"room"})
    parameters = (
        Spec("conductance", "W/K", "UA between the jacket and the coolant", 150.0, 0.8, 0.0, 5000.0),
        Spec("supply", "degC", "temperature of the coolant, the room at 20 degC", 20.0, 3.0, -10.0, 60.0, "linear"),
        FOLLOW,
    )
    off: ClassVar[Mapping[str, float]] = {"conductance": 0.0}
    shape = ("supply", "follow")
    scan: ClassVar[Mapping[str, tuple[float, ...]]] = {"supply": (14.0, 26.0)}
    of_port: ClassVar[Mapping[str, tuple[str, float | None]]] = {"follow": ("room", 1.0)}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["conductance"] * (_followed(p["supply"], view, p) - view.degC["jacket"]))


def _followed(degC: Numeric, view: View, p: Mapping[str, Numeric]) -> Numeric:
    """A temperature that is stated for a room at 20 degC, in the room as it is."""
    return degC + p["follow"] * (view.degC["room"] - REFERENCE_DEGC) if "room" in view.degC else degC


class CuttingFluid(Mechanism):
    """Fluid over table, fixture or bed while the pump runs; the heat leaves the port `tank` where that is a body."""

    key = "cutting_fluid"
    summary = "cutting fluid over table and workpiece"
    equation = "P = conductance flow (T_tank - T)"
    source = "Newton's law of cooling; 50 to 500 W/K to the tank, tank 3 to 10 K above the room"
    signature = "step of the rate when the flow starts or stops, the table first"
    needs = "cutting fluid"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"flow": "1"}
    ports = ("body", "tank")
    takes_from: ClassVar[str | None] = "tank"
    parameters = (
        Spec("conductance", "W/K", "exchange with the fluid at full flow", 200.0, 0.8, 0.0, 5000.0, per="flow"),
    )
    off: ClassVar[Mapping[str, float]] = {"conductance": 0.0}
    port_roles: ClassVar[Mapping[str, PortRole]] = {"tank": "surrounding"}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["conductance"] * size(view.driver["flow"]) * (view.degC["tank"] - view.degC["body"]))
