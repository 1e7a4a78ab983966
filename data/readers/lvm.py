"""LabVIEW measurement files (.lvm): a text table below a header that states units, decimal mark and start."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from data.machine import Form
from data.readers.cells import parse_number
from data.readers.csv import CsvReader, CsvSheet

_END = "***End_of_Header***"
_LABVIEW_S = -2_082_844_800.0  # 1904-01-01 in s since 1970


class LvmSheet(CsvSheet):
    """The rows below the last header. A clock of relative time begins at the header's date and time."""

    def __init__(self, path: Path, hints: Sequence[str], form: Form) -> None:
        super().__init__(path, hints, form)
        end = max((i for i, row in enumerate(self.head) if row and row[0].strip() == _END), default=-1)
        keys = {row[0].strip(): [c.strip() for c in row[1:]] for row in self.head[: end + 1] if len(row) > 1}
        first = {key: cells[0] for key, cells in keys.items() if cells}
        self.decimal = form.decimal or first.get("Decimal_Separator") or self.decimal
        self.summary = f"LabVIEW measurement, decimal {self.decimal}, {self.encoding}"
        columns = first.get("X_Columns", "One")
        labels = keys.get("Y_Unit_Label") or [""] * len(self.head[min(end + 1, len(self.head) - 1)])
        of_time = "s" if end >= 0 else ""  # LabVIEW's header states no other unit of time
        self.units = [u for label in labels for u in (of_time, label)] if columns == "Multi" else [of_time, *labels]
        if columns == "No":
            self.step_s = parse_number(first.get("Delta_X"), self.decimal)
        begins = parse_number((self.head[end + 2 : end + 3] or [[""]])[0][0], self.decimal) or 0.0
        if first.get("Time_Pref") == "Absolute" and begins > -_LABVIEW_S:
            self.origin_s = _LABVIEW_S
        elif "Date" in first and "Time" in first:
            stamp = pd.to_datetime(f"{first['Date']} {first['Time'].replace(',', '.')}", errors="coerce")
            self.origin_s = 0.0 if pd.isna(stamp) else stamp.timestamp()


class LvmReader(CsvReader):
    """Text that LabVIEW writes, with one header or several."""

    sheet = LvmSheet
