"""CSV in all its spellings. pyarrow parses the bulk; only blocks that it rejects take the tolerant way."""

from __future__ import annotations

import codecs
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv as pc

from data.errors import InputError
from data.readers.base import Block, Reader, Sheet
from data.readers.text import find_decimal, find_encoding, find_separator, split

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
        self.words = f"{names[self.separator]} separated, decimal {mark}, {self.encoding}"

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
                    delimiter=self.separator,
                    quote_char='"' if self._quoted else False,
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
    """A small table of text, first row the header: one dict a row. For tables beside recordings, up to 1 MB."""
    head = CsvSheet(path, ()).head
    rows = [[cell.strip() for cell in row] for row in head if row]
    if not rows:
        return []
    return [dict(zip(rows[0], row + [""] * (len(rows[0]) - len(row)), strict=False)) for row in rows[1:]]
