"""The folder of a proof: where everything in it lies, and only one who works on it at a time."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from data.atomic_file import write_atomic
from data.errors import InputError, WorkError
from twin.proof.sealing.isolation import allowed
from twin.proof.sealing.ledger import Ledger


@dataclass(frozen=True)
class ProofFolder:
    """PROOF: `cases` are all that an answering process gets of, `vault` holds the answers, `answers` what was said."""

    path: Path

    @property
    def commitment(self) -> Path:
        return self.path / "commitment.json"

    @property
    def cases(self) -> Path:
        return self.path / "cases"

    @property
    def vault(self) -> Path:
        return self.path / "vault"

    @property
    def answers(self) -> Path:
        return self.path / "answers"

    @property
    def opened(self) -> Path:
        return self.path / "opened.json"

    @property
    def is_sealed(self) -> bool:
        return self.commitment.exists()

    def ledger(self) -> Ledger:
        """The ledger, its chain checked."""
        return Ledger(self.path / "ledger.jsonl")

    def committed(self) -> dict[str, Any]:
        """What `commitment.json` says.

        Raises:
            InputError: there is none, or it cannot be read.
        """
        if not self.is_sealed:
            raise InputError(f"{self.path}: is no sealed proof; call `thermodrift prove seal --out {self.path}` first")
        return read_json(self.commitment)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Nobody else works on this proof meanwhile.

        Raises:
            InputError: somebody does, or an answering process could see into the folder.
            WorkError: it cannot be written.
        """
        if (seen := allowed().covers(self.path)) is not None:
            raise InputError(f"{self.path}: lies in {seen}, which answering processes may see; give another folder")
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            with FileLock(self.path / ".lock", timeout=0):
                yield
        except Timeout:
            raise InputError(f"{self.path}: another process works on this proof; wait for its end") from None
        except OSError as error:
            raise WorkError(f"{self.path}: cannot be written ({error}); give another folder") from None


def read_json(path: Path) -> Any:
    """Plain data from a file of the proof.

    Raises:
        InputError: it cannot be read, or is not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); this proof is incomplete, seal a new one") from None


def write_json(path: Path, value: Any) -> None:
    """Plain data into a file of the proof, in one step."""
    write_atomic(path, json.dumps(value, ensure_ascii=False, allow_nan=False, indent=1) + "\n")
