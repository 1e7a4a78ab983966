"""CSV reader: detects encoding, separator and decimal mark; blocks that pyarrow rejects are read as text."""

from __future__ import annotations

import codecs
import csv
import re
import unicodedata
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import pyarrow as pa
import pyarrow.csv as pc

from data.errors import InputError
from data.machine import Form
from data.readers.base import Block, Reader, Sheet
from data.readers.cells import cell_unit, parse_number

_BOMS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_EUROPEAN = frozenset("äöüßéèêàâçîôûñóíáúåøæÄÖÜÉµ°²³±·–€")
_OTHER_ENCODINGS = ["gb18030", "cp932", "cp1252"]  # than UTF-8 and UTF-16
SEPARATORS = (";", "\t", "|", ",")  # the comma last: it may be a decimal mark
_BLANKS = {"  ": re.compile(r" {2,}|\t"), " ": re.compile(r"[ \t]+")}  # two at least, one at least
_NAMES = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar", "  ": "blanks", " ": "blank"}
_COMMENT = re.compile(r"^[#%]+[ \t]+(?=\S)")  # before a header, which numbers follow
_NUMERIC = re.compile(r"\s*[-+.\d]")
_POINT = re.compile(r"\s*[+-]?\s*\d*\.\d+([eE][+-]?\d+)?\s*[^\d\s.,:]{0,4}\s*")  # may have a unit behind it
_COMMA = re.compile(_POINT.pattern.replace(r"\.", ",", 1))


def normalise(name: object) -> str:
    """A header as it is compared: one form of µ and full-width letters, no case, single spaces."""
    return " ".join(unicodedata.normalize("NFKC", str(name)).casefold().split())


def find_encoding(raw: bytes, where: str) -> str:
    """Codec name of the first bytes of a file.

    A byte order mark decides; then zero bytes (UTF-16); then strict UTF-8; then which of GB18030, Shift-JIS (cp932) and
    CP1252 gives the likeliest text.

    Raises:
        InputError: not a text file.
    """
    from charset_normalizer import from_bytes  # takes long to load

    for bom, name in _BOMS:
        if raw.startswith(bom):
            return name
    if b"\0" in raw:
        even, odd = raw[0::2].count(0), raw[1::2].count(0)
        if min(even, odd) * 10 < max(even, odd) and max(even, odd) * 4 > len(raw) // 2:
            return "utf-16-le" if odd > even else "utf-16-be"
    control = sum(raw.count(bytes([c])) for c in (*range(1, 9), 11, *range(14, 26), 28, 29, 30, 31))
    if control * 100 > len(raw):
        raise InputError(f"{where}: not a text file (binary content); expected CSV text; export the recording again")
    if (first := raw.find(b"\0")) >= 0:
        at = f"{raw.count(bytes(1))} NUL bytes from line {raw.count(10, 0, first) + 1} on, as a crash leaves them"
        raise InputError(f"{where}: {at}; expected CSV text; remove them or export the recording again")
    try:
        codecs.getincrementaldecoder("utf-8")("strict").decode(raw, False)  # the last character may be cut
        return "utf-8"
    except UnicodeDecodeError:
        pass
    foreign = b"\n".join(line for line in raw.splitlines() if not line.isascii())
    if {c for c in foreign.decode("cp1252", "replace") if ord(c) > 127} <= _EUROPEAN:
        return "cp1252"  # a few letters are too little to tell
    best = from_bytes(foreign[:10_000], cp_isolation=_OTHER_ENCODINGS).best()
    return best.encoding if best is not None else "cp1252"


def find_separator(lines: Sequence[str], hints: Sequence[str], separators: Sequence[str] = SEPARATORS) -> str:
    """The separator with which most expected names stand as fields of one line, else most cells are numbers."""
    wanted = {normalise(h) for h in hints}
    best = {s: 0 for s in separators}
    for line in lines:
        folded = normalise(line.replace("\t", "\0")) if wanted else ""
        if not any(w in folded.replace("\0", " ") for w in wanted):
            continue
        for separator in separators:
            best[separator] = max(best[separator], len(wanted & {normalise(c) for c in split(line, separator)}))
    sample = [line for line in lines if line.strip()][-50:]

    def numbers(separator: str) -> tuple[int, float]:
        rows = [split(line, separator) for line in sample]
        width = Counter(len(row) for row in rows).most_common(1)[0][0] if rows else 1
        total = 0.0
        for row in rows:
            filled = [cell for cell in row if cell.strip()]
            good = sum(_is_number(cell) and "\t" not in cell for cell in filled)
            total += good * good / max(1, len(filled)) if len(row) == width > 1 else 0.0
        return best[separator], total

    return max(separators, key=numbers)


