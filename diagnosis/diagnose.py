"""What physics did the simulation leave out? From a machine file and its recordings to a diagnosis."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from data.processes import Processes
from diagnosis.candidates.free_forms import Form
from diagnosis.contracts import COLUMNS, Where
from diagnosis.drafting.draft import drafted_part
from diagnosis.export.machine_file import changed_parts, with_deviations
from diagnosis.findings import report_data as made
from diagnosis.findings.conclude import (
    build_effect,
    residual_remarks,
    rms_of,
    slow_residual_ratio,
    unlisted_effect,
    verdict_of,
)
from diagnosis.findings.report_data import place_label
from diagnosis.findings.schema import (
    DetectionLimit,
    Finding,
    Findings,
    FitSummary,
    LeftOutRms,
    NextExperiment,
    Place,
)
from diagnosis.findings.statement import build_finding, verdict_statement
from diagnosis.fitting.batches import enough_batches, usable_batches
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import (
    baseline,
    check,
    degraded_channels,
    deterministic_fit,
    harms,
    lead_of,
    left_out_rows,
    on_all_rows,
    rows_as_given,
)
from diagnosis.localisation.balance import impossible
from diagnosis.localisation.where_when import locate
from diagnosis.next_experiment.proposal import NOTHING, Proposal, deciding_run, revealing_run
from diagnosis.policy import POLICY
from diagnosis.result import Diagnosis
from diagnosis.screening.screen import limits
from diagnosis.search.claims import Round
from diagnosis.search.refits import Progress
from diagnosis.search.search import Search, less, search, start_worker
from twin.calibration.identifiability import Interval, intervals90
from twin.calibration.least_squares import result
from twin.calibration.recorder import lead_remarks
from twin.compile import compile_network
from twin.schema import TwinPart, twin_part


@threadpool_limits.wrap(limits=1)  # small matrices: more threads cost time, and results must not depend on them
def diagnose(
    machine: Machine,
    batches: Sequence[Batch],
    *,
    seed: int = 0,
    processes: int = 1,
    progress: Progress | None = None,
) -> Diagnosis:
    """Locate, name, model and show what recordings have and the machine file's twin lacks.

    Without a twin part the simplest network that the recordings support is drafted first. `processes` side by side for
    refits; results do not depend on it. `seed` is of the refined twins.

    Raises:
        InputError: batches or a machine file that cannot be used; WorkError: the model fails at the priors' means.
    """
    begun = time.perf_counter()
    check(machine, batches)
    batches = sorted(batches, key=lambda b: b.batch_id)  # what is drawn for each must not depend on their order
    report = progress or (lambda step, n, of: None)
    with Processes(processes, start_worker) as workers:
        workers.warm_up()
        remarks: list[str] = []
        if machine.twin is None:
            draft = drafted_part(machine, batches, progress=lambda what, n, of: report("draft", n, of))
            part = draft.part
            remarks += draft.remarks
        else:
            part = twin_part(machine)
        batches, more = usable_batches(compile_network(machine, part=part), batches)
        remarks += more
        recordings = tuple(b.batch_id for b in batches)
        batches, more = enough_batches(batches)
        remarks += more
        fitted = baseline(machine, part, batches, report, len(recordings), seed)
        done = search(fitted, workers, report)
        if done.accepted and (lead_rows := lead_of(machine, done.final.part, batches)) != fitted.lead_rows:
            # what was missing had passed for drivers that act at another time
            done = search(baseline(machine, part, batches, report, len(recordings), seed, lead_rows), workers, report)
        report("left out", 0, 0)
    located: dict[str, pd.DataFrame] = {}
    try:
        first = locate(done.baseline.problem, done.baseline.x, done.baseline.fitted_nuisance, done.baseline.batches)
    except (InputError, WorkError) as error:
        remarks.append(f"no map of where and when: {error}")
    else:
        located["map"] = first.map
        if (form := _unlisted_form(done)) is not None:
            located["flux"] = first.over_time("heat" if form.heat else "displacement", form.where.name)
    diagnosis = _diagnosis(part, recordings, batches, done, located, tuple(remarks))
    seconds = round(time.perf_counter() - begun, 1)
    return replace(diagnosis, findings=diagnosis.findings.model_copy(update={"seconds": seconds}))


def _unlisted_form(done: Search) -> Form | None:
    """The term of the first effect that no listed mechanism is."""
    named = ((r.forms, r.best.candidate) for r in done.accepted if r.best is not None)
    found: Form | None = next((forms[c.name] for forms, c in named if c.kind.is_unlisted), None)
    return found


def _diagnosis(
    part: TwinPart,
    names: tuple[str, ...],
    batches: Sequence[Batch],
    done: Search,
    located: Mapping[str, pd.DataFrame],
    remarks: tuple[str, ...],
) -> Diagnosis:
    """What was found, from the search for listed effects, the effect of no list, and the tables of its localisation;
    `names` of the recordings, `batches` what was fitted of them, with all rows."""
    machine, final, named = done.baseline.machine, done.final, done.accepted
    before, after = left_out_rows(done.baseline), left_out_rows(final)
    full = on_all_rows(final, batches)
    intervals = {i.name: i for i in _intervals(deterministic_fit(full))}
    rms_table = made.rms_table(before, after, final)
    rms = rms_of(rms_table, final)
    part_after = with_deviations(final)
    drafted, units = machine.twin is None, {r.channel: r.unit for r in rms}
    remarks += tuple(i.words for i in impossible(done.baseline))
    remarks += lead_remarks(machine, final.lead_rows)
    pairs = [(r, left_out_rows(r.before)) for r in named]  # each effect, and what is left with all the others
    harmful = [r for r, left in pairs if r.best is not None and harms(left, after)]
    remarks += tuple(
        f"{r.best.candidate.label}: named, and kept out of the machine file: simulated alone, runs left out are "
        "predicted worse with it"
        for r in harmful if r.best is not None
    )  # fmt: skip
    kept = _without(done, harmful)
    written = full if kept is final else kept and on_all_rows(kept, batches)
    worse = {}
    if written is not None and not drafted:
        worse = degraded_channels(rows_as_given(on_all_rows(done.baseline, batches)), left_out_rows(written))
    if worse:
        remarks += (f"the machine file keeps its values and parts: the fitted ones raise {made.rises(worse, units)}",)
    run, possible = deciding_run(named), []
    separates = run.label if run is not None else ""
    effects = []
    for r, left in pairs:
        own_rms = rms_of(made.rms_table(left, after, final), final)
        one = build_effect(done, r, part_after, intervals, own_rms, separates)
        if one.kind.is_unlisted and r.best is not None:
            one = unlisted_effect(one, r.forms[r.best.candidate.name], final, r.best.candidate, intervals)
        effects.append(one)
    effects.sort(key=lambda f: -f.probability)
    slow = slow_residual_ratio(rms, final)
    listed = [f for f in effects if not f.kind.is_unlisted]
    verdict = verdict_of(listed, len(listed) < len(effects), rms, slow, final.runs)
    if run is None and verdict != "explained":
        run = revealing_run(done)
        possible = [n for n in run.separates if n != NOTHING] if run is not None else []
    remarks += residual_remarks(slow, final.runs)
    last = done.rounds[-1]
    table = limits(last.before, last.screen, last.threshold)
    detection_limits = _detection_limits(table)
    findings = tuple(build_finding(f) for f in effects)
    better = int((_per_batch(rms_table, "after") < _per_batch(rms_table, "before")).sum()) if effects else 0
    statement = verdict_statement(
        verdict,
        effects,
        rms,
        detection_limits,
        separates=run.label if run is not None else "",
        possible=possible,
        places=[place_label(Where(n.where.kind, n.where.name), part_after) for n in detection_limits],
    )
    everything = {name: pd.DataFrame(columns=list(columns)) for name, columns in COLUMNS.items()} | {
        "rms": rms_table,
        "series": made.series_table(before, after, final),
        "acf": made.acf_table(before, after, final),
        "candidates": made.candidates_table(done.rounds),
        "steps": made.steps_table(done.rounds),
        "limits": table,
        **located,
    }
    simulated = any(b.simulated for b in final.batches)
    new_file = {} if worse or written is None else _new_file(part, written, findings, len(names))
    return Diagnosis(
        machine=machine,
        findings=Findings(
            machine=machine.machine,
            batches=names,
            verdict=verdict,
            findings=findings,
            fit=FitSummary(
                left_out_rms=LeftOutRms(
                    before={r.key: r.before for r in rms},
                    after={r.key: r.after for r in rms},
                    noise_floor={r.key: r.noise for r in rms},
                ),
                batches_improved=better,
                batches=len(final.batches),
            ),
            detection_limits=detection_limits,
            next_experiment=_next(run),
            seconds=None,  # set once all is done
            statement=statement,
            simulated=simulated,
            drafted=drafted,
            remarks=remarks,
        ),
        part_before=done.baseline.part,
        part_after=part_after,
        simulated=simulated,
        drafted=drafted,
        remarks=remarks,
        tables=everything,
        network=final.problem.network,
        plan_text=(run.plan_text or None) if run is not None else None,
        search=done,
        **new_file,
    )


def _without(done: Search, harmful: Sequence[Round]) -> Fitted | None:
    """The final fit without these effects; None where no machine is without them."""
    fitted = done.final
    try:
        for r in harmful:
            fitted = less(fitted, r, done.baseline)
    except (InputError, WorkError):
        return None
    return fitted


def _new_file(part: TwinPart, written: Fitted, findings: Sequence[Finding], runs: int) -> dict[str, Any]:
    """The arguments of `diagnosed_text`: values of the deterministic fit, parts, and notes on them."""
    intervals, added = _intervals(deterministic_fit(written)), changed_parts(part, with_deviations(written))
    notes = _notes(findings, runs)
    return {
        "values": {i.name: i.value for i in intervals}, "intervals": intervals, "added": added,
        "notes": {name: note for name, note in notes.items() if name in written.part.mechanisms},
    }  # fmt: skip


def _intervals(fitted: Fitted) -> tuple[Interval, ...]:
    fit = result(fitted.problem, fitted.state, POLICY.fit_tolerance_nats, "")
    return tuple(intervals90(fit, fitted.problem.unknowns))


def _per_batch(table: pd.DataFrame, column: str) -> pd.Series:
    """By batch the mean over channels of log rms, noise taken in."""
    level = pd.Series(np.log(np.hypot(table[column].to_numpy(float), table["floor"].to_numpy(float))))
    return level.groupby(table["batch"].to_numpy()).mean()


def _detection_limits(table: pd.DataFrame) -> tuple[DetectionLimit, ...]:
    """Every candidate's limit; nan where no amplitude within bounds would be claimed."""
    return tuple(
        DetectionLimit(
            mechanism=mechanism, where=Place(kind=kind, name=name), words=words,
            limit=float(limit) if np.isfinite(limit) else None, unit=unit, absorbed=float(absorbed), absorbed_by=by,
        )
        for mechanism, kind, name, words, limit, unit, absorbed, by in table.itertuples(index=False, name=None)
    )  # fmt: skip


def _next(run: Proposal | None) -> NextExperiment | None:
    if run is None or not run.label:
        return None
    return NextExperiment(
        separates=tuple(run.separates), run=run.label, hours=run.hours, file="next_run.yml" if run.plan_text else None
    )


def _notes(findings: Sequence[Finding], runs: int) -> dict[str, str]:
    """Comments of a machine file on what was found."""
    return {
        f.name: f"found by a diagnosis of {runs} runs, probability {f.probability:.2f}; "
        f"{f.evidence.get('gain_nats', 0.0):.0f} nats of left-out score"
        for f in findings
        if f.name
    }
