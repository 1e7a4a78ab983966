"""What commands print: tables and lines on standard output, progress and errors on standard error."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipelines.caller import Done, Say

if TYPE_CHECKING:
    import pandas as pd

out = Console(soft_wrap=True)
err = Console(stderr=True, soft_wrap=True)


def line(text: object) -> None:
    """One line of result, without markup."""
    out.print(escape(str(text)), highlight=False)


def error(text: object) -> None:
    """The one line that a failed command ends with."""
    err.print(f"thermodrift: {escape(str(text))}", highlight=False)


@contextmanager
def progress(quiet: bool) -> Iterator[tuple[Say, Done]]:
    """One live line with the present step and its progress; plain lines where standard error is no terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(30), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=err, transient=True, disable=quiet or not err.is_terminal) as bar:
        current = bar.add_task("starting", total=None)

        def say(text: str) -> None:
            if not quiet and not err.is_terminal:
                err.print(escape(text), highlight=False)
            bar.reset(current, description=escape(text), total=None)

        def done(step: str, n: int, of: int) -> None:
            bar.update(current, description=escape(step), completed=n, total=of)

        yield say, done


def print_json(value: Any) -> None:
    """Strict JSON: a number that is not finite is null."""
    sys.stdout.write(json.dumps(_finite(value), indent=1, default=str, allow_nan=False) + "\n")


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of a table as plain data."""
    rows: list[dict[str, Any]] = json.loads(frame.to_json(orient="records", date_format="iso"))
    return rows


def table(title: str, *columns: str, left: Collection[str] = (), wrap: Collection[str] = ()) -> Table:
    """An empty table; columns are aligned right except those in `left`, and on one line except those in `wrap`."""
    made = Table(title=title or None, box=SIMPLE_HEAD, title_justify="left", pad_edge=False, show_edge=False)
    for name in columns:
        made.add_column(
            name, justify="left" if name in left else "right", no_wrap=name not in wrap,
            overflow="fold" if name in wrap else "ellipsis",
        )  # fmt: skip
    return made


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
