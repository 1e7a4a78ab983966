"""`thermodrift simulate`: run plans through a machine file's twin, written as recordings, reports and a picture."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import InputError
from data.units import unit_label
from pipelines import console
from pipelines.caller import Done, Say
from pipelines.options import Json
from reports.labels import number

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray
    from rich.table import Table

    from data.arrays import Array
    from data.batch import Batch
    from data.machine import Machine
    from twin.network import Network
    from twin.run_plan import RunPlan
    from twin.simulation import Simulation
    from twin.simulation.inputs import Inputs
    from twin.views.heat_flows import HeatFlows

STEP_TOLERANCE_K = 0.01  # of the time integration
OVERVIEW, TWIN = "overview.png", "twin.html"
HOURS = (1.0, 2.0, 6.0)  # at which the console shows the errors


@dataclass(frozen=True)
class SimulationRequest:
    """What to simulate. `step_s` None: a row at every step of the plan. `noise` adds noise and resolution."""

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
    """One plan, read and checked: its inputs, the indices (k,) of the plan's steps that are rows, the file to write."""

    plan: RunPlan
    inputs: Inputs
    rows: NDArray[np.int64]
    file: Path


@dataclass(frozen=True)
class Simulated:
    """One plan: as read, as simulated, as it would have been recorded, and its report where there is one."""

    job: Job
    inputs: Inputs  # in the substeps that the simulation used
    simulation: Simulation
    batch: Batch
    report: Path | None = None

    def heat_flows(self) -> HeatFlows:
        """Where the heat comes from, is stored and goes: watts by law, body, surrounding and link over time."""
        from twin.views.heat_flows import heat_flows

        return heat_flows(self.simulation, self.inputs)


@dataclass(frozen=True)
class SimulationOutcome:
    """All plans of one call, the picture that shows them together, and the page of the twin with their heat flows."""

    machine: str
    plans: tuple[Simulated, ...]
    overview: Path
    twin: Path


def simulate_plans(request: SimulationRequest, say: Say, done: Done) -> SimulationOutcome:
    """Simulate every plan and write DIR/PLAN.parquet, DIR/PLAN/ (the thermal test's report), overview.png, twin.html.

    Files and options are checked before the work starts. Each file appears whole or not at all. A machine without
    error channels gets no report.

    Raises:
        InputError: a machine file, plan or option that cannot be used, a file that is there already, a folder that
            cannot be written, heat that is stiff beyond the step control.
    """
    from data.files import check_folder
    from data.lakefile import content_digest, encode
    from data.machine import load_machine
    from pipelines.commands.describe import describe_twin
    from reports.twin.figures import overview_png
    from reports.twin.iso230_3 import write_iso_report
    from reports.twin.page import TwinData, write_twin_report

    machine = load_machine(request.machine_file)
    network, jobs = jobs_of(request, machine)
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
    described = describe_twin(request.machine_file)
    flows = [one.heat_flows() for one in out]
    data = TwinData(described.view, network.parameters, described.origin, flows=flows, modes=described.modes)
    write_twin_report(page, data, len(flows))
    return SimulationOutcome(machine.machine, tuple(out), picture, page)


def jobs_of(request: SimulationRequest, machine: Machine) -> tuple[Network, tuple[Job, ...]]:
    """Compile the machine's twin and read the plans; nothing is simulated or written.

    Raises:
        InputError: as `simulate_plans`.
    """
    from data.lakefile import safe_name
    from twin.compile import compile_network
    from twin.run_plan import load_run_plan
    from twin.simulation.inputs import inputs_of_plan

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
    return network, tuple(jobs.values())


def simulate_job(job: Job, network: Network, machine: Machine, request: SimulationRequest) -> Simulated:
    """Simulate one plan, with time steps that are accurate to `STEP_TOLERANCE_K`.

    Raises:
        InputError: heat that is stiff beyond the step control.
    """
    from twin.simulation import choose_substeps
    from twin.simulation import simulate as simulate_network
    from twin.simulation.inputs import start_of_plan

    start = start_of_plan(network, job.plan)
    inputs = job.inputs.refined(choose_substeps(network, network.values, job.inputs, start, STEP_TOLERANCE_K))
    found = simulate_network(network, network.values, inputs, start, keep_cells=True)
    return Simulated(job, inputs, found, recorded(job, found, machine, request))


