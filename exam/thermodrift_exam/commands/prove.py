"""`thermodrift prove`: seal, run and open a proof of the diagnosis, step by step or all at once."""

from __future__ import annotations

from dataclasses import asdict
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import InputError, one_of
from pipelines import console
from pipelines.options import Json, split
from reports.labels import NOTHING, count
from thermodrift_exam.commands import Workers, processes
from thermodrift_exam.proof.spec import PLANT_KINDS

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

    from thermodrift_exam.proof.proving import ProofOutcome, ProofRequest
    from thermodrift_exam.proof.sealing.running import Examinee


def proof_dict(outcome: ProofOutcome) -> dict[str, Any]:
    """The outcome of a proof for other programs."""
    r = outcome.run
    cases = r.table("outcomes")
    return {
        "root": r.root, "suite": r.suite, "sealed": r.sealed, "opened": r.opened, "version": r.version,
        "source_digest": r.source_digest, "partial": r.partial, "cases": r.cases, "scored": len(cases),
        "right": int(cases["right"].sum()), "isolation": dict(r.isolation), "void": dict(r.void),
        "failed": dict(r.failed), "goals": console.records(r.table("goals")), "leak": console.records(r.table("leak")),
        "files": {name: str(path) for name, path in outcome.files.items()},
    }  # fmt: skip


def print_proof(outcome: ProofOutcome) -> None:
    """Goals over all plants, the leak test, then files."""
    r = outcome.run
    cases = r.table("outcomes")
    partial = ", opened before every case had an answer" if r.partial else ""
    label = "  (SIMULATED plants)" if cases["simulated"].any() else ""
    console.out.print(f"proof of {count(r.cases, 'case')}, suite {r.suite}{partial}{label}", style="bold")
    console.line(f"root     {r.root}")
    console.line(f"right    {int(cases['right'].sum())} of {len(cases)} answers as a whole")
    for what, cases_of in (("void", r.void), ("failed", r.failed)):
        if cases_of:
            first, why = next(iter(cases_of.items()))
            console.line(f"{what:8} {count(len(cases_of), 'case')}; {first}: {why}")
    goals = r.table("goals")
    console.out.print(_goals(goals[goals["plant"] == "all"]))
    if len(r.table("leak")):
        console.out.print(_leak(r.table("leak")))
    for path in outcome.files.values():
        console.line(path)


def _goals(goals: pd.DataFrame) -> Table:
    columns = ("measure", "goal", "measured", "90 %", "n", "met")
    table = console.table("goals", *columns, left=columns[:1], wrap=columns)
    for g in goals.astype(object).where(goals.notna(), None).to_dict("records"):
        measured = NOTHING if g["value"] is None else f"{g['value']:.3g}"
        interval = "" if g["low90"] is None else f"{g['low90']:.3g} … {g['high90']:.3g}"
        met = "" if g["met"] is None else "yes" if g["met"] else "no"
        table.add_row(str(g["measure"]), str(g["goal"]), measured, interval, str(g["n"]), met)
    return table


def _leak(leak: pd.DataFrame) -> Table:
    columns = ("question", "area", "90 %", "chance", "p", "cases")
    title = "leak test: names, sizes and inputs alone (chance: the range that permuted answers reach)"
    table = console.table(title, *columns, left=columns[:1], wrap=columns)
    for row in leak.to_dict("records"):
        interval = f"{row['low90']:.2f} … {row['high90']:.2f}"
        shown = (f"{row['auc']:.2f}", interval, f"{row['chance']:.2f}", f"{row['p']:.2f}", str(row["n"]))
        table.add_row(str(row["question"]), *shown)
    return table


app = typer.Typer(help="Examine the diagnosis in public, on recordings in which the effect is concealed.")

