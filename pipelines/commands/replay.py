"""`thermodrift replay`: a year of recordings arrives run by run, and the models that a schedule would have promoted."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from data.errors import one_of
from pipelines import console
from pipelines.caller import Done, Say
from pipelines.options import Json, MachineFile, split

if TYPE_CHECKING:
    from models.selection.replay import Replay, Retraining, Score
    from pipelines.jobs.replay import ReplayRequest


def print_replay(r: Replay) -> None:
    """One line per training, and what the champions were worth over the year."""
    for reason in r.left_out:
        console.line(f"left out: {reason}")
    console.line(r.account["summary"])
    for t in r.targets:
        console.line(f"{r.machine} {t}{'  (simulated recordings)' if r.simulated else ''}")
        for g in r.retrainings_of(t):
            console.line(f"  {training_line(g, r.score(t, g.number))}")
        s = r.score(t)
        console.line(f"  {worth(r, t)}" if s.n else "  no run was predicted by a champion")


def training_line(g: Retraining, s: Score) -> str:
    """A training, its champion, and the runs that followed."""
    champion = "no champion" if g.after is None else f"champion {g.after}"
    expected = f"expects {g.expected_S_um:.2f}, 90 % below {g.bound90_S_um:.2f} µm"
    followed = (
        f"then {s.n} runs: S {s.S_um:.2f} µm, first champion {s.frozen_S_um:.2f}, no model {s.none_S_um:.2f}"
        if s.n else "no run with a champion follows"
    )  # fmt: skip
    return f"{g.number} {g.date[:10]} {g.n_batches} runs: {g.outcome}, {champion}, {expected}; {followed}"


def worth(r: Replay, target: str) -> str:
    """The year in one sentence."""
    s = r.score(target)
    frozen, none = s.against_frozen, s.against_none
    return (
        f"{s.n} runs: S {s.S_um:.2f} µm with the champion of the day, {s.frozen_S_um:.2f} with the first champion "
        f"({frozen.difference_um:+.2f} ± {frozen.se_um:.2f} paired; another champion on {s.retrained} runs), "
        f"{s.none_S_um:.2f} without a model ({none.difference_um:+.2f} ± {none.se_um:.2f}); "
        f"below the 90 % bound: {s.covered} of {s.bounded} runs, below the champion's stated one {s.covered_stated} "
        f"of {s.bounded_stated}"
    )


def write_replay_files(r: Replay, out: Path) -> tuple[Path, Path]:
    """OUT/replay.json and OUT/replay.html."""
    from data.files import write_atomic
    from reports.replay import write_replay

    write_atomic(out / "replay.json", console.json_text(r.as_dict()))
    write_replay(out / "replay.html", r)
    return out / "replay.json", out / "replay.html"


def replay_year(request: ReplayRequest, say: Say, done: Done) -> Replay:
    """Replay and write its files; nothing is written elsewhere, so the home's environment is not configured."""
    from pipelines import settings
    from pipelines.caller import DirectCaller
    from pipelines.jobs.replay import replay

    result = replay(request, settings.load(), DirectCaller(), say, done)
    write_replay_files(result, request.out)
    return result


def replay(
    machine: MachineFile,
    recordings: Annotated[list[Path], typer.Option(help="files or folders with the year's recordings")],
    out: Annotated[Path, typer.Option("--out", help="folder of the replay: its own lake, models, replay.html")],
    disturb: Annotated[
        int | None, typer.Option(help="seed: some runs come late, twice, out of order, or faulty at first")
    ] = None,
    channels: Annotated[str, typer.Option(help="error channels to learn, between commas; default: all")] = "",
    effort: Annotated[str, typer.Option(help="how much to cross: quick, usual or complete")] = "quick",
    start: Annotated[int, typer.Option(help="runs of the first training")] = 8,
    every: Annotated[int, typer.Option(help="new runs from one training to the next")] = 4,
    as_json: Json = False,
) -> None:
    """Let a year of recordings arrive run by run: retrain, promote, and predict each run before it is learned.

    Shows what each retraining was worth against a model that is never retrained and against none. The same command
    goes on where it was stopped.
    """
    from models.selection.crossing import FINALISTS, Plan
    from pipelines.jobs.replay import ReplayRequest

    plan = Plan(effort=one_of(effort, FINALISTS, "--effort"))
    request = ReplayRequest(machine, tuple(recordings), out, split(channels), plan, start, every, disturb)
    with console.progress(as_json) as (say, done):
        result = replay_year(request, say, done)
    if as_json:
        console.print_json(result.as_dict())
        return
    print_replay(result)
    console.line(f"page     {out / 'replay.html'}")
