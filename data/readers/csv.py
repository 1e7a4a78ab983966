"""CSV reader: detects encoding, separator and decimal mark; blocks that pyarrow rejects are read as text."""

from __future__ import annotations

import codecs
import csv
import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv as pc

from data.errors import InputError
from data.readers.base import Block, Reader, Sheet
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


_HEAD_BYTES = 1 << 20
_BLOCK_BYTES = 4 << 20


class CsvSheet(Sheet):
    """A text file with separators. Encoding, separator and decimal mark are found from its first megabyte."""

    def __init__(self, path: Path, hints: Sequence[str]) -> None:
        self.path = path
        with path.open("rb") as file:
            raw = file.read(_HEAD_BYTES)
            more = bool(file.read(1))
        self.encoding = find_encoding(raw, hints, path.name)
        text = raw.decode(self.encoding, "replace")
        self._newline = "\n" if "\n" in text or "\r" not in text else "\r"
        lines = [line.rstrip("\r") for line in text.split(self._newline)]
        lines = lines[:-1] if (more and len(lines) > 1) or not lines[-1] else lines
        self.separator = find_separator(lines, hints)
        self.head = [split(line, self.separator) if line.strip() else [] for line in lines]
        self.decimal = find_decimal([[c for c in row] for row in self.head])
        self._quoted = '"' in text
        names = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar"}
        mark = "point" if self.decimal == "." else "comma"
        self.summary = f"{names[self.separator]} separated, decimal {mark}, {self.encoding}"

    def blocks(self, first_row: int, positions: Sequence[int], text: Collection[int] = ()) -> Iterator[Block]:
        widths = Counter(len(row) for row in self.head[first_row : first_row + 200] if row)
        if not widths:
            return
        named = len(self.head[first_row - 1]) if first_row else 0
        usual = widths.most_common(1)[0][0]
        width = max(max(positions) + 1, named if 5 * widths[named] > widths.total() else usual)
        for lines in self._bytes(first_row):
            yield self._parse(lines, width, positions, text)

    def _bytes(self, skip_lines: int) -> Iterator[bytes]:
        """The file below its first lines, as UTF-8 bytes in pieces that end with a line."""
        end = self._newline.encode()
        wide = self.encoding.startswith("utf-16")
        decoder = codecs.getincrementaldecoder(self.encoding)("replace") if wide else None
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            rest = b""
            while True:
                raw = file.read(_BLOCK_BYTES)
                last = len(raw) < _BLOCK_BYTES
                piece = rest + (decoder.decode(raw, last).encode() if decoder else raw)
                cut = len(piece) if last else piece.rfind(end) + 1
                piece, rest = piece[:cut], piece[cut:]
                start = 0
                while skip_lines and start < len(piece):
                    start = piece.find(end, start) + 1 or len(piece)
                    skip_lines -= 1
                piece = piece[start:] if start else piece
                if not wide and not piece.isascii():
                    piece = piece.decode(self.encoding, "replace").encode()
                if piece:
                    self.share_read = min(1.0, (file.tell() - len(rest)) / size)
                    yield piece
                if last:
                    return
                if len(rest) > 16 * _BLOCK_BYTES:
                    raise InputError(f"{self.path.name}: a line of more than 64 MB; expected CSV text; export it again")

    def _parse(self, lines: bytes, width: int, positions: Sequence[int], text: Collection[int]) -> Block:
        names = [f"c{i}" for i in range(width)]
        rejected: list[None] = []

        def skip(row: Any) -> str:
            rejected.append(None)
            return "skip"

        def read(types: dict[str, Any]) -> Any:
            rejected.clear()
            return pc.read_csv(
                pa.BufferReader(lines),
                read_options=pc.ReadOptions(column_names=names),
                parse_options=pc.ParseOptions(
                    delimiter=self.separator, quote_char='"' if self._quoted else False, invalid_row_handler=skip
                ),
                convert_options=pc.ConvertOptions(
                    column_types=types,
                    include_columns=[f"c{i}" for i in positions],
                    null_values=[""],
                    strings_can_be_null=True,
                    decimal_point=self.decimal,
                    check_utf8=False,
                ),
            )

        wanted = {f"c{i}": pa.string() if i in text else pa.float64() for i in positions}
        try:
            table = read(wanted)
        except pa.ArrowInvalid:
            try:
                table = read(dict.fromkeys(wanted, pa.string()))
            except pa.ArrowInvalid as error:
                if "Empty CSV" in str(error):
                    return Block({i: pa.array([], pa.float64()) for i in positions}, self._count(lines))
                raise InputError(
                    f"{self.path.name}: cannot be read as CSV ({str(error).splitlines()[0]}); export it again"
                ) from None
        # a lone quote may swallow lines: every line that came back as no row is a ragged one
        ragged = max(len(rejected), self._count(lines, table.num_rows) - table.num_rows)
        return Block({i: table.column(f"c{i}") for i in positions}, ragged)

    def _count(self, lines: bytes, expected: int = -1) -> int:
        """Lines that are not blank; the slow count only where the quick one does not fit."""
        end = self._newline.encode()
        quick = lines.count(end) + (not lines.endswith(end))
        if quick == expected:
            return quick
        return sum(1 for line in lines.split(end) if line.strip(b"\r\n"))


class CsvReader(Reader):
    """Comma, semicolon, tab or bar; UTF-8, UTF-16, GB18030, Shift-JIS, CP1252; decimal point or comma."""

    @contextmanager
    def open(self, path: Path, hints: Sequence[str]) -> Iterator[list[Sheet]]:
        yield [CsvSheet(path, hints)]


def read_text_table(path: Path) -> list[dict[str, str]]:
    """A small table of text, first row the header: one dict per row. For tables next to recordings, up to 1 MB."""
    head = CsvSheet(path, ()).head
    rows = [[cell.strip() for cell in row] for row in head if row]
    if not rows:
        return []
    return [dict(zip(rows[0], row + [""] * (len(rows[0]) - len(row)), strict=False)) for row in rows[1:]]
