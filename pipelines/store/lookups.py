"""Models of the registry by name without MLflow, whose import alone takes longer than a prediction.

The answers of the registry are kept below the home, and hold as long as the files of a SQLite store are the same. Of a
store on a server, which may change unseen, and of models whose files are elsewhere, nothing is kept.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from data.errors import InputError, closest
from data.files import from_json, write_atomic
from pipelines.store.audit import CHAMPION, PROVISIONAL

if TYPE_CHECKING:
    from pipelines.settings import Settings

_FILE = "registry.json"
_SCHEMA = "thermodrift.registry/1"


@dataclass(frozen=True)
class Place:
    """The folder of a version's files, and the sha256 that the registry has of them."""

    folder: str
    sha256: str


@dataclass(frozen=True)
class Registry:
    """All registered models with their aliases, and the versions of them that were looked up, by NAME/VERSION.

    `made_from` has the folder of all models and the `stats` of the store's files; None where nothing is kept.
    """

    made_from: Mapping[str, Any] | None
    aliases: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    places: Mapping[str, Place] = field(default_factory=dict)

    def place(self, name: str, which: str) -> Place | None:
        """Where a version's files are, by number or alias (empty: `which_of`); None where that is not known.

        Raises:
            InputError: unknown name, with the closest.
        """
        if not self.aliases:
            return None
        if name not in self.aliases:
            raise unknown_model(name, self.aliases)
        which = which_of(self.aliases[name], which)
        return self.places.get(f"{name}/{self.aliases[name].get(which, which)}")


def kept(settings: Settings) -> Registry:
    """What is known without MLflow; call it before the registry is read, since it states the files of the store."""
    made_from = _made_from(settings)
    try:
        found = from_json((settings.home / _FILE).read_text(encoding="utf-8"))
        if made_from is not None and (found["schema"], found["made_from"]) == (_SCHEMA, made_from):
            return Registry(made_from, found["aliases"], {k: Place(**p) for k, p in found["places"].items()})
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass  # none yet, or another program's
    return Registry(made_from)


def keep(known: Registry, aliases: Mapping[str, Mapping[str, str]], found: Mapping[str, Place], home: Path) -> None:
    """Add versions (NAME/VERSION) to what was `kept` before the registry was read."""
    if known.made_from is None:
        return
    here = {v: p for v, p in found.items() if Path(p.folder).is_relative_to(known.made_from["artifacts"])}
    if not here:
        return
    places = {**known.places, **here}
    content = {
        "schema": _SCHEMA, "made_from": known.made_from, "aliases": {k: dict(v) for k, v in aliases.items()},
        "places": {k: vars(p) for k, p in places.items()},
    }  # fmt: skip
    with suppress(OSError):  # a home that cannot be written is looked up anew each time
        write_atomic(home / _FILE, json.dumps(content, ensure_ascii=False))


def which_of(aliases: Mapping[str, object], which: str) -> str:
    """The alias or version that is meant; a name alone (empty) means the champion, without one the provisional."""
    return which or (PROVISIONAL if PROVISIONAL in aliases and CHAMPION not in aliases else CHAMPION)


def unknown_model(name: str, names: Iterable[str]) -> InputError:
    """No registered model has this name."""
    known = list(names)
    hint = closest(name, known) if known else "the registry is empty; train first"
    return InputError(f"unknown model {name!r}; {hint}")


def stats(files: Iterable[Path]) -> dict[str, list[int] | None]:
    """Size and time of change of files, None where one is not there."""
    found: dict[str, list[int] | None] = {}
    for file in files:
        try:
            seen = file.stat()
            found[str(file)] = [seen.st_size, seen.st_mtime_ns]
        except OSError:
            found[str(file)] = None
    return found


def store_files(file: Path) -> list[Path]:
    """The files that change with a SQLite store."""
    return [file, Path(f"{file}-wal")]


def _made_from(settings: Settings) -> dict[str, Any] | None:
    artifacts = urlsplit(settings.artifacts_uri or "")
    if settings.store_file is None or artifacts.scheme != "file":
        return None
    return {"artifacts": unquote(artifacts.path), "files": stats(store_files(settings.store_file))}
