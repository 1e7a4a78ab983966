"""One stored batch as one Parquet file: content digest, writing, reading, safe file names.

A plain Parquet reader gets `time_s`, one float64 column per channel (null where nothing was recorded) and two
constant columns, `batch` and `simulated`. Everything else of the batch is one JSON in the file's schema
metadata under the key ``thermodrift``.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from data.batch import Batch, Channel, Finding
from data.errors import InputError, WorkError
from data.files import from_json
from data.machine import RESERVED, Machine, Recording, TimeColumn

SCHEMA = "thermodrift.batch/1"
META_KEY = b"thermodrift"
MEASURED = ("temperature", "ambient", "error")  # roles whose noise distinguishes recordings
PARALLEL_VALUES = 500_000


def content_digest(batch: Batch) -> str:
    """SHA-256 (hex) of what was recorded: names, units, every float, start, labels, simulated.

    Independent of channel order and of NaN's bit pattern. Findings, repairs, roles, resolutions, ranges and
    the source's path do not count: they describe the content, see `remarks_digest`.

    Raises:
        InputError: a table without `time_s`, a column that is not a channel, a reserved name, an unstorable label.
    """
    columns = _columns(batch)
    names = sorted(columns)
    if batch.n_rows * len(names) > PARALLEL_VALUES:
        with ThreadPoolExecutor(2) as pool:  # hashlib and numpy release the GIL
            hashes = list(pool.map(lambda n: _hash_floats(columns[n]), names))
    else:
        hashes = [_hash_floats(columns[n]) for n in names]
    units = {n: batch.channels[n].unit for n in names if n in batch.channels}
    head = {
        "columns": [[n, units.get(n, "s"), h] for n, h in zip(names, hashes, strict=True)],
        "rows": batch.n_rows,
        "start": _start_text(batch),
        "labels": _plain(batch.labels, f"batch {batch.batch_id} of {batch.machine}"),
        "simulated": batch.simulated,
    }
    return hashlib.sha256(_canonical(head)).hexdigest()


def measured_digest(batch: Batch) -> str:
    """SHA-256 (hex) of the measured values alone, so that copies of a recording are equal under any name.

    The batch's id and start, labels, names of channels, and drivers (a schedule may give all of these by the file's
    name) do not count; channels without a value neither. A batch of drivers alone is identified by those.

    Raises:
        InputError: see `content_digest`.
    """
    columns = {n: v for n, v in _columns(batch).items() if n != "time_s" and not np.isnan(v).all()}
    measured = [v for n, v in columns.items() if batch.channels[n].role in MEASURED] or list(columns.values())
    return hashlib.sha256("".join(sorted(_hash_floats(v) for v in measured)).encode()).hexdigest()


def remarks_digest(batch: Batch) -> str:
    """SHA-256 (hex) of the remarks on the content: findings, repairs, channel descriptions."""
    meta = _meta(batch, "")
    return hashlib.sha256(_canonical({k: meta[k] for k in ("findings", "repairs", "channels")})).hexdigest()


def encode(batch: Batch, digest: str) -> pa.Buffer:
    """The batch as the bytes of a Parquet file."""
    columns = _columns(batch)
    arrays: dict[str, Any] = {n: pa.array(v, from_pandas=True) for n, v in columns.items()}
    arrays["batch"] = pa.DictionaryArray.from_arrays(pa.array(np.zeros(batch.n_rows, np.int8)), [batch.batch_id])
    arrays["simulated"] = pa.array(np.full(batch.n_rows, batch.simulated))
    table = pa.table(arrays)
    sink = pa.BufferOutputStream()
    quantised = [n for n in arrays if n != "time_s"]  # a clock never repeats: no dictionary for it
    # without Arrow's own schema note, `batch` reads back as plain text everywhere
    with pq.ParquetWriter(sink, table.schema, compression="zstd", use_dictionary=quantised, store_schema=False) as out:
        out.write_table(table)
        out.add_key_value_metadata({META_KEY: json.dumps(_meta(batch, digest))})
    return sink.getvalue()


def unreadable(where: str, error: OSError, name: str = "", remedy: str = "ingest its source again") -> WorkError:
    """The error of a stored file that cannot be read; `where` is its place, `name` that of its batch."""
    return WorkError(f"lake file {where}: {name}cannot be read ({error.strerror or error}); {remedy}")


def decode(body: bytes, where: str, version: int = 1) -> Batch:
    """The batch of a stored file's bytes; `where` is its place in error lines, `version` the lake's number of it.

    Raises:
        WorkError: damaged, or not a file that the lake wrote.
    """
    try:
        table = pq.ParquetFile(pa.BufferReader(body)).read()
        meta = from_json((table.schema.metadata or {})[META_KEY])
        if meta["schema"] != SCHEMA:
            raise ValueError(f"schema {meta['schema']!r}")
        return _batch(table, meta, version)
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError, AttributeError) as error:
        reason = " ".join(str(error).split())
        raise WorkError(
            f"lake file {where}: cannot be read ({reason}); expected a batch stored by ingest; "
            "restore it from a backup or ingest its source again"
        ) from None


def _batch(table: Any, meta: Mapping[str, Any], version: int) -> Batch:
    frame = table.drop_columns(["batch", "simulated"]).to_pandas(ignore_metadata=True)
    return Batch(
        machine=meta["machine"],
        batch_id=meta["batch_id"],
        table=frame,
        channels={c["name"]: Channel(**c) for c in meta["channels"]},
        start=None if meta["start"] is None else pd.Timestamp(meta["start"]),
        simulated=meta["simulated"],
        source=meta["source"],
        digest=meta["digest"],
        version=version,
        repairs=meta["repairs"],
        findings=tuple(Finding.from_dict(f) for f in meta["findings"]),
        labels=meta["labels"],
    )


def safe_name(text: str) -> str:
    """A file name for any batch id: different ids never share a name.

    Letters of any script stay; path and glob characters and a leading dot or underscore (plain readers skip
    those) become %XX; a very long id is cut and gets a hash.

    Raises:
        InputError: text that is not Unicode, from a file name in an unknown encoding.
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        raise InputError(f"{text!r} is not valid text and cannot name a stored file; rename the recording") from None
    name = re.sub(r'[\x00-\x1f\x7f/\\:*?"<>|%=\[\]]', lambda m: f"%{ord(m[0]):02X}", text)
    if name[:1] in (".", "_"):
        name = f"%{ord(name[0]):02X}{name[1:]}"
    if len(name.encode()) > 180:
        name = f"{name.encode()[:120].decode(errors='ignore')}~{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    return name or "%"


