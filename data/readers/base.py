"""Base classes of the file readers: a reader opens a file and yields its sheets.

To add a format, write one class in a new file and a line in `data/readers/__init__.py`:

    class OdsReader(Reader):
        @contextmanager
        def open(self, path, hints):
            yield [OdsSheet(...), ...]

A sheet is independent of the machine file. `head` holds the first rows as cells, in which `data.readers.header` finds
the header; `blocks(first_row, positions, text)` yields the data rows below it, column by column. A damaged file is an
InputError.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data.machine import Form

HEAD_ROWS = 1000  # the header is searched in these rows only, in formats that are slow to scan


@dataclass(frozen=True)
class Block:
    """Consecutive data rows. `columns`: position -> Arrow array of numbers, text or timestamps, all of one length.

    `ragged_rows` counts rows that could not be split into columns; they are in no array.
    """

    columns: dict[int, Any]
    ragged_rows: int = 0


class Sheet(ABC):
    """One table of a file. `name` is the sheet's name ("" where the format has none)."""

    name: str = ""
    head: Sequence[Sequence[Any]] = ()  # first rows, cells as text or as Python values
    decimal: str = "."  # decimal mark of numbers in text cells
    share_read: float = 1.0  # share of the file in the blocks so far: predicts the number of rows
    first_row: int | None = None  # of the data, where the format states it
    summary: str = ""  # how the text is encoded: "semicolon, decimal comma, cp1252"
    units: Sequence[str] = ()  # by column, where the format states them apart from the rows
    origin_s: float = 0.0  # s since 1970 at which an elapsed clock shows 0; 0 where the file does not say
    cut: bool = False  # the file ends within a row: what follows is missing
    step_s: float | None = None  # between two rows, where the format states it in place of a clock

    @abstractmethod
    def blocks(self, first_row: int, positions: Sequence[int], text: Collection[int] = ()) -> Iterator[Block]:
        """Data rows from row `first_row` of `head` on; only the columns at `positions`; `text` ones never as numbers.

        Raises:
            InputError: the file turns out to be damaged.
        """


class Reader(ABC):
    """One file format. `form`: what the machine file states of the layout; the rest is found."""

    form: Form = Form()

    @abstractmethod
    def open(self, path: Path, hints: Sequence[str]) -> AbstractContextManager[Sequence[Sheet]]:
        """The sheets of a file that exists and is not empty; valid inside the `with`.

        `hints` are column names that are expected: they settle encoding and separator.

        Raises:
            InputError: not a file of this format, damaged, or without a table.
        """
