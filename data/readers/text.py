"""How a text file is written: encoding, separator, decimal mark. Settled by the names that are expected in it."""

from __future__ import annotations

import codecs
import csv
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Sequence

from data.errors import InputError
from data.readers.cells import parse_number

_BOMS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_SEPARATORS = (",", ";", "\t", "|")
_WORDS = ("温度", "时间", "時間", "日時", "位移", "変位", "主轴", "主軸", "转速", "回転", "环境", "室温", "進給",
          "轴", "軸", "℃", "°C", "µm", "temperatur", "weg", "zeit", "vorschub", "drehzahl")  # fmt: skip
_EUROPEAN = frozenset("äöüßéèêàâçîôûñóíáúåøæÄÖÜÉµ°²³±·–€")
_POINT = re.compile(r"\s*[+-]?\d*\.\d+([eE][+-]?\d+)?\s*")
_COMMA = re.compile(r"\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*")


def normalise(name: object) -> str:
    """A header as it is compared: one form of µ and full-width letters, no case, single spaces."""
    return " ".join(unicodedata.normalize("NFKC", str(name)).casefold().split())


def find_encoding(raw: bytes, hints: Sequence[str], where: str) -> str:
    """Codec name of the first bytes of a file.

    A byte order mark decides; then zero bytes (UTF-16); then strict UTF-8. Of GB18030, Shift-JIS (cp932) and CP1252
    that one wins in which most of the expected names are found, then the one whose characters are common.

    Raises:
        InputError: not a text file.
    """
    for bom, name in _BOMS:
        if raw.startswith(bom):
            return name
    if b"\0" in raw:
        even, odd = raw[0::2].count(0), raw[1::2].count(0)
        if min(even, odd) * 10 < max(even, odd) and max(even, odd) * 4 > len(raw) // 2:
            return "utf-16-le" if odd > even else "utf-16-be"
        raise _not_text(where)
    control = sum(raw.count(bytes([c])) for c in (*range(1, 9), 11, *range(14, 26), 28, 29, 30, 31))
    if control * 100 > len(raw):
        raise _not_text(where)
    if _decodes(raw, "utf-8"):
        return "utf-8"
    candidates = [e for e in ("gb18030", "cp932", "cp1252") if _decodes(raw, e)]
    wanted = [normalise(h) for h in hints if not h.isascii()]

    def score(name: str) -> tuple[int, int, float]:
        text = raw.decode(name, "replace")
        folded = normalise(text)
        return sum(h in folded for h in wanted), sum(w in text or w in folded for w in _WORDS), _common(text, name)

    return max(candidates, key=score) if candidates else "cp1252"


def _not_text(where: str) -> InputError:
    return InputError(f"{where}: not a text file (binary content); expected CSV text; export the recording again")


def _decodes(raw: bytes, encoding: str) -> bool:
    try:
        codecs.getincrementaldecoder(encoding)("strict").decode(raw, False)
    except UnicodeDecodeError:
        return False
    return True


def _common(text: str, encoding: str) -> float:
    """Share of the non-ASCII characters that are everyday ones in that encoding."""
    foreign = [c for c in text if ord(c) > 127]
    tests: dict[str, Callable[[str], bool]] = {
        "cp1252": _EUROPEAN.__contains__,
        "gb18030": lambda c: b"\xa1" <= c.encode("gb18030")[:1] <= b"\xd7" and c.encode("gb18030")[1:2] >= b"\xa1",
        "cp932": lambda c: b"\x81" <= c.encode("cp932", "replace")[:1] <= b"\x97",
    }
    return sum(map(tests[encoding], foreign)) / len(foreign) if foreign else 0.0


def find_separator(lines: Sequence[str], hints: Sequence[str]) -> str:
    """The separator with which most expected names stand as fields of one line, else most cells are numbers."""
    wanted = {normalise(h) for h in hints}
    best = {s: 0 for s in _SEPARATORS}
    for line in lines:
        folded = normalise(line.replace("\t", "\0")) if wanted else ""
        if not any(w in folded.replace("\0", " ") for w in wanted):
            continue
        for separator in _SEPARATORS:
            best[separator] = max(best[separator], len(wanted & {normalise(c) for c in split(line, separator)}))
    if max(best.values()) > 0:
        return max(_SEPARATORS, key=lambda s: best[s])

    sample = [line for line in lines if line.strip()][-50:]

    def numbers(separator: str) -> float:
        rows = [split(line, separator) for line in sample]
        width = Counter(len(row) for row in rows).most_common(1)[0][0] if rows else 1
        total = 0.0
        for row in rows:
            filled = [cell for cell in row if cell.strip()]
            good = sum(_is_number(cell) and "\t" not in cell for cell in filled)
            total += good * good / max(1, len(filled)) if len(row) == width > 1 else 0.0
        return total

    return max((";", "\t", "|", ","), key=numbers)  # the comma last: it may be a decimal mark


def _is_number(cell: str) -> bool:
    return parse_number(cell) is not None or parse_number(cell, ",") is not None


def split(line: str, separator: str) -> list[str]:
    """The fields of one line; quotes are understood."""
    if '"' not in line:
        return line.split(separator)
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:
        return line.split(separator)


def find_decimal(rows: Sequence[Sequence[str]]) -> str:
    """The decimal mark that more of the cells use."""
    count: Counter[str] = Counter()
    for row in rows[-200:]:
        for cell in row:
            if _POINT.fullmatch(cell):
                count["."] += 1
            elif _COMMA.fullmatch(cell):
                count[","] += 1
    return "," if count[","] > count["."] else "."
