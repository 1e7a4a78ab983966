"""`thermodrift schedule`: retraining on a cron schedule."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipelines import console
from pipelines.options import MachineFile


def schedule(
    machine: MachineFile,
    recordings: Annotated[list[Path], typer.Option(help="folders that new recordings arrive in")],
    cron: Annotated[str, typer.Option(help="when to retrain, as cron")] = "0 5 * * 1",
) -> None:
    """Serve retraining on a schedule: new batches are ingested and learned; runs until interrupted."""
    from pipelines import settings

    settings.configure_environment()
    from data.machine import load_machine
    from pipelines.recordings import check_recordings
    from pipelines.scheduling import serve_schedule

    load_machine(machine)
    check_recordings(recordings)
    settings.load()
    serve_schedule(machine, recordings, cron, say=console.line)