def _is_number(cell: str) -> bool:
    return any(parse_number(cell, mark) is not None for mark in ".,") or cell_unit(cell) is not None


def split(line: str, separator: str) -> list[str]:
    """The fields of one line; quotes are understood, except between blanks."""
    if separator in _BLANKS:
        return _BLANKS[separator].split(line.strip())
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


def _whole(lines: list[str]) -> list[str]:
    """Lines whose header cells go on over several: the whole row stands in the last one, empty lines before it."""
    for i in range(min(_TITLE_LINES, len(lines))):
        if lines[i].count('"') % 2:
            end = next((k for k in range(i + 1, min(i + 5, len(lines))) if lines[k].count('"') % 2), None)
            if end is None:
                break
            lines[i + 1] = f"{lines[i]} {lines[i + 1]}"
            lines[i] = ""
    return lines


_ENDS = re.compile("\r\n|\n|\r")  # one file may mix them
_TITLE_LINES = 50
_HEAD_BYTES = 1 << 20
_BLOCK_BYTES = 4 << 20
_TAIL_BYTES = 1 << 16


class CsvSheet(Sheet):
    """A text file with separators. What `form` leaves open is found from the file's first megabyte."""

    def __init__(self, path: Path, hints: Sequence[str], form: Form) -> None:
        self.path = path
        with path.open("rb") as file:
            raw = file.read(_HEAD_BYTES)
            more = bool(file.read(1))
        self.encoding = form.encoding or find_encoding(raw, path.name)
        text = raw.decode(self.encoding, "replace")
        lines = _ENDS.split(text)
        if more and len(lines) == 1:
            raise InputError(f"{path.name}: its first line is longer than 1 MB; expected names; export it again")
        lines = lines[:-1] if more or not lines[-1] else lines
        lines = _whole(lines)
        below = [*lines[1:], ""]
        lines = [_COMMENT.sub("", a) if _NUMERIC.match(b) else a for a, b in zip(lines, below, strict=True)]
        self.separator = form.separator or find_separator(lines, hints, (*SEPARATORS, *_BLANKS))
        self.head = [split(line, self.separator) if line.strip(" ") else [] for line in lines]
        self.decimal = form.decimal or find_decimal(self.head)
        widths = Counter(len(row) for row in self.head if len(row) > 1)
        width = widths.most_common(1)[0][0] if widths else 1
        for i, row in enumerate(self.head):
            if len(row) not in (0, width):
                self.head[i] = self._refitted(lines[i], width) or row
        self.cut = self._ends_within_a_row()
        self._quoted = '"' in text and self.separator not in _BLANKS
        mark = "point" if self.decimal == "." else "comma"
        self.summary = f"{_NAMES.get(self.separator, self.separator)} separated, decimal {mark}, {self.encoding}"

    def _ends_within_a_row(self) -> bool:
        """Whether the last line has no end, and fewer cells than the line before it."""
        with self.path.open("rb") as file:
            file.seek(max(0, self.path.stat().st_size - _TAIL_BYTES))
            lines = _ENDS.split(file.read().decode(self.encoding, "replace"))
        if len(lines) < 3 or not lines[-1].strip():
            return False
        return len(split(lines[-1], self.separator)) < len(split(lines[-2], self.separator))

    def _refitted(self, line: str, width: int) -> list[str] | None:
        """The `width` cells of a line that another separator divides, or where a note without a digit follows them."""
        cells = split(line, self.separator)
        filled = [bool(_NUMERIC.match(cell)) for cell in cells[:width] if cell.strip()]
        if len(cells) > width and 2 * sum(filled) > len(filled) and not re.search(r"\d", "".join(cells[width:])):
            return cells[:width]
        others = [s for s in SEPARATORS if s not in (self.separator, self.decimal)] if len(cells) == 1 else []
        return next((found for s in others if len(found := split(line, s)) == width > 1), None)

    def _all_refitted(self, lines: bytes, width: int) -> bytes:
        out, mark = [], "\t" if self.separator in _BLANKS else self.separator
        for line in lines.decode("utf-8", "replace").split("\n"):
            cells = self._refitted(line, width) or [line]
            out.append(mark.join(f'"{cell}"' if mark in cell and len(cells) > 1 else cell for cell in cells))
        return "\n".join(out).encode()

    def blocks(self, first_row: int, positions: Sequence[int], text: Collection[int] = ()) -> Iterator[Block]:
        widths = Counter(len(row) for row in self.head[first_row : first_row + 200] if row)
        if not widths:
            return
        above = self.head[first_row - 1] if first_row else []
        named = 0 if any(map(_NUMERIC.match, above[:1])) else len(above)
        usual = widths.most_common(1)[0][0]
        width = max(max(positions) + 1, named if 5 * widths[named] > widths.total() else usual)
        for lines in self._bytes(first_row):
            yield self._parse(lines, width, positions, text)

    def _bytes(self, skip_lines: int) -> Iterator[bytes]:
        """The file below its first lines, as UTF-8 bytes in pieces that end with a line."""
        blanks = re.compile(_BLANKS.get(self.separator, _BLANKS[" "]).pattern.encode())
        wide = self.encoding.startswith("utf-16")
        decoder = codecs.getincrementaldecoder(self.encoding)("replace") if wide else None
        size = self.path.stat().st_size
        with self.path.open("rb") as file:
            rest = b""
            while True:
                raw = file.read(_BLOCK_BYTES)
                last = len(raw) < _BLOCK_BYTES
                piece = rest + (decoder.decode(raw, last).encode() if decoder else raw)
                if b"\r" in piece:
                    piece = piece.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
                cut = len(piece) if last else piece.rfind(b"\n") + 1
                piece, rest = piece[:cut], piece[cut:]
                start = 0
                while skip_lines and start < len(piece):
                    start = piece.find(b"\n", start) + 1 or len(piece)
                    skip_lines -= 1
                piece = piece[start:] if start else piece
                if not wide and not piece.isascii():
                    piece = piece.decode(self.encoding, "replace").encode()
                if self.separator in _BLANKS:
                    piece = b"\n".join(b"\t".join(blanks.split(line.strip())) for line in piece.splitlines())
                if piece:
                    self.share_read = min(1.0, (file.tell() - len(rest)) / size)
                    yield piece
                if last:
                    return
                if len(rest) > 16 * _BLOCK_BYTES:
                    raise InputError(f"{self.path.name}: a line of more than 64 MB; expected CSV text; export it again")

    def _parse(self, lines: bytes, width: int, positions: Sequence[int], text: Collection[int]) -> Block:
        names = [f"c{i}" for i in range(width)]
        rejected: list[str] = []

        def skip(row: Any) -> str:
            if row.text.strip(" "):
                rejected.append(row.text)
            return "skip"

        def read(types: dict[str, Any], refitted: bytes | None = None) -> Any:
            rejected.clear()
            table = pc.read_csv(
                pa.BufferReader(lines if refitted is None else refitted),
                read_options=pc.ReadOptions(column_names=names),
                parse_options=pc.ParseOptions(
                    delimiter="\t" if self.separator in _BLANKS else self.separator,
                    quote_char='"' if self._quoted or refitted else False,
                    invalid_row_handler=skip,
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
            refits = refitted is None and any(self._refitted(text, width) for text in rejected)
            return read(types, self._all_refitted(lines, width)) if refits else table

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
        quick = lines.count(b"\n") + (not lines.endswith(b"\n"))
        if quick == expected:
            return quick
        return sum(1 for line in lines.split(b"\n") if line.strip(b" "))


class CsvReader(Reader):
    """Comma, semicolon, tab, bar or blanks; UTF-8, UTF-16, GB18030, Shift-JIS, CP1252; decimal point or comma."""

    sheet: ClassVar[type[CsvSheet]] = CsvSheet

    @contextmanager
    def open(self, path: Path, hints: Sequence[str]) -> Iterator[list[Sheet]]:
        yield [self.sheet(path, hints, self.form)]


def read_text_table(path: Path) -> list[dict[str, str]]:
    """A small table of text, first row the header: one dict per row. For tables next to recordings, up to 1 MB."""
    head = CsvSheet(path, (), Form()).head
    rows = [[cell.strip() for cell in row] for row in head if row]
    if not rows:
        return []
    return [dict(zip(rows[0], row + [""] * (len(rows[0]) - len(row)), strict=False)) for row in rows[1:]]
