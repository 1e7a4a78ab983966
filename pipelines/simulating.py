"""`thermodrift simulate`: run plans through a machine file's twin, written as recordings, reports and a picture."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from data.files import check_folder, write_atomic
from data.lakefile import content_digest, encode, safe_name
from data.machine import Machine, load_machine
from reports.twin.iso230_3 import write_iso_report
from twin.compile import compile_network
from twin.network import Network
from twin.run_plan import RunPlan, load_run_plan
from twin.simulation import Simulation, choose_substeps
from twin.simulation import simulate as simulate_network
from twin.simulation.inputs import Inputs, inputs_of_plan, start_of_plan

Say = Callable[[str], None]

STEPS_K = 0.01  # to which the time steps are right
OVERVIEW, TWIN = "overview.png", "twin.html"


@dataclass(frozen=True)
class SimulationRequest:
    """What to simulate. `step_s` None: a row at every step of the plan. `noise` adds what instruments add."""

    machine_file: Path
    plans: tuple[Path, ...]
    out: Path
    step_s: float | None = None
    noise: bool = False
    seed: int = 0
    begins: pd.Timestamp | None = None
    overwrite: bool = False


@dataclass(frozen=True)
class Job:
    """One plan, read and checked: what drives it, which of its borders (k,) are rows, and the file to write."""

    plan: RunPlan
    inputs: Inputs
    rows: NDArray[np.int64]
    file: Path


@dataclass(frozen=True)
class Simulated:
    """One plan: as read, as simulated, as it would have been recorded, and its report where there is one."""

    job: Job
    inputs: Inputs  # in the steps that were needed
    simulation: Simulation
    batch: Batch
    report: Path | None = None


@dataclass(frozen=True)
class SimulationOutcome:
    """All plans of one call, the picture that shows them together, and the page of the twin with their heat flows."""

    machine: str
    plans: tuple[Simulated, ...]
    overview: Path
    twin: Path


def simulate_plans(request: SimulationRequest, say: Say, done: Callable[[str, int, int], None]) -> SimulationOutcome:
    """Simulate every plan and write DIR/PLAN.parquet, DIR/PLAN/ (the thermal test's report), overview.png, twin.html.

    Everything that can be wrong with the files is looked at before the work starts. Each file appears whole or not at
    all. A machine without error channels gets no report.

    Raises:
        InputError: a machine file, plan or option that cannot be used, a file that is there already, a folder that
            cannot be written, heat that is stiff beyond the step control.
    """
    from pipelines.describe_twin import describe_twin
    from reports.twin.figures import overview_png
    from reports.twin.page import TwinData, write_twin_report
    from twin.views.heat_flows import heat_flows

    network, machine, jobs = jobs_of(request)
    picture, page = request.out / OVERVIEW, request.out / TWIN
    check_folder(request.out, [*(j.file for j in jobs), picture, page], request.overwrite)
    out: list[Simulated] = []
    for job in jobs:
        say(f"{job.file.stem}: {job.plan.name}")
        done(job.file.stem, len(out), len(jobs))
        one = simulate_job(job, network, machine, request)
        if network.errors:
            one = replace(one, report=write_iso_report(one.batch, job.file.with_suffix("")))
        _write(job.file, encode(one.batch, content_digest(one.batch)).to_pybytes())
        out.append(one)
    _write(picture, overview_png([(s.job.file.stem, s.batch) for s in out]))
    say("heat flows and modes")
    told = describe_twin(request.machine_file)
    flows = [heat_flows(one.simulation, one.inputs) for one in out]
    data = TwinData(told.view, network.parameters, told.origin, flows=flows, modes=told.modes)
    write_twin_report(page, data, len(flows))
    return SimulationOutcome(machine.machine, tuple(out), picture, page)


def jobs_of(request: SimulationRequest) -> tuple[Network, Machine, tuple[Job, ...]]:
    """Read machine and plans; nothing is simulated or written.

    Raises:
        InputError: as `simulate_plans`.
    """
    machine = load_machine(request.machine_file)
    network = compile_network(machine, f"machine file {request.machine_file}")
    if request.seed < 0:
        raise InputError(f"--seed: got {request.seed}, expected 0 or more")
    begins = request.begins
    clock_h = float("nan") if begins is None else (begins - begins.normalize()).total_seconds() / 3600.0
    jobs: dict[Path, Job] = {}
    seen: dict[Path, Path] = {}
    for path in request.plans:
        file = request.out / f"{safe_name(path.stem)}.parquet"
        if file in seen:
            raise InputError(f"{seen[file]} and {path} would both be written as {file.name}; rename one of them")
        seen[file] = path
        plan = load_run_plan(path, machine)
        inputs = inputs_of_plan(network, replace(plan, name=path.stem), clock_h)
        jobs[file] = Job(plan, inputs, _rows(plan, request.step_s), file)
    return network, machine, tuple(jobs.values())


def simulate_job(job: Job, network: Network, machine: Machine, request: SimulationRequest) -> Simulated:
    """Simulate one plan, with time steps that are right to 0.01 K.

    Raises:
        InputError: heat that is stiff beyond the step control.
    """
    start = start_of_plan(network, job.plan)
    inputs = job.inputs.refined(choose_substeps(network, network.values, job.inputs, start, STEPS_K))
    found = simulate_network(network, network.values, inputs, start, keep_cells=True)
    return Simulated(job, inputs, found, recorded(job, found, machine, request))


def recorded(job: Job, found: Simulation, machine: Machine, request: SimulationRequest) -> Batch:
    """The plan as a measuring system would have recorded it, marked as simulated.

    A row has the drivers that hold from it on; where a driver jumps, the error still is that of before.
    """
    network, plan, rows = found.network, job.plan, job.rows
    columns: dict[str, Array] = {}
    last = len(plan.time_s) - 2
    columns |= {n: v[np.minimum(rows, last)] for n, v in plan.drivers.items()}
    of_channel = {s.channel: s.name for s in network.surroundings if s.channel}
    for channel in machine.names("ambient"):
        given = plan.surroundings.get(channel, plan.surroundings.get(of_channel.get(channel, "")))
        if given is not None:
            columns[channel] = given[rows]
    rng = np.random.default_rng([request.seed, zlib.crc32(found.batch_ids[0].encode())])
    shown = [(r.channel, r.noise, found.readings[0, 0, rows, k]) for k, r in enumerate(network.readings)]
    shown += [(e.channel, e.noise, found.errors[0, 0, rows, k]) for k, e in enumerate(network.errors)]
    for channel, sd, values in shown:
        columns[channel] = values + rng.normal(0.0, sd, len(values)) if request.noise else values
    if request.noise:
        columns = {n: _stepped(v, machine, n) for n, v in columns.items()}
    channels = {n: c for n, c in machine.batch_channels().items() if n in columns}
    table = pd.DataFrame({"time_s": plan.time_s[rows], **{n: columns[n] for n in channels}})
    labels = {
        "plan": plan.name,
        "plan_file": plan.source,
        "machine_file": request.machine_file.name,
        "noise_seed": request.seed if request.noise else None,
        "thermodrift": version("thermodrift"),
    }
    return Batch(
        machine.machine, found.batch_ids[0], table, channels, start=request.begins, simulated=True,
        source=plan.source, labels=labels,
    )  # fmt: skip


def beginning(text: str) -> pd.Timestamp | None:
    """A date and time as written, without a zone; None of an empty text.

    Raises:
        InputError: it cannot be read.
    """
    if not text.strip():
        return None
    begins = pd.to_datetime(text, errors="coerce")
    if not isinstance(begins, pd.Timestamp) or begins.tzinfo is not None:
        raise InputError(f"--begins: got {text!r}, expected a local date and time such as '2025-07-15 06:30'")
    return begins


def _stepped(values: Array, machine: Machine, channel: str) -> Array:
    """Rounded to the instrument's resolution; drivers are as commanded."""
    part = machine.channels[channel]
    if part.resolution is None or part.role in ("driver", "position"):
        return values
    return np.asarray(np.rint(values / part.resolution) * part.resolution + 0.0)


def _rows(plan: RunPlan, step_s: float | None) -> NDArray[np.int64]:
    """Which borders of the plan are rows of the recording, (k,)."""
    step = plan.step_s if step_s is None else step_s
    every = round(step / plan.step_s)
    if not step > 0 or abs(every * plan.step_s - step) > 1e-9 * step:
        raise InputError(
            f"--step: got {step:g} s, expected a whole number of the plan's steps of {plan.step_s:g} s ({plan.source})"
        )
    on_step = np.flatnonzero(plan.on_step)
    rows = on_step[::every]
    if len(rows) < 2:
        raise InputError(
            f"--step: {step:g} s leaves {len(rows)} row of {plan.source}, which lasts {plan.time_s[-1]:g} s; "
            "expected 2 or more"
        )
    return rows


def _write(file: Path, content: bytes) -> None:
    try:
        write_atomic(file, content)
    except OSError as error:
        raise InputError(f"{file}: cannot be written ({error.strerror}); give another --out") from None
