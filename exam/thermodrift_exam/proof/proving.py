"""`thermodrift prove`: seal a suite of concealed cases, answer them in isolation, open and score them."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

import pandas as pd

from data.errors import InputError, WorkError
from thermodrift_exam.proof.report.tables import ProofRun
from thermodrift_exam.proof.sealing.folder import ProofFolder, files_digest, state_of
from thermodrift_exam.proof.sealing.opening import unseal
from thermodrift_exam.proof.sealing.running import LIMIT_S, Examinee, RunOutcome, run
from thermodrift_exam.proof.sealing.seal import Done, Suite, seal
from thermodrift_exam.proof.spec import CENTRES, PLANT_KINDS, REAL, CaseSpec, PlantKind

Which = Literal["development", "sealed"]
SUITES: tuple[Which, ...] = get_args(Which)
SECRET_BYTES = 32
SEED_BITS = 63  # of a development suite without a given seed


@dataclass(frozen=True)
class ProofRequest:
    """The requested proof: `cases` of simulated plants, and every case that the real recordings in `data` provide.

    `seed` None: a secret for a sealed suite, a drawn number that is reported for a development one.
    """

    out: Path
    cases: int = 60
    suite: Which = "sealed"
    plants: tuple[PlantKind, ...] = CENTRES
    seed: int | None = None
    data: Path | None = None


def drawn(request: ProofRequest) -> Suite:
    """The specs of a request and what they were drawn from.

    Raises:
        InputError: a seed for a sealed suite; real recordings requested and none there.
    """
    if request.suite == "sealed" and request.seed is not None:
        raise InputError(
            f"--seed: got {request.seed}; a sealed suite is drawn from a secret, leave it out or give "
            "--suite development"
        )
    number = secrets.randbits(SEED_BITS) if request.seed is None else request.seed
    secret = request.suite == "sealed"
    seed = secrets.token_bytes(SECRET_BYTES) if secret else number
    specs = specs_of(request, seed)
    return Suite(request.suite, specs, seed.hex() if isinstance(seed, bytes) else str(seed), secret)


def specs_of(request: ProofRequest, seed: bytes | int) -> list[CaseSpec]:
    """Cases of simulated plants first, then every case of the real recordings.

    Raises:
        InputError: real recordings requested and none there.
    """
    from thermodrift_exam.proof.suite import real_suite, suite

    plants = [p for p in request.plants if p not in REAL]
    real = [p for p in request.plants if p in REAL]
    specs = suite(seed, request.cases, request.suite, plants) if plants else []
    if not real:
        return specs
    if request.data is None:
        raise InputError(f"--plants {real[0]}: is made of real recordings; give their folder by --data")
    more = real_suite(seed, request.data, request.suite, real, first=len(specs) + 1)
    if not more:
        raise InputError(f"--data {request.data}: holds no recordings of {' or '.join(real)}; give another folder")
    return [*specs, *more]


def make_case(spec: CaseSpec, folder: Path, data: Path | None = None) -> dict[str, Any]:
    """Build a case in a folder; returns its key."""
    from thermodrift_exam.proof.suite import build, write_built

    built = build(spec, data)
    write_built(built, folder)
    return built.answer


Say = Callable[[str], None]
# Tables that are written next to the page as CSV.
WRITTEN = ("outcomes", "terms", "missed", "claims", "goals", "compared", "leak", "convergence")


@dataclass(frozen=True)
class ProofOutcome:
    """An opened proof: the run as its page shows it, and the written files."""

    run: ProofRun
    files: dict[str, Path] = field(default_factory=dict)


def seal_proof(request: ProofRequest, workers: int, done: Done | None = None) -> str:
    """Draw, build and seal the suite; returns the root.

    Raises:
        InputError: a seed for a sealed suite, or a folder that holds something; WorkError: it cannot be written.
    """
    return seal(ProofFolder(request.out), drawn(request), partial(make_case, data=request.data), workers, done)


RIVALS = Path(__file__).resolve().parents[2] / "thermodrift_rivals"  # next to this package, which stays unseen


def examinee(limit_s: float = LIMIT_S, ablated: int | None = None) -> Examinee:
    """The diagnosis, and the baselines on its fits; ablations for the first `ablated` cases, None: for all."""
    both, one = "thermodrift_rivals:replies", "thermodrift_rivals:baselines"
    return Examinee(baselines=both, cheap=one, compared=ablated, limit_s=limit_s, import_from=(str(RIVALS),))


def run_proof(
    out: Path, workers: int, restart: bool = False, by: Examinee | None = None, done: Done | None = None,
    until: datetime | None = None,
) -> RunOutcome:  # fmt: skip
    """Answer every case that has no answer yet.

    Raises:
        InputError, WorkError: as `thermodrift_exam.proof.sealing.running.run`.
    """
    return run(ProofFolder(out), by or examinee(), workers, restart, done, until)


def open_proof(
    out: Path, workers: int, partial: bool = False, deals: int = 100, say: Say = lambda text: None,
    done: Done | None = None,
) -> ProofOutcome:  # fmt: skip
    """Check everything, reveal the key, score, and write tables and page.

    Args:
        deals: number of permutations in the leak test; 0 omits the test.

    Raises:
        InputError: not sealed, not run, incomplete, or not as it was recorded; WorkError: it cannot be written.
    """
    from thermodrift_exam.proof.judging import judge_all, scoring_source
    from thermodrift_exam.proof.report.page import write_proof_report
    from thermodrift_exam.proof.sealing.leak import COLUMNS, leak_table
    from thermodrift_exam.proof.suite.suite import possible
    from thermodrift_exam.proof.tables import convergence_of, proof_run, tables_of

    folder = ProofFolder(out)
    folder.committed()
    with folder.locked():
        say("open")
        opened = unseal(folder, partial)
        say("leak test")
        leak = leak_table(folder.cases, opened.answers, possible, deals, done=done) if deals else None
        judged = judge_all(folder, opened, workers, done)
        for name, j in judged.items():
            if j.trouble:
                say(f"{name}: no true model: {j.trouble}")
        say("score")
        tables = tables_of(folder, opened, judged, pd.DataFrame(columns=list(COLUMNS)) if leak is None else leak)
        if opened.commitment["suite"] == "sealed":
            say("convergence of the plants")
            tables["convergence"] = convergence_of(sorted(set(tables["outcomes"]["plant"])))
        run = proof_run(opened, judged, tables)
        files = {f"{name}.csv": out / f"{name}.csv" for name in WRITTEN if name in tables}
        try:
            for name, path in files.items():
                tables[name.removesuffix(".csv")].to_csv(path, index=False, lineterminator="\n")
        except OSError as error:
            raise WorkError(f"{out}: cannot be written ({error.strerror}); free the folder and open again") from None
        files["report.html"] = write_proof_report(out, run)
        folder.ledger().add(
            "scored", cases=len(judged), source=scoring_source(), outcomes=files_digest(out, [files["outcomes.csv"]])
        )
    return ProofOutcome(run, files)


def prove(
    request: ProofRequest, workers: int, by: Examinee | None = None, deals: int = 100,
    say: Say = lambda text: None, done: Done | None = None,
) -> ProofOutcome:  # fmt: skip
    """Seal, run and open; steps that the ledger of the folder records as done are not repeated.

    Raises:
        InputError: the folder holds a proof of another number of cases or suite; the rest as of the three steps.
    """
    folder = ProofFolder(request.out)
    if folder.is_sealed:
        held = folder.committed()
        requested = len(specs_of(replace(request, suite="development"), 0))
        if (held["number"], held["suite"]) != (requested, request.suite):
            raise InputError(
                f"--out {request.out}: holds a {held['suite']} proof of {held['number']} cases, requested is a "
                f"{request.suite} one of {requested}; give another --out"
            )
    else:
        say("seal")
        say(f"root {seal_proof(request, workers, done)}")
    if state_of(folder.ledger().entries, str(folder.path)).opened is None:
        say("run")
        run_proof(request.out, workers, by=by, done=done)
    return open_proof(request.out, workers, deals=deals, say=say, done=done)


def check_plants(plants: Sequence[str]) -> tuple[PlantKind, ...]:
    """The requested plants.

    Raises:
        InputError: an unknown one, with the closest.
    """
    from data.errors import one_of

    return tuple(one_of(p, PLANT_KINDS, "--plants") for p in plants)
