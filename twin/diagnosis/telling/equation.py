"""A mechanism's equation with its fitted numbers in it."""

from __future__ import annotations

import re
from collections.abc import Mapping

from twin.diagnosis.telling.honest_digits import few, listed, with_unit
from twin.mechanisms.base import Mechanism

_DIGITS = 3
_PROSE = r"(?:after|always|and|at|by|else|from|if|in|is|no|of|or|so|then|through|to|until|where|while|with|within)"
_OPERAND_NEXT = rf" +(?=[\w(\[θα°|])(?!{_PROSE}\b)"


def equation_with_numbers(mechanism: type[Mechanism], values: Mapping[str, float]) -> str:
    """``P = 10.2 W/K · (T_floor - T)``: the parameters' names replaced by their values, in the mechanism's units.

    Three significant digits. A blank that means a product becomes a dot beside a number; what defines a parameter
    (``gain = ± α · length``) stays; parameters that the equation has under a symbol are told behind it.
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
    told = listed([words for _, words in sorted(behind)])
    return f"{text}; {told}" if told else text
