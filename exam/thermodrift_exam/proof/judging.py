"""What scoring needs of each opened case: the stored answer and the true model."""

from __future__ import annotations

import math
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from data.processes import Processes
from diagnosis.findings.schema import Findings, read_findings
from thermodrift_exam.proof.sealing.examinee import FINDINGS, PLAN, read_case
from thermodrift_exam.proof.sealing.folder import ProofFolder, files_digest, read_json, source_digest, write_json
from thermodrift_exam.proof.sealing.isolation import roots
from thermodrift_exam.proof.sealing.opening import Opened
from thermodrift_exam.proof.sealing.running import RUN, Examinee, examine
from thermodrift_exam.proof.sealing.seal import Done
from thermodrift_exam.proof.spec import KIND_PLANTS

if TYPE_CHECKING:
    from thermodrift_exam.proof.scoring.answer_key import Stored
    from thermodrift_exam.proof.scoring.true_model import TrueModel


def executed(case: Path, plan: str, key: Mapping[str, Any], kept: Path, by: Examinee | None = None) -> Findings | None:
    """Findings with the proposed run among the recordings; None where the run is impossible or the diagnosis fails.

    Earlier answers of the same source are read from the folder `kept`. The answering process is confined as before.
    """
    source = source_digest()
    if not (kept / RUN).exists() or read_json(kept / RUN)["source_digest"] != source:
        with tempfile.TemporaryDirectory(prefix="thermodrift-") as place:
            more = Path(place) / "case"
            shutil.copytree(case, more)
            try:
                _add(more, plan, key)
            except InputError:  # a plan that this plant cannot run separates nothing
                return None
            files = examine(more, by or Examinee(), source)
        shutil.rmtree(kept, ignore_errors=True)
        kept.mkdir()
        for name, content in files.items():
            (kept / name).write_bytes(content)
    return read_findings(kept / FINDINGS) if (kept / FINDINGS).exists() else None


def _add(case: Path, plan: str, key: Mapping[str, Any]) -> None:
    """One more recording in a case's folder, and its machine file with the sensor that the plan requests."""
    from thermodrift_exam.plants.planned import execute
    from thermodrift_exam.plants.plant import csv_text, machine_text
    from thermodrift_exam.proof.suite.other_kinds import executed_kind

    drawn = key["redraw"]
    if drawn["plant"] in KIND_PLANTS:
        done = executed_kind(drawn, plan)
    else:
        done = execute(drawn["seed"], {**drawn["effects"], **drawn["decoys"]}, plan, drawn["plant"], **drawn["options"])
    (case / "machine.yml").write_text(machine_text(done.machine), encoding="utf-8")
    text = csv_text(done.machine.machine, done.table)
    (case / "recordings" / f"{done.batch.batch_id}.csv").write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class Judged:
    """One case: the stored answer, and its true model or the reason why there is none."""

    stored: Stored
    truth: TrueModel | None
    trouble: str = ""


def judge_all(folder: ProofFolder, opened: Opened, workers: int, done: Done | None = None) -> dict[str, Judged]:
    """Every case that counts. True models take seconds each and are stored in PROOF/judged for the next opening.

    Raises:
        WorkError: the folder cannot be written.
    """
    kept = folder.path / "judged"
    kept.mkdir(exist_ok=True)
    source = scoring_source()
    tasks = [
        (folder.cases / n, folder.answers / n, kept / f"{n}.json", kept / n, opened.answers[n], source)
        for n in opened.counting
    ]
    out: dict[str, Judged] = {}
    for name, judged in _judged(tasks, workers):
        out[name] = judged
        if done is not None:
            done("judge", len(out), len(tasks))
    return dict(sorted(out.items()))


def _judged(tasks: Sequence[tuple[Any, ...]], workers: int) -> Iterator[tuple[str, Judged]]:
    """Names and results of `judge`, in the order of completion."""
    with Processes(workers) as pool:
        yield from ((tasks[k][0].name, judged) for k, judged in pool.completed(judge, tasks))


def judge(case: Path, answer: Path, kept: Path, again: Path, key: Mapping[str, Any], source: str) -> Judged:
    """One case; its true model is read from the file `kept` if the same source computed it.

    `again` is the folder with the findings after the proposed run.
    """
    from thermodrift_exam.proof.scoring.answer_key import read_stored

    with threadpool_limits(limits=1), tempfile.TemporaryDirectory(prefix="thermodrift-") as lake:
        machine, batches = read_case(case, Path(lake))
        stored = read_stored(answer, machine, batches)
        if key["kind"] == "confounded" and (answer / PLAN).exists():
            stored = replace(stored, again=executed(case, (answer / PLAN).read_text(encoding="utf-8"), key, again))
        held = read_json(kept) if kept.exists() else {}
        if held.get("source") != source:
            truth, trouble = _true(machine, batches, key)
            held = {"source": source, "truth": plain_json(asdict(truth)) if truth else None, "trouble": trouble}
            write_json(kept, held)
    return Judged(stored, truth_from_json(held["truth"]), held["trouble"])


def _true(machine: Machine, batches: list[Batch], key: Mapping[str, Any]) -> tuple[TrueModel | None, str]:
    from thermodrift_exam.proof.scoring.true_model import true_model

    try:
        return true_model(machine, batches, key), ""
    except (InputError, WorkError) as error:
        return None, str(error)


def plain_json(value: Any) -> Any:
    """As in JSON: NaN becomes null."""
    if isinstance(value, dict):
        return {k: plain_json(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain_json(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def truth_from_json(plain: Mapping[str, Any] | None) -> TrueModel | None:
    from thermodrift_exam.proof.scoring.true_model import TrueModel

    if plain is None:
        return None

    def number(value: float | None) -> float:
        return math.nan if value is None else value

    before, true, floor = (number(plain[k]) for k in ("error_before", "error_true", "error_floor"))
    gains, bars = (tuple(map(number, plain[k])) for k in ("gain_nats", "bar_nats"))
    sizes = tuple((value, low, high) for value, low, high in plain["sizes"])
    return TrueModel(before, true, floor, gains, bars, tuple(plain["visible"]), sizes)


def scoring_source() -> str:
    """Digest of the source that scores an answer."""
    root, _ = roots()
    return files_digest(root, sorted(f for part in ("data", "twin") for f in (root / part).rglob("*.py")))
