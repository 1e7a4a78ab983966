"""From a machine file, recordings and a calibration to what the report of a twin shows."""

from __future__ import annotations

from collections.abc import Sequence

from data.batch import Batch
from data.errors import InputError
from data.machine import Machine
from pipelines.report.twin_report import MOST_BATCHES, TwinData
from twin.calibration import Calibration
from twin.compile import compile_network, expanded
from twin.network import Network
from twin.schema import twin_part
from twin.simulation import choose_substeps, simulate
from twin.simulation.inputs import Inputs, inputs_of
from twin.simulation.steady import Steady, steady_state
from twin.views.compared import compared
from twin.views.heat_flows import heat_flows
from twin.views.mode_words import machine_modes, mode_views
from twin.views.overview import overview

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
    inputs = inputs_of(network, batches) if batches else None
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
    """What the fit says of itself, of what the recordings leave open, and of its residuals."""
    said = [calibration.fit.words, *(u.words for u in calibration.undetermined)]
    return tuple(s for s in (*said, *calibration.whiteness_in_words.values()) if s)