def _columns(batch: Batch) -> dict[str, NDArray[np.float64]]:
    """Checked columns in the table's order, each contiguous little-endian float64."""
    names = list(batch.table.columns)
    where = f"batch {batch.batch_id} of {batch.machine}"
    if "time_s" not in names or len(set(names)) != len(names):
        raise InputError(f"{where}: got columns {names}; expected time_s and one column per channel, each name once")
    for name in names:
        if name != "time_s" and name not in batch.channels:
            raise InputError(f"{where}: column {name!r} is no channel of the batch; name it in the machine file")
        if name in RESERVED:
            raise InputError(
                f"{where}: channel {name!r} has a name that the lake keeps for itself ({', '.join(RESERVED)}); "
                "give the channel another name in the machine file"
            )
    return {n: np.ascontiguousarray(batch.table[n].to_numpy(dtype="<f8", na_value=np.nan)) for n in names}


def _hash_floats(values: NDArray[np.float64]) -> str:
    missing = np.isnan(values)
    if missing.any():
        values = np.where(missing, np.nan, values)
    return hashlib.sha256(values.data).hexdigest()


def _meta(batch: Batch, digest: str) -> dict[str, Any]:
    where = f"batch {batch.batch_id} of {batch.machine}"
    return {
        "schema": SCHEMA,
        "machine": batch.machine,
        "batch_id": batch.batch_id,
        "digest": digest,
        "start": _start_text(batch),
        "simulated": bool(batch.simulated),
        "source": batch.source,
        "channels": [_plain(_channel(c), where) for c in batch.channels.values()],
        "repairs": _plain(batch.repairs, where),
        "findings": [_plain(f.as_dict(), where) for f in batch.findings],
        "labels": _plain(batch.labels, where),
    }


def _channel(channel: Channel) -> dict[str, Any]:
    """The channel's fields; a position only where there is one, so that lakes older than positions stay as they are."""
    fields = asdict(channel)
    return fields if channel.position else {k: v for k, v in fields.items() if k != "position"}


def _start_text(batch: Batch) -> str | None:
    return None if batch.start is None or pd.isna(batch.start) else pd.Timestamp(batch.start).isoformat()


def _canonical(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":")).encode()


def _plain(value: Any, where: str) -> Any:
    """JSON-ready: numpy scalars as Python's, times as ISO text."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, pd.Timestamp):
        return value.isoformat()
    if isinstance(value, Mapping):
        return {str(k): _plain(v, where) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v, where) for v in value]
    raise InputError(
        f"{where}: label of type {type(value).__name__} cannot be stored; expected text, a number, a bool or a list"
    )


@dataclass(frozen=True)
class NativeParquet:
    """Metadata of a Parquet file written by thermodrift: machine, batch id, channels, if simulated, start, labels."""

    name: str
    note: Mapping[str, Any]

    def layout(self, machine: Machine) -> Machine:
        """The machine file as it describes this file: columns by channel name, time in s, no schedule, no cutting.

        Raises:
            InputError: the file is of another machine.
        """
        if self.note["machine"] != machine.machine:
            raise InputError(
                f"{self.name}: written for machine {self.note['machine']!r}, the machine file is of "
                f"{machine.machine!r}; take the machine file of this recording"
            )
        own = Recording(time=TimeColumn(), step_s=machine.recording.step_s, max_gap_s=machine.recording.max_gap_s)
        units = {c["name"]: c["unit"] for c in self.note["channels"]}
        channels = {
            n: c.model_copy(
                update={"column": n, "columns": None, "unit_in_file": units.get(n, c.unit), "source": "file"}
            )
            for n, c in machine.channels.items()
        }
        simulated = machine.simulated or bool(self.note["simulated"])
        ignore = ["batch", "simulated"]
        return machine.model_copy(
            update={"recording": own, "channels": channels, "simulated": simulated, "ignore": ignore}
        )

    def marked(self, batch: Batch) -> Batch:
        """The batch with the start and the labels of the metadata, and its id where the file has the lake's name."""
        start, batch_id = self.note["start"], self.note["batch_id"]
        if self.name != f"{safe_name(batch_id)}.parquet":
            batch_id = batch.batch_id
        start = None if start is None else pd.Timestamp(start)
        return replace(batch, batch_id=batch_id, start=start, labels=self.note["labels"])


PARQUET = (".parquet", ".pq")  # suffixes


def native_parquet(path: Path) -> NativeParquet | None:
    """Metadata of a Parquet file written by thermodrift; None for any other file, damaged ones included."""
    if path.suffix.lower() not in PARQUET:
        return None
    try:
        note = from_json((pq.read_schema(path).metadata or {})[META_KEY])
        if note["schema"] != SCHEMA:
            return None
        keys = ("machine", "batch_id", "channels", "simulated", "start", "labels")
        return NativeParquet(path.name, {k: note[k] for k in keys})
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError):
        return None
