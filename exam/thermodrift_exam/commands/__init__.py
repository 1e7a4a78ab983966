"""The commands that this distribution adds to `thermodrift`."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from data.errors import InputError

Workers = Annotated[int | None, typer.Option(help="processes; default: one per core")]


def processes(workers: int | None) -> int:
    """The number of processes; one per core by default.

    Raises:
        InputError: fewer than one.
    """
    if workers is not None and workers < 1:
        raise InputError(f"--workers: got {workers}, expected 1 or more")
    return workers or os.cpu_count() or 1
