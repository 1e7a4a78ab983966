"""What a diagnosis hands to those who word it: one effect, where, how large, how sure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from twin.compiling.scope import several
from twin.diagnosis.proposals.candidate import Where
from twin.diagnosis.telling.findings import rms_key
from twin.diagnosis.telling.honest_digits import Estimate, listed
from twin.mechanisms import MECHANISMS
from twin.schema import MechanismPart, TwinPart

UNLISTED = ("free_flux", "free_shift", "unlisted")  # what stands in for physics that no listed mechanism describes


@dataclass(frozen=True)
class Rms:
    """Left-out errors of one channel without and with what was found, in `unit`; `noise` is what noise alone leaves."""

    channel: str
    unit: str
    before: float
    after: float
    noise: float = math.nan
    sensor: bool = False  # False: an error channel

    @property
    def key(self) -> str:
        return rms_key(self.channel, self.unit)

    @property
    def times_noise(self) -> float:
        """What is left after all that was found over the given noise; 0 where none is given."""
        return self.after / self.noise if self.noise > 0 else 0.0


@dataclass(frozen=True)
class Other:
    """Another explanation; `alike`: these runs cannot tell it from the one found."""

    mechanism: str
    where: Where
    place: str
    probability: float
    beside: str = ""
    alike: bool = True


@dataclass(frozen=True)
class Found:
    """One effect that a diagnosis found.

    `mechanism` is a registry key or a rival's, `place` and `beside` come from `place_words` and `beside_words`. For a
    wrong parameter `parameters` are by path ("exposures.front-air.conductance") and `was` has the file's values; for
    what varies between runs the one estimate is its sd, as a share where the unit is 1. `size` is what sentences call
    the effect's size where no parameter is (root mean square watts of a `free_flux`). `separates`: the run that would
    tell the alternatives apart ("a night switched off"), `caps`: what keeps the probability from being higher ("3 runs
    only").
    """

    mechanism: str
    where: Where
    place: str
    parameters: Mapping[str, Estimate]
    probability: float
    name: str = ""
    beside: str = ""
    others: tuple[Other, ...] = ()
    regime: str = "always"
    windows: tuple[tuple[str, float, float], ...] = ()
    rms: tuple[Rms, ...] = ()
    separates: str = ""
    caps: tuple[str, ...] = ()
    evidence: Mapping[str, Any] = field(default_factory=dict)
    was: Mapping[str, float] = field(default_factory=dict)
    size: Estimate | None = None

    @property
    def main(self) -> tuple[str, ...]:
        """Its parameters that say how large it is: the mechanism's amplitudes, else the first that was fitted."""
        scales = (MECHANISMS[self.mechanism].off or {}) if self.mechanism in MECHANISMS else {}
        own = tuple(p for p in scales if p in self.parameters)
        fitted = [p for p, e in self.parameters.items() if e.known]
        return tuple(p for p in own if p in fitted) or own[:1] or tuple(fitted[:1]) or tuple(self.parameters)[:1]

    @property
    def tied(self) -> tuple[Other, ...]:
        """Explanations that these runs cannot tell from it and that are at least half as probable."""
        if self.probability > 0.9:
            return ()
        return tuple(o for o in self.others if o.alike and o.probability >= self.probability / 2)


def times_noise(rms: Sequence[Rms]) -> float:
    """Left-out errors after all that was found over the given noise, the median over channels; 0 where none is."""
    return float(np.nanmedian([r.times_noise for r in rms if r.noise > 0] or [0.0]))


def place_words(where: Where, part: TwinPart) -> str:
    """``the bed``, ``the shaft and the front bearing housing`` of a link, channels by their name.

    A body goes by its `words`, or by its name with blanks for underscores (words with a colon explain, not name).
    """
    if where.kind == "link" and where.name in part.links:
        return listed([_thing(p, part) for p in part.links[where.name].between])
    if where.kind == "link" and where.name in part.exposures:
        exposure = part.exposures[where.name]
        return listed([_thing(p, part) for p in (exposure.of, exposure.to)])
    return _thing(where.name, part) if where.kind == "node" else where.name


def beside_words(given: MechanismPart, where: Where, part: TwinPart) -> str:
    """What else a mechanism looks at: ``surrounding: the room, speed: spindle_rpm``; nothing for the place itself."""
    ports = given.at if isinstance(given.at, Mapping) else {}
    at = {port: listed([_thing(p, part) for p in several(places)]) for port, places in ports.items()}
    told = [f"{port.replace('_', ' ')}: {place}" for port, place in at.items() if place != place_words(where, part)]
    if isinstance(given.drivers, Mapping):
        told += [f"{role.replace('_', ' ')}: {channel}" for role, channel in given.drivers.items()]
    elif given.drivers:
        told.append(f"driver: {given.drivers}")
    if where.kind != "node" and isinstance(given.at, str):
        told.insert(0, _thing(given.at, part))
    on = [target for target in several(given.acts_on) if target != where.name]
    if on:
        told.insert(0, f"{'with' if where.kind == 'sensor' else 'acts on'}: {listed(on)}")
    return ", ".join(told)


def _thing(place: str, part: TwinPart) -> str:
    """A body or surrounding with its article; numbered ones (node3) have none."""
    name, _, at = place.partition("@")
    held = part.bodies.get(name) or part.surroundings.get(name)
    words = held.words if held and held.words and ":" not in held.words else name.replace("_", " ")
    article = "" if words[-1].isdigit() or words.split()[0].lower() in ("a", "an", "the") else "the "
    return f"{article}{words}{f' at {at}' if at else ''}"
