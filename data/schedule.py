"""Drivers and labels that stand in a table beside the recordings: one row a batch."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError
from data.machine import Schedule
from data.readers.cells import parse_number
from data.readers.csv import read_text_table

_LONGER_SHARE = 0.05
_LONGER_S = 600.0


def scheduled(
    schedule: Schedule, directory: Path, batch_ids: tuple[str, ...], time_s: NDArray[np.float64]
) -> tuple[dict[str, NDArray[np.float64]], dict[str, Any]]:
    """Driver channels as recorded in the schedule, piecewise constant on time_s (n,), and the batch's labels.

    `batch_ids` are the names under which the batch may stand there, best first. Stages follow each other from t = 0.
    A recording that goes on clearly longer than its stages (by 5 % or 10 min) had stopped: its drivers are 0 from
    there; otherwise the last stage holds to the end.

    Raises:
        InputError: schedule file or column missing, no row for the batch, a stage without a number.
    """
    path = directory / schedule.file
    if not path.is_file():
        raise InputError(f"{batch_ids[0]}: schedule {schedule.file!r} is missing beside the recording; put it there")
    rows = read_text_table(path)
    columns = [schedule.batch_column, *schedule.labels.values()]
    columns += [c for stage in schedule.stages for c in (stage.hours, *stage.drivers.values())]
    for column in columns:
        if rows and column not in rows[0]:
            raise InputError(
                f"{schedule.file}: no column {column!r}; got {', '.join(rows[0])}; correct recording.schedule"
            )
    by_id = {row[schedule.batch_column].removesuffix(".0"): row for row in rows}
    row = next((by_id[b] for b in batch_ids if b in by_id), None)
    if row is None:
        raise InputError(
            f"{batch_ids[0]}: no row in schedule {schedule.file} with {schedule.batch_column} = {batch_ids[0]!r}"
            f" ({len(rows)} rows); add one or move the recording away"
        )
    labels = {label: _value(row[column]) for label, column in schedule.labels.items()}
    return _drivers(schedule, row, batch_ids[0], time_s), labels


def _drivers(
    schedule: Schedule, row: Mapping[str, str], batch_id: str, time_s: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    values = {name: np.zeros(len(time_s)) for stage in schedule.stages for name in stage.drivers}
    begin = 0.0
    last: dict[str, float] = {}
    for stage in schedule.stages:
        if not row[stage.hours]:
            continue
        end = begin + 3600.0 * _number(row, stage.hours, schedule.file, batch_id)
        during = (time_s >= begin - 1e-6) & (time_s < end - 1e-6)
        for name, column in stage.drivers.items():
            last[name] = _number(row, column, schedule.file, batch_id)
            values[name][during] = last[name]
        begin = end
    beyond = time_s[-1] - begin if len(time_s) else 0.0
    if beyond <= min(_LONGER_SHARE * begin, _LONGER_S):
        for name, value in last.items():
            values[name][time_s >= begin - 1e-6] = value
    return values


def _number(row: Mapping[str, str], column: str, file: str, batch_id: str) -> float:
    value = parse_number(row[column])
    if value is None:
        raise InputError(f"{file} row {batch_id} column {column!r}: got {row[column]!r}, expected a number; correct it")
    return value


def _value(text: str) -> Any:
    number = parse_number(text)
    return text if number is None else number
