"""What a reader is: it opens a file and hands out its sheets, each with its first rows and a stream of blocks.

To add a format, write one class in a new file and a line in `data/readers/__init__.py`:

    class OdsReader(Reader):
        @contextmanager
        def open(self, path, hints):
            yield [OdsSheet(...), ...]

A sheet knows nothing of machines: it gives `head`, the first rows as cells, in which `data.readers.header`
looks for the header, and `blocks(first_row, positions, text)`, the data rows below, column by column.
Everything that is wrong with the file itself is an InputError in one line.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HEAD_ROWS = 1000  # a header further down is not looked for in formats that are slow to scan


@dataclass(frozen=True)
class Block:
    """Consecutive data rows. `columns`: position -> Arrow array of numbers, text or timestamps, all of one length.

    `ragged_rows` counts rows of this stretch that could not be told apart into columns; they are in no array.
    """

    columns: dict[int, Any]
    ragged_rows: int = 0


class Sheet(ABC):
    """One table of a file. `name` is the sheet's name ("" where the format has none)."""

    name: str = ""
    head: Sequence[Sequence[Any]] = ()  # first rows, cells as text or as Python values
    decimal: str = "."  # decimal mark of numbers in text cells
    share_read: float = 1.0  # of the file, by the blocks given out so far: foretells how many rows will come
    words: str = ""  # how the text is written, for people: "semicolon, decimal comma, cp1252"

    @abstractmethod
    def blocks(self, first_row: int, positions: Sequence[int], text: Collection[int] = ()) -> Iterator[Block]:
        """Data rows from row `first_row` of `head` on; only the columns at `positions`; `text` ones never as numbers.

        Raises:
            InputError: the file turns out to be damaged.
        """


class Reader(ABC):
    """One file format."""

    @abstractmethod
    def open(self, path: Path, hints: Sequence[str]) -> AbstractContextManager[Sequence[Sheet]]:
        """The sheets of a file that exists and is not empty; valid inside the `with`.

        `hints` are column names that are expected: they settle encoding and separator.

        Raises:
            InputError: not a file of this format, damaged, or without a table.
        """
