"""Long tables, one reading in a row, as wide ones with a column for each name and the rows in order of time."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

import numpy as np
import pandas as pd
import pyarrow as pa

from data.errors import InputError
from data.machine import Form
from data.readers.base import Block, Sheet
from data.readers.cells import stamp_formats, to_float, to_seconds
from data.readers.csv import normalise

_LOOK_ROWS = 200
MOST_NAMES = 2000
_SCAN_SHARE = 0.05  # of the time between two readings of a name: between two names in a scan


class PivotSheet(Sheet):
    """What `form.pivot` describes; names and readings are text. Readings of one name and time stay apart, in rows;
    those of different names in one scan share a row.

    Raises:
        InputError: a column of the pivot is not in the file, or so many names that they are none.
    """

    first_row = 1

    def __init__(self, sheet: Sheet, form: Form, time: str | int, where: str) -> None:
        assert form.pivot is not None
        names, values = ([c] if isinstance(c, str) else c for c in (form.pivot.name, form.pivot.value))
        wanted = [*names, *values, *([time] if isinstance(time, str) else [])]
        folded = [[normalise(c) for c in row if c is not None] for row in sheet.head]
        row = next((i for i, cells in enumerate(folded) if all(normalise(w) in cells for w in wanted)), None)
        if row is None:
            got = ", ".join(str(c) for c in next((r for r in sheet.head if len(r) > 1), [])[:8])
            raise InputError(
                f"{where}: no line with the columns {', '.join(map(repr, wanted))}; got {got}; correct recording.pivot"
                " (name, value) and recording.time.column"
            )
        place = {w: folded[row].index(normalise(w)) for w in wanted}
        clock = place[time] if isinstance(time, str) else time
        self.name, self.decimal, self.origin_s = sheet.name, sheet.decimal, sheet.origin_s
        self.summary = f"long table, {sheet.summary}"
        self._ragged = 0
        frame = self._read(sheet, row + 1, [clock, *(place[n] for n in names)], [place[v] for v in values])
        seconds = self._seconds(frame["time"])
        self._ragged += int(np.isnan(seconds).sum())
        frame = frame.assign(order=seconds)[~np.isnan(seconds)].sort_values("order", kind="stable")
        label = frame["name"] if len(values) == 1 else frame["name"] + " " + frame["value"].map(dict(enumerate(values)))
        if label.nunique() > MOST_NAMES:
            raise InputError(f"{where}: {label.nunique()} different names in {names}; correct recording.pivot.name")
        frame = frame.assign(label=label, order=_scans(frame["order"], label))
        frame = frame.assign(again=frame.groupby(["order", "label"], sort=False).cumcount())
        wide = frame.pivot(index=["order", "again"], columns="label", values="cell")
        first = frame.drop_duplicates("order").set_index("order")["time"]
        self._table = wide[list(dict.fromkeys(label))]
        self._times = first.reindex(wide.index.get_level_values("order")).tolist()
        title = str(sheet.head[row][clock])
        cells = self._table.iloc[: _LOOK_ROWS * 10].to_numpy(object)
        self.head = [
            [title, *self._table.columns],
            *([t, *(None if pd.isna(c) else c for c in row)] for t, row in zip(self._times, cells, strict=False)),
        ]

    def _read(self, sheet: Sheet, first: int, keys: Sequence[int], values: Sequence[int]) -> pd.DataFrame:
        parts = []
        places = sorted({*keys, *values})
        for block in sheet.blocks(first, places, places):
            self._ragged += block.ragged_rows
            text = {i: pd.Series(c.to_pylist(), dtype=object).map(_text) for i, c in block.columns.items()}
            name = text[keys[1]]
            for more in keys[2:]:
                name = name + " " + text[more]
            parts += [
                pd.DataFrame({"time": text[keys[0]], "name": name, "value": k, "cell": text[v]})
                for k, v in enumerate(values)
            ]
        frame = pd.concat(parts, ignore_index=True)
        return frame[(frame["time"] != "") & (frame["name"].str.strip() != "")]

    def _seconds(self, times: pd.Series) -> np.ndarray:
        """What the rows are sorted by; NaN where a time cannot be read, such as that of a repeated header."""
        column = pa.array(times.tolist(), pa.string())
        formats = stamp_formats(times.iloc[:_LOOK_ROWS].tolist())
        seconds = to_seconds(column, "timestamp" if formats else "s", formats[0] if formats else None, self.decimal)
        return to_float(column, self.decimal)[0] if np.isnan(seconds).all() else seconds

    def blocks(self, first_row: int, positions: Sequence[int], text: Collection[int] = ()) -> Iterator[Block]:
        columns = {}
        for i in positions:
            cells = self._times if i == 0 else self._table.iloc[:, i - 1]
            columns[i] = pa.array([None if pd.isna(c) else c for c in cells[first_row - 1 :]], pa.string())
        yield Block(columns, self._ragged)


def _scans(order: pd.Series, label: pd.Series) -> pd.Series:
    """Rising times (n,) with one for the readings that a logger takes one after the other in a scan of all names."""
    interval = order.groupby(label).diff()
    slack = _SCAN_SHARE * float(interval[interval > 0].median())
    begins = order.where((order.diff() > slack) | (order.index == order.index[0])).ffill()
    return begins if bool((order - begins <= 5 * slack).all()) else order


def _text(cell: object) -> str:
    return "" if cell is None else str(cell).strip()