def recorded(job: Job, found: Simulation, machine: Machine, request: SimulationRequest) -> Batch:
    """The plan as a measuring system would have recorded it, marked as simulated.

    A row has the drivers that hold from it on; where a driver jumps, the row's error is that before the jump.
    """
    from importlib.metadata import version

    import numpy as np
    import pandas as pd

    from data.batch import Batch

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
    import pandas as pd

    if not text.strip():
        return None
    begins = pd.to_datetime(text, errors="coerce")
    if not isinstance(begins, pd.Timestamp) or begins.tzinfo is not None:
        raise InputError(f"--begins: got {text!r}, expected a local date and time such as '2025-07-15 06:30'")
    return begins


def _stepped(values: Array, machine: Machine, channel: str) -> Array:
    """Rounded to the instrument's resolution; drivers are as commanded."""
    import numpy as np

    part = machine.channels[channel]
    if part.resolution is None or part.role in ("driver", "position"):
        return values
    return np.asarray(np.rint(values / part.resolution) * part.resolution + 0.0)


def _rows(plan: RunPlan, step_s: float | None) -> NDArray[np.int64]:
    """Which steps of the plan are rows of the recording, (k,)."""
    import numpy as np

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
    from data.files import write_atomic

    try:
        write_atomic(file, content)
    except OSError as error:
        raise InputError(f"{file}: cannot be written ({error.strerror}); give another --out") from None


def error_table(batch: Batch) -> pd.DataFrame:
    """Per error channel: unit, range, value after 1, 2 and 6 h (NaN where the plan is shorter) and at the end."""
    import numpy as np
    import pandas as pd

    rows = []
    for name in batch.names("error"):
        values, unit = batch.values(name), batch.channels[name].unit
        after = np.interp([h * 3600.0 for h in HOURS], batch.time_s, values, right=np.nan)
        at = {f"at_{h:g}h": float(v) for h, v in zip(HOURS, after, strict=True)}
        rows.append({"channel": name, "unit": unit, "range": float(np.ptp(values)), **at, "end": float(values[-1])})
    return pd.DataFrame(rows, columns=["channel", "unit", "range", *(f"at_{h:g}h" for h in HOURS), "end"])


def hottest(one: Simulated) -> tuple[str, float, float]:
    """The cell that gets hottest, how hot (degC) and when (s)."""
    import numpy as np

    cells = one.simulation.cells_degC
    assert cells is not None
    row, cell = np.unravel_index(int(np.argmax(cells[0, 0])), cells.shape[2:])
    return one.simulation.network.cells[cell], float(cells[0, 0, row, cell]), float(one.simulation.time_s[0, row])


def heat_table(one: Simulated) -> pd.DataFrame:
    """Per heat source: mean and greatest W over the plan, and its energy in Wh, the most first."""
    import pandas as pd

    found, seconds = one.simulation, float(one.job.plan.time_s[-1])
    names = [h.law.name for h in found.network.heats]
    rows = [
        {"source": n, "mean_W": found.heat_J[n][0, 0, -1] / seconds, "most_W": found.heat_W[n][0, 0].max(),
         "energy_Wh": found.heat_J[n][0, 0, -1] / 3600.0}
        for n in names
    ]  # fmt: skip
    table = pd.DataFrame(rows, columns=["source", "mean_W", "most_W", "energy_Wh"])
    return table.sort_values("mean_W", ascending=False, kind="stable", ignore_index=True)


def print_simulation(outcome: SimulationOutcome) -> None:
    """Per plan: errors, hottest body, heat by source; then where everything is."""
    from features.iso230_3 import clock

    for one in outcome.plans:
        length = clock(float(one.job.plan.time_s[-1]))
        console.line(f"{one.job.file.stem}: {one.job.plan.name}, {length} h, simulated; {one.simulation.message}")
        if len(one.batch.names("error")):
            console.out.print(_errors(error_table(one.batch)))
        body, degC, time_s = hottest(one)
        console.line(f"hottest body: {body}, {degC:.1f} °C at {clock(time_s)} h")
        console.out.print(_heats(heat_table(one)))
        console.line(f"recording {one.job.file}")
        if one.report is not None:
            console.line(f"report    {one.report}")
    console.line(f"overview  {outcome.overview}")
    console.line(f"twin      {outcome.twin}")


