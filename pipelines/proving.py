"""`thermodrift prove`: seal a suite of concealed cases, have them answered apart, open and score them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import pandas as pd

from data.errors import InputError, WorkError
from pipelines.proof_suite import ProofRequest, drawn, make_case, specs_of
from pipelines.report.proof_run import ProofRun
from twin.proof.sealing.digests import files_digest
from twin.proof.sealing.examining import Examinee
from twin.proof.sealing.folder import ProofFolder
from twin.proof.sealing.opening import unseal
from twin.proof.sealing.running import RunOutcome, run
from twin.proof.sealing.seal import Done, seal
from twin.proof.sealing.state import state_of
from twin.proof.spec import PLANT_KINDS, PlantKind

Say = Callable[[str], None]
# Tables that stand beside the page as CSV.
WRITTEN = ("outcomes", "terms", "missed", "claims", "goals", "compared", "leak", "convergence")


@dataclass(frozen=True)
class ProofOutcome:
    """An opened proof: the run as its page shows it, and the files that were written."""

    run: ProofRun
    files: dict[str, Path] = field(default_factory=dict)


def seal_proof(request: ProofRequest, workers: int, done: Done | None = None) -> str:
    """Draw, build and seal the suite; returns the root.

    Raises:
        InputError: a seed for a sealed suite, or a folder that holds something; WorkError: it cannot be written.
    """
    return seal(ProofFolder(request.out), drawn(request), partial(make_case, data=request.data), workers, done)


def run_proof(
    out: Path, workers: int, restart: bool = False, by: Examinee | None = None, done: Done | None = None
) -> RunOutcome:
    """Have every case answered that has no answer yet.

    Raises:
        InputError, WorkError: as `twin.proof.sealing.running.run`.
    """
    return run(ProofFolder(out), by or Examinee(), workers, restart, done)


def open_proof(
    out: Path, workers: int, partial: bool = False, deals: int = 100, say: Say = lambda text: None,
    done: Done | None = None,
) -> ProofOutcome:  # fmt: skip
    """Check everything, reveal the key, score, and write tables and page.

    Args:
        deals: how often answers are dealt anew for the leak test; 0 leaves it out.

    Raises:
        InputError: not sealed, not run, incomplete, or not as it was recorded; WorkError: it cannot be written.
    """
    from pipelines.proof_convergence import convergence_of
    from pipelines.proof_judging import judge_all, scoring_source
    from pipelines.proof_tables import proof_run, tables_of
    from pipelines.report.proof import write_proof_report
    from twin.proof.sealing.leak import COLUMNS, leak_table
    from twin.proof.suite.eligible import possible

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
        told = proof_run(opened, judged, tables)
        files = {f"{name}.csv": out / f"{name}.csv" for name in WRITTEN if name in tables}
        try:
            for name, path in files.items():
                tables[name.removesuffix(".csv")].to_csv(path, index=False, lineterminator="\n")
        except OSError as error:
            raise WorkError(f"{out}: cannot be written ({error.strerror}); free the folder and open again") from None
        files["report.html"] = write_proof_report(out, told)
        folder.ledger().add(
            "scored", cases=len(judged), source=scoring_source(), outcomes=files_digest(out, [files["outcomes.csv"]])
        )
    return ProofOutcome(told, files)


def prove(
    request: ProofRequest, workers: int, by: Examinee | None = None, deals: int = 100,
    say: Say = lambda text: None, done: Done | None = None,
) -> ProofOutcome:  # fmt: skip
    """Seal, run and open; what was done already, by the folder's ledger, is not done again.

    Raises:
        InputError: the folder holds a proof of another number of cases or suite; the rest as of the three steps.
    """
    folder = ProofFolder(request.out)
    if folder.is_sealed:
        held = folder.committed()
        asked = len(specs_of(replace(request, suite="development"), 0))
        if (held["number"], held["suite"]) != (asked, request.suite):
            raise InputError(
                f"--out {request.out}: holds a {held['suite']} proof of {held['number']} cases, asked for is a "
                f"{request.suite} one of {asked}; give another --out"
            )
    else:
        say("seal")
        say(f"root {seal_proof(request, workers, done)}")
    if state_of(folder.ledger().entries, str(folder.path)).opened is None:
        say("run")
        run_proof(request.out, workers, by=by, done=done)
    return open_proof(request.out, workers, deals=deals, say=say, done=done)


def check_plants(plants: Sequence[str]) -> tuple[PlantKind, ...]:
    """The plants that were asked for.

    Raises:
        InputError: an unknown one, with the closest.
    """
    from pipelines.options import one_of

    return tuple(one_of(p, PLANT_KINDS, "--plants") for p in plants)
