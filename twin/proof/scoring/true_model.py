"""The twin with the true terms added, refitted: how much of the left-out error they explain, and which are visible."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TrueModel:
    """Errors in units of the noise (`error_level`), of the baseline and of the true model; one entry a term below.

    `gain_nats` and `threshold_nats` of each term with the others in; `visible` says whether it counts.
    """

    error_before: float
    error_true: float
    error_floor: float
    gain_nats: tuple[float, ...]
    threshold_nats: tuple[float, ...]
    visible: tuple[bool, ...]
