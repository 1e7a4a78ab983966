"""The command line, related commands in one file: request and outcome, the work, what is printed, the typer function.

`thermodrift --help` loads these modules, so they import what is heavy inside the functions that need it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipelines.settings import Settings


def load_settings() -> Settings:
    """The settings; before, the environment from which mlflow and prefect are configured when they are imported."""
    from pipelines.settings import configure_environment, load

    configure_environment()
    return load()
