"""The command of the proof: seal, run and open, one by one or all at once."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from data.errors import InputError, one_of
from pipelines import screen
from pipelines.options import Json, split

if TYPE_CHECKING:
    from evidence.proof.proving import ProofRequest
    from evidence.proof.sealing.running import Examinee

app = typer.Typer(help="Examine the diagnosis in public, on recordings in which the effect is concealed.")

Cases = Annotated[int, typer.Option(help="how many cases")]
Out = Annotated[Path | None, typer.Option("--out", help="folder of the proof; begun ones go on")]
Plants = Annotated[str, typer.Option(help="plants, comma separated")]
Which = Annotated[str, typer.Option("--suite", help="sealed: from a secret; development: from a known seed")]
Data = Annotated[Path | None, typer.Option("--data", help="folder of real recordings, for grafted and withheld")]
Seed = Annotated[int | None, typer.Option(help="of a development suite; default: drawn and told")]
Workers = Annotated[int | None, typer.Option(help="processes; default: one per core")]
Limit = Annotated[float, typer.Option(help="seconds that a diagnosis may take")]
Deals = Annotated[int, typer.Option(help="how often the leak test deals answers anew; 0: no leak test")]
Proof = Annotated[Path, typer.Argument(metavar="PROOF", help="folder of the proof")]
BOTH = "elements,volumes"


@app.callback(invoke_without_command=True)
def prove(
    context: typer.Context,
    cases: Cases = 60,
    to: Out = None,
    plants: Plants = BOTH,
    suite: Which = "sealed",
    seed: Seed = None,
    data: Data = None,
    workers: Workers = None,
    limit: Limit = 300.0,
    deals: Deals = 100,
    as_json: Json = False,
) -> None:
    """Examine the diagnosis on concealed effects: seal, run and open in one go, or step by step."""
    if context.invoked_subcommand is not None:
        return
    from evidence.proof.proving import prove as prove_all
    from pipelines.prove_screen import outcome_dict, print_outcome

    request = _request(cases, to, plants, suite, seed, data)
    with screen.progress(as_json) as (say, done):
        outcome = prove_all(request, _count(workers), _examinee(limit), _deals(deals), say, done)
    if as_json:
        screen.print_json(outcome_dict(outcome))
    else:
        print_outcome(outcome)


@app.command()
def seal(
    cases: Cases = 60,
    to: Out = None,
    plants: Plants = BOTH,
    suite: Which = "sealed",
    seed: Seed = None,
    data: Data = None,
    workers: Workers = None,
    as_json: Json = False,
) -> None:
    """Draw and build the cases, lock the answers away, and tell the root that commits to all of it."""
    from evidence.proof.proving import seal_proof

    request = _request(cases, to, plants, suite, seed, data)
    with screen.progress(as_json) as (_, done):
        root = seal_proof(request, _count(workers), done)
    if as_json:
        screen.print_json({"root": root, "out": request.out, "suite": suite})
    else:
        screen.line(f"root     {root}")
        screen.line(f"{request.out}: sealed, suite {suite}; publish the root, then call")
        screen.line(f"         thermodrift prove run {request.out}")


@app.command()
def run(
    proof: Proof,
    workers: Workers = None,
    limit: Limit = 300.0,
    restart: Annotated[
        bool, typer.Option("--restart", help="drop the answers of another source; the ledger says so")
    ] = False,
    as_json: Json = False,
) -> None:
    """Have every case answered by a process that sees nothing else; what is answered stays."""
    from evidence.proof.proving import run_proof

    with screen.progress(as_json) as (_, done):
        outcome = run_proof(proof, _count(workers), restart, _examinee(limit), done)
    if as_json:
        from dataclasses import asdict

        screen.print_json(asdict(outcome))
        return
    screen.line(
        f"{proof}: {outcome.cases} cases, {outcome.before} answered before, {outcome.answered} now; "
        f"{outcome.interrupted} had been interrupted, {outcome.void} void"
    )
    screen.line(f"         thermodrift prove open {proof}")


@app.command("open")
def open_(
    proof: Proof,
    partial: Annotated[
        bool, typer.Option("--partial", help="also when cases have no answer; they are void for good")
    ] = False,
    publish: Annotated[
        Path | None, typer.Option(help="Markdown page whose block of results is replaced, such as docs/proof.md")
    ] = None,
    workers: Workers = None,
    deals: Deals = 100,
    as_json: Json = False,
) -> None:
    """Check seal, ledger and answers, reveal the key, score, and write tables and page."""
    from evidence.proof.proving import open_proof
    from pipelines.prove_screen import outcome_dict, print_outcome

    with screen.progress(as_json) as (say, done):
        outcome = open_proof(proof, _count(workers), partial, _deals(deals), say, done)
    if publish is not None:
        from evidence.proof.report.markdown import publish_proof

        publish_proof(publish, outcome.run)
    if as_json:
        screen.print_json(outcome_dict(outcome))
    else:
        print_outcome(outcome)


def _request(cases: int, to: Path | None, plants: str, suite: str, seed: int | None, data: Path | None) -> ProofRequest:
    from evidence.proof.proving import SUITES, ProofRequest, check_plants

    if cases < 1:
        raise InputError(f"--cases: got {cases}, expected 1 or more")
    if to is None:
        raise InputError("prove: got no folder for the proof; give --out PROOF")
    if seed is not None and seed < 0:
        raise InputError(f"--seed: got {seed}, expected 0 or more")
    which = one_of(suite, SUITES, "--suite")
    return ProofRequest(to, cases, which, check_plants(split(plants)), seed, data)


def _examinee(limit_s: float) -> Examinee:
    from evidence.proof.sealing.running import Examinee

    if not limit_s > 0:
        raise InputError(f"--limit: got {limit_s:g}, expected more than 0 seconds")
    return Examinee(limit_s=limit_s)


def _count(workers: int | None) -> int:
    if workers is not None and workers < 1:
        raise InputError(f"--workers: got {workers}, expected 1 or more")
    return workers or os.cpu_count() or 1


def _deals(deals: int) -> int:
    if deals < 0:
        raise InputError(f"--deals: got {deals}, expected 0 or more")
    return deals
