"""The functions of the public API; each calls the function that the command of the same name calls.

A machine is its machine file or what `load_machine` made of it. Progress is logged to the logger ``thermodrift`` at
level INFO. Everything that is kept between calls goes below the home: ``var/`` in the working directory, or the folder
that THERMODRIFT_HOME names.

Functions with `processes` start worker processes where it is more than 1. These import the main module again, so a
script needs the usual ``if __name__ == "__main__":`` then. Results do not depend on their number.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from data.batch import Batch
from data.errors import InputError, closest
from data.machine import Machine, load_machine

if TYPE_CHECKING:
    import pandas as pd

    from compensation.rehearsal import Rehearsal
    from data.ingest import IngestReport
    from data.lake import Lake
    from diagnosis.result import Diagnosis
    from models.base import Family
    from models.selection.crossing import Plan
    from models.selection.result import GridResult
    from pipelines.commands.simulate import Simulated
    from pipelines.jobs.training import TrainOutcome
    from pipelines.store.model_store import StoredModel
    from twin.calibration import Calibration, CalibrationOptions

AnyMachine = Machine | Path | str
Paths = Path | str | Sequence[Path | str]
_log = logging.getLogger("thermodrift").info


def sample_year(folder: Path | str, seed: int = 0) -> tuple[Path, list[Path]]:
    """Write the built-in sample year: SIMULATED recordings of 30 runs, and the machine file.

    Returns:
        The machine file and the recordings, all in `folder`.
    """
    from pipelines.commands.simulate import write_sample

    return write_sample(Path(folder), seed)


def read(recordings: Paths, machine: AnyMachine, *, need_error: bool = True) -> list[Batch]:
    """Read recordings into batches, with the findings of all checks; nothing is stored.

    Args:
        recordings: files, or folders whose files match `recording.files` of the machine file.
        need_error: refuse a file without an error channel.

    Raises:
        InputError: no recording there, or one that cannot be used.
    """
    from pipelines.jobs.recordings import checked_files

    return checked_files(_machine(machine), _paths(recordings), need_error)


def ingest(recordings: Paths, machine: AnyMachine, lake: Lake | None = None) -> IngestReport:
    """Read, check and store recordings in the lake; what cannot be used goes to quarantine with the reason.

    Args:
        lake: default: the lake in the home.

    Raises:
        InputError: a path does not exist, or a channel's unit cannot be kept; nothing has been read then.
        WorkError: the lake cannot be written; what was stored before stays.
    """
    from data.ingest import ingest
    from pipelines.jobs.recordings import home_lake

    return ingest(_paths(recordings), _machine(machine), lake or home_lake(), progress=_log)


def train(
    machine_file: Path | str,
    recordings: Paths = (),
    *,
    channels: Sequence[str] = (),
    plan: Plan | None = None,
    promote: bool = True,
    processes: int = 1,
) -> TrainOutcome:
    """Ingest, cross selectors with families, track in MLflow, promote the best cell and write the report.

    Args:
        recordings: files and folders to ingest first; default: what the lake holds.
        channels: error channels to learn; default: all.
        plan: selectors, families, protocols and effort; default: ``Plan()``.
        promote: register the best cell, as champion, provisional or challenger.

    Returns:
        The results by channel, ids of trainings, promotions, and the path of the report.

    Raises:
        InputError: a file, channel or plan that cannot be used, or too few batches.
        WorkError: lake or tracking store do not answer.
    """
    from models.selection.crossing import Plan
    from pipelines import settings
    from pipelines.caller import DirectCaller
    from pipelines.jobs import training
    from pipelines.jobs.request import TrainRequest

    settings.configure_environment()
    request = TrainRequest(
        Path(machine_file), tuple(_paths(recordings)), tuple(channels), plan or Plan(), promote=promote,
        workers=processes,
    )  # fmt: skip
    return training.train(request, settings.load(), DirectCaller(), _log)


def cross(
    batches: Sequence[Batch],
    machine: AnyMachine,
    *,
    channels: Sequence[str] = (),
    plan: Plan | None = None,
    processes: int = 1,
) -> dict[str, GridResult]:
    """Every selector with every model family, judged on runs left out; nothing is stored or tracked.

    Args:
        batches: what `read` gives.
        channels: error channels to learn; default: all.
        plan: selectors, families, protocols and effort; default: ``Plan()``.

    Returns:
        By channel the tables of the crossing; `leaderboard` ranks its cells, its `predictions` are the curves left out.

    Raises:
        InputError: an unknown channel, selector or family, or too few batches.
    """
    from models.selection.crossing import Plan
    from models.selection.grid import run_grid
    from pipelines.jobs.request import error_channels

    known = _machine(machine)
    done = run_grid(
        batches, error_channels(channels, known), plan or Plan(), known, workers=processes, progress=_progress
    )
    return {channel: result for channel, (_, result) in done.items()}


def leaderboard(result: GridResult, protocol: str = "") -> pd.DataFrame:
    """The best cell of every family, the smallest score S_mean + S_std first.

    Args:
        result: one channel of `cross` or of ``train(…).results``.
        protocol: how the cells are judged; default: by the expected loss in a future run
            (`models.selection.promotion`).

    Returns:
        family, selector, n_tsp, score_um, S_mean_um, S_std_um, max_abs_um (µm), inputs ("|"-joined), and the leading
        protocol.

    Raises:
        InputError: a protocol that is unknown or was not run.
    """
    from models.protocols import PROTOCOLS, PromotionRule
    from models.selection.promotion import ranked

    if protocol and protocol not in PROTOCOLS:
        raise InputError(f"unknown protocol {protocol!r}: {closest(protocol, PROTOCOLS)}")
    rule = PromotionRule()
    table = ranked(result, rule.only(protocol) if protocol else rule)
    return table[
        ["family", "selector", "n_tsp", "score_um", "S_mean_um", "S_std_um", "max_abs_um", "inputs", "protocol"]
    ]


def save_model(model: Family, batches: Sequence[Batch], machine_file: Path | str, folder: Path | str) -> StoredModel:
    """Store a fitted family as a model folder, which `load_model`, `predict`, `rehearse` and `export` take.

    Args:
        model: fitted, for example ``td.FAMILIES["ridge"]().fit(batches, inputs, "z")``.
        batches: those it was fitted on; they give the region, beyond which a prediction is flagged.
        folder: new or empty.

    Raises:
        InputError: a machine file that cannot be used, or a folder that holds something.
    """
    from pipelines.store import fitted_model

    into = Path(folder)
    if into.exists() and (not into.is_dir() or any(into.iterdir())):
        raise InputError(f"folder {into}: is not empty; give a new one")
    load_machine(machine_file)
    return fitted_model.write(into, model, Path(machine_file).read_text(encoding="utf-8"), batches)


def load_model(uri: Path | str) -> StoredModel:
    """The model behind ``models:/NAME@champion``, ``models:/NAME/3``, ``runs:/RUN/model`` or a local folder.

    ``models:/NAME`` is its champion, without one its provisional version, see `StoredModel.standing`.

    Raises:
        InputError: unknown name, alias, version, run or folder, with the closest.
        WorkError: the tracking store does not answer.
    """
    from pipelines import settings
    from pipelines.commands.predict import load_model

    settings.configure_environment()
    return load_model(str(uri), settings.load())


def predict(model: StoredModel | Path | str, recording: Batch | Path | str) -> pd.DataFrame:
    """Predicted error of a batch, or of every batch in a raw recording.

    Args:
        model: a loaded model, or what `load_model` takes.

    Returns:
        batch_id, time_s (s), predicted_um (µm, relative to the batch's start), outside_region, outside_of, distance,
        authority, expected_S_um, bound90_S_um, flagged, simulated, standing; for an error along an axis position_mm as
        well.

    Raises:
        InputError: a model or file that cannot be used, or a missing input.
    """
    from pipelines.commands.predict import predict_batches
    from pipelines.jobs.recordings import checked_files

    known = load_model(model) if isinstance(model, Path | str) else model
    path = [] if isinstance(recording, Batch) else [Path(recording)]
    batches = [recording] if isinstance(recording, Batch) else checked_files(known.machine, path, False)
    table = predict_batches(known, batches)
    if table is None:
        raise InputError(f"recording {recording}: no batch in it that machine {known.machine.machine} can read")
    return table


def rehearse(
    models: Paths,
    recordings: Paths,
    *,
    sample_s: float = 10.0,
    failures: Sequence[str] = (),
    readings: str | None = None,
    readings_h: float | None = None,
    max_um: float | None = None,
    rate_um_per_s: float = 0.1,
    out: Path | str | None = None,
) -> Rehearsal:
    """Play recordings to a compensation as if they happened now: the error without and with it.

    Args:
        models: what `load_model` takes, one for each axis of one machine.
        recordings: files or folders that the models have not seen.
        sample_s: time between two samples.
        failures: of sensors, as "front:lost@3h+45min": how is lost, frozen or stepping, from when on and how long.
        readings: of a probe, "1h" after the start of each recording or "every 1h"; None: none.
        readings_h: hours between two readings, instead.
        max_um, rate_um_per_s: limits of what is sent; None: a quarter more than the training's largest error.
        out: page of the rehearsal; None: none.

    Raises:
        InputError: models, recordings or failures that cannot be used.
    """
    from pipelines.jobs.compensating import Given, labelled, rehearse_models
    from pipelines.jobs.recordings import played_files

    names = _uris(models)
    known = [load_model(name) for name in names]
    batches = played_files(known[0].machine, _paths(recordings))
    given = Given(max_um, rate_um_per_s, sample_s)
    done = rehearse_models(known, batches, given, failures=failures, readings=readings, readings_h=readings_h)
    if out is not None:
        from data.account import Account
        from reports.rehearsal import write_rehearsal

        write_rehearsal(Path(out), done, labelled([str(n) for n in names], known), Account.of(batches).summary)
    return done


def export(models: Paths, to: str, out: Path | str | None = None, *, provisional: bool = True) -> list[Path]:
    """Write models for a control or another program: receiver, c, st, onnx, json or sinumerik.

    Args:
        models: what `load_model` takes, one for each axis of one machine.
        out: folder of the files; None: below the home.
        provisional: accept models that are better than none, but not shown beyond doubt; the files say so.

    Raises:
        InputError: an unknown form, a family that it cannot express, with those that can, or a model that may not act.
    """
    from pipelines.commands.predict import model_folder
    from pipelines.jobs.compensating import write_export
    from pipelines.settings import configure_environment, load

    configure_environment()
    folders = {str(m): model_folder(str(m), load()) for m in _uris(models)}
    return write_export(folders, to, None if out is None else Path(out), provisional=provisional)[1]


def registry(
    model: str | None = None,
    *,
    at: str | date | datetime | None = None,
    machine: str | None = None,
    lineage: bool = False,
) -> pd.DataFrame:
    """Champions of the registered models, now or at an earlier time; a model's history; or a version's lineage.

    Args:
        model: NAME: its history; with `lineage` NAME/VERSION, or NAME for the champion (at that time). Default: all.
        at: which version was champion then. A date, also as a string, is that whole day; a time without a zone is
            local.
        machine: name of a machine: its models only.
        lineage: the batches that a version was trained on.

    Returns:
        Times in UTC. Without arguments a row per model: model, machine, target, champion, since, action, who, why,
        versions, note. With `at` a row per champion: model, machine, target, version, since, until, action, who, why,
        training_id, code_version, note; version is missing where there was none. With a model a row per entry of its
        log: when, who, host, action, model, from_version, to_version, why, forced, training_id, code_version, until,
        carried_out, note. With `lineage` a row per batch: batch_id, start, digest, version, source, n_rows, masked;
        ``attrs`` holds the version's model, training and code versions.

    Raises:
        InputError: an unknown model, version or machine, or a time without any champion, before the first promotion or
            in the future.
        WorkError: the tracking store does not answer.
    """
    from pipelines import settings
    from pipelines.commands.registry import Lineage, look_up

    settings.configure_environment()
    found = look_up(model, at, machine, lineage, settings.load())
    if isinstance(found, Lineage):
        table = found.batches
        table.attrs.update(found.version)
        return table
    return found


def simulate(
    machine: AnyMachine,
    plan: Path | str,
    *,
    step_s: float | None = None,
    noise: bool = False,
    seed: int = 0,
    begins: str = "",
) -> Simulated:
    """Simulate a run plan by the machine's twin; nothing is written.

    Args:
        plan: stages (.yml) or a table over time.
        step_s: from row to row (s); default: the plan's step.
        noise: add noise and resolution of sensors and probes, drawn with `seed`.
        begins: local date and time of the first row; sunlight needs it.

    Returns:
        The simulation, and `batch`: the plan as it would have been recorded.

    Raises:
        InputError: no twin part, a plan or option that cannot be used, heat that is stiff beyond the step control.
    """
    from pipelines.commands.simulate import SimulationRequest, beginning, jobs_of, simulate_job

    known = _machine(machine)
    file = Path(known.machine) if isinstance(machine, Machine) else Path(machine)
    request = SimulationRequest(file, (Path(plan),), Path(), step_s, noise, seed, beginning(begins))
    network, (job,) = jobs_of(request, known)
    return simulate_job(job, network, known, request)


def calibrate(
    machine: AnyMachine,
    batches: Sequence[Batch],
    options: CalibrationOptions | None = None,
    *,
    out: Path | str | None = None,
    overwrite: bool = False,
) -> Calibration:
    """Fit the machine file's free parameters to batches: values with 90 % intervals.

    Args:
        options: of the fit; default: ``CalibrationOptions()``.
        out: write the calibrated machine file there; `machine` is a file then.

    Raises:
        InputError: no twin part, a batch that cannot be used, fewer rows than free parameters, or `out` that exists.
        WorkError: the fit did not converge, or the file cannot be written.
    """
    from pipelines.commands.calibrate import check_calibrated, write_calibrated
    from twin.calibration import CalibrationOptions, calibrate

    chosen = options or CalibrationOptions()
    if out is None:
        return calibrate(_machine(machine), batches, chosen, _progress)
    file, to = _machine_file(machine), Path(out)
    known, text = check_calibrated(file, to, overwrite)
    found = calibrate(known, batches, chosen, _progress)
    write_calibrated(found, text, file, to, overwrite)
    return found


def diagnose(
    machine: AnyMachine,
    batches: Sequence[Batch],
    *,
    out: Path | str | None = None,
    seed: int = 0,
    processes: int = 1,
    overwrite: bool = False,
) -> Diagnosis:
    """Name the physics that the machine's twin lacks: what, where, when, how sure, and how much better it fits.

    A machine file without a twin part is diagnosed against the simplest network that the batches support.

    Args:
        out: a folder for report.html, findings.json, machine.yml and next_run.yml; `machine` is a file then.
        seed: of all random draws.
        overwrite: replace an earlier diagnosis of this machine in `out`.

    Returns:
        The diagnosis; `findings` holds the verdict and the findings.

    Raises:
        InputError: a machine file, batch or folder that cannot be used.
        WorkError: the model fails at the priors' means, or `out` cannot be written.
    """
    from diagnosis.diagnose import diagnose
    from pipelines.jobs.diagnosing import DiagnosisRequest, check_diagnosis, write_diagnosis

    if out is None:
        return diagnose(_machine(machine), batches, seed=seed, processes=processes, progress=_progress)
    folder = Path(out)
    request = DiagnosisRequest(_machine_file(machine), folder, seed=seed, overwrite=overwrite)
    known, text = check_diagnosis(request)
    found = diagnose(known, batches, seed=seed, processes=processes, progress=_progress)
    _, trouble = write_diagnosis(found, folder, text)
    if trouble:
        logging.getLogger("thermodrift").warning("%s; the findings stand in %s", trouble, folder)
    return found


def _machine(machine: AnyMachine) -> Machine:
    return machine if isinstance(machine, Machine) else load_machine(machine)


def _machine_file(machine: AnyMachine) -> Path:
    if isinstance(machine, Machine):
        raise InputError(f"machine {machine.machine}: with `out` give the path of the machine file, whose text is kept")
    return Path(machine)


def _paths(recordings: Paths) -> list[Path]:
    return [Path(p) for p in ([recordings] if isinstance(recordings, Path | str) else recordings)]


def _uris(models: Paths) -> list[Path | str]:
    return [models] if isinstance(models, Path | str) else list(models)


def _progress(step: str, n: int, of: int) -> None:
    _log(f"{step} {n}/{of}" if of else step)
