"""The panel of an opened demonstration, above the page of its diagnosis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from diagnosis.findings.schema import Finding
from reports.diagnosis import tables
from reports.diagnosis.first_screen import MOST_PARAMETERS, values_label
from reports.labels import listed
from reports.layout import Group, Heading, Pairs, Text

Outcome = Literal["found", "found_and_more", "other_place", "in_set", "missed", "wrong", "false_alarm", "nothing_right"]
RIGHT: tuple[Outcome, ...] = ("found", "nothing_right")  # outcomes of an answer that is right as a whole
_HEADLINES = {
    "found": "Found: what was concealed is what was named.",
    "found_and_more": "Found, but something that is not true was named as well.",
    "other_place": "Half right: the effect was named, at a wrong place.",
    "in_set": "Not settled: what was concealed is among the explanations that these recordings cannot distinguish.",
    "missed": "Not found: something was concealed, and no effect was named.",
    "wrong": "Not found: something else was named than what was concealed.",
    "false_alarm": "False alarm: nothing was concealed, and the diagnosis did not call that consistent.",
    "nothing_right": "Right: nothing was concealed, and nothing was named.",
}


@dataclass(frozen=True)
class Unsealed:
    """A demonstration that was opened: what was concealed, in words, and which finding counts for it.

    `finding` is the one that counts, or the first that was named; `false` are the other claims that are not true.
    `digest` is what the answer was committed to by at `sealed_at` (UTC), `isolation` how the answering process was
    kept away from it.
    """

    outcome: Outcome
    concealed: str
    finding: Finding | None
    false: tuple[Finding, ...]
    verdict: str
    digest: str
    sealed_at: str
    seed: int
    isolation: str

    @property
    def headline(self) -> str:
        """The outcome in plain words."""
        return _HEADLINES[self.outcome]

    def panel(self, errors: Sequence[str], corrected: bool) -> Group:
        """Outcome, what was concealed and named, left-out errors (before and after where `corrected`), and the seal."""
        named, x = f"nothing; verdict: {tables.CHIPS[self.verdict]}", self.finding
        lines = []
        if x is not None:
            named = tables.effect_label(x)
            sure = f"{tables.probability_label(x.probability)}, {tables.likelihood(x.probability)}"
            lines += [Text(values_label(x), "small"), Text(f"probability {sure}", "small")]
        if self.false:
            untrue = listed([tables.effect_label(x) for x in self.false], MOST_PARAMETERS)
            lines.append(Text(f"not true: {untrue}", "wrong"))
        found = "Named" if self.outcome in ("missed", "wrong", "false_alarm", "nothing_right") else "Found"
        left = "Left-out error, before → after" if corrected else "Left-out error, nothing corrected"
        three = (
            ("Concealed", self.concealed[:1].upper() + self.concealed[1:]),
            (found, (Text(named[:1].upper() + named[1:]), *(t for t in lines if t.text))),
            (left, tuple(Text(line) for line in errors)),
        )
        when = self.sealed_at.replace("T", " ").replace("Z", " UTC")
        note = (
            "The recordings are simulated, with an effect that the machine file does not have, or with none. Seed "
            f"{self.seed} drew what it is, and it was sealed on {when}, before the diagnosis began. The diagnosis ran "
            f"in a process that could read the machine file and the recordings and not the answer ({self.isolation})."
        )
        blocks = (
            Text("thermodrift demonstration", "eyebrow"),
            Heading(self.headline, simulated=True, level=2),
            Pairs(three, "three"),
            Text(note, "note"),
            Text(f"seal, SHA-256: {self.digest}", "note digest"),
        )
        return Group(blocks, f"unsealed {'right' if self.outcome in RIGHT else 'off'}")
