"""Compilation of surroundings, sensors and error chains."""

from __future__ import annotations

import math

import numpy as np

from data.errors import closest
from twin.compiling.cells import Scope, number
from twin.compiling.laws import acting, port_of
from twin.compiling.parameters import LENGTH, MATERIAL, OFFSET, SHARE, TEMPERATURE
from twin.mechanisms import MECHANISMS
from twin.network import CompiledSurrounding, ErrorRow, Law, Reading
from twin.quantity import Monomial, Spec, Value
from twin.schema import ChainLink, ErrorChain, Sensor, Surrounding, Tilt


def surrounding(scope: Scope, name: str, given: Surrounding) -> CompiledSurrounding:
    key = f"surroundings.{name}"
    for channel in [given.channel] if given.channel else given.first or ():
        if channel not in scope.machine.channels:
            raise ValueError(f"{key}: no channel {channel!r}; {closest(channel, scope.machine.channels)}")
    return CompiledSurrounding(
        name,
        given.channel,
        None if given.value is None else scope.table.add(f"{key}.value", TEMPERATURE, given.value),
        given.first or (),
        None if given.follow is None else scope.table.add(f"{key}.follow", SHARE, given.follow),
        None if given.offset is None else scope.table.add(f"{key}.offset", OFFSET, given.offset),
        0.0 if given.per_batch is None else number(f"{key}.per_batch", given.per_batch, "K"),
        acting(scope, "surrounding_K", name),
    )


def reading(scope: Scope, channel: str, given: Sensor) -> Reading:
    key = f"sensors.{channel}"
    _channel(scope, key, channel, "temperature", "ambient")
    effects = []
    for attribute, law in (("bonding", "sensor_bonding"), ("lag", "sensor_lag"), ("offset", "sensor_offset")):
        value = getattr(given, attribute)
        if value is None:
            continue
        mechanism = MECHANISMS[law]()
        ports = {}
        if mechanism.ports:
            if given.air is None:
                raise ValueError(f"{key}.air is missing; name the surrounding that cools the sensor")
            ports = {mechanism.ports[0]: port_of(scope, given.air, f"{key}.air")}
        index = scope.table.add(f"{key}.{attribute}", mechanism.parameters[0], value)
        effects.append(Law(f"{channel}.{attribute}", mechanism, {mechanism.parameters[0].name: index}, {}, ports))
    noise = _noise(scope, key, channel, given.noise, "K")
    return Reading(
        channel, scope.cells.weights(given.at, f"{key}.at"), (*effects, *acting(scope, "reading", channel)), noise
    )


def _channel(scope: Scope, key: str, channel: str, *roles: str) -> None:
    if channel not in scope.machine.channels:
        raise ValueError(f"{key}: no channel {channel!r} in 'channels'; {closest(channel, scope.machine.channels)}")
    if scope.machine.channels[channel].role not in roles:
        raise ValueError(f"{key}: channel {channel!r} is a {scope.machine.channels[channel].role}, expected {roles[0]}")


def _noise(scope: Scope, key: str, channel: str, given: str | float | None, unit: str) -> float:
    """Standard deviation: as given, or the rounding error of the channel's resolution."""
    if given is not None:
        return number(f"{key}.noise", given, unit)
    resolution = scope.machine.channels[channel].resolution
    if resolution is None:
        raise ValueError(f"{key}.noise is missing and channel {channel!r} states no resolution; give one of them")
    return resolution / math.sqrt(12.0)


def error(scope: Scope, channel: str, given: ErrorChain) -> ErrorRow:
    key = f"errors.{channel}"
    _channel(scope, key, channel, "error")
    unit = scope.machine.channels[channel].unit
    gain = Spec("gain", f"{unit}/K", "a displacement per kelvin", scale="linear")
    rows, gains, words = [], [], []
    for k, c in enumerate(given.chain):
        at = f"{key}.chain[{k}]"
        rows.append(scope.cells.weights(c.body, f"{at}.body"))
        gains.append(_chain_gain(scope, at, c, gain))
        words.append(c.words or c.body)
    for k, t in enumerate(given.tilts):
        at = f"{key}.tilts[{k}]"
        rows.append(scope.cells.weights(t.hot, f"{at}.hot") - scope.cells.weights(t.cold, f"{at}.cold"))
        gains.append(_tilt_gain(scope, at, t, gain))
        words.append(t.words or f"{t.hot} - {t.cold}")
    return ErrorRow(
        channel, unit, np.array(rows).reshape(len(rows), len(scope.cells)), tuple(gains), tuple(words),
        acting(scope, "displacement", channel), acting(scope, "reading", channel),
        _noise(scope, key, channel, given.noise, unit),
    )  # fmt: skip


def _expansion(scope: Scope, at: str, given: Value | None, place: str) -> tuple[int, float]:
    if given is not None:
        return scope.table.add(f"{at}.expansion", MATERIAL["expansion"], given), 1.0
    body = scope.part.bodies[place.partition("@")[0]]
    return scope.table.material(body.material, "expansion", f"{at}.expansion"), 1.0


def _chain_gain(scope: Scope, at: str, c: ChainLink, gain: Spec) -> Monomial:
    if c.gain is not None:
        return Monomial(float(c.sign), ((scope.table.add(f"{at}.gain", gain, c.gain), 1.0),))
    return Monomial(
        float(c.sign),
        (_expansion(scope, at, c.expansion, c.body), (scope.table.add(f"{at}.length", LENGTH, c.length), 1.0)),
    )


def _tilt_gain(scope: Scope, at: str, t: Tilt, gain: Spec) -> Monomial:
    if t.gain is not None:
        return Monomial(float(t.sign), ((scope.table.add(f"{at}.gain", gain, t.gain), 1.0),))
    sizes = {"height": 1.0, "lever": 1.0, "depth": -1.0}
    return Monomial(
        float(t.sign),
        (
            _expansion(scope, at, t.expansion, t.hot),
            *((scope.table.add(f"{at}.{s}", LENGTH, getattr(t, s)), e) for s, e in sizes.items()),
        ),
    )
