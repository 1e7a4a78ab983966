"""What the reader had to repair in the recording's clock, told as findings that mask nothing."""

from __future__ import annotations

from data.batch import Batch, Finding
from data.checks.base import Check
from data.machine import Machine

_REPAIRS = {
    "unparsable_time": "rows without a readable time were dropped",
    "time_outliers": "rows with a time far off both neighbours were dropped",
    "backward_steps": "steps back in time were put in order",
    "clock_restarts": "restarts of the clock, carried on without a pause; how long the pause was is not known",
    "duplicates": "rows with the time of another row were averaged with it",
}


class Clock(Check):
    key = "clock"
    words = "the recording's clock was repaired"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        return [
            self.finding(None, f"clock: {batch.repairs[kind]} {words}", masks=False)
            for kind, words in _REPAIRS.items()
            if batch.repairs.get(kind)
        ]
