"""The report of a twin: machine, network, parameters, fit, residuals, heat, modes on one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from data.batch import Batch
from data.errors import InputError, check_suffix
from data.machine import LEAD_ROWS, Machine
from reports.drawing import picture, picture_bytes
from reports.layout import Heading, Items, Page, Pairs, Section, Text, given
from reports.rendering import write_page
from reports.twin import tables
from reports.twin.figures import mode_shapes, residual_map
from reports.twin.flows import flow_picture, heat_stack
from reports.twin.network_picture import network_picture
from reports.viewer import Pane, Trace, viewer
from twin.calibration import Calibration
from twin.calibration.identifiability import Interval
from twin.compile import compile_network, expanded
from twin.network import Network
from twin.quantity import Parameter
from twin.schema import twin_part
from twin.simulation import choose_substeps, simulate
from twin.simulation.inputs import Inputs, acting, inputs_of
from twin.simulation.start import Steady, steady_state
from twin.views.compared import Compared, compared, rms_table
from twin.views.heat_flows import HeatFlows, heat_flows
from twin.views.overview import ModeView, Overview, machine_modes, mode_views, overview

PICTURES = (".svg", ".png", ".html")
MOST_BATCHES = 4
_HOUR_S = 3600.0


@dataclass(frozen=True)
class TwinData:
    """What the report is made of; whatever is empty is left out of the page.

    `intervals` by parameter and `left_out` (`LeftOut.by_channel()`) come from a calibration, `compared` and `flows`
    from a simulation. `origin` states where the values come from, `findings` are sentences for the engineer.
    """

    view: Overview
    parameters: Sequence[Parameter]
    origin: str = "as the machine file states them"
    intervals: Mapping[str, Interval] = field(default_factory=dict)
    findings: Sequence[str] = ()
    left_out: pd.DataFrame | None = None
    compared: Sequence[Compared] = ()
    flows: Sequence[HeatFlows] = ()
    modes: Sequence[ModeView] = ()


def write_twin_report(path: Path | str, data: TwinData, most_batches: int = MOST_BATCHES) -> Path:
    """One self-contained page; .md has the tables and no pictures.

    Figures are drawn of the `most_batches` with the greatest residual; the map shows all. The file appears whole or
    not at all.

    Raises:
        InputError: another suffix, or a place that cannot be written.
    """
    path = Path(path)
    write_page(path, twin_page(data, most_batches, pictures=path.suffix == ".html"))
    return path


def write_picture(path: Path | str, view: Overview) -> Path:
    """The network alone, as .svg or .png, or as .html with the table of its bodies.

    Raises:
        InputError: another suffix, or a place that cannot be written.
    """
    path = Path(path)
    check_suffix("picture", path, PICTURES)
    if path.suffix == ".html":
        return write_twin_report(path, TwinData(view, ()))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(picture_bytes(network_picture(view), path.suffix[1:]))
    except OSError as error:
        raise InputError(f"picture {path}: cannot be written ({error.strerror}); give another place") from None
    return path


def twin_page(data: TwinData, most_batches: int = MOST_BATCHES, pictures: bool = True) -> Page:
    """The page; what is not given is left out."""
    view = data.view
    sections = [_network(data, pictures)]
    sections += [_parameters(data)] if data.parameters else []
    sections += [_fit(data, most_batches, pictures)] if data.compared or data.left_out is not None else []
    sections += [_heat(data, most_batches, pictures)] if data.flows else []
    sections += [_modes(data, pictures)] if data.modes else []
    facts = [("Machine", view.machine), ("Network", tables.counted(view)), ("Values", data.origin)]
    batches = list(dict.fromkeys([c.batch_id for c in data.compared] + [f.batch_id for f in data.flows]))
    if batches:
        named = ", ".join(batches[:3]) + (f" and {len(batches) - 3} more" if len(batches) > 3 else "")
        facts.append(("Batches", named))
    footer = (
        "Temperatures and displacements of a twin are computed, never measured; SIMULATED marks figures and tables "
        "whose recordings are computed too.",
        *([] if pictures else ["The pictures are in the HTML report."]),
    )
    simulated = view.simulated or any(c.simulated for c in data.compared)
    top = given(Text(view.description), Pairs(tuple(facts)))
    return Page("thermodrift twin", f"Twin of {view.machine}", top, tuple(sections), footer, simulated)


def _network(data: TwinData, pictures: bool) -> Section:
    shown = []
    if pictures:
        label, simulated = "Thermal network and error chains", data.view.simulated
        shown.append(picture(network_picture(data.view), label, simulated, "svg", "network full"))
    return Section("network", "Network", (*shown, tables.bodies(data.view)))


def _parameters(data: TwinData) -> Section:
    free, fixed = (tables.parameters(data.parameters, data.intervals, f, data.view.simulated) for f in (True, False))
    said = (Heading("What the fit says"), Items(tuple(data.findings))) if data.findings else ()
    return Section("parameters", "Parameters", given(free, *said, fixed.folded() if fixed.rows else None))


def _fit(data: TwinData, most: int, pictures: bool) -> Section:
    chosen = worst(data.compared, most)
    simulated = any(c.simulated for c in data.compared)
    blocks: list[Any] = []
    if data.compared:
        blocks.append(Text("Displacements count from their first reading. Residual: recorded − simulated.", "note"))
    blocks.append(tables.left_out(data.left_out, data.view.simulated) if data.left_out is not None else None)
    if pictures and data.compared:
        blocks.append(viewer("Recorded and simulated", _panes(data.compared), simulated))
    if data.compared:
        blocks.append(tables.rms(rms_table(data.compared), simulated))
    if len(chosen) < len(data.compared):
        said = f"Drawn: the {len(chosen)} of {len(data.compared)} batches with the greatest residual."
        blocks.append(Text(said, "note"))
    for c in chosen if pictures else ():
        blocks.append(picture(residual_map(c), f"{c.batch_id}: residual map", c.simulated, look="full"))
    return Section("fit", "Simulated against recorded", given(*blocks))


def _panes(parts: Sequence[Compared]) -> list[Pane]:
    """A pane per batch and channel, displacements counted from their first reading as in the figures."""
    panes = []
    for c in parts:
        for name, unit, recorded, computed in zip(c.channels, c.units, c.recorded, c.computed, strict=True):
            traces = (Trace("recorded", recorded, "recorded"), Trace("simulated", computed, "computed"))
            panes.append(Pane(c.batch_id, name, unit, c.time_s / _HOUR_S, traces))
    return panes


def _heat(data: TwinData, most: int, pictures: bool) -> Section:
    blocks: list[Any] = [Text("Every watt is computed, also where a recording gave drivers and surroundings.", "note")]
    blocks += [tables.heat(f) for f in data.flows[:most]]
    for f in data.flows[:most] if pictures else ():
        moment = min(_HOUR_S, 0.5 * float(f.time_s[-1]))
        blocks.append(picture(heat_stack(f), f"{f.batch_id}: where the watts go", f.simulated, look="full"))
        label = f"{f.batch_id}: heat through the network"
        blocks.append(picture(flow_picture(data.view, f, moment), label, f.simulated, "svg", "network full"))
    return Section("heat", "Where the watts go", tuple(blocks))


def _modes(data: TwinData, pictures: bool) -> Section:
    simulated, label = data.view.simulated, "Shapes of the slowest modes"
    shown = [picture(mode_shapes(data.modes, simulated), label, simulated, look="full")] if pictures else []
    return Section("modes", "Time constants and modes", (*shown, tables.modes(data.modes, data.view)))


def worst(parts: Sequence[Compared], most: int) -> list[Compared]:
    """The batches with the greatest residual, each channel by its median over all batches; in their own order."""
    table = rms_table(parts)
    if table.empty:
        return list(parts[:most])
    usual = table.groupby("channel")["rms"].transform("median").replace(0.0, np.nan)
    size = (table["rms"] / usual).groupby(table["batch"], sort=False).mean().fillna(0.0)
    chosen = set(size.sort_values(ascending=False, kind="stable").index[:most])
    return [c for c in parts if c.batch_id in chosen]


AIR_DEGC = 20.0


def twin_data(
    machine: Machine,
    batches: Sequence[Batch] = (),
    calibration: Calibration | None = None,
    most_flows: int = MOST_BATCHES,
) -> TwinData:
    """Simulate the batches free-running from their first readings, with the calibrated values where there are some.

    The watts of the network picture are those at the greatest value that each driver had in the batches.

    Raises:
        InputError: no twin part, or recordings that cannot drive it.
    """
    network = compile_network(machine) if calibration is None else calibration.network
    part = expanded(twin_part(machine))
    lead_rows = LEAD_ROWS[machine.recording.drivers or "held"] if calibration is None else calibration.lead_rows
    inputs = inputs_of(network, acting(batches, lead_rows)) if batches else None
    if inputs is not None:
        inputs = inputs.refined(choose_substeps(network, network.values, inputs))
    drivers, steady = _steady(network, inputs)
    view = overview(network, part, machine.description, machine.simulated, steady, drivers)
    modes = machine_modes(network, None if steady is None else steady.factor)
    rise = None if steady is None else steady.degC - AIR_DEGC
    done = simulate(network, network.values, inputs, keep_cells=True) if inputs is not None else None
    flows = []
    if done is not None and inputs is not None:
        flows = [heat_flows(done, inputs, batch=k) for k in range(min(most_flows, len(batches)))]
    return TwinData(
        view,
        network.parameters,
        _origin(calibration),
        {} if calibration is None else {i.name: i for i in calibration.intervals90},
        () if calibration is None else _findings(calibration),
        None if calibration is None or calibration.left_out is None else calibration.left_out.by_channel(),
        [] if done is None else compared(done, batches),
        flows,
        mode_views(network, modes, rise),
    )


def _steady(network: Network, inputs: Inputs | None) -> tuple[dict[str, float] | None, Steady | None]:
    if inputs is None and network.drivers:
        return None, None
    drivers = {n: float(inputs.drivers[n].max()) for n in network.drivers} if inputs is not None else {}
    try:
        return drivers, steady_state(network, drivers, AIR_DEGC)
    except InputError:  # the picture then shows laws without watts
        return None, None


def _origin(calibration: Calibration | None) -> str:
    if calibration is None:
        return "as the machine file states them"
    n = len(calibration.batches)
    return f"calibrated on {n} {'simulated ' if calibration.simulated else ''}{'batch' if n == 1 else 'batches'}"


def _findings(calibration: Calibration) -> tuple[str, ...]:
    """Remarks on the fit, on what the recordings leave undetermined, and on the residuals."""
    said = [calibration.fit.message, *calibration.remarks, *(u.summary for u in calibration.undetermined)]
    return tuple(s for s in (*said, *calibration.whiteness_in_words.values()) if s)
