"""Parquet reader."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from data.errors import InputError
from data.readers.base import Block, Reader, Sheet

_BLOCK_ROWS = 1 << 18


class ParquetSheet(Sheet):
    """One Parquet file; row 0 of `head` are the column names."""

    summary = "parquet"
    first_row = 1

    def __init__(self, path: Path, file: Any) -> None:
        self._path = path
        self._file = file
        self._names = list(file.schema_arrow.names)
        first = next(self._batches(self._names, 200), None)
        rows = list(zip(*first.to_pydict().values(), strict=True)) if first is not None and self._names else []
        self.head = [self._names, *(list(row) for row in rows)]

    def _batches(self, names: Sequence[str], size: int) -> Iterator[Any]:
        try:
            yield from self._file.iter_batches(batch_size=size, columns=list(names))
        except (pa.ArrowException, OSError) as error:
            raise _damaged(self._path, error) from None

    def blocks(self, first_row: int, positions: Sequence[int], text: Collection[int] = ()) -> Iterator[Block]:
        skip = max(0, first_row - 1)
        done, total = 0, self._file.metadata.num_rows
        names = list(dict.fromkeys(self._names[i] for i in positions))
        for batch in self._batches(names, _BLOCK_ROWS):
            done += batch.num_rows
            self.share_read = done / total
            if skip >= batch.num_rows:
                skip -= batch.num_rows
                continue
            rows, skip = batch.slice(skip), 0
            yield Block({i: rows.column(rows.schema.get_field_index(self._names[i])) for i in positions})


def _damaged(path: Path, error: BaseException) -> InputError:
    reason = (str(error).splitlines() or [""])[0]
    return InputError(f"{path.name}: not a readable Parquet file ({reason}); write or copy it again")


class ParquetReader(Reader):
    """Numbers, timestamps and text columns of one Parquet file."""

    @contextmanager
    def open(self, path: Path, hints: Sequence[str]) -> Iterator[list[Sheet]]:
        try:
            file = pq.ParquetFile(path)
        except (pa.ArrowException, OSError) as error:
            raise _damaged(path, error) from None
        with file:
            yield [ParquetSheet(path, file)]
