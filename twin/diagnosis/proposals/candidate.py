"""A candidate: what may be missing and where, as a change of a machine file's twin part."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from pydantic import BaseModel

from twin.diagnosis.proposals.values_of_part import with_parts, with_value
from twin.quantity import Parameter, Value
from twin.schema import MechanismPart, TwinPart

Kind = Literal["node", "link", "sensor", "error"]
RIVALS = ("wrong_parameter", "coarse_network", "varies_between_runs")  # no mechanisms: what else explains a mismatch


@dataclass(frozen=True)
class Where:
    """A place: a body or surrounding (node), a link or exposure (link), a sensor or an error channel."""

    kind: Kind
    name: str


@dataclass(frozen=True)
class Change:
    """A value of the machine file that a rival doubts: freed with this spread, or different from run to run."""

    parameter: Parameter
    spread: float | None = None  # in the fitting coordinate
    per_batch: float | None = None


@dataclass(frozen=True)
class Candidate:
    """One mechanism at one place, or a rival that needs no new physics.

    `part` is the instance as a machine file would state it, every value fixed at `Spec.value`; `amplitudes` its
    parameters that switch it off and the values at which they do; `shape` those that are freed beside them. A rival
    that changes a value has a `change` instead, one that cuts a body has `parts`.
    """

    mechanism: str
    where: Where
    name: str  # unique; the instance's name in a machine file
    words: str
    part: MechanismPart | None = None
    amplitudes: Mapping[str, float] = field(default_factory=dict)
    shape: tuple[str, ...] = ()
    fault: bool = False
    change: Change | None = None
    variant_of: str = ""  # the name of what this is at another value of its shape
    parts: Mapping[str, BaseModel] = field(default_factory=dict)  # by path: what a finer network states anew

    @property
    def plain(self) -> str:
        """The name, the same at every value at which its shape is looked for."""
        return self.variant_of or self.name

    def applied(self, part: TwinPart, values: Mapping[str, Value] | None = None) -> TwinPart:
        """The twin part with this candidate in it; `values` replace its parameters' own.

        Raises:
            ValueError: the name is taken.
        """
        if self.change is not None:
            new = {"spread": self.change.spread, "per_batch": self.change.per_batch}
            return with_value(part, self.change.parameter, **{k: v for k, v in new.items() if v is not None})
        if self.parts:
            return with_parts(part, self.parts)
        assert self.part is not None
        if self.name in part.mechanisms:
            raise ValueError(f"mechanisms.{self.name}: is there already; the candidate needs another name")
        given = self.part.model_copy(update={"parameters": {**self.part.parameters, **(values or {})}})
        return with_parts(part, {f"mechanisms.{self.name}": given})
