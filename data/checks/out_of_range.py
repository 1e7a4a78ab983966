"""Samples outside the plausible range of the machine file."""

from __future__ import annotations

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import Check, span_words, stretches
from data.checks.signals import signals
from data.machine import Machine


class OutOfRange(Check):
    key = "out_of_range"
    words = "outside the plausible range of the machine file"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        found = []
        seen = signals(batch)
        for name, channel in batch.channels.items():
            if channel.low is None or channel.high is None:
                continue
            least, most = seen.extremes(name)
            if least >= channel.low and most <= channel.high:
                continue
            v = batch.masked(name)  # an infinite value is out of range as well
            with np.errstate(invalid="ignore"):
                out = (v < channel.low) | (v > channel.high)
            for a, b in stretches(out):
                worst = v[a : b + 1][np.argmax(np.abs(v[a : b + 1] - 0.5 * (channel.low + channel.high)))]
                found.append(
                    self.finding(
                        name,
                        f"{name} reads {worst:.5g} {channel.unit} {span_words(batch, a, b)}, outside "
                        f"{channel.low:g} to {channel.high:g}",
                        float(batch.time_s[a]),
                        float(batch.time_s[b]),
                    )
                )
        return found
