"""The contract of a check for faults in recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import Check
from data.machine import Machine
from thermodrift.testing.contract import Suite, expect
from thermodrift.testing.recordings import toy_batch, toy_machine

Fault = Callable[[Batch], Batch]
N_CLEAN = 6


@cache
def recording(seed: int) -> Batch:
    return toy_batch(seed)


@dataclass(frozen=True)
class CheckCase:
    """A check, clean recordings, and a recording with its fault where one is given."""

    check: type[Check]
    fault: Fault | None
    channel: str | None

    @property
    def machine(self) -> Machine:
        return toy_machine()

    @property
    def clean(self) -> list[Batch]:
        return [recording(seed) for seed in range(N_CLEAN)]

    @cached_property
    def faulty(self) -> Batch:
        """The recording with the fault; a clean one without."""
        batch = recording(N_CLEAN)
        return batch if self.fault is None else self.fault(batch)

    @cached_property
    def findings(self) -> list[Finding]:
        """In the faulty recording."""
        return self.found(self.faulty)

    def found(self, batch: Batch) -> list[Finding]:
        """In one recording, alone and among clean ones."""
        check = self.check()
        across = check.across([*self.clean, batch], self.machine)
        return [*check.batch(batch, self.machine), *across.get(N_CLEAN, [])]


SUITE: Suite[CheckCase] = Suite()


@SUITE.check("findings, overrules and the documentation name a check by its key")
def says_what_it_is(c: CheckCase) -> None:
    cls = c.check
    expect(issubclass(cls, Check), "a subclass of data.checks.base.Check", cls)
    expect(cls.key and cls.key.isidentifier(), "a key that a machine file can name", cls.key)
    expect(cls.summary and "\n" not in cls.summary, "a summary of one line", cls.summary)


@SUITE.check("a false finding takes good rows out of the training, run after run")
def clean_recordings_raise_nothing(c: CheckCase) -> None:
    for seed, batch in enumerate(c.clean):
        found = c.check().batch(batch, c.machine)
        expect(not found, f"no finding in the clean recording {seed}", [f.message for f in found])
    across = c.check().across(c.clean, c.machine)
    expect(not any(across.values()), "no finding among clean recordings", across)


@SUITE.check("a check that finds nothing is none")
def its_fault_is_found(c: CheckCase) -> None:
    if c.fault is not None:
        found = c.findings
        expect(any(f.channel == c.channel for f in found), f"a finding of channel {c.channel}", found)
        others = [f for f in found if f.masks and f.channel != c.channel]
        expect(not others, "no mask of another channel", others)


@SUITE.check("the report prints them, masks are cut by them, an overrule must match them")
def findings_have_key_channel_time_and_message(c: CheckCase) -> None:
    end_s = float(c.faulty.time_s[-1])
    for f in c.findings:
        expect(f.check == c.check.key, f"the check's key {c.check.key} in a finding", f.check)
        expect(f.channel is None or f.channel in c.faulty.channels, "a channel of the recording, or None", f.channel)
        begin, until = f.start_s or 0.0, end_s if f.end_s is None else f.end_s
        expect(0.0 <= begin <= until <= end_s, f"start before end within 0 to {end_s:g} s", (f.start_s, f.end_s))
        expect(f.message and "\n" not in f.message, "a message of one line", repr(f.message))
        expect(isinstance(c.check().habit(c.faulty, f), str), "a text as habit", c.check().habit(c.faulty, f))


@SUITE.check("an ingest that is repeated must find the same, and the lake keeps what was recorded")
def the_same_every_time_and_nothing_is_changed(c: CheckCase) -> None:
    before, findings = c.faulty.table.copy(), c.faulty.findings
    again = c.found(c.faulty)
    expect(again == c.findings, "the same findings twice", again)
    expect(c.faulty.table.equals(before), "the table as it was", "another one")
    expect(c.faulty.findings == findings, "findings returned, not kept", c.faulty.findings)


@SUITE.check("a logger that stops at once, a sensor that never sends, a machine with one run")
def little_is_survived(c: CheckCase) -> None:
    whole = c.faulty
    two = replace(whole, table=whole.table.iloc[:2].reset_index(drop=True))
    dead = replace(whole, table=whole.table.assign(front=np.nan, spindle_rpm=np.nan))
    fewer = {n: s for n, s in whole.channels.items() if n not in ("front", "spindle_rpm")}
    lacking = replace(whole, table=whole.table.drop(columns=["front", "spindle_rpm"]), channels=fewer)
    for batch in (two, dead, lacking):
        c.found(batch)
        c.check().across([batch], c.machine)
    c.check().across([], c.machine)
