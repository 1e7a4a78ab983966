"""A diagnosis continued: the recordings of an earlier one and new ones together, and what that changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from data.files import check_folder
from data.machine import Machine, load_machine, parse_machine
from diagnosis.findings.schema import read_findings
from pipelines.caller import RETRIES, DirectCaller, Done, Say
from pipelines.jobs.diagnosing import FILES, FINDINGS, PLAN, DiagnosisOutcome, DiagnosisRequest, finished
from pipelines.jobs.inputs import Inputs, Recorded, read_inputs
from pipelines.jobs.recordings import Gathered, check_recordings, gather_batches, home_lake, load_batches
from pipelines.settings import Settings
from reports.diagnosis.first_screen import Continued
from twin.run_plan import RunPlan, load_run_plan

SAME_SHARE = 0.05  # of a driver's range in the plan: as near a shop comes to a speed that it is given
SAME_ROWS = 0.9  # of the plan's time: a shop switches a little sooner or later


def continue_diagnosis(
    out: Path,
    recordings: tuple[Path, ...],
    settings: Settings,
    machine_file: Path | None = None,
    seed: int | None = None,
    report: bool = True,
    say: Say = lambda text: None,
    done: Done | None = None,
) -> DiagnosisOutcome:
    """Diagnose the machine of an earlier diagnosis on its recordings and new ones, and write into its folder again.

    The earlier findings stay as `findings.1.json`, `findings.2.json`, …

    Args:
        out: folder of the earlier diagnosis.
        machine_file: instead of the one that was diagnosed.
        seed: of all random draws; default: the earlier one's.

    Raises:
        InputError: no earlier diagnosis, another machine, a recording that it has used already, or one of its
            recordings that the lake does not hold any more.
        WorkError: as `diagnose_file`.
    """
    if not recordings:
        raise InputError("--continue: no new recordings; give them by --recordings")
    before = read_inputs(out)
    findings = read_findings(out / FINDINGS)
    check_recordings(recordings)
    check_folder(out, [out / n for n in FILES], overwrite=True)
    machine, file, text = _machine(out, machine_file, before)
    caller = DirectCaller()
    gather = partial(gather_batches, machine, batch_ids=(), say=say)
    gathered: Gathered = caller.map("ingest", gather, [recordings], retries=RETRIES)[0]
    batches, new = joined(before, gathered.batches, load_batches(home_lake(), machine), out, say)
    continued = Continued(findings, new, made(out / PLAN, machine, [b for b in batches if b.batch_id in new]))
    seed = before.seed if seed is None else seed
    again = DiagnosisRequest(file, out, recordings, (), seed, report, overwrite=True)
    together = Gathered(tuple(batches), gathered.ingested)
    return finished(again, machine, text, together, settings, say, done, caller, continued)


def joined(
    before: Inputs, new: Sequence[Batch], held: Sequence[Batch], out: Path, say: Say = lambda text: None
) -> tuple[list[Batch], tuple[str, ...]]:
    """Of the lake's batches those of the earlier diagnosis and the new ones, and the new ones' ids.

    Raises:
        InputError: a new one is among the earlier ones, or one of these is in the lake no more.
    """
    known = {r.batch_id: r for r in before.recordings}
    again = [b.batch_id for b in new if b.batch_id in known]
    if again:
        which = f"{again[0]} is" if len(again) == 1 else f"{', '.join(again[:3])}{', …' * (len(again) > 3)} are"
        raise InputError(f"--recordings: {which} among the recordings of {out} already; give new ones alone")
    at = {b.batch_id: b for b in held}
    gone = [r for r in before.recordings if r.batch_id not in at]
    if gone:
        raise InputError(_gone(gone, before.machine, out))
    for r in before.recordings:
        if r.digest and at[r.batch_id].digest != r.digest:
            say(f"{r.batch_id}: has another content in the lake than at the earlier diagnosis; the present one is used")
    ids = {b.batch_id for b in new}
    return [b for b in held if b.batch_id in ids or b.batch_id in known], tuple(b.batch_id for b in new)


def made(plan_file: Path, machine: Machine, new: Sequence[Batch]) -> tuple[str, ...]:
    """Those of the new recordings that follow the proposed run; none where no plan was written, or it reads no more."""
    if not plan_file.exists():
        return ()
    try:
        plan = load_run_plan(plan_file, machine)
    except InputError:  # someone has changed it; the recordings count all the same
        return ()
    return tuple(b.batch_id for b in new if follows(b, plan))


def follows(batch: Batch, plan: RunPlan) -> bool:
    """Whether the recorded drivers are the plan's, for nine tenths of its time, from some row of the batch on."""
    n = int((1 - SAME_ROWS) * plan.time_s[-1] / max(batch.step_s, 1.0))
    length = batch.n_rows - int(np.ceil(plan.time_s[-1] / max(batch.step_s, 1.0))) + n
    wanted = {k: v for k, v in plan.drivers.items() if k in batch.table.columns}
    return any(_agree(batch, plan, wanted, begin) for begin in range(max(length, 0)))


def _agree(batch: Batch, plan: RunPlan, wanted: Mapping[str, Array], begin: int) -> bool:
    time_s = batch.time_s[begin:] - batch.time_s[begin] + batch.step_s / 2  # amid a row: borders are anybody's
    time_s = time_s[time_s < plan.time_s[-1]]
    if len(time_s) < SAME_ROWS * plan.time_s[-1] / batch.step_s:
        return False
    step = np.clip(np.searchsorted(plan.time_s, time_s, side="right") - 1, 0, len(plan.time_s) - 2)
    same = np.ones(len(time_s), bool)
    for name, values in wanted.items():
        recorded = batch.values(name)[begin : begin + len(time_s)]
        near = SAME_SHARE * max(float(np.ptp(values)), float(np.max(np.abs(values))), 1e-9)
        either = np.minimum(np.abs(recorded - values[step]), np.abs(_next(batch, name, begin, step) - values[step]))
        same &= either <= near
    return bool(np.mean(same) >= SAME_ROWS)


def _next(batch: Batch, name: str, begin: int, step: Array) -> Array:
    """The reading one row later: a row may show the stretch that ends there or the one that begins."""
    values = batch.values(name)
    at = np.clip(np.arange(begin + 1, begin + 1 + len(step)), 0, len(values) - 1)
    return np.asarray(values[at])


def _gone(gone: Sequence[Recorded], machine: str, out: Path) -> str:
    first = gone[0]
    source = f" (it came from {first.source})" if first.source else ""
    more = f" and {len(gone) - 1} more of its recordings are" if len(gone) > 1 else " is"
    return (
        f"--continue {out}: {first.batch_id}{source}{more} not in the lake, where {machine} was diagnosed from; "
        f"bring it back by `thermodrift ingest` or `thermodrift lake restore {machine}`, or diagnose anew"
    )


def _machine(out: Path, machine_file: Path | None, before: Inputs) -> tuple[Machine, Path, str]:
    """The machine, its file's name and its text: as it was diagnosed, or from a file of the same machine.

    Raises:
        InputError: the file is of another machine.
    """
    if machine_file is None:
        text = before.machine_text
        return parse_machine(text, f"machine file of {out}"), Path(before.machine_file), text
    machine = load_machine(machine_file)
    if machine.machine != before.machine:
        raise InputError(
            f"--continue {out}: is a diagnosis of {before.machine}, and {machine_file} is a file of "
            f"{machine.machine}; leave --machine out, or give the folder of its own diagnosis"
        )
    return machine, machine_file, machine_file.read_text(encoding="utf-8")