def simulation_dict(outcome: SimulationOutcome) -> dict[str, Any]:
    """The outcome of a simulation for other programs."""
    plans = []
    for one in outcome.plans:
        body, degC, time_s = hottest(one)
        plans.append(
            {
                "plan": one.job.plan.name,
                "file": str(one.job.file),
                "report": None if one.report is None else str(one.report),
                "hours": float(one.job.plan.time_s[-1]) / 3600.0,
                "rows": one.batch.n_rows,
                "words": one.simulation.message,
                "errors": console.records(error_table(one.batch)),
                "hottest": {"body": body, "degC": degC, "time_s": time_s},
                "heat": console.records(heat_table(one)),
            }
        )
    files = {"overview": str(outcome.overview), "twin": str(outcome.twin)}
    return {"machine": outcome.machine, "simulated": True, "plans": plans, **files}


def _errors(table: pd.DataFrame) -> Table:
    shown = console.table("", "error", "unit", "range", *(f"{h:g} h" for h in HOURS), "end", left=("error", "unit"))
    for r in table.to_dict("records"):
        values = (r["range"], *(r[f"at_{h:g}h"] for h in HOURS), r["end"])
        shown.add_row(str(r["channel"]), unit_label(str(r["unit"])), *(number(float(v)) for v in values))
    return shown


def _heats(table: pd.DataFrame) -> Table:
    shown = console.table("", "heat", "mean W", "most W", "Wh", left=("heat",))
    for r in table.to_dict("records"):
        shown.add_row(str(r["source"]), *(number(float(r[k]), 0) for k in ("mean_W", "most_W", "energy_Wh")))
    total = table[["mean_W", "energy_Wh"]].sum()
    shown.add_row("all", number(float(total["mean_W"]), 0), "", number(float(total["energy_Wh"]), 0))
    return shown


def write_sample(folder: Path, seed: int, say: Say = lambda text: None) -> tuple[Path, list[Path]]:
    """The machine file and the recordings of the sample machine; a machine file there is kept, it may be edited."""
    from data.files import write_atomic
    from plants.sample.sample_machine import FILE
    from plants.sample.sample_year import write_sample_year

    files = write_sample_year(folder, seed=seed)
    say(f"{folder}: {len(files)} simulated recordings of the sample machine, seed {seed}")
    own = folder / FILE.name
    if own.exists():
        say(f"{own}: kept as it is")
    else:
        write_atomic(own, FILE.read_bytes())
        say(f"{own}: its machine file")
    return own, files


def simulate(
    plans: Annotated[list[Path] | None, typer.Argument(help="run plans: stages (.yml) or tables over time")] = None,
    machine: Annotated[Path | None, typer.Option("--machine", help="machine file (.yml) with a twin part")] = None,
    sample_year: Annotated[bool, typer.Option("--sample-year", help="the built-in year of 30 batches")] = False,
    to: Annotated[Path | None, typer.Option("--out", help="folder; default: simulated, or sample_year")] = None,
    step: Annotated[float | None, typer.Option(help="seconds from row to row; default: the plan's step")] = None,
    noise: Annotated[bool, typer.Option("--noise", help="add noise and resolution of sensors and probes")] = False,
    seed: Annotated[int, typer.Option(help="of the noise, or of the sample year")] = 0,
    begins: Annotated[str, typer.Option(help="date and time of the first row; sunlight needs it")] = "",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace recordings of the same name")] = False,
    as_json: Json = False,
) -> None:
    """Simulate run plans by a machine file's twin, or the sample year; written as recordings, labelled simulated."""
    if sample_year:
        if plans or machine is not None:
            raise InputError("simulate: --sample-year has its own machine and plans; leave out --machine and PLANS")
        write_sample(to or Path("sample_year"), seed, console.line)
        return
    if not plans and machine is None:
        raise InputError(
            "simulate: got nothing to simulate; call `thermodrift simulate --sample-year --out FOLDER`, or "
            "`thermodrift simulate PLAN --machine FILE --out FOLDER`"
        )
    if not plans:
        raise InputError("simulate: got no run plan; name one or more (.yml with stages, or a table over time)")
    if machine is None:
        raise InputError("simulate: got a run plan and no machine; give its file by --machine")
    folder = to or Path("simulated")
    request = SimulationRequest(machine, tuple(plans), folder, step, noise, seed, beginning(begins), overwrite)
    with console.progress(as_json) as (say, done):
        outcome = simulate_plans(request, say, done)
    if as_json:
        console.print_json(simulation_dict(outcome))
    else:
        print_simulation(outcome)
