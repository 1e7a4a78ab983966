"""Each suite catches a broken plug-in of its kind, with what was expected, what came and why."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

import thermodrift as td
from compensation.contracts import Correction, Sample
from compensation.exports.base import Export
from compensation.exports.json_file import JsonExport
from data.arrays import Array, Numeric
from data.batch import Batch, Finding
from data.checks.base import Check
from data.errors import InputError, WorkError
from data.machine import Machine
from data.readers.base import Block, Reader, Sheet
from features.design import Design
from features.selectors.correlation import Correlation
from models.families.mlr import MLR
from thermodrift.testing import (
    ContractCheck,
    ContractError,
    check_check,
    check_export,
    check_family,
    check_mechanism,
    check_reader,
    check_selector,
    check_sink,
    check_source,
)
from thermodrift.testing.points import Case, U
from twin.mechanisms.base import Mechanism, View, size
from twin.quantity import Spec


def failing(checks: Iterator[ContractCheck], name: str) -> str:
    """The message of the one check with this name, which must fail."""
    (check,) = (c for c in checks if c.name == name)
    with pytest.raises(ContractError) as error:
        check()
    assert str(error.value).startswith(f"{check}: expected ") and f"Why: {check.why}" in str(error.value)
    return str(error.value)


# ----- families


class SeesTheError(MLR):
    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        return [0.5 * design.y_um[design.rows(k)] for k in batches]


class LooksAhead(MLR):
    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        return [values * (1 + 0.01 * len(values)) for values in super().respond(design, batches)]


class LearnsFromAll(MLR):
    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        return super().fit_folds(design, [list(range(design.n_batches))] * len(folds))


class Unseeded(MLR):
    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        fitted = super().fit_folds(design, folds)
        for model in fitted:
            model.fitted["coef_um_per_K"] = np.asarray(model.fitted["coef_um_per_K"]) * (
                1 + 0.1 * np.random.default_rng().random()
            )
        return fitted


class KeepsAnObject(MLR):
    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        fitted = super().fit_folds(design, folds)
        for model in fitted:
            model.fitted["when"] = {1, 2}
        return fitted


class Offset(MLR):
    def program(self, channels: Any, step_s: float) -> Any:
        program = super().program(channels, step_s)
        self.fitted["coef_um_per_K"] = 1.01 * np.asarray(self.fitted["coef_um_per_K"])
        return program


@pytest.mark.parametrize(
    ("family", "name", "got"),
    [
        (SeesTheError, "prediction_does_not_read_the_error_channel", "NaN on one side"),
        (LooksAhead, "prediction_does_not_look_ahead", "got a difference of"),
        (LearnsFromAll, "nothing_is_learned_outside_the_training_batches", "got a difference of"),
        (Unseeded, "fit_gives_a_new_copy_the_same_every_time", "got a difference of"),
        (KeepsAnObject, "plain_data_gives_the_same_predictions", "lists and arrays in as_plain(), got <class 'set'>"),
        (Offset, "program_equals_predict", "got a difference of"),
    ],
)
def test_a_broken_family_is_caught(family: type[MLR], name: str, got: str) -> None:
    assert got in failing(check_family(family, generate_only=True), name)


# ----- selectors


class ChoosesFromAll(Correlation):
    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        return super().select_design(design, range(design.n_batches), n_tsps)


class LargestValue(Correlation):
    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        order = np.argsort(-np.abs(np.nan_to_num(design.stacked(train)[0])).max(axis=0))
        return {n: tuple(design.inputs[i] for i in sorted(order[:n])) for n in n_tsps}


class BestFirst(Correlation):
    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        return {n: names[::-1] for n, names in super().select_design(design, train, n_tsps).items()}


@pytest.mark.parametrize(
    ("selector", "name"),
    [
        (ChoosesFromAll, "nothing_is_learned_outside_the_training_batches"),
        (LargestValue, "unit_and_sign_of_an_input_do_not_matter"),
        (LargestValue, "a_number_that_cannot_be_is_refused"),
        (BestFirst, "distinct_inputs_in_the_designs_order"),
    ],
)
def test_a_broken_selector_is_caught(selector: type[Correlation], name: str) -> None:
    failing(check_selector(selector, generate_only=True), name)


# ----- mechanisms


class Drag(Mechanism):
    """A brush that rubs."""

    key = "drag"
    summary = "drag of a brush"
    equation = "P = force |v|"
    source = "Coulomb 1785; 20 to 100 N a brush, by data sheets"
    signature = "only while the axis moves; warms the brush's holder"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"feed": "mm/min"}
    parameters = (Spec("force", "N", "drag of all brushes", 60.0, 0.6, 0.0, 2000.0),)
    off: ClassVar[Mapping[str, float] | None] = {"force": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["force"] * size(view.driver["feed"]) / 60e3)


class WrongFactor(Drag):
    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return 1000.0 * super().heat_W(view, p)


class NotAnalytic(Drag):
    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(np.abs(p["force"]) * size(view.driver["feed"]) / 60e3)


class HeatsAtRest(Drag):
    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return super().heat_W(view, p) + p["force"] * 0.1


class Cools(Drag):
    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return -super().heat_W(view, p)


class NeverOff(Drag):
    off: ClassVar[Mapping[str, float] | None] = {"force": 10.0}


CASE = Case(lambda q: q.force * q.feed)


def test_a_whole_mechanism_passes() -> None:
    assert check_mechanism(Drag, CASE)


@pytest.mark.parametrize(
    ("law", "name"),
    [
        (WrongFactor, "units_agree_with_the_equation"),
        (NotAnalytic, "derivatives_are_those_of_differences"),
        (HeatsAtRest, "without_its_driver_it_does_nothing"),
        (Cools, "finite_and_of_its_sign_over_the_whole_prior"),
        (NeverOff, "switched_off_it_does_nothing"),
    ],
)
def test_a_broken_mechanism_is_caught(law: type[Mechanism], name: str) -> None:
    failing(check_mechanism(law, CASE, generate_only=True), name)


def test_an_equation_that_hides_a_unit_is_caught() -> None:
    unit = Case(lambda q: U.Quantity(q.force.magnitude, "N") * q.feed)
    text = failing(check_mechanism(Drag, unit, generate_only=True), "equation_finds_every_wrong_unit")
    assert "the equation to differ with force in " in text and "instead of N" in text


# ----- checks for faults


class TooHot(Check):
    key = "too_hot"
    summary = "a temperature above 60 degC"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        hot = [n for n in batch.names("temperature") if np.nanmax(batch.values(n), initial=0.0) > 60.0]
        return [self.finding(n, f"{n} is above 60 degC") for n in hot]


class Nervous(TooHot):
    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        return [self.finding("front", "front moves")]


class Blind(TooHot):
    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        return []


class Blames(TooHot):
    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        return [self.finding(n, "a sensor is too hot") for f in super().batch(batch, machine) for n in ("front", "bed")]


class Repairs(TooHot):
    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        found = super().batch(batch, machine)
        for f in found:
            batch.table[f.channel] = batch.table[f.channel].clip(upper=60.0)
        return found


class NeedsFront(TooHot):
    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        return super().batch(batch, machine) if batch.values("front")[0] < 60.0 else []


class TwoLines(TooHot):
    def finding(self, channel: str | None, message: str, *times: Any, **options: Any) -> Finding:
        return super().finding(channel, f"{message}\nlook at it", 100.0, 50.0)


def heated(batch: Batch) -> Batch:
    return replace(batch, table=batch.table.assign(front=batch.table["front"] + 70.0))


def test_a_whole_check_passes() -> None:
    check_check(TooHot, heated, "front")


@pytest.mark.parametrize(
    ("check", "name"),
    [
        (Nervous, "clean_recordings_raise_nothing"),
        (Blind, "its_fault_is_found"),
        (Blames, "its_fault_is_found"),
        (Repairs, "the_same_every_time_and_nothing_is_changed"),
        (NeedsFront, "little_is_survived"),
        (TwoLines, "findings_have_key_channel_time_and_message"),
    ],
)
def test_a_broken_check_is_caught(check: type[Check], name: str) -> None:
    failing(check_check(check, heated, "front", generate_only=True), name)


# ----- readers


class LinesSheet(Sheet):
    """Columns between bars."""

    name, decimal = "", "."

    def __init__(self, rows: list[list[str]]) -> None:
        self.rows, self.head = rows, rows[:200]

    def blocks(self, first_row: int, positions: Sequence[int], text: Collection[int] = ()) -> Iterator[Block]:
        rows = self.rows[first_row:]
        yield Block({p: self.column([row[p] for row in rows], p in text) for p in positions})

    def column(self, cells: list[str], text: bool) -> Any:
        return pa.array(cells) if text else pa.array([float(c) if c else None for c in cells])


class BarReader(Reader):
    sheet: ClassVar[type[LinesSheet]] = LinesSheet

    @contextmanager
    def open(self, path: Path, hints: Sequence[str]) -> Iterator[list[Sheet]]:
        try:
            rows = [line.split("|") for line in path.read_text(encoding="ascii").splitlines()]
            whole = [row for row in rows if len(row) == len(rows[0]) > 1]
            if not whole:
                raise ValueError("no bar in it")
            numbers = [[c for c in row[:3] if c] for row in whole[1:]]
            for row in numbers:
                list(map(float, row))
        except (ValueError, IndexError) as error:
            raise InputError(f"{path.name}: not a table between bars ({error}); export it again") from None
        yield [self.sheet(whole)]


class ZeroForNothing(LinesSheet):
    def column(self, cells: list[str], text: bool) -> Any:
        return pa.array(cells) if text else pa.array([float(c or 0.0) for c in cells])


class AlwaysNumbers(LinesSheet):
    def column(self, cells: list[str], text: bool) -> Any:
        return super().column(cells, False)


class FromTheTop(LinesSheet):
    def blocks(self, first_row: int, positions: Sequence[int], text: Collection[int] = ()) -> Iterator[Block]:
        yield from super().blocks(1, positions, text)


class Everything(LinesSheet):
    def blocks(self, first_row: int, positions: Sequence[int], text: Collection[int] = ()) -> Iterator[Block]:
        yield from super().blocks(first_row, range(4), [3])


class Trusting(BarReader):
    @contextmanager
    def open(self, path: Path, hints: Sequence[str]) -> Iterator[list[Sheet]]:
        yield [LinesSheet([line.split("|") for line in path.read_text(encoding="ascii").splitlines()])]


def with_sheet(made: type[LinesSheet]) -> type[BarReader]:
    return type(made.__name__, (BarReader,), {"sheet": made})


def write_bars(table: pd.DataFrame, path: Path) -> None:
    table.to_csv(path, index=False, sep="|")


def test_a_whole_reader_passes() -> None:
    check_reader(BarReader, write_bars, "bar")


@pytest.mark.parametrize(
    ("reader", "name"),
    [
        (with_sheet(ZeroForNothing), "numbers_come_back"),
        (with_sheet(AlwaysNumbers), "text_columns_stay_text"),
        (with_sheet(FromTheTop), "data_begin_at_the_given_row"),
        (with_sheet(Everything), "only_the_given_positions_are_read"),
        (Trusting, "another_format_is_one_line"),
    ],
)
def test_a_broken_reader_is_caught(reader: type[Reader], name: str) -> None:
    failing(check_reader(reader, write_bars, "bar", generate_only=True), name)


# ----- connectors


class ListSource:
    def __init__(self, samples: Sequence[Sample]) -> None:
        self.waiting, self.closed = list(samples), False

    def samples(self) -> Iterator[Sample | None]:
        while not self.closed:
            yield self.waiting.pop(0) if self.waiting else None

    def close(self) -> None:
        self.closed = True


class Repeats(ListSource):
    def __init__(self, samples: Sequence[Sample]) -> None:
        super().__init__([s for s in samples for _ in range(2)])


class Fahrenheit(ListSource):
    def __init__(self, samples: Sequence[Sample]) -> None:
        super().__init__([replace(s, values={n: 1.8 * v + 32.0 for n, v in dict(s.values).items()}) for s in samples])


class ClosesOnce(ListSource):
    def close(self) -> None:
        if self.closed:
            raise OSError("closed")
        super().close()


class ListSink:
    def __init__(self) -> None:
        self.sent: list[dict[str, Any]] = []

    def write(self, correction: Correction) -> None:
        for axis, um in correction.offset_um.items():
            if not np.isfinite(um):
                raise WorkError(f"list: axis {axis!r}: offset_um is {um}; nothing is sent")
        self.sent.append(asdict(correction))

    def close(self) -> None:
        pass


class Negates(ListSink):
    def write(self, correction: Correction) -> None:
        super().write(replace(correction, offset_um={a: -um for a, um in correction.offset_um.items()}))


class SendsAnything(ListSink):
    def write(self, correction: Correction) -> None:
        self.sent.append(asdict(correction))


def source_of(made: type[ListSource], *, generate_only: bool = True) -> Iterator[ContractCheck]:
    return check_source(lambda _, samples: made(samples), made.__name__, generate_only=generate_only)


def sink_of(made: type[ListSink], *, generate_only: bool = True) -> Iterator[ContractCheck]:
    def make(_: Machine) -> tuple[ListSink, Callable[[], list[dict[str, Any]]]]:
        sink = made()
        return sink, lambda: sink.sent

    return check_sink(make, made.__name__, generate_only=generate_only)


def test_whole_connectors_pass() -> None:
    source_of(ListSource, generate_only=False)
    sink_of(ListSink, generate_only=False)


@pytest.mark.parametrize(
    ("checks", "name"),
    [
        (source_of(Repeats), "samples_arrive_once_with_values_and_readings"),
        (source_of(Fahrenheit), "samples_arrive_once_with_values_and_readings"),
        (source_of(ClosesOnce), "closing_twice_is_harmless_and_ends_the_samples"),
        (sink_of(Negates), "a_correction_arrives_whole"),
        (sink_of(SendsAnything), "a_number_that_is_not_finite_is_never_sent"),
    ],
)
def test_a_broken_connector_is_caught(checks: Iterator[ContractCheck], name: str) -> None:
    failing(checks, name)


# ----- exports


class Unmarked(JsonExport):
    def files(self, export: Export) -> dict[str, str | bytes]:
        return super().files(replace(export, simulated=False))


class Stamped(JsonExport):
    count: ClassVar[list[int]] = []

    def files(self, export: Export) -> dict[str, str | bytes]:
        self.count.append(1)
        return {name: f"{text!s}\n{len(self.count)}" for name, text in super().files(export).items()}


class Nameless(JsonExport):
    def files(self, export: Export) -> dict[str, str | bytes]:
        return {f"model_{name}": text for name, text in super().files(export).items()}


class Refuses(JsonExport):
    def files(self, export: Export) -> dict[str, str | bytes]:
        if len(export.axes) > 1:
            raise InputError("export json: one axis\nonly")
        return super().files(export)


@pytest.mark.parametrize(
    ("export", "name"),
    [
        (Unmarked, "simulated_models_are_marked"),
        (Stamped, "the_same_bytes_every_time"),
        (Nameless, "every_file_states_what_it_is"),
        (Refuses, "every_form_is_written_or_refused_in_one_line"),
    ],
)
def test_a_broken_export_is_caught(export: type[JsonExport], name: str) -> None:
    failing(check_export(export, generate_only=True), name)


# ----- how a suite runs


def test_all_failures_are_named_at_once() -> None:
    with pytest.raises(ContractError) as error:
        td.testing.check_selector(ChoosesFromAll)
    first, *others = str(error.value).splitlines()
    assert first == f"{len(others)} of {len(list(check_selector('none', generate_only=True)))} checks failed"
    assert all(line.startswith("selector correlation: ") for line in others)


def test_an_error_of_the_plug_in_is_told_with_its_kind() -> None:
    class Divides(Correlation):
        def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> Any:
            return 1 / 0

    every = list(check_selector(Divides, generate_only=True))
    text = failing(iter(every), "distinct_inputs_in_the_designs_order")
    assert "expected no error, got ZeroDivisionError: division by zero" in text


def test_checks_have_names_for_pytest() -> None:
    names = [str(c) for c in check_family("ridge", generate_only=True)]
    assert "family ridge: prediction_does_not_look_ahead" in names and len(set(names)) == len(names)
    _: Callable[[], None] = next(check_family("ridge", generate_only=True))
