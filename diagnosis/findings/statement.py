"""The sentence for the engineer: claim, evidence, advice, caveat, and never more certain than the probability.

Every mechanism is described by its own `summary`, the place and its amplitude, so that a new one needs nothing here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from data.units import unit_label
from diagnosis.contracts import CandidateKind, Where
from diagnosis.findings.report_data import Effect, Other, Rms, beyond_noise, times_noise
from diagnosis.findings.schema import Alternative, DetectionLimit, Finding, FittedParameter, Place, Verdict, When
from diagnosis.formatting import amount, as_given, few, listed, of_error, percent, with_unit
from diagnosis.policy import POLICY
from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism

_DIGITS = 3
_PROSE = r"(?:after|always|and|at|by|else|from|if|in|is|no|of|or|so|then|through|to|until|where|while|with|within)"
_OPERAND_NEXT = rf" +(?=[\w(\[θα°|])(?!{_PROSE}\b)"


def equation_with_numbers(mechanism: type[Mechanism], values: Mapping[str, float]) -> str:
    """``P = 10.2 W/K · (T_floor - T)``: the parameters' names replaced by their values, in the mechanism's units.

    Three significant digits. A blank that means a product becomes a dot next to a number; what defines a parameter
    (``gain = ± α · length``) stays; parameters that the equation has under a symbol are appended.
    """
    text, behind = mechanism.equation, []
    for spec in sorted(mechanism.parameters, key=lambda s: -len(s.name)):
        if spec.name not in values:
            continue
        number = with_unit(few(values[spec.name], _DIGITS), spec.unit)
        name = rf"(?<![\w.]){re.escape(spec.name)}(?!\w|\(| *= )"
        marked = f"\x00{number}\x01"  # between two signs that no equation has, until all names are replaced
        text, factors = re.subn(name + _OPERAND_NEXT, f"{marked} · ", text)
        text, others = re.subn(name, marked, text)
        if not factors + others:
            behind.append((mechanism.parameters.index(spec), f"{spec.name.replace('_', ' ')} {number}"))
    text = re.sub(rf"(?<!\w)((?!{_PROSE} )[\w.]+|[)\]]) (?=\x00)", r"\1 · ", text)  # a factor before a number
    text = text.replace("\x01 \x00", "\x01 · \x00")
    text = re.sub(r"(?<=\^)\x00([^\x01]* [^\x01]*)\x01", r"(\1)", text)
    text = re.sub(r"\x00(−[^\x01]*)\x01", r"(\1)", text)
    text = text.replace("\x00", "").replace("\x01", "")
    appended = listed([text for _, text in sorted(behind)])
    return f"{text}; {appended}" if appended else text


_THINGS = {"sensor": "sensor|channel", "error": "channel", "link": "joint|link", "node": "body"}  # what words call it
_MAX_NAMED = 3  # limits, alternatives and parameters that a sentence names


def build_finding(effect: Effect) -> Finding:
    """The entry of findings.json, with its sentence, its equation with numbers, and its errors as evidence."""
    values = {p: e.value for p, e in effect.parameters.items()}
    figures = {"before": "before", "after": "after", "noise_floor": "noise"}
    rms = {key: {r.key: getattr(r, own) for r in effect.rms} for key, own in figures.items()}
    return Finding(
        mechanism=effect.mechanism,
        where=_place(effect.where),
        when=When(regime=effect.regime, windows=effect.windows),
        parameters={
            p: FittedParameter(value=e.value, unit=e.unit, interval90=(e.low, e.high) if e.known else None)
            for p, e in effect.parameters.items()
        },
        probability=effect.probability,
        alternatives=tuple(
            Alternative(
                mechanism=o.mechanism, where=_place(o.where), probability=o.probability, alike=o.indistinguishable
            )
            for o in effect.others
        ),
        equation=equation_with_numbers(MECHANISMS[effect.mechanism], values) if effect.mechanism in MECHANISMS else "",
        statement=statement(effect),
        evidence={**({"left_out_rms": rms} if effect.rms else {}), **effect.evidence},
        name=effect.name or None,
    )


def statement(effect: Effect) -> str:
    """Claim, evidence, advice and caveat of one effect, as a few short sentences on one line."""
    claim = claim_phrase(effect)
    reduced = reductions(effect.rms)
    if reduced:
        claim += f"; with it {reduced}"
        better, of = effect.evidence.get("batches_improved"), effect.evidence.get("batches")
        claim += f", more probable in {better} of {of} runs" if better is not None and of else ""
    return " ".join(
        [
            f"{claim}.",
            *_others(effect),
            *_advice(effect),
            *([f"No surer than that: {listed(effect.caps)}."] if effect.caps else []),
        ]
    )


def claim_phrase(effect: Effect) -> str:
    """What is missing, where and how much, without a full stop; the first letter is a capital."""
    if effect.tied:
        # what is claimed may be the less likely: a likelier, indistinguishable one may fail a criterion
        own = (
            effect.separate_probability,
            f"{effect_phrase(effect)}{_size(effect)} ({percent(effect.separate_probability)})",
        )
        tied = [(o.probability, f"{_other_phrase(o)} ({percent(o.probability)})") for o in effect.tied]
        phrases = [text for _, text in sorted([own, *tied], key=lambda s: -s[0])]
        n = len(phrases)
        number = {2: "two", 3: "three", 4: "four"}.get(n, str(n))
        return f"These runs cannot distinguish {number} explanations: {listed(phrases, 'or')}"
    hedge = _hedge(effect.probability)
    sentence = _sentence(effect)
    if sentence:
        return _capital(f"{hedge} {sentence}".strip())
    if effect.kind.is_unlisted:
        return _capital(f"{hedge} {effect_phrase(effect)}; no listed mechanism does this".strip())
    frame = "in the measurement" if MECHANISMS[effect.mechanism].fault else "missing"
    return f"{_capital(f'{hedge} {frame}'.strip())}: {effect_phrase(effect)}{_size(effect)}"


def effect_phrase(effect: Effect) -> str:
    """``heat to the floor at the bed``, and when; what has no listed mechanism by its size: ``60 W into the bed``."""
    if effect.kind.is_unlisted:
        return f"{_size(effect).removeprefix(', ')} {_inward(effect)}{_in_brackets(effect.context)}{_when(effect)}"
    return _noun(effect.mechanism, effect.where, effect.place, effect.context) + _when(effect)


def reductions(rms: Sequence[Rms], most: int = 2) -> str:
    """By how much the errors of the runs left out fall, the greatest reduction first, and which ones rise; empty where
    none falls."""
    rms = [r for r in rms if few(r.before) != few(r.after)]
    fallen = [r for r in rms if r.after < POLICY.reduced_max_share * r.before]
    fallen = sorted(fallen, key=lambda r: (r.after / r.before, r.channel))[:most]
    risen = [r for r in rms if r.before < POLICY.reduced_max_share * r.after and not r.after <= r.noise]
    risen = sorted(risen, key=lambda r: (-r.after / r.before, r.channel))[:most]
    phrases = []
    for k, r in enumerate(fallen):
        of = " of runs left out of the fit" if k == 0 else ""
        noise = f" (noise {few(r.noise)})" if r.noise > 0 else ""
        phrases.append(f"{_error_of(r)}{of} falls from {few(r.before)} to {of_error(r.after, r.unit)}{noise}")
    worse = listed([f"{_error_of(r)} rises from {few(r.before)} to {of_error(r.after, r.unit)}" for r in risen])
    return f"{listed(phrases)}{f', while {worse}' if worse and phrases else ''}"


def _error_of(r: Rms) -> str:
    return f"the misfit of the sensor {r.channel}" if r.sensor else f"the {r.channel} error"


def verdict_statement(
    verdict: Verdict,
    effects: Sequence[Effect] = (),
    rms: Sequence[Rms] = (),
    limits: Sequence[DetectionLimit] = (),
    separates: str = "",
    possible: Sequence[str] = (),
    places: Sequence[str] = (),
) -> str:
    """The verdict as a sentence.

    Args:
        limits: detection limits, the most informative first, with the `places` (`place_label`) of each.
        separates: the run that would distinguish the explanations `possible`, or show whether they hold.
    """
    # of several effects each says by itself how sure it is, and what may be in its place
    named = listed([effect_phrase(f) + ("" if f.kind.is_unlisted else _size(f)) + _doubt(f, effects) for f in effects])
    hedge = _hedge(effects[0].probability) if len(effects) == 1 else ""
    reduced = reductions(rms)
    if verdict == "consistent":
        return _consistent(rms, limits, places) + _open_question(separates, possible)
    if verdict == "undecidable":
        tied = effects and effects[0].tied
        text = "Something is missing." if tied else "Something is missing, and these runs do not show what."
        text += f" {claim_phrase(effects[0])}." if effects else ""
        if not tied:
            return text + _open_question(separates, possible)
        return text + (f" {_capital(separates)} would decide." if separates else "")
    if verdict == "unlisted":
        text = "No listed mechanism explains the difference"
        return f"{text}: {named}{f'; with it {reduced}' if reduced else ''}."
    if verdict == "partly_explained":
        text = _capital(f"{hedge} part of the difference is {named}".strip())
        still = [f"{r.channel} still at {few(r.times_noise)} times its noise" for r in beyond_noise(rms)[:_MAX_NAMED]]
        more = f"{text}{f'; with it {reduced}' if reduced else ''}. Not explained: {listed(still) or 'what remains'}."
        return more + _open_question(separates, possible)
    text = _capital(f"{hedge} the difference is {named}".strip())
    them = "it" if len(effects) == 1 else "them"
    noise_alone = f"With {them} every channel is within {few(POLICY.noise_max_ratio)} times its noise on runs left out"
    return f"{text}{f'; with it {reduced}' if reduced else ''}. {noise_alone}."


def _open_question(run: str, possible: Sequence[str]) -> str:
    """What these runs support too little for a claim, and the run that would show it."""
    return f" Too weak for a claim: {listed(possible)}. {_capital(run)} would show more." if run and possible else ""


def _consistent(rms: Sequence[Rms], limits: Sequence[DetectionLimit], places: Sequence[str]) -> str:
    largest = sorted(rms, key=lambda r: -r.times_noise)[:_MAX_NAMED]
    left = [f"{r.channel} {of_error(r.after, r.unit)}"
            + (f" (noise {few(r.noise)})" if r.noise > 0 else "") for r in largest]  # fmt: skip
    worst = beyond_noise(rms)
    text = "Nothing is missing: the remaining error is the noise"
    if worst:
        text = (
            f"No missing effect is supported by these runs; the remaining error, {few(times_noise(rms))} times the "
            f"noise in the median channel and {few(worst[0].times_noise)} times in {worst[0].channel}, is not "
            "explained: a network this coarse may leave as much"
        )
    text += f" ({', '.join(left)})" if left else ""
    least: dict[str, str] = {}  # of a mechanism with a dimension; the limits come by mechanism, the least first
    for n, place in zip(limits, places or [n.where.name for n in limits], strict=True):
        if n.limit is not None and n.unit not in ("", "1") and n.mechanism not in least:
            what = _noun(n.mechanism, Where(n.where.kind, n.where.name), place)
            least[n.mechanism] = f"{what} {with_unit(few(n.limit), n.unit)}"
    seen = list(least.values())[:_MAX_NAMED]
    rest = len(limits) - len(seen)
    more = f" and {rest} more in the table of limits" if rest else ""
    return f"{text}. An effect above these limits would be claimed: {', '.join(seen)}{more}." if seen else f"{text}."


def _sentence(effect: Effect) -> str:
    """The claim where it is a sentence by itself: alternatives, and summaries such as "sensor that drifts"."""
    if effect.kind is CandidateKind.WRONG_PARAMETER:
        was = {
            p: f"{with_unit(as_given(effect.was[p]), e.unit)} → "
            for p, e in effect.parameters.items()
            if p in effect.was
        }
        phrases = _few([f"{p} ({was.get(p, '')}{amount(e)})" for p, e in effect.parameters.items()])
        several = len(phrases) > 1
        return f"the value{'s' * several} of {listed(phrases)} in the machine file {'are' if several else 'is'} wrong"
    if effect.mechanism not in MECHANISMS or effect.kind.is_unlisted:
        return ""
    thing = re.match(rf"({_THINGS[effect.where.kind]}) that (.+)", MECHANISMS[effect.mechanism].summary)
    if not thing:
        return ""
    place = f" between {effect.place}" if effect.where.kind == "link" else f" {effect.place}"
    return f"the {thing[1]}{place} {thing[2]}{_in_brackets(effect.context)}{_when(effect)}{_size(effect)}"


def _noun(key: str, where: Where, place: str, context: str = "") -> str:
    """``heat to the floor at the bed``, ``constant error of the sensor front``; alternatives have own phrases."""
    names = {
        CandidateKind.WRONG_PARAMETER: f"a wrong value in the machine file ({where.name})",
        CandidateKind.UNLISTED: f"something of no listed mechanism {_at(where, place)}",
    }
    if key not in MECHANISMS:
        return names.get(CandidateKind.of(key), f"{key.replace('_', ' ')} {_at(where, place)}")
    text, linked = MECHANISMS[key].summary, "between " if where.kind == "link" else ""
    thing = re.search(rf"(^|\ba |\b)({_THINGS[where.kind]})\b", text)
    if (
        thing
    ):  # "a sensor" and a leading "sensor" become "the sensor front", "bonded sensor" becomes "bonded sensor front"
        the = "the " if thing[1] or thing.start() == 0 else ""
        named = f"{text[: thing.start()]}{the}{thing[2]} {linked}{place}{text[thing.end() :]}"
    elif where.kind == "sensor":
        named = f"{text}: {place}"
    else:
        named = f"{text} {_at(where, place)}"
    return named + _in_brackets(context)


def _at(where: Where, place: str) -> str:
    return {"node": f"at {place}", "link": f"between {place}", "error": f"in the {place} error",
            "sensor": f"of the sensor {place}"}[where.kind]  # fmt: skip


def _inward(effect: Effect) -> str:
    """Where what is not listed goes."""
    return {"node": f"into {effect.place}", "link": f"between {effect.place}", "error": f"in the {effect.place} error",
            "sensor": f"in what the sensor {effect.place} shows"}[effect.where.kind]  # fmt: skip


def _size(effect: Effect) -> str:
    """``, 10 W/K (90 %: 9–12)``; a bare number, or one of several, with its parameter's name."""
    if effect.size is not None:
        return f", {amount(effect.size)}"
    named = len(effect.main) > 1 or any(not unit_label(effect.parameters[p].unit) for p in effect.main)
    phrases = [f"{p.replace('_', ' ')} " * named + amount(effect.parameters[p]) for p in effect.main]
    return f", {listed(_few(phrases))}" if phrases else ""


