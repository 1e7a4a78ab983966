"""Registry of file readers. A new format is a class in a new file plus a line here."""

from __future__ import annotations

from pathlib import Path

from data.errors import InputError
from data.readers.base import Reader
from data.registry import Registry

READERS = Registry(
    "reader",
    {
        "csv": "data.readers.csv:CsvReader",
        "xlsx": "data.readers.xlsx:XlsxReader",
        "parquet": "data.readers.parquet:ParquetReader",
    },
)

_OTHER_SUFFIXES = {"txt": "csv", "tsv": "csv", "dat": "csv", "asc": "csv", "xlsm": "xlsx", "pq": "parquet"}


def reader_for(path: Path) -> Reader:
    """The reader of a file by its suffix (case does not matter).

    Raises:
        InputError: unsupported file extension.
    """
    suffix = path.suffix.lower().removeprefix(".")
    key = _OTHER_SUFFIXES.get(suffix, suffix)
    if key not in READERS:
        allowed = ", ".join(f".{s}" for s in [*READERS, *_OTHER_SUFFIXES])
        raise InputError(
            f"{path.name}: unsupported file extension {path.suffix!r}; expected one of {allowed}; export it as CSV"
        )
    reader: Reader = READERS[key]()
    return reader


def has_reader(path: Path) -> bool:
    """Does the file's suffix belong to a known format?"""
    suffix = path.suffix.lower().removeprefix(".")
    return _OTHER_SUFFIXES.get(suffix, suffix) in READERS
