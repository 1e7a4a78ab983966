"""`thermodrift schedule`: retraining of a fleet, or of one machine, when it is due."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from data.errors import InputError
from pipelines import console

CRON = "0 5 * * 1"


def schedule(
    fleet: Annotated[Path | None, typer.Argument(help="fleet file: machines, folders, when")] = None,
    machine: Annotated[Path | None, typer.Option(help="one machine file, instead of a fleet file")] = None,
    recordings: Annotated[list[Path] | None, typer.Option(help="folders that its new recordings arrive in")] = None,
    cron: Annotated[str | None, typer.Option(help=f"when to retrain it, as cron; default: '{CRON}'")] = None,
    check: Annotated[bool, typer.Option("--check", help="check the fleet and its machine files, and end")] = False,
) -> None:
    """Retrain machines when they are due: new batches are ingested and learned; runs until interrupted."""
    from pipelines.fleet.fleet_file import Fleet, load_fleet, of_one
    from pipelines.fleet.service import checked, local_timezone, serve_fleet
    from pipelines.home import home

    served: Fleet
    if fleet is not None:
        if machine is not None or recordings or cron is not None:
            raise InputError(f"{fleet}: got --machine, --recordings or --cron too; a fleet file has its own")
        served = load_fleet(fleet, local_timezone())
    else:
        if machine is None or not recordings:
            raise InputError("expected a fleet file, or --machine and --recordings")
        missing = [str(p) for p in recordings if not p.exists()]
        if missing:
            raise InputError(f"--recordings {', '.join(missing)}: no such file or folder; give existing ones")
        served = of_one(machine, recordings, cron or CRON, local_timezone())
    if check:
        served, _ = checked(served, console.note)
        console.line(f"{served.source}: {len(served.machines)} machine{'s' * (len(served.machines) > 1)}, no mistake")
        return
    serve_fleet(served, home(), console.line)