def _few(phrases: list[str]) -> list[str]:
    """What a sentence names of several parameters; `findings.json` has all of them."""
    more = len(phrases) - _MAX_NAMED
    return phrases if more < 1 else [*phrases[:_MAX_NAMED], f"{more} more"]


def _others(effect: Effect) -> list[str]:
    """What would look the same, and the run that would distinguish them; what is less likely is not named."""
    same = [o for o in effect.others if o.indistinguishable and o not in effect.tied][:_MAX_NAMED]
    if not same:
        return [f"{_capital(effect.separates)} would distinguish them."] if effect.tied and effect.separates else []
    named = listed([f"{_other_phrase(o)} ({percent(o.probability)})" for o in same])
    run = f"; {effect.separates} would distinguish them" if effect.separates else ""
    return [f"{_capital(named)} would look the same in these runs{run}."]


def _doubt(effect: Effect, among: Sequence[Effect]) -> str:
    """`` (41 %; or radiation at the bed, 52 %)``: of one effect among several; nothing where it is sure. Of a single
    effect ``, or radiation at the bed``: what these runs cannot distinguish from it."""
    if len(among) == 1:
        return f", or {listed([_other_phrase(o) for o in effect.tied], 'or')}" if effect.tied else ""
    if effect.probability > POLICY.unhedged_probability:
        return ""
    tied = [f"{_other_phrase(o)}, {percent(o.probability)}" for o in effect.tied]
    return f" ({percent(effect.probability)}{''.join(f'; or {text}' for text in tied)})"


def _other_phrase(other: Other) -> str:
    return _noun(other.mechanism, other.where, other.place, other.context)


def _advice(effect: Effect) -> list[str]:
    if effect.mechanism in MECHANISMS and MECHANISMS[effect.mechanism].fault:
        return ["Check it at the machine before the model is changed."]
    if effect.kind is CandidateKind.WRONG_PARAMETER:
        return ["Check the value against the drawing or the data sheet."]
    return []


def _hedge(probability: float) -> str:
    if probability > POLICY.unhedged_probability:
        return ""
    return f"{'most likely' if probability >= POLICY.likely_probability else 'perhaps'} ({percent(probability)})"


def _when(effect: Effect) -> str:
    return "" if effect.regime in ("", "always") else f" (when: {effect.regime})"


def _in_brackets(context: str) -> str:
    return f" ({context})" if context else ""


def _place(where: Where) -> Place:
    return Place(kind=where.kind, name=where.name)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
