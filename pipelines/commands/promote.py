"""`thermodrift promote` and `thermodrift rollback`: which version of a model is the champion."""

from __future__ import annotations

from typing import Annotated

import typer

from pipelines import console
from pipelines.options import MachineFile


def promote(
    training: Annotated[str, typer.Argument(help="training id, as `thermodrift status` lists it")],
    machine: MachineFile,
    cell: Annotated[str, typer.Option(help="selector|family|n_tsp; default: by the rule in mlflow.yml")] = "",
    force: Annotated[bool, typer.Option("--force", help="replace the champion though it is not beaten")] = False,
) -> None:
    """Promote a cell of a tracked training: refit on its batches, register, compare with the champion."""
    from pipelines import settings

    settings.configure_environment()
    from pipelines.training import promote_tracked

    console.line(promote_tracked(training, machine, cell, force, settings.load()).summary)


def rollback(
    model: Annotated[str, typer.Argument(help="registered model, MACHINE-CHANNEL")],
    reason: Annotated[str, typer.Option("--reason", help="why; `thermodrift registry MODEL` shows it")] = "",
    of: Annotated[
        int | None, typer.Option("--of", help="the version to roll back; where it is not champion, nothing changes")
    ] = None,
) -> None:
    """Make the champion before the present one the champion again; what was rolled back is not returned to."""
    from pipelines import settings

    settings.configure_environment()
    from pipelines import registry

    console.line(registry.rollback(model, settings.load(), reason, of).summary)