Cases = Annotated[int, typer.Option(help="how many cases")]
Out = Annotated[Path | None, typer.Option("--out", help="folder of the proof; one that was begun continues")]
Plants = Annotated[str, typer.Option(help=f"plants, comma separated: {', '.join(PLANT_KINDS)}")]
Which = Annotated[str, typer.Option("--suite", help="sealed: from a secret; development: from a known seed")]
Data = Annotated[Path | None, typer.Option("--data", help="folder of real recordings, for grafted and withheld")]
Seed = Annotated[int | None, typer.Option(help="of a development suite; default: drawn, and printed")]
Limit = Annotated[float, typer.Option(help="seconds that a diagnosis may take")]
Ablated = Annotated[int | None, typer.Option(help="ablations for the first N cases alone; default: for all")]
Deals = Annotated[int, typer.Option(help="permutations of the leak test; 0: no leak test")]
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
    ablated: Ablated = None,
    deals: Deals = 100,
    as_json: Json = False,
) -> None:
    """Examine the diagnosis on concealed effects: seal, run and open in one go, or step by step."""
    if find_spec("skfem") is None:
        raise InputError("prove: package scikit-fem is not installed; run pip install 'thermodrift-exam[proof]'")
    if context.invoked_subcommand is not None:
        return
    from thermodrift_exam.proof.proving import prove as prove_all

    request = _request(cases, to, plants, suite, seed, data)
    with console.progress(as_json) as (say, done):
        outcome = prove_all(request, processes(workers), _examinee(limit, ablated), _deals(deals), say, done)
    if as_json:
        console.print_json(proof_dict(outcome))
    else:
        print_proof(outcome)


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
    """Draw and build the cases, encrypt the answers, and print the root hash that commits to all of it."""
    from thermodrift_exam.proof.proving import seal_proof

    request = _request(cases, to, plants, suite, seed, data)
    with console.progress(as_json) as (_, done):
        root = seal_proof(request, processes(workers), done)
    if as_json:
        console.print_json({"root": root, "out": request.out, "suite": suite})
    else:
        console.line(f"root     {root}")
        console.line(f"{request.out}: sealed, suite {suite}; publish the root, then call")
        console.line(f"         thermodrift prove run {request.out}")


@app.command()
def run(
    proof: Proof,
    workers: Workers = None,
    limit: Limit = 300.0,
    ablated: Ablated = None,
    restart: Annotated[
        bool, typer.Option("--restart", help="drop the answers of another source version; the ledger records it")
    ] = False,
    until: Annotated[
        datetime | None,
        typer.Option(formats=["%Y-%m-%dT%H:%MZ"], help="UTC time after which no case begins; the same in every run"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Diagnose every case in an isolated process; existing answers stay."""
    from thermodrift_exam.proof.proving import run_proof

    with console.progress(as_json) as (_, done):
        end = None if until is None else until.replace(tzinfo=UTC)
        outcome = run_proof(proof, processes(workers), restart, _examinee(limit, ablated), done, end)
    if as_json:
        console.print_json(asdict(outcome))
        return
    console.line(
        f"{proof}: {outcome.cases} cases, {outcome.before} answered before, {outcome.answered} now; "
        f"{outcome.interrupted} had been interrupted, {outcome.void} void"
    )
    console.line(f"         thermodrift prove open {proof}")


@app.command("open")
def open_(
    proof: Proof,
    partial: Annotated[bool, typer.Option("--partial", help="also when cases have no answer; they stay void")] = False,
    publish: Annotated[
        Path | None, typer.Option(help="page whose block of results is replaced, as exam/results/proof.md")
    ] = None,
    workers: Workers = None,
    deals: Deals = 100,
    as_json: Json = False,
) -> None:
    """Check seal, ledger and answers, reveal the key, score, and write tables and page."""
    from thermodrift_exam.proof.proving import open_proof

    with console.progress(as_json) as (say, done):
        outcome = open_proof(proof, processes(workers), partial, _deals(deals), say, done)
    if publish is not None:
        from thermodrift_exam.proof.report.markdown import publish_proof

        publish_proof(publish, outcome.run)
    if as_json:
        console.print_json(proof_dict(outcome))
    else:
        print_proof(outcome)


def _request(cases: int, to: Path | None, plants: str, suite: str, seed: int | None, data: Path | None) -> ProofRequest:
    from thermodrift_exam.proof.proving import SUITES, ProofRequest, check_plants

    if cases < 1:
        raise InputError(f"--cases: got {cases}, expected 1 or more")
    if to is None:
        raise InputError("prove: got no folder for the proof; give --out PROOF")
    if seed is not None and seed < 0:
        raise InputError(f"--seed: got {seed}, expected 0 or more")
    which = one_of(suite, SUITES, "--suite")
    return ProofRequest(to, cases, which, check_plants(split(plants)), seed, data)


def _examinee(limit_s: float, ablated: int | None) -> Examinee:
    from thermodrift_exam.proof.proving import examinee

    if not limit_s > 0:
        raise InputError(f"--limit: got {limit_s:g}, expected more than 0 seconds")
    if ablated is not None and ablated < 0:
        raise InputError(f"--ablated: got {ablated}, expected 0 or more")
    return examinee(limit_s, ablated)


def _deals(deals: int) -> int:
    if deals < 0:
        raise InputError(f"--deals: got {deals}, expected 0 or more")
    return deals
