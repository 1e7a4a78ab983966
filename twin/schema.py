"""The twin part of a machine file: bodies, links, exposures, mechanisms, sensors and error chains, as written."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from data.errors import InputError
from data.machine import Machine, Section
from data.yaml_file import parse_part
from twin.quantity import Value

Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
Place = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*(@[0-9.]+(,[0-9.]+)?)?$")]  # a body, or a point in it


class Material(Section):
    """What a body is made of; built-in ones (steel, cast_iron, aluminium, …) are in `twin.schema`."""

    specific_heat: Value  # J/kg/K
    conductivity: Value  # W/m/K
    expansion: Value  # um/m/K


class Body(Section):
    """A part that stores heat: one lump, a bar of N cells along its length, or a plate of N × M cells.

    Capacity by itself or as mass × the material's specific heat. Bars and plates conduct inside by their material and
    size, or by `conductance` from one end to the other. Refining a casting means changing `cells`.
    """

    capacity: Value | None = None  # J/K, of the whole body
    mass: Value | None = None  # kg
    material: str | None = None
    shape: Literal["lump", "bar", "plate"] = "lump"
    cells: Annotated[int, Field(ge=1, le=400)] | tuple[int, int] = 1
    length: Value | None = None  # m, along the bar, or the plate's first side
    area: Value | None = None  # m², of the bar's section
    width: Value | None = None  # m, the plate's second side
    thickness: Value | None = None  # m, of the plate
    conductance: Value | None = None  # W/K, end to end of a bar, instead of material and size
    words: str = ""


class Link(Section):
    """Heat conduction between two places: a conductance, a joint (area × coefficient) or a bar (k A / L)."""

    between: tuple[Place, Place]
    conductance: Value | None = None  # W/K
    area: Value | None = None  # m²
    coefficient: Value | None = None  # W/m²/K of a joint
    length: Value | None = None  # m of a bar between the places
    material: str | None = None
    words: str = ""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, raw: Any) -> Any:
        return _conductance_alone(raw)


class Exposure(Section):
    """Heat exchange of a place (or, without @, of a whole body evenly) with a surrounding."""

    of: Place
    to: Name
    conductance: Value | None = None  # W/K
    area: Value | None = None  # m²
    coefficient: Value | None = None  # W/m²/K
    words: str = ""

    @model_validator(mode="before")
    @classmethod
    def _short(cls, raw: Any) -> Any:
        return _conductance_alone(raw)


class Surrounding(Section):
    """A temperature that the machine does not change: a recorded channel, a constant, or a batch's first readings.

    With all of `value`, `first` and `follow` it is value + follow (first − value): ground that follows the season
    in part. `offset` (K) is added; `per_batch` (K) is the prior sd of one more offset that every batch has of its own.
    Surroundings that the machine does warm (enclosure air, a tank) are bodies: expose to them by name.
    """

    channel: str | None = None
    value: Value | None = None  # degC
    first: tuple[str, ...] | None = None  # mean of these channels' first readings, held through the batch
    follow: Value | None = None  # share, of a constant that follows the first readings in part
    offset: Value | None = None  # K
    per_batch: str | float | None = None
    words: str = ""

    @model_validator(mode="after")
    def _one_kind(self) -> Surrounding:
        given = tuple(x is not None for x in (self.channel, self.value, self.first, self.follow))
        if given != (False, True, True, True) and (sum(given) != 1 or given[3]):
            raise ValueError(
                "a surrounding is one of channel (recorded), value (constant) or first (first readings), "
                "or value, first and follow together"
            )
        return self


class MechanismPart(Section):
    """One mechanism at work: its law (a key of `twin.mechanisms`), where, driven by what, with which parameters.

    `at` names the places that the law's temperatures come from, by port (a list is their mean) or, for a law with one
    port, just the place. `into` spreads heat over places as shares; one of them may be "rest". `acts_on` names the
    links, exposures, heat mechanisms, sensors, errors or surroundings that the law changes.
    """

    law: str
    at: Mapping[str, Place | tuple[Place, ...]] | Place | None = None
    into: Mapping[Place, Value | Literal["rest"]] | Place | None = None
    acts_on: tuple[str, ...] | str | None = None
    drivers: Mapping[str, str] | str | None = None
    parameters: Mapping[str, Value] = {}
    words: str = ""


class Sensor(Section):
    """A temperature channel of the recordings: where it sits and how it measures; the key is the channel."""

    at: Place
    air: Name | None = None  # the surrounding that cools a badly bonded sensor
    lag: Value | None = None  # s
    bonding: Value | None = None  # 1
    offset: Value | None = None  # K
    noise: str | float | None = None  # K, sd of the noise; default from the channel's resolution
    words: str = ""


class ChainLink(Section):
    """One expanding length of an error chain: sign × expansion × length × rise, or `gain` × rise."""

    body: Place
    length: Value | None = None  # m
    sign: Literal[1, -1] = 1
    expansion: Value | None = None  # um/m/K; default: the body's material
    gain: Value | None = None  # um/K, signed, where no length is known
    words: str = ""


class Tilt(Section):
    """Bending: angle = expansion × height × (hot − cold) / depth, the error is angle × lever; or `gain` alone."""

    hot: Place
    cold: Place
    height: Value | None = None  # m
    depth: Value | None = None  # m
    lever: Value | None = None  # m
    expansion: Value | None = None  # um/m/K; default: the hot body's material
    sign: Literal[1, -1] = 1
    gain: Value | None = None  # um/K
    words: str = ""


class ErrorChain(Section):
    """An error channel as a signed chain; the key is the channel. Plus closes the gap, unless `words` state otherwise.

    A closed chain of lengths gives no error when everything warms and expands equally; `uniform_length` (m) is
    what its signed lengths add up to (0 for a closed one). Chains with gains alone are not checked.
    """

    chain: tuple[ChainLink, ...] = ()
    tilts: tuple[Tilt, ...] = ()
    uniform_length: str | float = 0.0
    noise: str | float | None = None  # sd of the noise in the channel's unit; default from its resolution
    words: str = ""


class Calibrated(Section):
    """Where the values come from, written by `thermodrift calibrate`."""

    batches: tuple[str, ...]
    when: str  # ISO date and time
    simulated: bool = False
    left_out_rms: Mapping[str, float] = {}  # by channel in its unit; empty where no batch was left out
    words: str = ""


class TwinPart(Section):
    """The whole twin part."""

    materials: Mapping[Name, Material] = {}
    surroundings: Mapping[Name, Surrounding]
    bodies: Mapping[Name, Body]
    links: Mapping[str, Link] = {}
    exposures: Mapping[str, Exposure] = {}
    mechanisms: Mapping[Name, MechanismPart] = {}
    sensors: Mapping[str, Sensor] = {}
    errors: Mapping[str, ErrorChain] = {}
    initial_spread: str | float = "1 K"  # prior sd of a body's start temperature about the first readings
    calibrated: Calibrated | None = None

    @model_validator(mode="before")
    @classmethod
    def _ends_from_keys(cls, raw: Any) -> Any:
        """`shaft-front: 14 W/K` gives its two ends by its key."""
        if not isinstance(raw, dict):
            return raw
        raw = dict(raw)
        for group, ends in (("links", ("between",)), ("exposures", ("of", "to"))):
            if isinstance(raw.get(group), dict):
                raw[group] = {k: _with_ends(k, v, ends) for k, v in raw[group].items()}
        return raw


def _conductance_alone(raw: Any) -> Any:
    """{'value': …, 'spread': …} or "14 W/K" next to the ends is the conductance."""
    if not isinstance(raw, dict) or "value" not in raw:
        return raw
    value = {k: raw[k] for k in Value.model_fields if k in raw}
    return {"conductance": value} | {k: v for k, v in raw.items() if k not in value}


def _with_ends(key: Any, given: Any, ends: tuple[str, ...]) -> Any:
    if isinstance(given, str | int | float):
        given = {"value": given}
    if not isinstance(given, dict) or all(e in given for e in ends):
        return given
    parts = tuple(str(key).split("-"))
    if len(parts) != 2:
        return given  # the model reports the missing key
    return {**({ends[0]: parts} if len(ends) == 1 else dict(zip(ends, parts, strict=True))), **given}


def twin_part(machine: Machine, where: str = "") -> TwinPart:
    """The machine file's twin part, checked for form; `twin.compile` checks its sense.

    Raises:
        InputError: no twin part, an unknown key (with the closest), a wrong value; one line with file and key.
    """
    at = where or f"machine {machine.machine}"
    if machine.twin is None:
        raise InputError(f"{at}: key 'twin' is missing; add bodies, surroundings, links and sensors (see machines/)")
    return parse_part(machine.twin, TwinPart, at, "twin")


# The expansions of steel and iron are those of the sample machine; the rest are handbook values.
MATERIALS: Mapping[str, Mapping[str, float]] = MappingProxyType({
    "steel": {"specific_heat": 460.0, "conductivity": 48.0, "expansion": 11.5},
    "cast_iron": {"specific_heat": 500.0, "conductivity": 50.0, "expansion": 10.8},
    "aluminium": {"specific_heat": 900.0, "conductivity": 160.0, "expansion": 23.5},
    "polymer_concrete": {"specific_heat": 900.0, "conductivity": 1.7, "expansion": 16.0},
    "granite": {"specific_heat": 800.0, "conductivity": 2.8, "expansion": 6.5},
    "invar": {"specific_heat": 515.0, "conductivity": 11.0, "expansion": 1.3},
    "brass": {"specific_heat": 380.0, "conductivity": 115.0, "expansion": 19.0},
    "copper": {"specific_heat": 385.0, "conductivity": 390.0, "expansion": 16.8},
})  # fmt: skip


def several(on: tuple[str, ...] | str | None) -> tuple[str, ...]:
    """One place or several, as a tuple."""
    return (on,) if isinstance(on, str) else on or ()
