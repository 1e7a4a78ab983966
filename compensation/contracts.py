"""What passes between connectors, the runtime and the safety layer."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from math import isfinite
from typing import Any, Protocol

from data.errors import InputError


@dataclass(frozen=True)
class Sample:
    """What arrives from the machine at one moment.

    Attributes:
        time_s: Unix time at which the values were taken, s.
        values: channel name → value in the unit of the machine file; a channel that did not arrive is absent or NaN.
        readings_um: error channel → error in µm that a probe measured at this moment; arrives now and then.
    """

    time_s: float
    values: Mapping[str, float]
    readings_um: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Correction:
    """What the control is to add to its set points.

    Attributes:
        time_s: Unix time of the sample that it answers, s.
        offset_um: axis → origin shift K0 in µm; the negative of the expected error, limited in size and rate.
        slope_um_per_m: axis → slope tan β in µm per m of travel; only axes whose error depends on the position.
        state: axis → `off`, `warm-up`, `active`, `hold` or `fade-out`.
        reasons: axis → why it is not `active`, or acts with reduced authority, and what its model is, where that is
            no champion; empty where there is neither.
        heartbeat: counts the corrections; one that stands still says that nobody computes them any more.
        valid_until_s: Unix time after which a receiver should hold what it has, and then fade, s.
    """

    time_s: float
    offset_um: Mapping[str, float]
    slope_um_per_m: Mapping[str, float] = field(default_factory=dict)
    state: Mapping[str, str] = field(default_factory=dict)
    reasons: Mapping[str, str] = field(default_factory=dict)
    heartbeat: int = 0
    valid_until_s: float = 0.0


class Source(Protocol):
    """Where samples come from."""

    def samples(self) -> Iterator[Sample | None]:
        """Samples as they arrive, in any order of their times; None when none has arrived for a while (at least once a
        second), so that the runtime notices silence. Ends when the source has ended for good."""

    def close(self) -> None:
        """Gives back what is open; may be called twice."""


class Sink(Protocol):
    """Where corrections go."""

    def write(self, correction: Correction) -> None:
        """Hands one correction over; never blocks for longer than a second.

        Raises:
            WorkError: it cannot be delivered, with the address and what to do.
        """

    def close(self) -> None:
        """Gives back what is open; may be called twice."""


def check_limits(what: str, limits: Any, may_be_zero: Collection[str] = ()) -> None:
    """Raises InputError where a field of a dataclass of limits is no finite number above 0, or at 0 where it may be."""
    for name, spec in limits.__dataclass_fields__.items():
        value, zero = getattr(limits, name), name in may_be_zero
        if not isinstance(value, int | float) or not isfinite(value) or value < 0 or (value == 0 and not zero):
            bound = "at or above 0" if zero else "above 0"
            raise InputError(
                f"{what}: got {name}={value!r}, expected a finite number {bound}; leave it out for the default of "
                f"{spec.default}"
            )
