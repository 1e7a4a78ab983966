"""`thermodrift describe --twin MACHINE.yml`: the network as a picture, its bodies and time constants as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table as Shown

from data.errors import InputError, closest
from data.machine import Machine, load_machine
from pipelines import screen
from reports.layout import Table
from reports.twin import tables as twin_tables
from reports.twin.network_picture import counted
from reports.twin.page import PICTURES, TwinData, write_picture, write_twin_report
from twin.compile import compile_network, expanded
from twin.network import Network
from twin.quantity import convert
from twin.schema import twin_part
from twin.simulation.start import Steady, steady_state
from twin.views.overview import ModeView, Overview, machine_modes, mode_views, overview

AIR_DEGC = 20.0


@dataclass(frozen=True)
class Described:
    """A machine file's twin as it is told."""

    network: Network
    view: Overview
    modes: tuple[ModeView, ...]
    origin: str


def describe_twin(machine_file: Path, out: Path | None = None, at: Sequence[str] = ()) -> Described:
    """Read the twin part; draw it to `out` (.svg, .png, or .html with all tables).

    `at` ("spindle_rpm=4000") says at which drivers the watts are shown, by default at half of every driver's range.

    Raises:
        InputError: no twin part or one that makes no sense, an unknown driver, a place that cannot be written.
    """
    if out is not None and out.suffix not in PICTURES:
        raise InputError(f"--out {out}: got suffix {out.suffix!r}, expected {', '.join(PICTURES)}")
    if out is not None and out.exists():
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
        _write(shown, out)
    return shown


def print_twin(shown: Described) -> None:
    """Bodies and time constants on the screen."""
    view = shown.view
    screen.line(f"{view.machine}{' (SIMULATED)' if view.simulated else ''}: {counted(view)}")
    screen.line(f"values {shown.origin}")
    for s in view.surroundings:
        screen.line(f"surrounding {s.name}: {s.words}")
    _print(twin_tables.bodies(view))
    if view.stated:
        screen.line(f"time constants and displacement, {view.stated}")
    _print(twin_tables.modes(shown.modes, view))


def _write(shown: Described, out: Path) -> None:
    if out.suffix == ".html":
        write_twin_report(out, TwinData(shown.view, shown.network.parameters, shown.origin, modes=shown.modes))
    else:
        write_picture(out, shown.view)


def _drivers(network: Network, machine: Machine, at: Sequence[str]) -> dict[str, float] | None:
    """The drivers that the watts are shown at; None where one has no value and no range from 0."""
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


def _steady(network: Network, drivers: Mapping[str, float] | None, asked: bool) -> Steady | None:
    if drivers is None:
        return None
    try:
        return steady_state(network, drivers, AIR_DEGC)
    except InputError:
        if asked:
            raise
        return None  # half of the range was our own idea: without a steady state the picture shows laws alone


def _print(table: Table) -> None:
    shown = Shown(box=SIMPLE_HEAD, title=table.caption, title_justify="left", title_style="bold", pad_edge=False)
    for c in table.columns:
        heading = f"{c.title} ({c.unit})" if c.unit else c.title
        shown.add_column(escape(heading), justify="right" if c.kind == "number" else "left", overflow="fold")
    for row in table.rows:
        shown.add_row(*(escape(str(cell)) for cell in row.cells))
    screen.out.print(shown)
    for note in table.notes:
        screen.line(note)
