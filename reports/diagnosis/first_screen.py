"""What precedes a diagnosis: the panel of an opened demonstration, and what further recordings changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from data.units import unit_label
from diagnosis.findings.schema import DetectionLimit, Finding, Findings
from reports.diagnosis import tables
from reports.labels import count, listed, three_digits
from reports.layout import Group, Heading, Pairs, Text

Outcome = Literal["found", "found_and_more", "other_place", "in_set", "missed", "wrong", "false_alarm", "nothing_right"]
RIGHT: tuple[Outcome, ...] = ("found", "nothing_right")  # outcomes of an answer that is right as a whole
MOST_PARAMETERS = 3  # in a sentence; the table has all
_LENGTHS = ("um", "mm", "nm")
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


@dataclass(frozen=True)
class Continued:
    """What was added to an earlier diagnosis: its findings `before`, the ids of the `new` recordings.

    `made`: those of them that follow the run which was proposed.
    """

    before: Findings
    new: tuple[str, ...]
    made: tuple[str, ...] = ()

    def sentences(self, after: Findings) -> list[str]:
        """What changed: the verdict, the first finding with its probability, whether the proposed run was made."""
        chips = [tables.CHIPS[f.verdict] for f in (self.before, after)]
        verdict = f"still {chips[1]}" if chips[0] == chips[1] else f"{chips[0]} → {chips[1]}"
        added = f"{listed(list(self.new), 4)} added, {count(len(after.batches), 'recording')} in all"
        said = [f"Verdict: {verdict} ({added})", f"First finding: {_first(self.before, after)}"]
        run = self.before.next_experiment
        if run is not None:
            given = f"The proposed run ({run.run.rstrip('.')})"
            own = f"is the recording {listed(list(self.made))}" if self.made else "is none of the new recordings"
            said.append(f"{given} {own}")
        return [f"{text}." for text in said]


def values_label(x: Finding) -> str:
    """``conductance 10.2 W/K (90 %: 8.9 to 11.6), follow 0.48``, three at most and how many more there are."""
    known = [(n, p) for n, p in x.parameters.items() if p.value is not None]
    free = [(n, p) for n, p in known if p.interval90 is not None and None not in p.interval90] or known
    said = []
    for name, p in free[:MOST_PARAMETERS]:
        assert p.value is not None
        text = f"{name.replace('_', ' ')} {three_digits(p.value)} {unit_label(p.unit)}".rstrip()
        low, high = p.interval90 or (None, None)
        if low is not None and high is not None:
            text += f" (90 %: {three_digits(low)} to {three_digits(high)})"
        said.append(text)
    more = len(known) - len(said)
    return ", ".join(said) + (f"; {more} more in the table" if more > 0 and said else "")


def _first(before: Findings, after: Findings) -> str:
    """``heat to the floor at bed, 52 % → 97 %``, or both where they differ."""
    old, new = (next(iter(f.findings), None) for f in (before, after))
    if old is None and new is None:
        return "none before and none now"
    if old is not None and new is not None and (old.mechanism, old.where) == (new.mechanism, new.where):
        chances = (tables.probability_label(x.probability) for x in (old, new))
        return f"{tables.effect_label(new)}, {' → '.join(chances)}"
    return " → ".join("none" if x is None else _with_probability(x) for x in (old, new))


def _with_probability(x: Finding) -> str:
    return f"{tables.effect_label(x)} ({tables.probability_label(x.probability)})"


def shortened(statement: str, most: int = MOST_PARAMETERS) -> str:
    """A statement of findings.json whose lists of values are cut after `most`, with how many more there are.

    Lists are ``dotted.name (old → new), …`` and what is between brackets with commas; tables have all of them.
    """
    text = statement
    for begin, end in reversed(_outer_brackets(text)):
        items = _split(text[begin + 1 : end - 1])
        if len(items) > most:
            cut = f"({', '.join(items[:most])} and {len(items) - most} more)"
            text = text[:begin] + cut + text[end:]
    for begin, end, items in reversed(_changed_values(text)):
        if len(items) > most:
            text = text[:begin] + f"{', '.join(items[:most])} and {len(items) - most} more" + text[end:]
    return text


def _outer_brackets(text: str) -> list[tuple[int, int]]:
    """Where brackets that are in no others open, and where they have closed; what does not close is none."""
    out, depth, begin = [], 0, 0
    for at, sign in enumerate(text):
        if sign == "(":
            begin = at if depth == 0 else begin
            depth += 1
        elif sign == ")" and depth > 0:
            depth -= 1
            if depth == 0:
                out.append((begin, at + 1))
    return out


def _split(text: str) -> list[str]:
    """Parts between commas outside brackets."""
    inner = _outer_brackets(text)
    commas = [k for k in range(len(text) - 1) if text[k : k + 2] == ", " and not any(a <= k < b for a, b in inner)]
    ends = [*commas, len(text)]
    begins = [0, *(k + 2 for k in commas)]
    return [text[a:b] for a, b in zip(begins, ends, strict=True)]


def _changed_values(text: str) -> list[tuple[int, int, list[str]]]:
    """Lists of ``dotted.name (…)`` joined by commas or "and": where each begins and ends, and its items."""
    found: list[tuple[int, int, list[str]]] = []
    for opening, end in _outer_brackets(text):
        begin = text.rfind(" ", 0, max(opening - 1, 0)) + 1
        if "." not in text[begin:opening]:
            continue
        if found and text[found[-1][1] : begin] in (", ", " and ", ", and "):
            first, _, items = found[-1]
            found[-1] = (first, end, [*items, text[begin:end]])
        else:
            found.append((begin, end, [text[begin:end]]))
    return found


def limits_sentence(limits: Sequence[DetectionLimit]) -> str:
    """Which displacement would be claimed on each error channel, in the channel's unit; empty where none is known.

    Of the mechanisms that move a channel by themselves, each at the driver or body where least is seen, the one that
    needs most is named. What acts through a temperature has its limit in another unit and is in the table.
    """
    least: dict[str, dict[str, tuple[float, str]]] = {}
    for x in limits:
        if x.where.kind == "error" and x.limit is not None and x.unit in _LENGTHS:
            own = least.setdefault(x.where.name, {})
            own[x.mechanism] = min((x.limit, unit_label(x.unit)), own.get(x.mechanism, (x.limit, unit_label(x.unit))))
    said = []
    for channel, own in sorted(least.items()):
        mechanism, (limit, unit) = max(own.items(), key=lambda item: item[1])
        said.append(f"on {channel} {tables.mechanism_label(mechanism)} from {three_digits(limit)} {unit}")
    return f"Would be claimed: {listed(said, MOST_PARAMETERS)}." if said else ""
