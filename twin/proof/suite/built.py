"""A case as it is handed out: what a diagnosis sees, on disk or in memory, and the answer that it does not see."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data.atomic_file import write_atomic
from data.batch import Batch
from data.machine import Machine
from data.recording import read_batches
from twin.plants.write import machine_text


@dataclass(frozen=True)
class Built:
    """The machine, its recordings as CSV texts by file name, and the answer key."""

    machine: Machine
    recordings: Mapping[str, str]
    answer: dict[str, Any]


def write_built(built: Built, folder: Path) -> None:
    """`machine.yml` and `recordings/*.csv` below a folder, and nothing else."""
    recordings = folder / "recordings"
    recordings.mkdir(parents=True, exist_ok=True)
    write_atomic(folder / "machine.yml", machine_text(built.machine))
    for name, text in built.recordings.items():
        write_atomic(recordings / name, text)


def batches_of(built: Built) -> list[Batch]:
    """The recordings as a reader makes batches of them, by name."""
    with tempfile.TemporaryDirectory() as place:
        write_built(built, Path(place))
        files = sorted((Path(place) / "recordings").iterdir())
        return [batch for file in files for batch in read_batches(file, built.machine)]
