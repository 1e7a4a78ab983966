"""`thermodrift describe`: a machine file drafted from recordings, or picture and tables of a machine file's twin."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from data.errors import InputError, check_suffix, closest
from data.files import write_atomic
from pipelines import console

if TYPE_CHECKING:
    from data.describe import Shown
    from data.machine import Machine
    from reports.layout import Table
    from twin.network import Network
    from twin.simulation.start import Steady
    from twin.views.overview import ModeView, Overview

AIR_DEGC = 20.0


@dataclass(frozen=True)
class Described:
    """A machine file's twin: network, overview, modes, and the origin of its values."""

    network: Network
    view: Overview
    modes: tuple[ModeView, ...]
    origin: str


def describe_twin(machine_file: Path, out: Path | None = None, at: Sequence[str] = ()) -> Described:
    """Read the twin part; draw it to `out` (.svg, .png, or .html with all tables).

    `at` ("spindle_rpm=4000") sets the drivers at which the heat flows are shown; the default is half of
    every driver's range.

    Raises:
        InputError: no twin part or an invalid one, an unknown driver, a file that exists or cannot be written.
    """
    from data.machine import load_machine
    from twin.compile import compile_network, expanded
    from twin.schema import twin_part
    from twin.views.overview import machine_modes, mode_views, overview

    if out is not None:
        from reports.twin.page import PICTURES  # takes long to load

        check_suffix("--out", out, PICTURES)
        if out.exists():
            raise InputError(f"{out} exists; give another --out or remove it first")
    where = f"machine file {machine_file}"
    machine = load_machine(machine_file)
    part = expanded(twin_part(machine, where))
    network = compile_network(machine, where)
    drivers = _drivers(network, machine, at)
    steady = _steady(network, drivers, bool(at))
    view = overview(network, part, machine.description, machine.simulated, steady, drivers)
    factor = None if steady is None else steady.factor
    rise = None if steady is None else steady.degC - AIR_DEGC
    modes = tuple(mode_views(network, machine_modes(network, factor), rise))
    known = part.calibrated
    origin = "as the machine file states them"
    if known is not None:
        origin = f"calibrated on {len(known.batches)} {'simulated ' if known.simulated else ''}batches, {known.when}"
    shown = Described(network, view, modes, origin)
    if out is not None:
        _draw(out, shown)
    return shown


def _draw(out: Path, shown: Described) -> None:
    from reports.twin.page import TwinData, write_picture, write_twin_report

    if out.suffix == ".html":
        write_twin_report(out, TwinData(shown.view, shown.network.parameters, shown.origin, modes=shown.modes))
    else:
        write_picture(out, shown.view)


def print_twin(shown: Described) -> None:
    """Bodies and time constants."""
    from reports.twin import tables

    view = shown.view
    console.line(f"{view.machine}{' (SIMULATED)' if view.simulated else ''}: {tables.counted(view)}")
    console.line(f"values {shown.origin}")
    for s in view.surroundings:
        console.line(f"surrounding {s.name}: {s.label}")
    _print(tables.bodies(view))
    if view.stated:
        console.line(f"time constants and displacement, {view.stated}")
    _print(tables.modes(shown.modes, view))


def _drivers(network: Network, machine: Machine, at: Sequence[str]) -> dict[str, float] | None:
    """The drivers that the watts are shown at; None where one has no value and no range from 0."""
    from twin.quantity import convert

    given: dict[str, float] = {}
    for text in at:
        name, eq, value = (x.strip() for x in text.partition("="))
        if not eq or name not in network.drivers:
            expected = f"{network.drivers[0]}=1" if network.drivers else "no --at: the twin has no driver"
            hint = closest(name, network.drivers) if network.drivers else ""
            raise InputError(f"--at {text}: got {name!r}, expected a driver and its value, e.g. {expected}; {hint}")
        try:
            given[name] = convert(value, machine.channels[name].unit)
        except ValueError as error:
            raise InputError(f"--at {text}: {error}") from None
    for name in network.drivers:
        bounds = machine.channels[name].range
        if name not in given:
            if bounds is None or bounds[0] != 0:
                if at:
                    raise InputError(f"--at: no value for driver {name!r}, which the twin needs; add --at {name}=1")
                return None
            given[name] = bounds[1] / 2
    return {n: given[n] for n in network.drivers}


