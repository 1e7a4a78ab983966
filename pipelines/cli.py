"""The command line. Exit codes: 0 done, 1 the work failed, 2 bad arguments or input (one clear line), 130 and 143
stopped by Ctrl-C and SIGTERM."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable
from functools import cache
from importlib.metadata import entry_points
from typing import Annotated, Any

import typer

from data.errors import InputError, WorkError, place_of
from pipelines import console, stopping
from pipelines.commands.calibrate import calibrate
from pipelines.commands.compensate import compensate, export, rehearse
from pipelines.commands.describe import describe
from pipelines.commands.diagnose import diagnose
from pipelines.commands.ingest import ingest
from pipelines.commands.lake import app as lake
from pipelines.commands.predict import predict
from pipelines.commands.registry import promote, registry, rollback
from pipelines.commands.report import report
from pipelines.commands.schedule import schedule
from pipelines.commands.simulate import simulate
from pipelines.commands.status import status
from pipelines.commands.train import train
from pipelines.home import home

app = typer.Typer(
    name="thermodrift",
    help="Thermal error of machine tools: from a year of recordings to a promoted compensation model.",
    no_args_is_help=True,
    invoke_without_command=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
COMMANDS: tuple[Callable[..., None], ...] = (
    describe, ingest, train, report, promote, rollback, status, registry, predict, rehearse, compensate, export,
    schedule, simulate, calibrate, diagnose,
)  # fmt: skip
for command in COMMANDS:
    app.command()(command)


@app.callback()
def _options(
    version: Annotated[bool, typer.Option("--version", help="print the version", is_eager=True)] = False,
) -> None:
    if version:
        from importlib.metadata import version as installed

        console.line(f"thermodrift {installed('thermodrift')}")
        raise typer.Exit


app.add_typer(lake, name="lake")
for entry in entry_points(group="thermodrift.commands"):  # of other distributions that are installed
    try:
        found = entry.load()
    except ImportError as error:
        console.note(f"command {entry.name} of {entry.value}: cannot be loaded ({error}); install it again")
        continue
    if isinstance(found, typer.Typer):
        app.add_typer(found, name=entry.name)
    else:
        app.command(entry.name)(found)


_ROOM = "make room on the disk"
_RIGHTS = "make it writable or let THERMODRIFT_HOME name another folder"
_DISK = {
    errno.ENOSPC: _ROOM, errno.EDQUOT: _ROOM, errno.EFBIG: _ROOM, errno.EROFS: _RIGHTS, errno.EACCES: _RIGHTS,
    errno.EPERM: _RIGHTS,
}  # fmt: skip


@cache
def program() -> Any:
    """All commands with their options, for which every signature is read."""
    return typer.main.get_command(app)


def main() -> None:
    """Entry point: input errors are one line and exit code 2, failed work exit code 1, a stop 128 + signal."""
    try:
        with stopping.prompt():
            code = program()(standalone_mode=False)
        sys.exit(code if isinstance(code, int) else 0)
    except InputError as error:
        console.error(error)
        sys.exit(2)
    except WorkError as error:
        console.error(error)
        sys.exit(1)
    except (KeyboardInterrupt, typer.Abort):
        sys.exit(130)
    except OSError as error:
        if error.errno in _DISK:
            where = place_of(error, home())
            console.error(f"{where}: {error.strerror or error}; {_DISK[error.errno]}, then run the same command again")
            sys.exit(1)
        if error.errno != errno.ENAMETOOLONG:
            raise
        console.error(f"{str(error.filename)[:60]}…: the path is too long; give a shorter one")
        sys.exit(2)
    except Exception as error:
        # typer vendors click, so a usage error is recognised by its method instead of its class.
        if not hasattr(error, "format_message"):
            raise
        context = getattr(error, "ctx", None)
        command = f"thermodrift {context.info_name}" if context is not None and context.parent else "thermodrift"
        console.error(f"{error.format_message().rstrip('.')}; see `{command} --help`")
        sys.exit(2)


if __name__ == "__main__":
    main()
