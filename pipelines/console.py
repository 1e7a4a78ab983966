"""What commands print: tables and lines on standard output, progress and errors on standard error."""

from __future__ import annotations

import json
import math
import re
import sys
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from data.endings import ending
from pipelines.caller import Done, Say

if TYPE_CHECKING:
    import pandas as pd

out = Console(soft_wrap=True, emoji=False)
err = Console(stderr=True, soft_wrap=True, emoji=False)
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")  # all but tab and newline
MIN_WRAPPED = 12  # characters
WIDE = 120  # characters
PLAIN_EVERY_S = 30.0  # between two lines of progress in a log: a long night gives a thousand
MIN_FINISHED = 2  # items from which on an estimate is shown: the first may have waited for imports


def plain(text: object) -> str:
    """Without markup, and with what would steer a terminal or turn the text around spelt out."""
    return escape(_CONTROL.sub(lambda found: ascii(found[0])[1:-1], str(text)))


@contextmanager
def printing_to(file: TextIO) -> Iterator[None]:
    """Results go into a file, so wide that tables are whole."""
    global out
    screen, out = out, Console(file=file, width=WIDE, soft_wrap=True, emoji=False)
    try:
        yield
    finally:
        out = screen


def line(text: object) -> None:
    """One line of result, without markup."""
    out.print(plain(text), highlight=False)


def error(text: object) -> None:
    """The one line that a failed command ends with."""
    err.print(f"thermodrift: {plain(text)}", highlight=False)


def note(text: object) -> None:
    """One line for the user's attention on standard error, without markup."""
    err.print(plain(text), highlight=False)


class Pace:
    """Estimates the time that a step still needs from the times at which its items were finished.

    The remaining items are taken to come as fast as the later half of the finished ones did: where the slow ones go
    first, the early ones say too much.
    """

    def __init__(self, now_s: float) -> None:
        self._of, self._marks = 0, [(0, now_s)]  # (finished, when)

    def left(self, n: int, of: int, now_s: float) -> str:
        """Note that `n` of `of` are finished; "about 3 min left", or empty where nothing is known yet."""
        last, when_s = self._marks[-1]
        if of != self._of or n < last:  # another step
            self._of, self._marks = of, [(0, when_s)]
        self._marks.append((n, now_s))
        if not MIN_FINISHED <= n < of:
            return ""
        then, then_s = max(mark for mark in self._marks if mark[0] <= n // 2)
        return f"about {_duration((of - n) * (now_s - then_s) / (n - then))} left"


def _duration(time_s: float) -> str:
    """Rounded up, since an estimate has one digit to give."""
    unit, size_s = next(((u, s) for u, s in (("h", 3600), ("min", 60)) if time_s > 1.5 * s), ("s", 1))
    return f"{math.ceil(time_s / size_s) if size_s > 1 else 10 * max(1, math.ceil(time_s / 10))} {unit}"


@contextmanager
def progress(quiet: bool) -> Iterator[tuple[Say, Done]]:
    """A line per step; below, on a terminal, a bar with what was finished last and an estimate of the time left.

    Where standard error is no terminal, a line every `PLAIN_EVERY_S` takes the bar's place.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(30), MofNCompleteColumn(), TimeElapsedColumn(),
               TextColumn("{task.fields[left]}"))  # fmt: skip
    pace, printed_s = Pace(time.monotonic()), time.monotonic()
    with Progress(*columns, console=err, transient=True, disable=quiet or not err.is_terminal) as bar, ending(bar.stop):
        current = bar.add_task("starting", total=None, left="")

        def say(text: str) -> None:
            nonlocal pace, printed_s
            pace, printed_s = Pace(time.monotonic()), time.monotonic()
            if not quiet:
                err.print(plain(text), highlight=False)
            bar.reset(current, description=plain(text), total=None, left="")

        def done(step: str, n: int, of: int) -> None:
            nonlocal printed_s
            now_s = time.monotonic()
            left = pace.left(n, of, now_s)
            bar.update(current, description=plain(step), completed=n, total=of, left=left)
            if not quiet and not err.is_terminal and of and now_s - printed_s > PLAIN_EVERY_S:
                printed_s = now_s
                err.print(plain(f"{step}: {n} of {of}" + f", {left}" * bool(left)), highlight=False)

        yield say, done


def print_json(value: Any) -> None:
    """Strict JSON: a number that is not finite is null."""
    sys.stdout.write(json.dumps(_finite(value), indent=1, default=str, allow_nan=False) + "\n")


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Rows of a table as plain data."""
    rows: list[dict[str, Any]] = json.loads(frame.to_json(orient="records", date_format="iso"))
    return rows


def table(title: str, *columns: str, left: Collection[str] = (), wrap: Collection[str] = ()) -> Table:
    """An empty table; columns are aligned right except those in `left`, and on one line except those in `wrap`;
    of these the ones in `left` keep a width in which words can be read."""
    made = Table(
        title=title or None, box=SIMPLE_HEAD, title_justify="left", pad_edge=False, show_edge=False,
        padding=(0, 1, 0, 0),
    )  # fmt: skip
    for name in columns:
        made.add_column(
            name, justify="left" if name in left else "right", no_wrap=name not in wrap,
            overflow="fold" if name in wrap else "ellipsis",
            min_width=MIN_WRAPPED if name in wrap and name in left else None,
        )  # fmt: skip
    return made


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
