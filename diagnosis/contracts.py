"""Types that the stages of a diagnosis share: candidates as changes of a twin part, and points of a fit."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel

from data.arrays import Array
from data.batch import Batch
from data.machine import Machine
from twin.calibration.fit_problem import x_of
from twin.calibration.problem import CalibrationProblem
from twin.quantity import Parameter, Value
from twin.schema import MechanismPart, TwinPart

# of a twin part, whose members have names
PART_GROUPS = ("materials", "surroundings", "bodies", "links", "exposures", "mechanisms", "sensors", "errors")
_INDEX = re.compile(r"^(\w+)\[(\d+)\]$")


def with_parts(part: TwinPart, parts: Mapping[str, BaseModel | None]) -> TwinPart:
    """The part with others in it by path ("bodies.bed"), new or in place of what was there; None takes one out."""
    update: dict[str, dict[str, Any]] = {}
    for path, given in parts.items():
        group, name = path.split(".", 1)
        members = update.setdefault(group, dict(getattr(part, group)))
        if given is None:
            members.pop(name, None)
        else:
            members[name] = given
    return part.model_copy(update=update)


def with_value(part: TwinPart, parameter: Parameter, **changes: Any) -> TwinPart:
    """The part in which one parameter's value is changed (`value`, `spread`, `per_batch`, …), written out if it was
    a default.

    Raises:
        ValueError: the part does not state it and cannot (a built-in material's property).
    """
    group, rest = parameter.name.split(".", 1)
    name, steps = _split(part, group, rest)
    members = dict(getattr(part, group))
    if name not in members:
        raise ValueError(f"twin.{parameter.name}: is no value of the machine file; state it there first")
    members[name] = _changed(members[name], steps, parameter, changes)
    return part.model_copy(update={group: members})


def _split(part: TwinPart, group: str, rest: str) -> tuple[str, list[str]]:
    """A member's name may hold dots of its own ("column@0.8-bed"): the longest that the part knows."""
    steps = rest.split(".")
    for n in range(len(steps) - 1, 0, -1):
        if ".".join(steps[:n]) in getattr(part, group):
            return ".".join(steps[:n]), steps[n:]
    return steps[0], steps[1:]


def _changed(owner: Any, steps: list[str], parameter: Parameter, changes: dict[str, Any]) -> Any:
    if isinstance(owner, MechanismPart) and len(steps) == 1:
        old = owner.parameters.get(steps[0])
        return owner.model_copy(update={"parameters": {**owner.parameters, steps[0]: _new(old, parameter, changes)}})
    if isinstance(owner, MechanismPart) and steps[0] == "into" and isinstance(owner.into, dict):
        place = ".".join(steps[1:])
        old = owner.into[place]
        new = _new(old if isinstance(old, Value) else None, parameter, changes)
        return owner.model_copy(update={"into": {**owner.into, place: new}})
    indexed = _INDEX.match(steps[0])
    if indexed:
        items = list(getattr(owner, indexed[1]))
        items[int(indexed[2])] = _changed(items[int(indexed[2])], steps[1:], parameter, changes)
        return owner.model_copy(update={indexed[1]: tuple(items)})
    if len(steps) != 1 or not isinstance(owner, BaseModel):
        raise ValueError(f"twin.{parameter.name}: is no value of the machine file; state it there first")
    return owner.model_copy(update={steps[0]: _new(getattr(owner, steps[0]), parameter, changes)})


def _new(old: Value | None, parameter: Parameter, changes: dict[str, Any]) -> Value:
    base = old if old is not None else Value(value=parameter.value, source=parameter.source)
    return base.model_copy(update=changes)


Kind = Literal["node", "link", "sensor", "error"]


class CandidateKind(StrEnum):
    """What a candidate or a finding is, by its `mechanism` key; `LISTED` are the laws of the library."""

    LISTED = "listed"
    SENSOR_SWAP = "sensor_swap"
    WRONG_PARAMETER = "wrong_parameter"
    FREE_FLUX = "free_flux"
    FREE_SHIFT = "free_shift"
    UNLISTED = "unlisted"

    @classmethod
    def of(cls, mechanism: str) -> CandidateKind:
        """The kind of a mechanism key."""
        return cls._value2member_map_.get(mechanism, cls.LISTED)  # type: ignore[return-value]

    @property
    def is_unlisted(self) -> bool:
        """Whether it represents physics that no listed mechanism describes."""
        return self in (CandidateKind.FREE_FLUX, CandidateKind.FREE_SHIFT, CandidateKind.UNLISTED)


@dataclass(frozen=True)
class Where:
    """A place: a body or surrounding (node), a link or exposure (link), a sensor or an error channel."""

    kind: Kind
    name: str


@dataclass(frozen=True)
class Change:
    """A value of the machine file that is doubted: freed with this spread, in the fitting coordinate."""

    parameter: Parameter
    spread: float


@dataclass(frozen=True)
class Candidate:
    """One mechanism at one place, or an alternative that needs no new physics.

    Attributes:
        part: the instance as a machine file would state it, every value fixed at `Spec.value`.
        amplitudes: the parameters that switch it off, with the values at which they do.
        shape: parameters that are freed with them.
        change: of an alternative that changes a value.
    """

    mechanism: str
    where: Where
    name: str  # unique; the instance's name in a machine file
    label: str
    part: MechanismPart | None = None
    amplitudes: Mapping[str, float] = field(default_factory=dict)
    shape: tuple[str, ...] = ()
    fault: bool = False
    change: Change | None = None
    variant_of: str = ""  # the name of what this is at another value of its shape

    @property
    def kind(self) -> CandidateKind:
        return CandidateKind.of(self.mechanism)

    @property
    def base_name(self) -> str:
        """The name, the same at every value at which its shape is looked for."""
        return self.variant_of or self.name

    def applied(self, part: TwinPart, values: Mapping[str, Value] | None = None) -> TwinPart:
        """The twin part with this candidate in it; `values` replace its parameters' own.

        Raises:
            ValueError: the name is taken.
        """
        if self.change is not None:
            return with_value(part, self.change.parameter, spread=self.change.spread)
        assert self.part is not None
        if self.name in part.mechanisms:
            raise ValueError(f"mechanisms.{self.name}: is there already; the candidate needs another name")
        given = self.part.model_copy(update={"parameters": {**self.part.parameters, **(values or {})}})
        return with_parts(part, {f"mechanisms.{self.name}": given})


@dataclass(frozen=True)
class Scored:
    """A candidate with what the screen says of it; the amplitude in its own unit (of a value's logarithm: a factor).

    `gain` in nats of log evidence, `absorbed` the share of its signature that a recalibration and structure take, `sd`
    of its amplitude, `prior` the sd of that before, `column` of its signature in the screen, -1 where it has none.
    """

    candidate: Candidate
    gain: float = 0.0
    absorbed: float = 0.0
    amplitudes: Mapping[str, float] = field(default_factory=dict)
    sd: float = 0.0
    prior: float = 0.0
    column: int = -1


@dataclass(frozen=True, eq=False)  # compared by identity, so that results may be cached by fit
class Point:
    """A twin part and the problem that its recordings pose, at z (p,) and at the batches' own unknowns."""

    machine: Machine
    part: TwinPart
    batches: tuple[Batch, ...]
    problem: CalibrationProblem
    z: Array
    nuisance: list[Array]
    lead_rows: float  # by how many rows a driver's change comes before the row that first shows it

    @cached_property
    def x(self) -> Array:
        return x_of(self.problem.unknowns, self.z)

    @cached_property
    def values(self) -> Array:
        """Parameter values (n,) of the network."""
        return self.problem.values_at(self.x)

    @property
    def step_s(self) -> float:
        """The longest spacing of the recordings' rows."""
        return max(b.step_s for b in self.batches)

    @cached_property
    def rows(self) -> Array:
        """Rows (K,) of each channel in all batches."""
        every = np.concatenate([m.channel for m in self.problem.measured])
        return np.bincount(every, minlength=len(self.problem.channels)).astype(float)


# Left-out values throughout. kind and name: where, as in the findings; or a candidate's unique name.
# Errors less their first sample, sensors in degC; gain in nats of left-out log score.
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "rms": ("batch", "channel", "unit", "rows", "before", "after", "floor"),
    "series": ("batch", "channel", "unit", "time_s", "recorded", "before", "after"),
    "acf": ("channel", "lag_s", "before", "after"),
    "candidates": ("rank", "mechanism", "kind", "name", "words", "cluster", "gain", "improved", "batches", "absorbed",
                   "amplitude", "unit", "probability"),
    "map": ("kind", "place", "by", "label", "value", "unit", "z"),  # by: batch, regime, hour or since_start
    "steps": ("step", "words", "gain", "threshold", "probability", "improved", "accepted"),
    "refinements": ("what", "why", "before", "after"),
    "limits": ("mechanism", "kind", "name", "words", "limit", "unit", "absorbed", "absorbed_by"),
    "flux": ("kind", "place", "batch", "time_s", "value", "sd", "unit"),
}  # fmt: skip
