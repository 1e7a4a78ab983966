"""Registry of file readers. A new format is a class in a new file plus a line here."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from data.errors import InputError
from data.machine import Form
from data.readers.base import Reader, Sheet
from data.registry import Registry

READERS = Registry(
    "reader",
    {
        "csv": "data.readers.csv:CsvReader",
        "xlsx": "data.readers.xlsx:XlsxReader",
        "parquet": "data.readers.parquet:ParquetReader",
        "lvm": "data.readers.lvm:LvmReader",
    },
)

_OTHER_SUFFIXES = {
    "txt": "csv",
    "tsv": "csv",
    "dat": "csv",
    "asc": "csv",
    "log": "csv",
    "xlsm": "xlsx",
    "pq": "parquet",
}
_LABVIEW = b"LabVIEW Measurement"  # first bytes, whatever the suffix


def reader_for(path: Path, form: Form | None = None) -> Reader:
    """The reader of a file that exists by `form.format`, its first bytes or its suffix (case does not matter).

    Raises:
        InputError: unsupported file extension, or an unknown format.
    """
    suffix = path.suffix.lower().removeprefix(".")
    key = form.format if form and form.format else _OTHER_SUFFIXES.get(suffix, suffix)
    if key not in READERS:
        allowed = ", ".join(f".{s}" for s in [*READERS, *_OTHER_SUFFIXES])
        raise InputError(
            f"{path.name}: unsupported file extension {path.suffix!r}; expected one of {allowed}; export it as CSV, or"
            " give recording.format"
        )
    if key == "csv" and path.is_file():
        with path.open("rb") as file:
            key = "lvm" if file.read(len(_LABVIEW)) == _LABVIEW else key
    reader: Reader = READERS[key]()
    reader.form = form or Form()
    return reader


@contextmanager
def sheets_of(path: Path, hints: Sequence[str] = (), form: Form | None = None) -> Iterator[Sequence[Sheet]]:
    """The sheets of a recording, a long one (`form.pivot`) as a wide one; valid inside the `with`.

    Raises:
        InputError: no file, an empty one, no reader for it, or what the reader says of it.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a directory, expected one recording file; give its files, such as {path}/*.csv")
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the path of a recording")
    if path.stat().st_size == 0:
        raise InputError(
            f"{path.name}: the file is empty (0 bytes); expected a header and at least 2 rows; copy it again"
        )
    with reader_for(path, form).open(path, hints) as sheets:
        if form is None or form.pivot is None:
            yield sheets
        else:
            from data.readers.pivot import PivotSheet

            yield [PivotSheet(sheet, form, form.time.column, path.name) for sheet in sheets]


def has_reader(path: Path) -> bool:
    """Does the file's suffix belong to a known format?"""
    suffix = path.suffix.lower().removeprefix(".")
    return _OTHER_SUFFIXES.get(suffix, suffix) in READERS
