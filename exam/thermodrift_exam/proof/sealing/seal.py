"""Sealing: cases without keys, keys in a vault, and the root to publish before any case is answered."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

from data.errors import InputError
from data.processes import Processes
from thermodrift_exam.proof.sealing.folder import (
    ProofFolder,
    canonical,
    digest_of,
    folder_digest,
    now,
    salted_digest,
    source_digest,
    write_json,
)

SCHEMA = "thermodrift.proof_commitment/1"
SALT_BYTES = 32
Done = Callable[[str, int, int], None]


class Spec(Protocol):
    """The specification of a case; its name reveals nothing about it."""

    @property
    def name(self) -> str: ...


Make = Callable[[Any, Path], dict[str, Any]]
"""Builds a case: writes machine file and recordings into the folder and returns the key."""


@dataclass(frozen=True)
class Suite:
    """The input of a seal: name, specs, and the secret that they are drawn from (a known number for development)."""

    name: str
    specs: Sequence[Spec]
    seed: str
    secret: bool


def seal(folder: ProofFolder, suite: Suite, make: Make, workers: int = 1, done: Done | None = None) -> str:
    """Build and seal a suite; returns the root, which commits to every case and answer and can be published.

    An interrupted seal starts again. `make` is a function of a module where there are several `workers`.

    Raises:
        InputError: the folder holds a sealed proof, or something else; no case; a name twice.
        WorkError: it cannot be written.
    """
    names = [s.name for s in suite.specs]
    if not names or len(set(names)) < len(names):
        raise InputError(f"proof: got {len(names)} cases with {len(set(names))} names; expected one name a case")
    with folder.locked():
        if folder.is_sealed:
            raise InputError(f"{folder.path}: holds a sealed proof already; run it, or give another --out")
        _clean(folder)
        for path in (folder.cases, folder.answers, folder.vault):
            path.mkdir()
        folder.vault.chmod(0o700)
        kept = {"seed": suite.seed, "salt": secrets.token_hex(SALT_BYTES)}
        _lock_away(folder.vault / "suite.json", kept)
        leaves: dict[str, dict[str, str]] = {}
        for name, answer in _made(suite.specs, make, folder.cases, workers):
            salt = secrets.token_hex(SALT_BYTES)
            _lock_away(folder.vault / f"{name}.json", {"salt": salt, "answer": answer})
            leaves[name] = {"answer": salted_digest(salt, answer), "case": folder_digest(folder.cases / name)}
            if done is not None:
                done("seal", len(leaves), len(names))
        commitment = {
            "schema": SCHEMA, "suite": suite.name, "number": len(names), "sealed": now(),
            "version": version("thermodrift"), "source_digest": source_digest(),
            "suite_seed": salted_digest(kept["salt"], suite.seed) if suite.secret else suite.seed,
            "cases": dict(sorted(leaves.items())),
        }  # fmt: skip
        root = digest_of(commitment)
        write_json(folder.commitment, commitment | {"root": root})
        folder.ledger().add(
            "sealed", root=root, suite=suite.name, number=len(names), source=commitment["source_digest"]
        )
    return root


def _clean(folder: ProofFolder) -> None:
    """Files of an interrupted seal are removed; other files are not."""
    left = {folder.cases, folder.vault, folder.answers}
    strange = sorted(p.name for p in folder.path.iterdir() if p not in left and p.name != ".lock")
    if strange:
        raise InputError(f"{folder.path}: holds {strange[0]}, expected an empty folder; give another --out")
    for path in left:
        shutil.rmtree(path, ignore_errors=True)


def _made(specs: Sequence[Spec], make: Make, cases: Path, workers: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """Name and key of every written case, in the order of completion."""
    for spec in specs:
        (cases / spec.name).mkdir()
    with Processes(workers) as pool:
        yield from ((specs[k].name, key) for k, key in pool.completed(make, [(s, cases / s.name) for s in specs]))


def _lock_away(path: Path, value: Any) -> None:
    """Readable by the owner only, from its creation on."""
    canonical(value)  # only data that can be hashed again are sealed
    path.touch(mode=0o600)
    write_json(path, value)
    path.chmod(0o600)


def names_of(commitment: Any) -> Iterable[str]:
    """The cases of a commitment in the order of their names."""
    return sorted(commitment["cases"])
