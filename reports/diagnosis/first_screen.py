"""What stands above a diagnosis: the claim of a finding, limits, and what further recordings changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from data.units import unit_label
from diagnosis.findings.schema import DetectionLimit, Finding, Findings
from reports.diagnosis import tables
from reports.labels import count, listed, three_digits

MOST_PARAMETERS = 3  # in a sentence; the table has all
_LENGTHS = ("um", "mm", "nm")


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


def claim(x: Finding) -> tuple[str, str]:
    """How sure a finding is; what is missing, where, when and how much, then what these runs cannot distinguish.

    The probability is that of all of these together.
    """
    tied = list(dict.fromkeys(tables.effect_label(o) for o in x.alternatives if o.alike))
    own = [tables.effect_label(x), "" if x.when.regime == "always" else f"when {x.when.regime}", values_label(x)]
    text = ", ".join(filter(None, own))
    if tied:
        text += f"; or, which these runs cannot distinguish from it, {listed(tied, MOST_PARAMETERS, 'or')}"
    return f"{tables.probability_label(x.probability)}, {tables.likelihood(x.probability)}", f"{text}."


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


def without_finding(f: Findings) -> str:
    """What stands below the headline of a verdict that no finding speaks for."""
    if f.verdict != "consistent":
        return "None of the explanations that were tried is probable enough for a claim."
    text = (
        f"In {count(f.fit.batches, 'left-out run')} the simulation misses no more than noise and a coarse network leave"
    )
    text += "; an effect above the limits below would be claimed." if f.detection_limits else "."
    return f"{text} {limits_sentence(f.detection_limits)}".rstrip()


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
