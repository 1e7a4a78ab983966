"""Watched folders: which machines have new recordings, and whether they are complete."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

from watchfiles import watch

from pipelines.caller import Say
from pipelines.fleet.fleet_file import Fleet

LOOK_AGAIN_S = 30.0  # for folders that were not there


class Folders:
    """Notes when files below the folders of watched machines change, in a thread."""

    def __init__(self, fleet: Fleet, say: Say) -> None:
        self._say = say
        self._of: dict[Path, list[str]] = {}  # two machines may record into one folder
        for m in (m for m in fleet.machines if m.when.watch):
            for r in m.recordings:
                self._of.setdefault(Path(r), []).append(m.name)
        self._quiet = {m.name: timedelta(minutes=m.when.quiet_min) for m in fleet.machines if m.when.watch}
        # What arrived while nobody watched is looked for at once.
        never = datetime.fromtimestamp(0, UTC)
        self._changed = dict.fromkeys(self._quiet, (never, never))  # first and last change since the machine's run
        self._lock = threading.Lock()
        self._stop = threading.Event()

    @contextmanager
    def watching(self) -> Iterator[None]:
        """The thread runs in the context."""
        thread = threading.Thread(target=self._watch, name="folders", daemon=True)
        if self._of:
            thread.start()
        try:
            yield
        finally:
            self._stop.set()
            if self._of:
                thread.join(5.0)

    def touch(self, name: str, when: datetime) -> None:
        """A machine's folders changed."""
        with self._lock:
            self._changed[name] = (self._changed.get(name, (when, when))[0], when)

    def settled(self, now: datetime) -> dict[str, datetime]:
        """Machines whose folders have changed, and not for their quiet time; since when they have new files."""
        with self._lock:
            return {name: first for name, (first, last) in self._changed.items() if now - last >= self._quiet[name]}

    def taken(self, name: str) -> None:
        """A run of the machine begins: it takes what is there now."""
        with self._lock:
            self._changed.pop(name, None)

    def _watch(self) -> None:
        while not self._stop.is_set():
            there = {p for p in self._of if p.exists()}
            try:
                if not there:
                    self._stop.wait(LOOK_AGAIN_S)
                    continue
                self._watch_these(there)
            except (OSError, RuntimeError) as error:  # a share went away, or the system's limit of watches is reached
                self._say(f"watched folders: {error}; trying again in {LOOK_AGAIN_S:g} s")
                self._stop.wait(LOOK_AGAIN_S)

    def _watch_these(self, there: set[Path]) -> None:
        """Returns where other folders are there than are watched."""
        looks_ms = round(1000 * LOOK_AGAIN_S)
        for changes in watch(*there, stop_event=self._stop, yield_on_timeout=True, rust_timeout=looks_ms,
                             raise_interrupt=False):  # fmt: skip
            now = datetime.now(UTC)
            for _, path in changes:
                for folder in self._of:
                    if folder == Path(path) or folder in Path(path).parents:
                        self._touch_all(folder, now)
            if {p for p in self._of if p.exists()} != there:
                for folder in set(self._of) - there:
                    if folder.exists():
                        self._touch_all(folder, now)
                return

    def _touch_all(self, folder: Path, when: datetime) -> None:
        for name in self._of[folder]:
            self.touch(name, when)
