"""The demonstration: conceal an effect, seal it, diagnose it in an isolated process, open the seal, and score.

The case's folder (machine file, recordings) is all that the answering process can read
(`thermodrift_exam.proof.sealing.isolation`). A salted SHA-256 commits to the concealed effect beforehand.
"""

from __future__ import annotations

import json
import secrets
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data.errors import InputError, WorkError
from data.files import check_folder, write_atomic
from data.machine import Machine, load_machine
from diagnosis.findings.schema import Finding, as_json
from diagnosis.result import Diagnosis
from reports.diagnosis import tables
from reports.diagnosis.page import write_diagnosis_report
from thermodrift_exam.plants.concealed import Case, conceal, write_case
from thermodrift_exam.plants.real import SCHEMA
from thermodrift_exam.proof.scoring.answer_key import AnswerKey, bodies_of_sensors
from thermodrift_exam.proof.scoring.matching import matches, means
from thermodrift_exam.proof.sealing.examinee import REPLIES
from thermodrift_exam.proof.sealing.folder import folder_digest, now, salted_digest, source_digest, write_json
from thermodrift_exam.proof.sealing.plain import from_plain
from thermodrift_exam.proof.sealing.running import RUN, Examinee, examine, in_parallel
from thermodrift_exam.proof.sealing.seal import SALT_BYTES, Done
from thermodrift_exam.proof.unsealed import RIGHT, Outcome, Unsealed

REPORT, PLAN, FINDINGS, SEALED, OPENED = "report.html", "next_run.yml", "findings.json", "sealed.json", "opened.json"
CASE = "case"
EXAMINEE = Examinee(baselines="thermodrift_exam.proof.sealing.plain:plain_text", limit_s=900.0)

Say = Callable[[str], None]


@dataclass(frozen=True)
class Seal:
    """The commitment made before the diagnosis begins: SHA-256 over salt ‖ answer, of the case, and when (UTC)."""

    digest: str
    case_digest: str
    at: str


@dataclass(frozen=True)
class Judgement:
    """`outcome` as the page names it, in `thermodrift_exam.proof.unsealed`.

    `finding` is the finding that matches the concealed effect, None without a match; `false` are the false claims.
    """

    outcome: Outcome
    finding: Finding | None
    false: tuple[Finding, ...]

    @property
    def right(self) -> bool:
        """Whether the answer is entirely right: everything concealed is found, and nothing else."""
        return self.outcome in RIGHT


@dataclass(frozen=True)
class Demonstration:
    """A demonstration that was opened; everything in it is simulated. `files` lie in `out`, by name."""

    seed: int
    seal: Seal
    answer: Mapping[str, Any]
    diagnosis: Diagnosis
    judgement: Judgement
    isolation: str
    out: Path
    files: Mapping[str, Path]


def demonstrate(
    seed: int,
    out: Path,
    say: Say = lambda text: None,
    done: Done | None = None,
    effect: str | None = None,
    by: Examinee = EXAMINEE,
) -> Demonstration:
    """Conceal what the seed draws, seal it, diagnose it without the key, open the seal, and write the page.

    An earlier demonstration in `out` is replaced.

    Args:
        say: receives a line when the seal is on disk, when the answer is there, and when the seal is opened.
        done: progress of the diagnosis, (step, n, of).
        effect: a key of `thermodrift_exam.plants.concealed.EFFECTS` or "nothing", instead of what the seed draws.

    Raises:
        InputError: a seed, effect or folder that cannot be used.
        WorkError: the diagnosis failed, or its process did not start; the effect stays sealed.
    """
    case = conceal(seed, effect)
    _emptied(out)
    salt = secrets.token_hex(SALT_BYTES)
    machine = load_machine(write_case(case, out / CASE))
    seal = _sealed(case, salt, out)
    say(f"sealed     sha256 {seal.digest} (simulated recordings, {len(case.recordings)} runs)")
    diagnosis, isolation = answered(out / CASE, machine, by, done)
    f = diagnosis.findings
    say(f"answered   {f.verdict.replace('_', ' ')}: {_named(f.findings) or 'nothing named'} ({isolation})")
    write_atomic(out / FINDINGS, as_json(f))
    judgement = judged(diagnosis, case.answer, machine)
    opened = {"seed": seed, "salt": salt, "answer": case.answer, "digest": seal.digest, "sealed": seal.at,
              "opened": now(), "isolation": isolation, "outcome": judgement.outcome}  # fmt: skip
    write_json(out / OPENED, opened)
    panel = unsealed(case.answer, diagnosis, judgement, seal, seed, isolation)
    say(f"opened     {panel.headline}")
    return Demonstration(seed, seal, case.answer, diagnosis, judgement, isolation, out, _written(out, diagnosis, panel))


