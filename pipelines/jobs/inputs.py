"""What a diagnosis was made from: the machine file's text and the recordings, so that it can be continued.

`inputs.json` lies next to the findings. Recordings are named by id and content digest: the lake holds them, and what is
withdrawn or purged there is not used again.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from data.batch import Batch
from data.errors import InputError
from data.files import from_json

INPUTS = "inputs.json"
SCHEMA = "thermodrift.diagnosis_inputs/1"


@dataclass(frozen=True)
class Recorded:
    """One recording: its id in the lake, the digest of its content there, and the file that it came from."""

    batch_id: str
    digest: str
    source: str


@dataclass(frozen=True)
class Inputs:
    """`machine_text` is the machine file as it was diagnosed, `machine_file` its name, `seed` that of the draws."""

    machine: str
    machine_file: str
    machine_text: str
    seed: int
    recordings: tuple[Recorded, ...]

    @classmethod
    def of(cls, machine: str, file: Path, text: str, seed: int, batches: Sequence[Batch]) -> Inputs:
        """Of a diagnosis of these batches."""
        recordings = tuple(Recorded(b.batch_id, b.digest, Path(b.source).name) for b in batches)
        return cls(machine, file.name, text, seed, recordings)

    @property
    def text(self) -> str:
        """The file."""
        return json.dumps({"schema": SCHEMA, **asdict(self)}, ensure_ascii=False, indent=1) + "\n"


def read_inputs(folder: Path) -> Inputs:
    """The inputs of the diagnosis in a folder.

    Raises:
        InputError: no such folder, no diagnosis in it, or one whose inputs cannot be read.
    """
    given = f"--continue {folder}"
    if not folder.is_dir():
        raise InputError(f"{given}: no such folder; give the folder of an earlier diagnosis")
    if not (folder / "findings.json").is_file():
        raise InputError(f"{given}: holds no findings.json, so no diagnosis; give the --out of an earlier one")
    path = folder / INPUTS
    if not path.is_file():
        raise InputError(
            f"{given}: has no {INPUTS}, which names its recordings; repeat it by `thermodrift diagnose --overwrite`"
        )
    try:
        raw = from_json(path.read_text(encoding="utf-8"))
        if raw.pop("schema") != SCHEMA:
            raise ValueError(f"the schema is not {SCHEMA}")
        return Inputs(**{**raw, "recordings": tuple(Recorded(**r) for r in raw["recordings"])})
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        said = " ".join(str(error).split())
        raise InputError(
            f"{path}: cannot be read ({said}); repeat the diagnosis by `thermodrift diagnose --overwrite`"
        ) from None