def _steady(network: Network, drivers: Mapping[str, float] | None, given: bool) -> Steady | None:
    from twin.simulation.start import steady_state

    if drivers is None:
        return None
    try:
        return steady_state(network, drivers, AIR_DEGC)
    except InputError:
        if given:
            raise
        return None  # nobody gave these drivers: without a steady state the picture shows the laws alone


def _print(table: Table) -> None:
    shown = console.table(table.caption)
    shown.title_style, shown.show_edge = "bold", True
    for c in table.columns:
        heading = f"{c.title} ({c.unit})" if c.unit else c.title
        shown.add_column(escape(heading), justify="right" if c.kind == "number" else "left", overflow="fold")
    for row in table.rows:
        shown.add_row(*(escape(str(cell)) for cell in row.cells))
    console.out.print(shown)
    for note in table.notes:
        console.line(note)


def describe(
    files: Annotated[list[Path] | None, typer.Argument(help="recordings of one machine")] = None,
    to: Annotated[
        Path | None, typer.Option("--out", help="the draft's file, or the picture's (.svg, .png, .html)")
    ] = None,
    twin: Annotated[
        Path | None, typer.Option("--twin", help="draw this machine file's thermal network instead")
    ] = None,
    show: Annotated[
        bool, typer.Option("--show", help="print the first rows of each column, and what it becomes or why not")
    ] = False,
    given: Annotated[
        list[str] | None,
        typer.Option("--set", help="a key of the files' layout that overrides what is found, such as header_rows=4"),
    ] = None,
    at: Annotated[
        list[str] | None, typer.Option("--at", help="with --twin: a driver's value for the heat flows, NAME=VALUE")
    ] = None,
) -> None:
    """Draft a machine file from recordings, every guess marked; or draw a machine file's twin."""
    if twin is not None:
        if files:
            raise InputError(f"--twin {twin}: draws a machine file and reads no recordings; leave out {files[0]}")
        print_twin(describe_twin(twin, to, at or ()))
        if to is not None:
            console.line(to)
        return
    if not files:
        raise InputError("describe: got nothing to describe; name recordings, or a machine file as --twin MACHINE.yml")
    if at:
        raise InputError(f"--at {at[0]}: belongs to a twin's picture; add --twin MACHINE.yml")
    from data.describe import drafted, notes
    from data.machine import Form
    from data.yaml_file import parse_yaml
    from pipelines.settings import load

    keys = "\n".join(": ".join(text.split("=", 1)) for text in given or ())
    named = "" if to is None else to.stem
    text, columns, runs = drafted(files, parse_yaml(keys or "{}", Form, "describe --set"), named)
    if show:
        for name, shown in columns.items():
            _print_columns(name, shown)
    elif to is None:
        sys.stdout.write(text)
    if to is not None:
        _write(to, text)
        console.line(
            f"{to}: a draft; check every line marked 'guessed', then call `thermodrift ingest --machine {to} …`"
        )
    if few := load().promotion.few(runs, ordered=True):
        console.note(f"{few}; with fewer `train` makes a provisional model at most")
    for note in notes(text):
        console.note(f"check: {note}")


def _print_columns(name: str, columns: Sequence[Shown]) -> None:
    """First cells of each column and what becomes of them."""
    table = console.table(name)
    for heading in ("column", "first cells", "read as", "first values"):
        table.add_column(heading, overflow="fold")
    for c in columns:
        values = ", ".join(f"{v:.6g}" for v in c.numbers)
        table.add_row(*(escape(text) for text in (c.column, ", ".join(c.cells), c.becomes, values)))
    console.out.print(table)


def _write(to: Path, text: str) -> None:
    """Write the draft; missing folders are made."""
    if to.exists():
        raise InputError(f"{to} exists; give another --out or remove it first")
    try:
        to.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(to, text)
    except OSError as error:
        raise InputError(f"--out {to}: cannot be written ({error.strerror}); give another path") from None