def answered(case: Path, machine: Machine, by: Examinee, done: Done | None = None) -> tuple[Diagnosis, str]:
    """The diagnosis of the case in a folder by a process that can read a copy of it and nothing else; with it the
    protection that held.

    Raises:
        WorkError: the process did not start, failed, or did not end in time.
    """
    answers: dict[str, dict[str, bytes]] = {}
    in_parallel([CASE], lambda _, stop: examine(case, by, source_digest(), stop, done), answers.__setitem__, 1)
    run = json.loads(answers[CASE][RUN])
    if error := run["error"] or run["rivals_error"]:
        raise WorkError(f"demonstration: the diagnosis failed: {error}")
    return from_plain(answers[CASE][REPLIES].decode(), machine, "demonstration: answer"), str(run["isolation"])


def judged(diagnosis: Diagnosis, answer: Mapping[str, Any], machine: Machine) -> Judgement:
    """Score by the rules of the proof: right is the mechanism at its place or an adjacent one; all else is false."""
    f, key = diagnosis.findings, key_of(answer)
    found = matches(f, key, bodies_of_sensors(machine))
    false = tuple(found.findings[n] for n in found.false)
    if not key.terms:
        silent = f.verdict == "consistent" and not f.findings
        return Judgement("nothing_right" if silent else "false_alarm", None, false)
    own = found.of_term[0]
    if own is not None:
        return Judgement("found_and_more" if false else "found", found.findings[own], false)
    tied = [x for n, x in enumerate(found.findings) if n not in found.false]
    if tied:
        return Judgement("in_set", tied[0], false)
    same = next((x for x in found.findings if means(x.mechanism, key.terms[0])), None)
    if same is not None:
        return Judgement("other_place", same, tuple(x for x in false if x is not same))
    return Judgement("wrong" if false else "missed", None, false)


def key_of(answer: Mapping[str, Any]) -> AnswerKey:
    """The answer of a demonstration as a key of the proof."""
    of = {"schema": SCHEMA, "case": "demonstration", "kind": "one", "plant": "sample", "suite": "demonstration"}
    return AnswerKey.from_json({**of, **answer})


def unsealed(
    answer: Mapping[str, Any], d: Diagnosis, judgement: Judgement, seal: Seal, seed: int, isolation: str
) -> Unsealed:
    """The panel on top of the page: concealed effect, named effect, seal."""
    first = judgement.finding or next(iter(d.findings.findings), None)
    return Unsealed(
        outcome=judgement.outcome,
        concealed=str(answer["words"]),
        finding=first,
        false=tuple(x for x in judgement.false if x is not first),
        verdict=d.findings.verdict,
        digest=seal.digest,
        sealed_at=seal.at,
        seed=seed,
        isolation=isolation,
    )


def _sealed(case: Case, salt: str, out: Path) -> Seal:
    """Commit to the key. The commitment is on disk when this returns, the key is not."""
    seal = Seal(salted_digest(salt, case.answer), folder_digest(out / CASE), now())
    how = "SHA-256 over salt, then the answer as JSON with sorted keys and no blanks; opened.json has both"
    write_json(out / SEALED, {"digest": seal.digest, "case": seal.case_digest, "sealed": seal.at, "how": how})
    return seal


def _emptied(out: Path) -> None:
    """Make the folder and remove the files of an earlier demonstration.

    Raises:
        InputError: it cannot be written, or holds a case of something else.
    """
    check_folder(out, [out / n for n in (REPORT, PLAN, FINDINGS, SEALED, OPENED)], overwrite=(out / SEALED).exists())
    if (out / CASE).exists() and not (out / SEALED).exists():
        raise InputError(f"{out / CASE}: is there, and is no demonstration's; give another --out")
    shutil.rmtree(out / CASE, ignore_errors=True)
    for name in (REPORT, PLAN, FINDINGS, SEALED, OPENED):
        (out / name).unlink(missing_ok=True)


def _written(out: Path, d: Diagnosis, panel: Unsealed) -> dict[str, Path]:
    """The page and the plan of the next run; all files by name."""
    changed = bool(d.findings.findings)
    write_diagnosis_report(out / REPORT, d, above=panel.panel(tables.error_lines(d.tables["rms"], changed), changed))
    if d.plan_text is not None:
        write_atomic(out / PLAN, d.plan_text)
    names = (REPORT, FINDINGS, PLAN, SEALED, OPENED)
    return {name: out / name for name in names if (out / name).exists()}


def _named(findings: tuple[Finding, ...]) -> str:
    return ", ".join(f"{x.mechanism} at {x.where.name}, {100 * x.probability:.0f} %" for x in findings)
