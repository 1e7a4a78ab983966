"""`thermodrift demonstrate`: a sealed demonstration of the diagnosis on simulated runs."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import InputError
from pipelines import console
from pipelines.options import Json

if TYPE_CHECKING:
    from thermodrift_exam.proof.demonstrating import Demonstration


def demonstration_dict(d: Demonstration) -> dict[str, Any]:
    """The demonstration for other programs; everything in it is simulated."""
    return {
        "simulated": True, "seed": d.seed, "outcome": d.judgement.outcome, "right": d.judgement.right,
        "sealed": {"digest": d.seal.digest, "case": d.seal.case_digest, "at": d.seal.at},
        "concealed": dict(d.answer), "diagnosis": d.diagnosis.findings.model_dump(mode="json", by_alias=True),
        "isolation": d.isolation, "out": str(d.out), "files": {name: str(path) for name, path in d.files.items()},
    }  # fmt: skip


FIXED_SEED = 1  # everybody sees the same demonstration; the documentation has a table of others


def seed_of(given: str) -> int:
    """The seed that was given: a number, or "today" for today's date as YYYYMMDD.

    Raises:
        InputError: anything else.
    """
    if given == "today":
        return int(f"{date.today():%Y%m%d}")
    if not given.isdecimal():
        raise InputError(f'--seed: got {given!r}, expected a whole number from 0, or "today"')
    return int(given)


def demonstrate(
    seed: Annotated[str, typer.Option(help='draws what is concealed; "today" is today\'s date')] = str(FIXED_SEED),
    to: Annotated[Path | None, typer.Option("--out", help="folder of the page; default: var/demonstration")] = None,
    as_json: Json = False,
) -> None:
    """Conceal an effect in simulated runs, seal it, diagnose without the answer, and open the seal."""
    from pipelines.settings import home
    from thermodrift_exam.proof.demonstrating import REPORT
    from thermodrift_exam.proof.demonstrating import demonstrate as work

    def say(text: str) -> None:
        if not as_json:
            console.line(text)

    with console.progress(as_json) as (_, done):
        d = work(seed_of(seed), to or home() / "demonstration", say, done)
    if as_json:
        console.print_json(demonstration_dict(d))
    else:
        console.line(f"page       {d.files[REPORT]}")
